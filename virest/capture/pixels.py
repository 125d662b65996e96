"""The colours of a decoded frame (contract, section 3).

Luma and chroma become RGB by the stream's own matrix and range, rounded; an untagged stream is BT.601, limited range,
at any size.  A chroma sample lies vertically between its two rows; horizontally on the left of its two columns, or
between them for codecs that centre it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array

KR_KB = {
    1: (0.2126, 0.0722),  # BT.709
    4: (0.30, 0.11),  # FCC
    5: (0.299, 0.114),  # BT.601, 625 lines
    6: (0.299, 0.114),  # BT.601, 525 lines
    7: (0.212, 0.087),  # SMPTE 240M
    9: (0.2627, 0.0593),  # BT.2020
    10: (0.2627, 0.0593),
}
"""Weights of red and blue in luma, by H.264's number of the matrix."""
BT601 = 6
"""H.264's number of the matrix that phones use, also where a movie states none."""
BT601_LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue, the movie's usual matrix."""
FULL_RANGE = 2
"""FFmpeg's AVCOL_RANGE_JPEG."""
PLANAR_8BIT = {"yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p"}
FIXED_POINT = 64
"""Fixed-point steps per grey level in the 16-bit sums: luma plus chroma stay below 2^15."""
CUBIC_MIDDLE = np.array([[-3, 19, 19, -3]], np.float32) / 32
"""OpenCV's cubic interpolation weights half way between two samples, as cv2.resize uses for the rows."""


@dataclass(frozen=True, slots=True)
class _ColourTables:
    """Contribution of each 8-bit luma and chroma value to red, green and blue, in 1/FIXED_POINT levels."""

    luma: NDArray[np.int16]
    red_v: NDArray[np.int16]
    green_u: NDArray[np.int16]
    green_v: NDArray[np.int16]
    blue_u: NDArray[np.int16]
    gray: NDArray[np.uint8]
    """Luma as full-range grey."""


@lru_cache(maxsize=16)
def _tables(matrix: int, full_range: bool) -> _ColourTables:
    kr, kb = KR_KB[matrix]
    kg = 1.0 - kr - kb
    code = np.arange(256.0)
    luma = code if full_range else (code - 16) * (255 / 219)
    chroma = (code - 128) * (1.0 if full_range else 255 / 224)

    def fixed(values: Array) -> NDArray[np.int16]:
        return np.rint(values * FIXED_POINT).astype(np.int16)

    return _ColourTables(
        fixed(luma),
        fixed(2 * (1 - kr) * chroma),
        fixed(-2 * kb * (1 - kb) / kg * chroma),
        fixed(-2 * kr * (1 - kr) / kg * chroma),
        fixed(2 * (1 - kb) * chroma),
        np.clip(np.rint(luma), 0, 255).astype(np.uint8),
    )


def _frame_tables(frame: Any) -> _ColourTables:
    matrix = int(frame.colorspace)
    full = int(frame.color_range) == FULL_RANGE or frame.format.name.startswith("yuvj")
    return _tables(matrix if matrix in KR_KB else BT601, full)


def _planes(frame: Any) -> list[NDArray[np.uint8]]:
    """Views of the planes, padding cut off."""
    return [
        np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height, : plane.width]
        for plane in frame.planes[:3]
    ]


def to_rgb(frame: Any, *, centred: bool = False) -> NDArray[np.uint8]:
    """RGB (h, w, 3) of a decoded PyAV frame, rounded; size, matrix and range are the stream's.

    centred: chroma lies between two columns of luma, not on the left one.
    """
    if frame.format.is_rgb:
        return frame.to_ndarray(format="rgb24")
    if frame.format.name not in PLANAR_8BIT:
        frame = frame.reformat(format="yuv444p")
    tables = _frame_tables(frame)
    y_code, u_code, v_code = _planes(frame)
    luma = cv2.LUT(y_code, tables.luma)
    green = cv2.add(cv2.LUT(u_code, tables.green_u), cv2.LUT(v_code, tables.green_v))
    channels = [
        _levels(cv2.add(luma, _upsample(chroma, luma.shape, centred=centred)))
        for chroma in (cv2.LUT(v_code, tables.red_v), green, cv2.LUT(u_code, tables.blue_u))
    ]
    return np.asarray(cv2.merge(channels), np.uint8)


def _levels(fixed: NDArray[Any]) -> NDArray[Any]:
    """Fixed-point sums to 8 bits, rounded and clipped: two integer passes, four times faster than one in float."""
    return cv2.convertScaleAbs(cv2.max(fixed, 0), alpha=1 / FIXED_POINT)  # type: ignore[call-overload]


def _upsample(chroma: NDArray[Any], shape: tuple[int, ...], *, centred: bool) -> NDArray[Any]:
    """Chroma at the luma's size, by cubic interpolation.

    A sample lies on the left of its two luma columns, the default of H.264 and its relatives, or between them (centred:
    JPEG and MPEG-1); always between its two rows.
    """
    height, width = shape[:2]
    if chroma.shape[:2] == (height, width):
        return chroma
    factor_x, factor_y = -(-width // chroma.shape[1]), -(-height // chroma.shape[0])
    if factor_x == 2 and not centred:
        between = cv2.filter2D(chroma, -1, CUBIC_MIDDLE, anchor=(1, 0), borderType=cv2.BORDER_REPLICATE)
        chroma, factor_x = cv2.merge([chroma, between]).reshape(len(chroma), -1), 1
    size = (chroma.shape[1] * factor_x, chroma.shape[0] * factor_y)
    return np.ascontiguousarray(cv2.resize(chroma, size, interpolation=cv2.INTER_CUBIC)[:height, :width])


def to_gray(frame: Any, *, centred: bool = False) -> NDArray[np.uint8]:
    """Luma (h, w) of a decoded PyAV frame, scaled to the full range; centred concerns chroma and is ignored."""
    del centred
    if frame.format.is_rgb:
        return luma_of(frame.to_ndarray(format="rgb24"))
    if frame.format.name not in PLANAR_8BIT:
        frame = frame.reformat(format="yuv444p")
    return np.asarray(cv2.LUT(_planes(frame)[0], _frame_tables(frame).gray), np.uint8)


def luma_of(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Luma of an RGB picture; a grey one unchanged."""
    return picture if picture.ndim == 2 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
