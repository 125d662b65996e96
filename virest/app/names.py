"""Names of a batch's captures in the output folder, and its shards."""

from __future__ import annotations

import os
from collections import defaultdict
from pathlib import PurePath

from virest.app.outputs import capture_name, resolved
from virest.errors import OutputError

JOINT = "-"


def shard_of(paths: list[str], shard: tuple[int, int] = (1, 1)) -> tuple[list[str], list[str]]:
    """Paths and names of the i-th of N parts of a batch, dealt in turn: part sizes differ by at most one capture."""
    names = batch_names(paths)
    part, parts = shard
    return paths[part - 1 :: parts], names[part - 1 :: parts]


def batch_names(paths: list[str]) -> list[str]:
    """A name for each capture: its folder's name, or, if several share it, the path below their common folder.

    Raises OutputError for a capture given twice, and for names that still collide.
    """
    names = [capture_name(path) for path in paths]
    groups: dict[str, list[int]] = defaultdict(list)
    for number, name in enumerate(names):
        groups[name].append(number)
    for name, numbers in groups.items():
        if len(numbers) > 1:
            for number, longer in zip(numbers, _relative_names([paths[n] for n in numbers], name), strict=True):
                names[number] = longer
    if len(set(names)) < len(names):
        twice = sorted(name for name in names if names.count(name) > 1)[0]
        raise OutputError(
            f"two captures would both be named {twice!r}", hint="rename one, or process them with different --out"
        )
    return names


def _relative_names(paths: list[str], name: str) -> list[str]:
    """Paths of equally named folders below their common folder, joined by dashes."""
    absolute = [resolved(path) for path in paths]
    if len(set(absolute)) < len(absolute):
        raise OutputError(
            f"{len(paths)} captures are named {name!r} ({', '.join(paths)}): the same folder is given twice and would "
            "share one output folder",
            hint="give each capture once",
        )
    common = os.path.commonpath(absolute) if not any("://" in place for place in absolute) else ""
    if not common:
        raise OutputError(
            f"{len(paths)} captures are named {name!r} ({', '.join(paths)}) and would share one output folder",
            hint="process them with different --out, or rename one",
        )
    return [JOINT.join(PurePath(os.path.relpath(place, common)).parts) for place in absolute]
