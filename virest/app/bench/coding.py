"""Bias of tracked points towards the motion of neighbouring coding blocks (:mod:`virest.inference.coded_motion`).

$ python -m virest.app.bench --only coding --quick

Captures without model errors, of four scenes and motions, are read out in all four directions and coded at three bit
rates.  Time offset, principal point, and k1 with the focal length are each fitted alone.  Their errors imply a coding
error of a step, as a fraction of its noise at 0.1 bits per pixel: by rows, at one instant, and of curved flow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.workload import Scale, simulated
from virest.app.console import numeric_table
from virest.app.diagnose import open_source
from virest.arrays import Array
from virest.camera.shutter import READOUT_DIRECTIONS
from virest.capture.video import GrayReader
from virest.image_formation.point_model import TrackTable, integrate_motion, predict
from virest.inference.blur_bias import blur_bias_px
from virest.inference.coded_motion import DEVIATION, MEAN, USUAL, drawn_px, step_slopes
from virest.inference.guide_choice import track_guided
from virest.inference.observed_tracks import observe_tracks
from virest.inference.profile_terms import FOCAL, K1, PRINCIPAL_POINT, TIME_OFFSET
from virest.inference.term import Term
from virest.inference.track_fit import fit_tracks

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
    observed = observe_tracks(capture, pairs, profile)
    seen = observed.table(MOST_POINTS)

    def fitted(terms: Sequence[Term], points: TrackTable) -> Array:
        return fit_tracks(capture.imu, points, profile, terms, covariances=False).change

    known = integrate_motion(capture.imu, profile, translation=False)
    guided = np.array([pair.guided for pair in observed.pairs])
    seen = replace(seen, second_px=seen.second_px - blur_bias_px(known, seen, guided))
    slopes = step_slopes(known, seen, None, predict(known, seen, None))
    drawn = drawn_px(slopes, seen.noise_px[seen.pair], seen.bits_per_px)
    rows, lens = 2 if profile.shutter.reads_columns else 3, (FOCAL, K1)
    offset, centre = (TIME_OFFSET,), (PRINCIPAL_POINT,)
    off: dict[tuple[Term, ...], Array] = {terms: fitted(terms, seen) for terms in (offset, centre, lens)}

    def asked(terms: tuple[Term, ...], pattern: int, part: int) -> float:
        usual = fitted(terms, replace(seen, second_px=seen.second_px + drawn[pattern])) - off[terms]
        return float(USUAL[pattern] * off[terms][part] / usual[part])

    return {"scene": name, "read": read, "bits_per_px": bits_per_px, "noise_px": float(np.median(seen.noise_px)),
            "offset_s": float(off[offset][0]), "centre_px": off[centre].tolist(), "k1": float(off[lens][1]),
            "left": asked(centre, 0, 0), "above": asked(centre, 1, 1), "by_rows": asked(offset, rows, 0),
            "curved": asked(lens, 4, 1)}  # fmt: skip


def _text(rows: list[Row]) -> str:
    lines = []
    for read, bits in product(READOUT_DIRECTIONS, BITS_PER_PX):
        some = [row for row in rows if row["read"] == read and row["bits_per_px"] == bits]
        offset_us, k1 = (scale * np.mean([row[key] for row in some]) for scale, key in ((1e6, "offset_s"), (1.0, "k1")))
        off = offset_us, *np.mean([row["centre_px"] for row in some], axis=0), k1
        lines.append(
            [read, f"{bits:g}", f"{np.mean([row['noise_px'] for row in some]):.3f}",
             *(f"{value:+.{digits}f}" for value, digits in zip(off, (0, 2, 2, 4), strict=True)),
             *(_asked(some, kind) for kind in ("by_rows", "left", "above", "curved"))]
        )  # fmt: skip
    header = ["read", "bits/px", "noise px", "offset µs", "cx px", "cy px", "k1",
              "by rows: implied mean ± std", "left", "above", "curved"]  # fmt: skip
    for bits in BITS_PER_PX:
        some = [row for row in rows if row["bits_per_px"] == bits]
        for name, read in (("columns", "left_to_right right_to_left"), ("rows", "top_to_bottom bottom_to_top")):
            by_rows = _asked([row for row in some if row["read"] in read], "by_rows")
            others = [_asked(some, kind) for kind in ("left", "above", "curved")] if name == "rows" else [""] * 3
            lines.append([name, f"{bits:g}", "", "", "", "", "", by_rows, *others])
    in_use = ", ".join(f"{mean:g} ± {std:g}" for mean, std in zip(MEAN, DEVIATION, strict=True))
    return (
        "CODING: points pulled to the motion of neighbouring blocks, fractions of the noise at 0.1 bits per pixel\n"
        f"in use (left, above, columns, rows, curved): {in_use}\n{numeric_table(header, lines)}"
    )


def _asked(rows: list[Row], kind: str) -> str:
    """Mean and standard deviation of the coding errors implied by the captures."""
    asked = np.array([row[kind] for row in rows])
    return f"{asked.mean():+.3f} ± {asked.std():.3f}"
