"""``virest evaluate slam``: the error that the rolling shutter adds to SLAM, and how much restoration removes (Case C).

Trajectories are estimated from global-shutter, rolling-shutter and restored frames of the same instants, without IMU,
aligned by a Sim(3) and scored by evo as ``evo_ape`` does; each run has its own seed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from virest import __version__
from virest.app import console
from virest.app.evaluation_captures import temporary_folder
from virest.app.machine import installed_version
from virest.app.outputs import json_line, output_error, require_writable, write_whole
from virest.app.slam_captures import (
    DEVICE_FRAMES,
    DEVICE_SOURCES,
    DEVICES,
    SEQUENCES,
    SlamCapture,
    make_capture,
    smaller,
)
from virest.app.slam_sequences import (
    SlamSequences,
    split_command,
    track_with_colmap,
    track_with_command,
    write_sequences,
)
from virest.errors import OutputError, SettingsError, VirestError
from virest.evaluation.structure_from_motion import MAX_FEATURES, OVERLAP, THREADS, require_pycolmap
from virest.evaluation.trajectories import ScoreSummary, TrajectoryScore, added_error_removed, score_path, summarise
from virest.restoration.settings import PRESETS

log = logging.getLogger(__name__)

SEEDS = 3
"""The fewest runs that have a median and a spread."""
QUICK_FRAMES, QUICK_DEVICES = 24, 2
"""Size of a quick run: frames per capture, and phones."""
TIMEOUT_S = 600.0
"""For one sequence: a SLAM that takes longer is taken to hang."""
Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class SlamOptions:
    """The options of one ``virest evaluate slam``."""

    command: str | None = None
    """Command line of a SLAM to run instead of COLMAP, with placeholders."""
    seeds: int | None = None
    """Runs per capture; None: SEEDS, since COLMAP's error on 24 frames varies up to fivefold with its seed."""
    devices: bool = False
    quick: bool = False
    out: Path | None = None
    """Keep sequences, trajectories and results here; None: keep nothing."""
    preset: str = "balanced"
    timeout_s: float = TIMEOUT_S


@dataclass(frozen=True, slots=True)
class _Task:
    """One capture to evaluate."""

    name: str
    plan: SlamCapture | None
    """The capture to simulate; None: it exists."""
    path: Path | None
    seeds: int
    table: str
    """``sequences`` or ``devices``."""


def run_slam(
    captures: Sequence[Path], options: SlamOptions, progress: Progress | None = None
) -> tuple[dict[str, Any], str, int]:
    """Evaluate captures, or the standard ones: facts for ``--json``, the tables, and the exit code."""
    words = None if options.command is None else split_command(options.command)
    tools = _tools(options.command)
    tasks = _tasks(captures, options)
    with ExitStack() as stack:
        out = _work_folder(options.out, stack)
        rows = []
        for k, task in enumerate(tasks):
            if progress:
                progress(task.name, k / len(tasks))
            rows.append(_judged(task, out, words, options))
        colmap = {"features": MAX_FEATURES, "overlap": OVERLAP, "threads": THREADS}
        sfm = colmap if options.command is None else None
        facts = {**tools, "preset": options.preset, "sfm": sfm, "results": rows}
        facts["summary"] = _summary(rows)
        if options.out:
            write_whole(out / "results.json", f"{json_line(facts)}\n".encode())
    return facts, describe(facts), console.batch_code([row.get("exit_code", 0) for row in rows])


# ── one capture ────────────────────────────────────────────────────────────────────────────────────────────────────


def _judged(task: _Task, out: Path, words: list[str] | None, options: SlamOptions) -> dict[str, Any]:
    """One row of a table; a failed capture gives a row with its error."""
    head = {"name": task.name, "table": task.table}
    try:
        path = task.path
        if task.plan is not None:
            path = make_capture(task.plan, out / "captures" / task.name.replace(" ", "_"))
        assert path is not None
        folder = out / task.table / task.name.replace(" ", "_")
        sequences = write_sequences(path, folder, PRESETS[options.preset])
        return {**head, **_plan_facts(task.plan), **_scored(sequences, task.seeds, words, options)}
    except SettingsError:
        raise
    except VirestError as error:
        return {**head, "error": str(error), "exit_code": console.report_error(error, task.name)}


def _scored(sequences: SlamSequences, seeds: int, words: list[str] | None, options: SlamOptions) -> dict[str, Any]:
    """Track every kind with every seed and compare."""
    numbers = list(range(seeds))
    summaries: dict[str, ScoreSummary] = {}
    kinds: dict[str, Any] = {}
    for kind in sequences.kinds:
        if words is None:
            runs = list(track_with_colmap(sequences, kind, numbers))
        else:
            runs = list(track_with_command(sequences, kind, numbers, words, options.timeout_s))
        reference, scores = _best_reference(sequences, kind, runs)
        summaries[kind] = summarise(scores)
        kinds[kind] = _kind_facts(reference, scores, summaries[kind])
        log.info("%s, %s: %s", sequences.name, kind, _error_cell(kinds[kind]))
    true, lens = sequences.truth.at(sequences.start_s), sequences.lens
    return {
        "frames": len(sequences.stamps_ns),
        "width": lens.width,
        "height": lens.height,
        "fps": round(sequences.fps, 3),
        "path_m": round(true.length_m, 4),
        "seeds": numbers,
        "kinds": kinds,
        **_comparison(summaries),
    }


def _best_reference(
    sequences: SlamSequences, kind: str, runs: Sequence[dict[int, Any]]
) -> tuple[str, list[TrajectoryScore]]:
    """Score trajectories at the instant that the frames show.

    The rows of a recorded frame differ in time: the first row's start and the middle row's mid-exposure are both
    scored, and the better result counts.
    """
    references = {"exposure-start": sequences.start_s}
    if kind == "rolling":
        references["frame-middle"] = sequences.middle_s
    scored = {
        name: [score_path(sequences.truth, found, time_s) for found in runs] for name, time_s in references.items()
    }
    best = min(scored, key=lambda name: summarise(scored[name]).median_m)
    return best, scored[best]


def _comparison(summaries: dict[str, ScoreSummary]) -> dict[str, Any]:
    rolling, restored = summaries["rolling"], summaries["restored"]
    true = summaries.get("global")
    removed = added_error_removed(true.median_m, rolling.median_m, restored.median_m) if true else None
    return {
        "added_error_removed": None if removed is None else round(removed, 4),
        "worse_than_recorded": bool(restored.median_m > rolling.median_m),
    }


def _kind_facts(reference: str, scores: Sequence[TrajectoryScore], summary: ScoreSummary) -> dict[str, Any]:
    return {
        "reference": reference,
        "rmse_m": [_finite(score.rmse_m) for score in scores],
        "median_m": _finite(summary.median_m),
        "low_m": _finite(summary.low_m),
        "high_m": _finite(summary.high_m),
        "tracked": round(summary.tracked, 4),
        "lost": sum(score.lost for score in scores),
    }


def _finite(value: float) -> float | None:
    return round(value, 7) if np.isfinite(value) else None


def _plan_facts(plan: SlamCapture | None) -> dict[str, Any]:
    if plan is None:
        return {}
    return {
        "note": plan.note,
        "readout_ms": plan.readout_ms,
        "exposure_ms": plan.exposure_ms,
        "field_of_view_deg": round(plan.field_of_view_deg, 1),
        "rate_rad_s": plan.rate_rad_s,
        "depth_m": plan.depth_m,
        "simulation_seed": plan.seed,
    }


# ── tasks ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _tasks(captures: Sequence[Path], options: SlamOptions) -> list[_Task]:
    seeds = options.seeds or (1 if options.quick else SEEDS)
    if captures:
        names = [Path(path).resolve().name for path in captures]
        if len(set(names)) < len(names):
            raise OutputError("two captures have the same name and would share one folder", hint="rename one")
        return [_Task(name, None, Path(p), seeds, "sequences") for name, p in zip(names, captures, strict=True)]
    plans: tuple[SlamCapture, ...] = SEQUENCES[:1] if options.quick else SEQUENCES
    phones: tuple[SlamCapture, ...] = (
        () if not options.devices else DEVICES[:QUICK_DEVICES] if options.quick else DEVICES
    )
    phones = tuple(smaller(plan, DEVICE_FRAMES) for plan in phones)
    if options.quick:
        plans = tuple(smaller(plan, QUICK_FRAMES) for plan in plans)
    return [
        *(_Task(plan.name, plan, None, seeds, "sequences") for plan in plans),
        *(_Task(plan.name, plan, None, seeds, "devices") for plan in phones),
    ]


def _work_folder(out: Path | None, stack: ExitStack) -> Path:
    """Output folder; a temporary one, removed at the end, if none is given."""
    if out is None:
        return stack.enter_context(temporary_folder("virest-slam-"))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise OutputError(f"{out} exists and is not empty", hint="choose another folder for --out")
    require_writable(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(out, error) from error
    return out


def _tools(command: str | None) -> dict[str, Any]:
    """Versions of the tools used; raises SettingsError if one is missing."""
    used = {"virest": __version__, "evo": installed_version("evo")}
    if used["evo"] is None:
        raise SettingsError("evo is needed to score trajectories", hint="pip install 'virest[slam]'")
    if command is not None:
        return {"versions": used, "tracker": command}
    require_pycolmap()
    return {"versions": used | {"pycolmap": installed_version("pycolmap")}, "tracker": "pycolmap"}


def _summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    done = [row for row in rows if "error" not in row]
    removed = [row["added_error_removed"] for row in done if row["added_error_removed"] is not None]
    parts = {"median": round(float(np.median(removed)), 4), "least": min(removed)} if removed else None
    return {
        "captures": len(rows),
        "failed": len(rows) - len(done),
        "worse_than_recorded": [row["name"] for row in done if row["worse_than_recorded"]],
        "added_error_removed": parts,
    }


# ── text ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def describe(facts: dict[str, Any]) -> str:
    """The tables, followed by tools and summary."""
    parts = []
    for table, head in (("sequences", "sequence"), ("devices", "device")):
        rows = [row for row in facts["results"] if row["table"] == table]
        if rows:
            parts += [_table(rows, head), ""]
    if any(row["table"] == "devices" and "error" not in row for row in facts["results"]):
        parts += [*DEVICE_SOURCES, ""]
    return "\n".join([*parts, *_closing(facts)])


def _table(rows: Sequence[dict[str, Any]], head: str) -> str:
    header = [head, "readout ms", "exposure ms", "view deg", "frames", "path m", "global mm", "rolling mm"]
    header += ["restored mm", "removed", ""]
    return console.table(header, [_cells(row) for row in rows])


def _cells(row: dict[str, Any]) -> list[str]:
    if "error" in row:
        return [row["name"], *["-"] * 9, "failed"]
    kinds = row["kinds"]
    errors = [_error_cell(kinds[kind]) if kind in kinds else "-" for kind in ("global", "rolling", "restored")]
    camera = [f"{row[key]:g}" if key in row else "-" for key in ("readout_ms", "exposure_ms", "field_of_view_deg")]
    removed = row["added_error_removed"]
    part = "-" if removed is None else f"{100 * removed:.1f} %"
    return [row["name"], *camera, str(row["frames"]), f"{row['path_m']:.2f}", *errors, part, _remark(row)]


def _remark(row: dict[str, Any]) -> str:
    words = ["worse than recorded"] if row["worse_than_recorded"] else []
    return ", ".join([*words, *([row["note"]] if "note" in row else [])])


def _error_cell(kind: dict[str, Any]) -> str:
    """Median error in millimetres, range over the seeds, and the tracked fraction if below 100 %."""
    runs = len(kind["rmse_m"])
    if kind["median_m"] is None:
        return f"lost {kind['lost']}/{runs}"
    low, high = kind["low_m"], kind["high_m"]
    spread = "" if runs == 1 else f" ({1e3 * low:.2f}-{'lost' if high is None else f'{1e3 * high:.2f}'})"
    part = "" if kind["tracked"] >= 1 else f" {100 * kind['tracked']:.0f} %"
    return f"{1e3 * kind['median_m']:.2f}{spread}{part}"


def _closing(facts: dict[str, Any]) -> list[str]:
    summary, versions = facts["summary"], facts["versions"]
    removed, worse = summary["added_error_removed"], summary["worse_than_recorded"]
    tools = ", ".join(f"{name} {number}" for name, number in versions.items())
    lines = [f"evo_ape RMSE after Sim(3) alignment, median (range) over seeds from 0; {tools}; {facts['tracker']}"]
    references = {row["kinds"]["rolling"]["reference"] for row in facts["results"] if "error" not in row}
    if references:
        lines.append(
            f"recorded frames at the better of exposure-start and frame-middle: {', '.join(sorted(references))}"
        )
    if removed:
        lines.append(
            f"restored frames remove {100 * removed['median']:.1f} % (median; minimum {100 * removed['least']:.1f} %) "
            "of the error that the rolling shutter adds"
        )
    lines.append(f"worse than recorded: {', '.join(worse) or 'none'}")
    return lines
