"""How the encoder coded a frame, as the decoder reports it: quantisation step, and prediction from the frame before."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from av.sidedata.sidedata import SideDataContainer

VP9_PARAMETERS, H264_PARAMETERS = 0, 1
"""AVVideoEncParamsType.  MPEG-4's is not used: measured noise was 2 to 30 times what its step leaves."""
PREDICTED = 2
"""AVPictureType of a frame that is predicted from earlier ones."""
QP_PLACE = 4
"""Index of a block's QP, after its position and size."""
STEP_AT_QP_0, QP_OF_TWICE = 0.625, 6.0
"""H.264 (ITU-T H.264, 8.5.9): quantiser step at QP 0, grey levels, and the increase of QP that doubles it."""
VP9_RISES = "94 25 17 13 10 9 7 6 6 5 5 4 4 4 3 3 3 3 3 2 3 2 2 2 2 2 2 2 2 2 1 2 1 2 1"
"""Run lengths over the index: VP9's step first rises by 4, then this many times by 1, by 2, by 3 ..."""
VP9_STEPS = (4 + np.cumsum([0, 4, *np.repeat(np.arange(1, 36), [int(n) for n in VP9_RISES.split()])])) / 8
"""(256,) VP9's step by index, grey levels (VP9 bitstream specification, 8.6.1, ac_qlookup, in eighths)."""


@dataclass(frozen=True, slots=True)
class FrameCoding:
    """How one frame was coded."""

    step: float
    """The quantiser's step, grey levels, of an orthonormal transform: mean over the frame's blocks."""
    from_previous: bool = False
    """Whether the frame was predicted from the one before, and stores only what it lacks."""


def frame_coding(frame: Any, reordered: bool) -> FrameCoding | None:
    """How a decoded frame was coded; None: not reported.

    reordered: whether the movie has frames that are predicted from later ones; what a frame is predicted from is then
    not told.
    """
    found = _kind_and_step(frame)
    if found is None:
        return None
    kind, step = found
    return FrameCoding(step, kind == H264_PARAMETERS and not reordered and frame.pict_type == PREDICTED)


def _kind_and_step(frame: Any) -> tuple[int, float] | None:
    """The kind of the encoder's parameters and the mean step, grey levels; None: not reported.

    FFmpeg's decoders report them for H.264 and VP9 (``AVVideoEncParams``: a header, then the QP difference of each
    block), not for HEVC.  ``frame.side_data`` is not used: it stores its result in the frame, a reference cycle that
    keeps a whole picture in memory until the garbage collector runs.
    """
    for side_data in SideDataContainer(frame):  # type: ignore[call-arg]  # missing from its stub
        if side_data.type.name != "VIDEO_ENC_PARAMS":
            continue
        data = bytes(side_data)
        count, start, size, kind, qp = struct.unpack_from("=I4xQQii", data)
        if start + count * size > len(data):
            continue
        blocks = np.frombuffer(data, np.int32, count * size // 4, start).reshape(count, size // 4)
        levels = qp + (blocks[:, QP_PLACE] if count else np.zeros(1, np.int32))
        if kind == H264_PARAMETERS and count:
            return kind, float(np.mean(STEP_AT_QP_0 * 2 ** (levels / QP_OF_TWICE)))
        if kind == VP9_PARAMETERS:
            return kind, float(np.mean(VP9_STEPS[np.clip(levels, 0, len(VP9_STEPS) - 1)]))
    return None
