"""Time blocks: data of one block share errors and count as one sample; held-out blocks test fits of the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from virest.arrays import Array, Index, Mask


def even_blocks(number: Index, total: int, blocks: int) -> Index:
    """Block (n,) of numbers below ``total`` in time order; all blocks hold about equally many numbers."""
    return np.asarray(number * blocks // max(total, 1))


def varied_blocks(position: Array | Index, lengths: Sequence[float] | Array) -> Index:
    """Block (n,) of each position in time; lengths cycle through ``lengths`` to avoid beats with periodic motion."""
    if not len(position):
        return np.zeros(0, np.intp)
    in_turn = np.asarray(lengths, float)
    count = int(np.ceil(np.ptp(position) / in_turn.mean())) + len(in_turn)
    edges = np.min(position) + np.cumsum(np.resize(in_turn, count))
    return np.asarray(np.searchsorted(edges, position, side="right"), np.intp)


def halves(block: Index) -> tuple[Mask, Mask]:
    """Masks (n,) of the data of two fits, alternating blocks; each fit is tested on the other's data."""
    even = block % 2 == 0
    return even, ~even


def evenly_chosen(values: Index, count: int) -> Index:
    """At most ``count`` of the values, spread evenly."""
    return values[np.unique(np.linspace(0, len(values) - 1, min(count, len(values))).astype(int))]
