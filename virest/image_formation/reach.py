"""Where blur carries the light of some pixels: masks dilated, or eroded, along the blur paths."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.image_formation.kernels import KernelField

PLACES = 4
"""The picture is divided into this many parts each way, each with its own blur path."""
TOUCHED = 2e-3
"""Kernel values above this are on the path."""


def along_paths(
    mask: NDArray[np.uint8],
    field: Callable[[Array], KernelField],
    operation: Callable[[Any, Any], Any],
    times: int = 1,
) -> NDArray[np.uint8]:
    """A mask (height, width) dilated or eroded along the local blur path, in both directions.

    operation: OpenCV's.  times: size of the picture that the field belongs to over the mask's.
    Paths vary over a picture with row time and lens: each of PLACES × PLACES parts uses the path at its centre.  Parts
    where the mask is constant, including a margin of the path's size, are unchanged, and so are pixels farther than two
    such margins from the mask.
    """
    height, width = mask.shape
    rows, columns = (np.linspace(0, length, PLACES + 1).astype(int) for length in (height, width))
    parts = [
        (slice(top, bottom), slice(left, right))
        for top, bottom in pairwise(rows.tolist())
        for left, right in pairwise(columns.tolist())
    ]
    middles = [[(c.start + c.stop - 1) / 2, (r.start + r.stop - 1) / 2] for r, c in parts]
    paths = field((np.array(middles) + 0.5) * times - 0.5).scaled(1 / times).arrays(positive=True)
    found, margin = mask.copy(), len(paths[0])
    for (r, c), path in zip(parts, paths, strict=True):
        top, left = max(r.start - margin, 0), max(c.start - margin, 0)
        seen = mask[top : r.stop + margin, left : c.stop + margin]
        if seen.size and seen.min() < seen.max():
            reach = (path + path[::-1, ::-1] > TOUCHED).astype(np.uint8)
            inner = slice(r.start - top, r.stop - top), slice(c.start - left, c.stop - left)
            near, changed = around(seen, 2 * margin), np.zeros_like(seen)
            changed[near] = operation(seen[near], reach)
            found[r, c] = changed[inner]
    return found


def around(mask: NDArray[np.uint8], reach: int) -> tuple[slice, slice]:
    """Rows and columns of the bounding box of a mask (height, width), extended on each side by ``reach`` px."""
    left, top, width, height = cv2.boundingRect(mask)
    return slice(max(top - reach, 0), top + height + reach), slice(max(left - reach, 0), left + width + reach)
