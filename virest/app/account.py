"""The content of run.json: the result for one capture, or why there is none."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from virest import __version__
from virest.app import console
from virest.app.finish import Finished, pictures_profile
from virest.app.outputs import file_facts, resolved
from virest.app.planning import Job, ProcessOptions
from virest.app.run_folder import parse_lines
from virest.camera.profile_file import profile_mapping
from virest.capture.location import is_remote, locate, read_each
from virest.errors import PARTLY_FAILED, VirestError
from virest.image_formation import transforms
from virest.restoration.capture import RestorationPlan

STATUSES = ("restored", "copied", "skipped", "failed")
STEPS = ("deblurred", "straightened", "undistorted")
"""Steps counted in addition to the four statuses; a copied frame may be undistorted."""
STAGES = ("decode", "estimate", "deblur", "shutter", "write")
MOST_FILES, MOST_BYTES = 32, 1 << 30
"""Limits on the files of an unreadable capture that run.json lists."""


def run_totals(logs: list[Path]) -> dict[str, Any]:
    """Counts by status and by step, seconds by stage, and the gain from neighbours, over all lines."""
    counts: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    joined: list[tuple[int, float]] = []
    for content in read_each(logs):
        for line in parse_lines(content):
            counts[line["status"]] += 1
            counts.update(line.get("done", ()))
            seconds.update({stage: line["seconds"].get(stage, 0.0) for stage in STAGES})
            deblur = line.get("deblur") or {}
            if deblur.get("neighbours"):
                joined.append((len(deblur["neighbours"]), deblur.get("neighbours_gain_db") or 0.0))
    return {
        "counts": {name: counts[name] for name in (*STATUSES, *STEPS)},
        "seconds": dict(seconds),
        "neighbours": _joined(joined),
    }


def _joined(joined: list[tuple[int, float]]) -> dict[str, Any]:
    """Frames restored with neighbours, their mean number of neighbours, and the mean gain predicted by the spectra."""
    count = len(joined)
    taken, gain_db = (sum(column) / count for column in zip(*joined, strict=True)) if count else (None, None)
    return {"frames": count, "mean_taken": taken, "mean_gain_db": gain_db}


def run_account(
    job: Job,
    plan: RestorationPlan,
    totals: dict[str, Any],
    wall_s: float,
    finished: Finished = Finished(),  # noqa: B008  (frozen)
) -> dict[str, Any]:
    """The content of run.json."""
    notes = [note.text for note in job.capture.notes if note.severity != "info"]
    counts = totals["counts"]
    return {
        **_head(job.path, job.name, PARTLY_FAILED if counts["failed"] else 0),
        "folder": str(job.capture.folder.absolute()),
        "movie": str(job.capture.movie.absolute()),
        "command": job.request["command"],
        "profile": profile_mapping(finished.profile(pictures_profile(plan))),
        "recorded_intrinsics": profile_mapping(plan.profile)["intrinsics"] if plan.settings.undistort else None,
        "crop_px": None if finished.crop_px is None else list(finished.crop_px),
        "film": None if finished.film is None else str(finished.film),
        "profile_source": job.profile_source,
        "profile_sha256": job.request["profile_sha256"],
        "settings": dataclasses.asdict(plan.settings),
        "frames": job.request["frames"],
        "inputs": _inputs(job),
        "counts": counts,
        "neighbours": totals["neighbours"],
        "totals": _sums(len(job.selected), totals["seconds"], wall_s),
        "verdict": verdict(counts, plan.copy_reason),
        "warnings": [*notes, *plan.warnings, *([plan.copy_reason] if plan.copy_reason else [])],
    }


def failure_account(
    path: str, name: str, options: ProcessOptions, job: Job | None, error: Exception, wall_s: float
) -> dict[str, Any]:
    """The content of run.json for a capture that could not be processed; unknown values are empty."""
    kind = type(error).__name__
    known = error if isinstance(error, VirestError) else VirestError(f"{kind}: {error}", hint=console.OUR_FAULT)
    return {
        **_head(path, name, known.exit_code, {"error": kind, "reason": known.message, "hint": known.hint}),
        "folder": str(locate(path).absolute()),
        "movie": str(job.capture.movie.absolute()) if job else None,
        "command": options.command,
        "profile": profile_mapping(job.profile) if job else {},
        "profile_source": job.profile_source if job else "",
        "profile_sha256": job.request["profile_sha256"] if job else None,
        "settings": dataclasses.asdict(options.settings),
        "frames": job.request["frames"] if job else None,
        "inputs": _inputs(job) if job else _facts_of_folder(locate(path)),
        "counts": dict.fromkeys((*STATUSES, *STEPS), 0),
        "neighbours": _joined([]),
        "totals": _sums(0, {}, wall_s),
        "verdict": f"not processed: {known.message}",
        "warnings": [text for text in (known.message, known.hint) if text],
    }


def _head(path: str, name: str, exit_code: int, failure: dict[str, str | None] | None = None) -> dict[str, Any]:
    """What every run.json begins with; source: the capture's path as given, and with links resolved."""
    return {
        "virest_run": 1,
        "version": __version__,
        "transforms": transforms.in_use(),
        "capture": name,
        "status": "done" if failure is None else "failed",
        "exit_code": exit_code,
        "failure": failure,
        "source": {"given": path, "resolved": resolved(path)},
    }


def _facts_of_folder(folder: Path) -> list[dict[str, Any]]:
    """Facts of regular files in an unreadable capture's folder, in bounded time; none for a remote address."""
    facts: list[dict[str, Any]] = []
    left = 0 if is_remote(folder) else MOST_BYTES
    with suppress(OSError):
        for file in sorted(folder.iterdir())[:MOST_FILES] if left else ():
            with suppress(OSError):
                if file.is_file() and (size := file.stat().st_size) <= left:
                    left -= size
                    facts.append({**file_facts(file), "path": resolved(file)})
    return facts


def _inputs(job: Job) -> list[dict[str, Any]]:
    """Facts of the input files with their paths."""
    known = zip(job.request["inputs"], job.inputs, strict=True)
    return [{**facts, "path": resolved(file)} for facts, file in known]


def _sums(frames: int, seconds: Mapping[str, float], wall_s: float) -> dict[str, Any]:
    return {
        "frames": frames,
        "seconds": {**{stage: round(seconds.get(stage, 0.0), 3) for stage in STAGES}, "wall": round(wall_s, 3)},
        "frames_per_s": round(frames / wall_s, 3) if wall_s > 0 else None,
    }


def verdict(counts: dict[str, int], copy_reason: str | None) -> str:
    """One word or sentence for the whole run."""
    if counts.get("failed"):
        return "some frames failed"
    if copy_reason:
        return f"copied: {copy_reason}"
    if counts.get("restored"):
        return "restored"
    return (
        "nothing to restore" if counts.get("copied") else "all frames skipped" if counts.get("skipped") else "no frames"
    )
