"""``virest process --dry-run``: predicted gain, time and size of a run, from a few frames; nothing is written."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from virest.app import console
from virest.app.names import shard_of
from virest.app.outputs import json_line
from virest.app.planning import Job, Planned, ProcessOptions, plan_capture, read_with_neighbours
from virest.app.png import png_bytes
from virest.capture.folder import Frame
from virest.capture.frame_coding import FrameCoding
from virest.capture.video import MovieIndex
from virest.errors import VirestError
from virest.restoration.capture import RestorationPlan, at_true_times, restore_frames

PROBED = 3
"""Frames restored per capture; the first does not count for the time, since it also builds tables."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """The predicted result and cost of one capture."""

    name: str
    frames: int
    skipped: int
    blur_px: float | None
    """Median over the probed frames, at the centre."""
    gain_db: float | None
    """Median predicted gain; None: deblurring is not expected to help."""
    seconds: float
    """Wall-clock time with the chosen number of processes, planning included."""
    bytes: float

    def facts(self) -> dict[str, Any]:
        """For ``--json``."""
        return {"capture": self.name, **{k: v for k, v in dataclasses.asdict(self).items() if k != "name"}}


@dataclass(frozen=True, slots=True)
class _Probe:
    """What one frame cost and gained."""

    seconds: float
    """Time of restoring and encoding it."""
    bytes: int
    """Size of its PNG."""
    blur_px: float | None
    gain_db: float | None
    """Predicted gain; None: deblurring is not expected to help."""


def predict_captures(paths: list[str], options: ProcessOptions, shard: tuple[int, int] = (1, 1)) -> int:
    """Predict each capture of a batch and print a table, or one line of JSON per capture.  Returns the exit code."""
    paths, names = shard_of(paths, shard)
    apart = dataclasses.replace(options, mode="overwrite")  # a dry run ignores an existing run
    forecasts, codes = [], []
    for path, name in zip(paths, names, strict=True):
        try:
            forecast = predict(path, name, apart)
            forecasts.append(forecast)
            codes.append(0)
            if options.json_lines:
                console.emit(json_line(forecast.facts()))
        except VirestError as error:
            codes.append(console.report_error(error, name))
    if forecasts and not options.json_lines:
        console.emit(_table(forecasts))
    return console.batch_code(codes)


def predict(path: str, name: str, options: ProcessOptions) -> Forecast:
    """Plan a capture and restore a few of its frames in memory.  Raises the errors that a run would raise."""
    planned: Planned = plan_capture(path, name, options)
    if planned.error is not None:
        raise planned.error
    assert planned.job is not None
    assert planned.index is not None
    assert planned.plan is not None
    job = planned.job
    usable = [frame for frame in job.selected if frame.skip_reason is None]
    tried = (_probe(job, planned.index, planned.plan, frame) for frame in _evenly_spaced(usable))
    probes = [probe for probe in tried if probe is not None]
    per_frame_s = _median([probe.seconds for probe in probes[1:] or probes]) or 0.0
    return Forecast(
        name,
        len(usable),
        len(job.selected) - len(usable),
        _median([probe.blur_px for probe in probes]),
        _median([probe.gain_db for probe in probes]),
        planned.seconds + per_frame_s * len(usable) / options.jobs,
        float(np.mean([probe.bytes for probe in probes])) * len(usable) if probes else 0.0,
    )


def _median(values: Sequence[float | None]) -> float | None:
    """Median of the known values; None if none is known."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _evenly_spaced(frames: Sequence[Frame]) -> list[Frame]:
    """PROBED evenly spaced frames, or all if there are fewer."""
    indices = np.linspace(0, max(len(frames) - 1, 0), min(PROBED, len(frames))).round().astype(int)
    return [frames[k] for k in indices.tolist()]


def _probe(job: Job, index: MovieIndex, plan: RestorationPlan, frame: Frame) -> _Probe | None:
    """Restore a frame in memory; None if that is not possible."""
    frames = list(at_true_times(job.capture.frames, plan.profile, job.capture.repeats))
    frames[frame.index] = frame  # selected, even if it belongs to the recorder's start-up
    coding: dict[int, FrameCoding] = {}
    near = read_with_neighbours(job.capture.movie, index, frames, frame.index, plan.reach, coding)
    if near is None:
        return None
    began = time.perf_counter()
    restored = next(restore_frames(near, job.capture.imu, plan, {frame.index}, coding), None)
    if restored is None or restored.picture is None or restored.degradation is None:
        return None
    size = len(png_bytes(restored.picture))
    seconds = time.perf_counter() - began
    found = restored.degradation
    return _Probe(seconds, size, found.blur.length_px, found.expected_gain_db)


def _table(forecasts: list[Forecast]) -> str:
    rows = [
        [f.name, str(f.frames), str(f.skipped), console.cell(f.blur_px, ".1f"), console.cell(f.gain_db, ".1f"),
         f"{f.seconds:.0f}", f"{f.bytes / 1e6:.1f}"]
        for f in forecasts
    ]  # fmt: skip
    if len(forecasts) > 1:
        total_s, total = sum(f.seconds for f in forecasts), sum(f.bytes for f in forecasts)
        rows.append(["total", str(sum(f.frames for f in forecasts)), str(sum(f.skipped for f in forecasts)), "", "",
                     f"{total_s:.0f}", f"{total / 1e6:.1f}"])  # fmt: skip
    return console.numeric_table(["capture", "frames", "skipped", "blur px", "gain dB", "time s", "MB"], rows)
