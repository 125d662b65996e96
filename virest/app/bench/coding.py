"""Bias of tracked points towards the motion of neighbouring coding blocks (:mod:`virest.inference.coded_motion`).

$ python -m virest.app.bench --only coding --quick

Captures without model errors, of four scenes and motions, are read out in all four directions, coded at three bit
rates, and tracked in equally blurred frames, as `calibrate` does.  What the points differ by from their predictions is
explained by the slopes of the steps, which gives the distances over which they are pulled; those of the same capture
coded at UNHARMED_BITS_PER_PX, of the same noise of pixels and gyroscope, are subtracted.  As a fraction of the steps'
noise at 0.1 bits per pixel, they are the coding errors that `coded_motion` uses.  The times at which the bottom of the
picture seems to lag behind its top, with and without these pulls, show whether they explain the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.workload import Scale, simulated
from virest.app.console import numeric_table
from virest.app.diagnose import open_source
from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.camera.shutter import READOUT_DIRECTIONS
from virest.capture.records import Capture
from virest.capture.video import GrayReader
from virest.image_formation.point_model import TrackTable, integrate_motion, predict
from virest.inference.coded_motion import DEVIATION, MEAN, USUAL, drawn_px, step_slopes
from virest.inference.even_blur import EvenGuide
from virest.inference.guidance import gyro_guide
from virest.inference.observed_tracks import observe_tracks
from virest.inference.robust import CAUCHY, cauchy_weight
from virest.inference.tracking import track_frames

Row = dict[str, Any]
BITS_PER_PX = (0.5, 0.2, 0.1)
"""From twice a phone's usual 0.25 bits per pixel to less than half of it."""
UNHARMED_BITS_PER_PX = 8.0
"""Asked for; the noise of these captures takes 3 to 5."""
SCENES = ("leaves", "text", "board", "photographs")
FIRST_SEED, FRAMES, MOST_POINTS = 9101, 84, 7000
"""First of this section's seeds; 2.8 s of movie; most track points of a fit, so that it stays short."""
PULLS = ("left", "above", "lasting left", "lasting above")
"""In the order of MEAN."""
LATER_S = 1e-3
"""Step of the time derivative of points' steps."""


@dataclass(frozen=True, slots=True)
class _Pulls:
    """What the points of one capture imply."""

    pull_px: Array
    """(4,) distances over which points are pulled, in the order of MEAN."""
    unit_px: Array
    """(4,) the same for a coding error as large as the noise at 0.1 bits per pixel."""
    lag_s: tuple[float, float]
    """Lag of the picture's bottom behind its top, and the rest of it that the pulls do not explain."""
    noise_px: float


def coding_section(work: Path, scale: Scale) -> tuple[Row, str]:
    """Measure all scenes (one with --quick) at every readout direction and bit rate."""
    scenes = list(enumerate(SCENES))[:: len(SCENES) if scale.quick else 1]
    rows = [row for one in product(scenes, READOUT_DIRECTIONS) for row in _rows(work, *one)]
    return {"captures": rows}, _text(rows)


def _rows(work: Path, scene: tuple[int, str], read: str) -> list[Row]:
    unharmed = _pulls(work, scene, read, UNHARMED_BITS_PER_PX)
    rows = []
    for bits in BITS_PER_PX:
        coded = _pulls(work, scene, read, bits)
        implied = (coded.pull_px - unharmed.pull_px) / coded.unit_px
        lags = np.subtract(coded.lag_s, unharmed.lag_s)
        rows.append({"scene": scene[1], "read": read, "bits_per_px": bits, "noise_px": coded.noise_px,
                     "lag_s": lags.tolist(), **dict(zip(PULLS, implied.tolist(), strict=True))})  # fmt: skip
    return rows


def _pulls(work: Path, scene: tuple[int, str], read: str, bits_per_px: float) -> _Pulls:
    number, name = scene
    rng = np.random.default_rng([FIRST_SEED, number])
    folder = simulated(
        work, f"coding-{name}-{read}-{bits_per_px:g}", scene=name, width=480, height=360, frames=FRAMES,
        rate_rad_s=float(rng.uniform(0.4, 1.4)), exposure_ms=float(rng.uniform(1, 8)),
        noise_levels=float(rng.uniform(0.7, 2.5)), readout_ms=float(rng.uniform(10, 26)), direction=read,
        bitrate_bits_per_px=bits_per_px, seed=FIRST_SEED + number, truth_frames=False,
    )  # fmt: skip
    source = open_source(folder)
    return _explained(source.capture, source.profile, _evenly_tracked(source.capture, source.profile))


def _evenly_tracked(capture: Capture, profile: CameraProfile) -> TrackTable:
    """Points of a capture whose profile is right, tracked in equally blurred frames."""
    guide = EvenGuide(gyro_guide(capture, profile), None, np.zeros(1))
    pairs = track_frames(GrayReader.of(capture.movie), range(FRAMES), guide=guide)
    return observe_tracks(capture, pairs, profile).table(MOST_POINTS)


def _explained(capture: Capture, profile: CameraProfile, table: TrackTable) -> _Pulls:
    """Explain tracked minus predicted points by pulls, and by lags of the picture and of its bottom."""
    known = integrate_motion(capture.imu, profile, translation=False)
    at = predict(known, table, None)
    noise_px, apart_px = table.noise_px[table.pair], table.second_px - at.second_px
    slopes = step_slopes(known, table, None, at)
    ways = np.concatenate([slopes.changed, slopes.lasting])
    unit_px = _size(drawn_px(slopes, noise_px, table.bits_per_px)) / USUAL / _size(ways)
    later = replace(table, first_stamp_s=table.first_stamp_s + LATER_S, second_stamp_s=table.second_stamp_s + LATER_S)
    per_s = (predict(known, later, None).second_px - at.second_px) / LATER_S
    late = [-per_s, -per_s * (table.first_px[:, 1:] / profile.height - 0.5)]
    weight = cauchy_weight((apart_px**2).sum(axis=-1), CAUCHY * noise_px) / noise_px**2

    def fitted(patterns: Sequence[Array]) -> Array:
        columns = np.stack([pattern.ravel() for pattern in patterns], axis=-1)
        pulled = columns.T * np.repeat(weight, 2)
        return np.asarray(np.linalg.solve(pulled @ columns, pulled @ apart_px.ravel()))

    lag_s = float(fitted(late)[1]), float(fitted([*late, *-ways])[1])
    return _Pulls(fitted([*-ways]), unit_px, lag_s, float(np.median(noise_px)))


def _size(vectors: Array) -> Array:
    """Root mean square (k,) of vectors (k, n, 2)."""
    return np.asarray(np.sqrt((vectors**2).sum(axis=-1).mean(axis=-1)))


def _text(rows: list[Row]) -> str:
    lines = []
    for read, bits in product(READOUT_DIRECTIONS, BITS_PER_PX):
        some = [row for row in rows if row["read"] == read and row["bits_per_px"] == bits]
        lines.append([read, f"{bits:g}", *_shown(some)])
    for bits in BITS_PER_PX:
        lines.append(["all", f"{bits:g}", *_shown([row for row in rows if row["bits_per_px"] == bits])])
    lines.append(["all", "all", *_shown(rows)])
    header = ["read", "bits/px", "noise px", "bottom lags µs", "beside pulls", f"{PULLS[0]}: implied mean ± std",
              *PULLS[1:]]  # fmt: skip
    in_use = ", ".join(f"{mean:g} ± {std:g}" for mean, std in zip(MEAN, DEVIATION, strict=True))
    return (
        "CODING: points pulled to the motion of neighbouring blocks, fractions of the noise at 0.1 bits per pixel\n"
        f"in use ({', '.join(PULLS)}): {in_use}\n{numeric_table(header, lines)}"
    )


def _shown(rows: list[Row]) -> list[str]:
    """Means over captures, and means and standard deviations of the coding errors that they imply."""
    noise_px, lags_us = (np.mean([row[key] for row in rows], axis=0) for key in ("noise_px", "lag_s"))
    implied = np.array([[row[pull] for pull in PULLS] for row in rows])
    parts = zip(implied.mean(axis=0), implied.std(axis=0), strict=True)
    return [f"{noise_px:.3f}", *(f"{1e6 * lag:+.0f}" for lag in lags_us), *(f"{m:+.3f} ± {d:.3f}" for m, d in parts)]
