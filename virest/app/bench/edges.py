"""Detection of sharpening (:mod:`virest.inference.unsharp_mask`) and defocus from edges.

$ python -m virest.app.bench --only edges --quick
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.workload import Scale, simulated
from virest.app.console import numeric_table
from virest.app.diagnose import open_source
from virest.diagnosis.local_blur import look_for_blur
from virest.diagnosis.local_blur_fit import Defocus, fit
from virest.inference.unsharp_mask import FALSE_ALARM, MOST_FRAMES, Overshoot, overshoot
from virest.motion.integration import integrate_gyro
from virest.motion.optics import moving_lens
from virest.restoration.capture import moved_over_frame
from virest.restoration.neighbours.survey import path_length_px
from virest.simulation.phone_isp import PhoneIsp

Row = dict[str, Any]
SCENES = ("leaves", "text", "board", "bright", "photographs")
SIZES = ((320, 240), (640, 480))
MOTIONS = ((0.4, 6.0), (0.6, 8.0), (1.2, 12.0))
"""RMS angular rate in rad/s and exposure in ms."""
MASKS = ((0.0, 1.0), (0.4, 1.0), (0.7, 1.0), (1.0, 1.5))
"""Amount and radius in px of the unsharp mask; the first entry is no sharpening."""
FRAMES, FIRST_SEED = 6, 7000
"""The edge spread is measured in single frames; first of this section's seeds."""
DEFOCUS_PX, SOFT_SCENES = (2.0, 2.5, 3.0, 3.5), ("leaves", "text", "board", "photographs")
"""σ of the added defocus; the scenes above without ``bright``."""
SOFT_FRAMES, FIRST_SOFT_SEED = 60, 7200
"""Defocus is fitted to a whole capture, here two seconds."""


def edges_section(work: Path, scale: Scale) -> tuple[Row, str]:
    """Measure all scenes, sizes and motions with every mask, and captures with defocus."""
    every = list(product(SCENES, SIZES, MOTIONS))[:: 4 if scale.quick else 1]
    groups = [[_row(work, number, *one, mask) for number, one in enumerate(every)] for mask in MASKS]
    softened = list(enumerate(product(DEFOCUS_PX, SOFT_SCENES)))[:: 5 if scale.quick else 1]
    soft = [_soft_row(work, *one) for one in softened]
    found = {"captures": [row for rows in groups for row in rows], "defocus": soft}
    return found, f"{_text(groups)}\n{_soft_text(soft)}"


def _row(
    work: Path,
    number: int,
    scene: str,
    size: tuple[int, int],
    motion: tuple[float, float],
    mask: tuple[float, float],
) -> Row:
    isp = PhoneIsp(sharpen=mask[0], sharpen_radius_px=mask[1], bits_per_px=(0.25, 0.6)[number % 2])
    name = f"edges-{number}-{mask[0]:g}"
    capture = simulated(
        work, name, scene=scene, width=size[0], height=size[1], frames=FRAMES, rate_rad_s=motion[0],
        exposure_ms=motion[1], seed=FIRST_SEED + number, isp=isp, truth_frames=False,
    )  # fmt: skip
    found = _overshoot(capture)
    row: Row = {"capture": name, "scene": scene, "size": list(size), "mask": list(mask), "p_value": None}
    if found is None:
        return row
    fitted = found.mask()
    overshoots = {"of_all": found.of_all, "of_sharpest": found.of_sharpest, "p_value": found.p_value}
    expected = found.expected_mask().amount
    return row | overshoots | {"fitted": [fitted.amount, fitted.radius_px], "expected": expected}


def _soft_row(work: Path, number: int, hidden: tuple[float, str]) -> Row:
    """Fit the defocus of one capture, its only model error, from its edges."""
    sigma_px, scene = hidden
    rng = np.random.default_rng([FIRST_SOFT_SEED, number])
    capture = simulated(
        work, f"defocus-{number}", scene=scene, width=480, height=360, frames=SOFT_FRAMES,
        rate_rad_s=float(rng.uniform(0.5, 1.4)), exposure_ms=float(rng.uniform(4, 11)),
        noise_levels=float(rng.uniform(1, 2.5)), bitrate_bits_per_px=float(rng.uniform(0.15, 0.4)),
        seed=FIRST_SOFT_SEED + number, effects=(f"defocus={sigma_px}",), truth_frames=False,
    )  # fmt: skip
    source = open_source(capture)
    trajectory = integrate_gyro(source.capture.imu, source.profile)
    seen = look_for_blur(source.gray, source.capture, source.profile, trajectory)
    effects: list[Any] = [Defocus()]
    found = fit(seen, source.profile, trajectory, effects)
    estimate = {"told_px": float(found.values[0][0]), "std_px": float(found.std[0])} if found.determined[0] else {}
    return {"scene": scene, "sigma_px": sigma_px, "edges": len(seen.edges), **estimate}


def _soft_text(rows: list[Row]) -> str:
    estimated = [row for row in rows if "told_px" in row]
    lines = [
        [f"{row['sigma_px']:g}", row["scene"], str(row["edges"]), f"{row['told_px']:.2f} ± {row['std_px']:.2f}"]
        for row in estimated
    ]
    off = np.array([row["told_px"] / row["sigma_px"] - 1 for row in estimated])
    return (
        f"DEFOCUS, px: relative error {np.mean(off):+.3f} in the mean, rms {np.sqrt(np.mean(off**2)):.3f},\n"
        f"in {len(estimated)} of {len(rows)} captures\n"
        + numeric_table(["hidden", "scene", "edges", "estimated"], lines)
    )


def _overshoot(capture: Path) -> Overshoot | None:
    """Overshoot in the MOST_FRAMES least blurred frames, measured as in the planning of a restoration."""
    source = open_source(capture)
    trajectory = integrate_gyro(source.capture.imu, source.profile)
    lens = moving_lens(trajectory, source.profile)
    motions = [
        moved_over_frame(trajectory, lens, frame, "exposure-start", None, source.profile)
        for frame in source.capture.frames
    ]
    least_blurred = sorted(range(len(motions)), key=lambda n: path_length_px(motions[n]))[:MOST_FRAMES]
    grey = source.gray(sorted(least_blurred))
    return overshoot([(picture, motions[n]) for n, picture in grey if picture is not None])


def _text(groups: list[list[Row]]) -> str:
    header = [
        "mask",
        "captures",
        "all edges",
        "sharpest",
        "most",
        f"detected (p < {FALSE_ALARM:g})",
        "amount",
        "radius px",
        "undone",
    ]
    lines = []
    for rows in groups:
        measured = [row for row in rows if row["p_value"] is not None]
        seen = [row for row in measured if row["p_value"] < FALSE_ALARM]
        every, sharpest = (np.array([row[key] for row in measured]) for key in ("of_all", "of_sharpest"))
        fitted = np.array([row["fitted"] for row in (measured if rows[0]["mask"][0] else seen)]).reshape(-1, 2)
        lines.append(
            [
                f"{rows[0]['mask'][0]:g}, {rows[0]['mask'][1]:g} px" if rows[0]["mask"][0] else "none",
                str(len(measured)),
                _mean_and_std(every, 4),
                _mean_and_std(sharpest, 4),
                f"{sharpest.max():.3f}",
                f"{len(seen)} of {len(measured)}",
                _mean_and_std(fitted[:, 0], 2),
                _mean_and_std(fitted[:, 1], 2),
                _mean_and_std([row["expected"] for row in measured], 2),
            ]
        )
    return (
        "EDGES: overshoot beside flat plateaus, as a fraction of the step, mean ± deviation between captures;\n"
        "how often a phone's sharpening is detected, the mask fitted to the sharpest edges, and the amount undone\n"
        + numeric_table(header, lines)
    )


def _mean_and_std(values: Any, digits: int) -> str:
    return f"{np.mean(values):.{digits}f} ± {np.std(values):.{digits}f}" if len(values) else "-"
