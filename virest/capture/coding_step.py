"""How coarsely a movie's coder quantised a frame, as its decoder tells."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from av.sidedata.sidedata import SideDataContainer

STEP_AT_QP_0, QP_OF_TWICE = 0.625, 6.0
"""Of H.264 (ITU-T H.264, 8.5.9): its quantiser's step in grey levels, and how much more QP doubles it."""
H264_PARAMETERS, QP_PLACE = 1, 4
"""AV_VIDEO_ENC_PARAMS_H264, and where a block's QP stands after its place and size."""


def coding_step(frame: Any) -> float | None:
    """The step of the coder's quantiser, grey levels: mean over the blocks of a decoded frame; None: not told.

    FFmpeg's decoder tells it for H.264 (``AVVideoEncParams``: a head, then blocks with what their QP is more).  Not
    read from ``frame.side_data``: the frame keeps what that returns, which keeps the frame, and a circle of a whole
    picture stays in memory until Python happens to look for circles.
    """
    for told in SideDataContainer(frame):  # type: ignore[call-arg]  # which its stub leaves out
        if told.type.name != "VIDEO_ENC_PARAMS":
            continue
        data = bytes(told)
        count, start, size, kind, qp = struct.unpack_from("=I4xQQii", data)
        if kind == H264_PARAMETERS and count and start + count * size <= len(data):
            blocks = np.frombuffer(data, np.int32, count * size // 4, start).reshape(count, -1)
            return float(np.mean(STEP_AT_QP_0 * 2 ** ((qp + blocks[:, QP_PLACE]) / QP_OF_TWICE)))
    return None
