"""How coarsely a movie's coder quantised a frame, as its decoder tells."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from av.sidedata.sidedata import SideDataContainer

VP9_PARAMETERS, H264_PARAMETERS = 0, 1
"""AVVideoEncParamsType; FFmpeg tells MPEG-4's too, but true noise was 2 to 30 times what its step leaves."""
QP_PLACE = 4
"""Where a block's QP stands after its place and size."""
STEP_AT_QP_0, QP_OF_TWICE = 0.625, 6.0
"""Of H.264 (ITU-T H.264, 8.5.9): its quantiser's step in grey levels, and how much more QP doubles it."""
VP9_RISES = "94 25 17 13 10 9 7 6 6 5 5 4 4 4 3 3 3 3 3 2 3 2 2 2 2 2 2 2 2 2 1 2 1 2 1"
"""How often in a row VP9's step rises by 1, 2, 3 ... from one index to the next, after a first rise by 4."""
VP9_STEPS = (4 + np.cumsum([0, 4, *np.repeat(np.arange(1, 36), [int(n) for n in VP9_RISES.split()])])) / 8
"""(256,) by VP9's index, grey levels (VP9 bitstream specification, 8.6.1, ac_qlookup, which counts eighths)."""


def coding_step(frame: Any) -> float | None:
    """The step of the coder's quantiser, grey levels: mean over the blocks of a decoded frame; None: not told.

    FFmpeg's decoders tell it for H.264 and VP9 (``AVVideoEncParams``: a head, then blocks with what their QP is more),
    not for HEVC.  Steps are those of a transform that keeps the sum of squares.  Not read from
    ``frame.side_data``: the frame keeps what that returns, which keeps the frame, and a circle of a whole picture stays
    in memory until Python happens to look for circles.
    """
    for told in SideDataContainer(frame):  # type: ignore[call-arg]  # which its stub leaves out
        if told.type.name != "VIDEO_ENC_PARAMS":
            continue
        data = bytes(told)
        count, start, size, kind, qp = struct.unpack_from("=I4xQQii", data)
        if start + count * size > len(data):
            continue
        blocks = np.frombuffer(data, np.int32, count * size // 4, start).reshape(count, size // 4)
        levels = qp + (blocks[:, QP_PLACE] if count else np.zeros(1, np.int32))
        if kind == H264_PARAMETERS and count:
            return float(np.mean(STEP_AT_QP_0 * 2 ** (levels / QP_OF_TWICE)))
        if kind == VP9_PARAMETERS:
            return float(np.mean(VP9_STEPS[np.clip(levels, 0, len(VP9_STEPS) - 1)]))
    return None
