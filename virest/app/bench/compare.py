"""Compare two bench.json files: every common figure, new over old, and which changes exceed the noise.

$ python -m virest.app.bench --compare OLD.json NEW.json
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from virest.app.console import cell, numeric_table

Report = dict[str, Any]
NAMES = (
    "preset",
    "capture",
    "kind",
    "set",
    "camera",
    "scene",
    "told",
    "command",
    "size",
    "tile_px",
    "readout",
    "hidden",
    "seed",
)
"""Keys that identify a record of a list; others are identified by a numeric ``frame`` or ``frames``."""
NOISE = 0.15
"""Relative change up to which two timings on one quiet machine may be equal."""
MEMORY_NOISE = 0.05
"""The same for memory, which other processes hardly change."""
NOISE_DB = 0.05
"""Absolute change in dB: gains do not depend on the machine's load, and their ratio is meaningless near zero."""
BUSY_CORES = 0.25
"""Load by other processes above which wall-clock times are unreliable."""
MORE_IS_BETTER = ("frames_per_s", "_db", "share_of_floor", "share_of_floor_by_cpu", "share_of_floor_by_stages",
                  "frames_per_s_by_cpu", "scaling", "scaling_by_cpu",
                  "right", "good_done", "cores_that_fill_the_link")  # fmt: skip
LESS_IS_BETTER = ("_s", "_mb", "s_per_frame", "cpu_s_per_frame", "part_of_asked", "cpu_part_of_asked", "exponent",
                  "wall_exponent", "estimate_share", "estimate_share_with_planning", "grown", "dollars",
                  "core_hours", "straightened_median_px", "straightened_p90_px", "promise_off", "worse_share",
                  "promised_and_worse")  # fmt: skip
"""Last meaningful part of a figure's path; with a leading underscore, a suffix of it."""
NO_FIGURES = ("load", "others_cores", "busiest_others_cores", "asked_s", "exit_code")
"""Keys that describe the machine or the settings and are not compared as figures."""


@dataclass(frozen=True, slots=True)
class Change:
    """One figure in both reports."""

    name: str
    """Path, such as ``speed.presets[fast].frames_per_s``."""
    old: float
    new: float
    mark: str
    """``better``, ``worse``, ``changed`` (neither direction is better), or empty within the noise."""

    @property
    def ratio(self) -> float | None:
        """New over old; None if the old value is 0."""
        return self.new / self.old if self.old else None


def read_report(path: Path) -> Report:
    """Read one bench.json; raises ValueError for other files."""
    report = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(report, dict) or "virest_bench" not in report:
        raise ValueError(f"{path}: not a report of this benchmark")
    return report


def compared(old: Report, new: Report, noise: float = NOISE) -> list[Change]:
    """All common figures, in the order of the new report."""
    before, after = dict(figures(old)), dict(figures(new))
    return [Change(n, before[n], v, _mark(n, before[n], v, noise)) for n, v in after.items() if n in before]


def compare_text(old: Report, new: Report, noise: float = NOISE) -> str:
    """Differences of machines and versions, then all common figures, then sections in only one report."""
    changes = compared(old, new, noise)
    rows = [[c.name, f"{c.old:.6g}", f"{c.new:.6g}", cell(c.ratio, ".3f"), c.mark] for c in changes]
    flagged = sum(bool(change.mark) for change in changes)
    title = (
        f"COMPARE: {len(changes)} figures, {flagged} changed by more than the noise ({100 * noise:.0f} %; memory "
        f"{100 * min(noise, MEMORY_NOISE):.0f} %; decibels by {NOISE_DB} dB)\n"
    )
    body = numeric_table(["figure", "old", "new", "new / old", ""], rows) if rows else "no figure in common"
    return "\n".join([*differences(old, new), title + body, *_only_one(old, new)])


def differences(old: Report, new: Report) -> list[str]:
    """One line for each difference that makes the reports less comparable."""
    before, after = ({**r.get("versions", {}), "scale": r.get("scale")} for r in (old, new))
    lines = [
        f"{key}: {before.get(key)} -> {after.get(key)}"
        for key in dict.fromkeys([*before, *after])
        if before.get(key) != after.get(key) or key == "load"
    ]
    if before["scale"] != after["scale"]:
        lines.append("the scales differ: numbers of frames and sizes are not the same, so figures are not comparable")
    for word, report in (("old", old), ("new", new)):
        lines += [f"{word} {name}: other processes kept {cores:.1f} cores busy; compare figures by CPU time"
                  for name, cores in _busy_sections(report)]  # fmt: skip
    return [*lines, ""] if lines else []


def _busy_sections(report: Report) -> Iterator[tuple[str, float]]:
    """Sections during which other processes used more than BUSY_CORES, with their number of cores."""
    for section, facts in report.items():
        cores = max(_others_cores(facts), default=0.0)
        if cores > BUSY_CORES:
            yield section, cores


def _others_cores(value: Any) -> Iterator[float]:
    """Every ``others_cores`` in a section, at any depth."""
    if isinstance(value, dict):
        yield from (float(cores) for key, cores in value.items() if key == "others_cores")
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _others_cores(inner)


def _only_one(old: Report, new: Report) -> list[str]:
    """Sections in only one of the reports."""
    sections = [
        {key for key, value in report.items() if isinstance(value, dict)} - {"versions"} for report in (old, new)
    ]
    lines = []
    for word, names in (("old", sections[0] - sections[1]), ("new", sections[1] - sections[0])):
        if names:
            lines.append(f"only in the {word} report: {', '.join(sorted(names))}")
    return lines


# ── figures ──────────────────────────────────────────────────────────────────────────────────────────────────────


def figures(report: Report) -> Iterator[tuple[str, float]]:
    """(path, value) of every figure in the sections."""
    for section, facts in report.items():
        if section != "versions" and isinstance(facts, dict):
            yield from _leaves(section, facts)


def _leaves(path: str, value: Any) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in NO_FIGURES:
                yield from _leaves(f"{path}.{key}", inner)
    elif isinstance(value, list):
        for position, inner in enumerate(value):
            yield from _leaves(f"{path}[{_identity(inner, position)}]", inner)
    elif isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        yield path, float(value)


def _identity(record: Any, position: int) -> str:
    """Identity of a record, so that lists may grow or change order; its position if it has none."""
    if not isinstance(record, dict):
        return str(position)
    words = [str(record[key]) for key in NAMES if isinstance(record.get(key), str | int | None) and key in record]
    words += [str(record[key]) for key in ("frame", "frames") if isinstance(record.get(key), int)]
    return " ".join(words) or str(position)


def _mark(name: str, old: float, new: float, noise: float) -> str:
    """Whether a figure changed by more than its noise, and whether for better or worse."""
    if "_db" in name:
        beyond = abs(new - old) > NOISE_DB
    else:
        allowed = min(noise, MEMORY_NOISE) if "_mb" in name else noise
        beyond = abs(new - old) > allowed * max(abs(old), 1e-12)
    if not beyond:
        return ""
    direction = better_direction(name)
    return "changed" if not direction else "better" if (new > old) == (direction > 0) else "worse"


def better_direction(name: str) -> int:
    """1 if more is better, -1 if less is better, 0 if neither, by the unit in the figure's name.

    The last meaningful part of the path decides, so that ``gain_db.fast`` is in decibels.
    """
    for part in reversed(name.split(".")):
        plain = part.partition("[")[0]
        for words, direction in ((MORE_IS_BETTER, 1), (LESS_IS_BETTER, -1)):
            if any(plain == word or (word.startswith("_") and plain.endswith(word)) for word in words):
                return direction
    return 0
