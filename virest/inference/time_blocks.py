"""Blocks of time: what lies in one shares its errors, so it counts once; blocks judge fits that did not see them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


def even_blocks(number: Index, total: int, blocks: int) -> Index:
    """Block (n,) of each of some numbers below ``total``, counted in time: about as many numbers in each."""
    return np.asarray(number * blocks // max(total, 1))


def varied_blocks(position: Array | Index, lengths: Sequence[float] | Array) -> Index:
    """Block (n,) of each position in time, from the first on: lengths in turn, varied so that nothing beats."""
    if not len(position):
        return np.zeros(0, np.intp)
    in_turn = np.asarray(lengths, float)
    count = int(np.ceil(np.ptp(position) / in_turn.mean())) + len(in_turn)
    edges = np.min(position) + np.cumsum(np.resize(in_turn, count))
    return np.asarray(np.searchsorted(edges, position, side="right"), np.intp)


def halves(block: Index) -> tuple[Mask, Mask]:
    """What two fits see, (n,) each: every other block; what one sees judges the other."""
    even = block % 2 == 0
    return even, ~even
