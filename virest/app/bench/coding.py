"""How far coding draws points to the motion of the blocks above and to the left (:mod:`virest.inference.coded_motion`).

$ python -m virest.app.bench --only coding --quick

Captures of which nothing is wrong, of four motions and contents, each read downwards, upwards, to the right and to the
left and coded at three rates: by how much the time offset that their points ask for is off, and what error of a step,
over the square of its noise, that asks for beside the one in use.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.tables import table
from virest.app.bench.workload import Scale, simulated
from virest.app.diagnose import open_source
from virest.camera.shutter import READOUT_DIRECTIONS
from virest.capture.video import GrayReader, probe_movie
from virest.image_formation.point_model import TrackTable, ground, predict
from virest.inference.coded_motion import DRAWN_PER_PX, drawn_px, step_slopes
from virest.inference.guide_choice import track_guided
from virest.inference.observed_tracks import observe_tracks
from virest.inference.profile_terms import TIME_OFFSET
from virest.inference.track_fit import fit_tracks

Row = dict[str, Any]
BITS_PER_PX = (0.5, 0.2, 0.1)
SCENES = ("leaves", "text", "board", "photographs")
FIRST_SEED, FRAMES, MOST_POINTS = 9101, 84, 7000


def coding_section(work: Path, scale: Scale) -> tuple[Row, str]:
    """Measure captures of all scenes, read and coded in all ways; quick: of one."""
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
    pairs = track_guided(capture, profile, GrayReader(capture.movie, probe_movie(capture.movie)), range(FRAMES))
    seen = observe_tracks(capture, pairs, profile).table(MOST_POINTS)

    def offset_s(points: TrackTable) -> float:
        return float(fit_tracks(capture.imu, points, profile, (TIME_OFFSET,), covariances=False).change[0])

    known = ground(capture.imu, profile, translation=False)
    slopes = step_slopes(known, seen, None, predict(known, seen, None))
    in_use, axis = DRAWN_PER_PX, 0 if profile.shutter.reads_columns else 1
    drawn = drawn_px(slopes, seen.noise_px[seen.pair])[axis] / in_use[axis]
    lag_s = offset_s(seen)
    unit_s = offset_s(replace(seen, second_px=seen.second_px + drawn)) - lag_s
    return {"scene": name, "read": read, "bits_per_px": bits_per_px, "noise_px": float(np.median(seen.noise_px)),
            "offset_s": lag_s, "drawn_per_px": lag_s / unit_s, "in_use": in_use[axis]}  # fmt: skip


def _text(rows: list[Row]) -> str:
    lines = []
    for read, bits in product(READOUT_DIRECTIONS, BITS_PER_PX):
        some = [row for row in rows if row["read"] == read and row["bits_per_px"] == bits]
        offset_us, asked = (np.array([row[key] for row in some]) for key in ("offset_s", "drawn_per_px"))
        lines.append(
            [read, f"{bits:g}", f"{np.mean([row['noise_px'] for row in some]):.3f}", f"{1e6 * np.mean(offset_us):+.0f}",
             f"{np.mean(asked):+.1f}", f"{np.sqrt(np.mean(asked**2)):.1f}", f"{some[0]['in_use']:g}"]
        )  # fmt: skip
    header = ["read", "bits/px", "noise px", "offset off by µs", "asked 1/px", "rms", "in use"]
    return "CODING: points drawn to the motion of the blocks above and to the left\n" + table(header, lines)
