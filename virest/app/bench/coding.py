"""Bias of tracked points towards the motion of neighbouring coding blocks (:mod:`virest.inference.coded_motion`).

$ python -m virest.app.bench --only coding --quick

Captures without model errors, of four scenes and motions, are read out in all four directions and coded at three bit
rates.  The time offset and the principal point are each fitted alone.  Their errors imply a coding error of a step,
divided by the square of its noise: by rows, and at one instant.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.app.bench.workload import Scale, simulated
from virest.app.console import numeric_table
from virest.app.diagnose import open_source
from virest.camera.shutter import READOUT_DIRECTIONS
from virest.capture.video import GrayReader
from virest.image_formation.point_model import TrackTable, integrate_motion, predict
from virest.inference.coded_motion import AT_ONCE_PER_PX, BY_ROWS_PER_PX, drawn_px, step_slopes
from virest.inference.guide_choice import track_guided
from virest.inference.observed_tracks import observe_tracks
from virest.inference.profile_terms import PRINCIPAL_POINT, TIME_OFFSET
from virest.inference.term import Term
from virest.inference.track_fit import fit_tracks

Array = NDArray[np.float64]
Row = dict[str, Any]
BITS_PER_PX = (0.5, 0.2, 0.1)
"""From twice a phone's usual 0.25 bits per pixel to less than half of it."""
SCENES = ("leaves", "text", "board", "photographs")
FIRST_SEED, FRAMES, MOST_POINTS = 9101, 84, 7000
"""First of this section's seeds; 2.8 s of movie; most track points of a fit, so that it stays short."""


def coding_section(work: Path, scale: Scale) -> tuple[Row, str]:
    """Measure all scenes (one with --quick) at every readout direction and bit rate."""
    scenes = list(enumerate(SCENES))[:: len(SCENES) if scale.quick else 1]
    rows = [_row(work, *one) for one in product(scenes, READOUT_DIRECTIONS, BITS_PER_PX)]
    return {"captures": rows}, _text(rows)


def _row(work: Path, scene: tuple[int, str], read: str, bits_per_px: float) -> Row:
    number, name = scene
    rng = np.random.default_rng([FIRST_SEED, number])
    folder = simulated(
        work, f"coding-{name}-{read}-{bits_per_px:g}", scene=name, width=480, height=360, frames=FRAMES,
        rate_rad_s=float(rng.uniform(0.4, 1.4)), exposure_ms=float(rng.uniform(1, 8)),
        noise_levels=float(rng.uniform(0.7, 2.5)), readout_ms=float(rng.uniform(10, 26)), direction=read,
        bitrate_bits_per_px=bits_per_px, seed=FIRST_SEED + number, truth_frames=False,
    )  # fmt: skip
    source = open_source(folder)
    capture, profile = source.capture, source.profile
    pairs = track_guided(capture, profile, GrayReader.of(capture.movie), range(FRAMES))
    seen = observe_tracks(capture, pairs, profile).table(MOST_POINTS)

    def fitted(term: Term, points: TrackTable) -> Array:
        return fit_tracks(capture.imu, points, profile, (term,), covariances=False).change

    known = integrate_motion(capture.imu, profile, translation=False)
    slopes = step_slopes(known, seen, None, predict(known, seen, None))
    at_once, by_rows = np.split(drawn_px(slopes, seen.noise_px[seen.pair]), 2)
    axis = 0 if profile.shutter.reads_columns else 1
    offset_s, centre_px = fitted(TIME_OFFSET, seen), fitted(PRINCIPAL_POINT, seen)

    def asked(term: Term, off: Array, drawn: Array, in_use: float, part: int = 0) -> float:
        unit = fitted(term, replace(seen, second_px=seen.second_px + drawn / in_use)) - off
        return float(off[part] / unit[part])

    left, above = (asked(PRINCIPAL_POINT, centre_px, at_once[k], AT_ONCE_PER_PX[k], k) for k in (0, 1))
    return {"scene": name, "read": read, "bits_per_px": bits_per_px, "noise_px": float(np.median(seen.noise_px)),
            "offset_s": float(offset_s[0]), "centre_px": centre_px.tolist(), "left": left, "above": above,
            "by_rows": asked(TIME_OFFSET, offset_s, by_rows[axis], BY_ROWS_PER_PX[axis])}  # fmt: skip


def _text(rows: list[Row]) -> str:
    lines = []
    for read, bits in product(READOUT_DIRECTIONS, BITS_PER_PX):
        some = [row for row in rows if row["read"] == read and row["bits_per_px"] == bits]
        off = 1e6 * np.mean([row["offset_s"] for row in some]), *np.mean([row["centre_px"] for row in some], axis=0)
        lines.append(
            [read, f"{bits:g}", f"{np.mean([row['noise_px'] for row in some]):.3f}",
             *(f"{value:+.{digits}f}" for value, digits in zip(off, (0, 2, 2), strict=True)),
             *(_asked(some, kind) for kind in ("by_rows", "left", "above"))]
        )  # fmt: skip
    header = ["read", "bits/px", "noise px", "offset µs", "cx px", "cy px",
              "by rows: implied 1/px, rms", "at once, left", "at once, above"]  # fmt: skip
    lines.append(["all", "", "", "", "", "", "", _asked(rows, "left"), _asked(rows, "above")])
    for name, read in (("columns", "left_to_right right_to_left"), ("rows", "top_to_bottom bottom_to_top")):
        lines.append(
            [name, "", "", "", "", "", _asked([row for row in rows if row["read"] in read], "by_rows"), "", ""]
        )
    in_use = f"in use: by rows {BY_ROWS_PER_PX}, at once {AT_ONCE_PER_PX} (left, above)"
    title = f"CODING: points pulled to the motion of the blocks above and to the left; {in_use}\n"
    return title + numeric_table(header, lines)


def _asked(rows: list[Row], kind: str) -> str:
    """Mean and RMS of the coding errors implied by the captures."""
    asked = np.array([row[kind] for row in rows])
    return f"{asked.mean():+.1f} {np.sqrt(np.mean(asked**2)):.1f}"
