"""Position errors of straightened points against truth, for all four readout directions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.workload import Scale, recorded_frames, run_process, simulated
from virest.app.console import numeric_table
from virest.app.evaluation_captures import truth_frame
from virest.camera.shutter import READOUT_DIRECTIONS
from virest.evaluation.fidelity import point_distances_px

SIZES = {"640x480": (640, 480), "720x1280": (720, 1280)}
"""The simulator's usual frame in landscape and in portrait."""


def shutter_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Median and 90th percentile of the distance (px) between corners of the truth and the same points of the frame."""
    sizes = dict(list(SIZES.items())[:1]) if scale.quick else SIZES
    frames = 3 if scale.quick else 8
    results = [_measure(work, size, direction, frames) for size in sizes for direction in READOUT_DIRECTIONS]
    header = ["size", "readout", "points", "recorded median", "straightened median", "straightened 90 %"]
    rows = [
        [r["size"], r["direction"], str(r["points"])]
        + [f"{r[key]:.3f}" for key in ("recorded_median_px", "straightened_median_px", "straightened_p90_px")]
        for r in results
    ]
    title = "SHUTTER: distance in px of tracked points from truth (exposure 1 ms, readout 20 ms, rate 1.5 rad/s)\n"
    return {"captures": results}, title + numeric_table(header, rows)


def _measure(work: Path, size: str, direction: str, frames: int) -> dict[str, Any]:
    width, height = SIZES[size]
    capture = simulated(
        work,
        f"{direction}-{size}",
        width=width,
        height=height,
        frames=frames,
        exposure_ms=1.0,
        rate_rad_s=1.5,
        direction=direction,
        seed=31,
    )
    run = run_process(capture, work / "shutter", "--deblur", "none")
    recorded = dict(recorded_frames(capture))
    before, after = [], []
    for line in run.lines:
        truth, valid = truth_frame(capture, line["frame"]), line["valid_px"]
        before.append(point_distances_px(recorded[line["frame"]], truth, valid))
        after.append(point_distances_px(run.picture(line), truth, valid))
    straightened = np.concatenate(after)
    return {
        "size": size,
        "direction": direction,
        "points": len(straightened),
        "recorded_median_px": float(np.median(np.concatenate(before))),
        "straightened_median_px": float(np.median(straightened)),
        "straightened_p90_px": float(np.quantile(straightened, 0.9)),
    }
