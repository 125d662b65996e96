"""Whether deviations hold: calibrate simulated captures whose truth is known, and compare errors with deviations.

Each seed draws what is hidden, and how the capture is taken: motion, blur, noise, bit rate, scene, layout.  The table
shows, for each value, median |error| / deviation (0.67 where deviations hold) and the part of errors within two of them
(0.95), the mean error in deviations, which a bias moves from 0, and a histogram of error / deviation.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from virest.app.bench.tables import table
from virest.app.bench.workload import Scale
from virest.app.calibrate import plan_calibration
from virest.app.simulate import simulate_command
from virest.calibration.geometry import CalibratedValue, GeometryCalibration, calibrate_geometry
from virest.camera.profile import CameraProfile, read_profile
from virest.capture.video import GrayReader, probe_movie
from virest.errors import VirestError
from virest.inference.guide_choice import track_guided

Array = NDArray[np.float64]
Row = dict[str, Any]
FRAMES, QUICK_SEEDS = 90, 12
EXTRA = ("focal", "distortion", "principal-point")
HIDDEN = ("time_offset", "readout_time", "gyro_bias", "imu_rotation", "focal_length", "radial_distortion",
          "principal_point")  # fmt: skip
SCENES = ("leaves", "text", "board", "photographs")
FIRST_SEED = 50_000
BINS = np.array([-np.inf, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, np.inf])


def calibration_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Calibrate one capture a seed."""
    seeds = QUICK_SEEDS if scale.quick else scale.seeds
    rows = [row for k in range(seeds) for row in calibrated_rows(work, FIRST_SEED + k)]
    names = list(dict.fromkeys(row["value"] for row in rows))
    summary = {name: summed([row["error_in_std"] for row in rows if row["value"] == name]) for name in names}
    header = ["value", "captures", "median |e|/σ", "within 2σ", "mean e/σ", "e/σ below -3, -2, -1, 0, 1, 2, 3, above"]
    text = table(header, [_shown(name, one) for name, one in summary.items()])
    return {"summary": summary, "rows": rows}, f"Deviations of calibrate: {seeds} simulated captures\n{text}"


def calibrated_rows(work: Path, seed: int) -> list[Row]:
    """Errors and deviations of all values of one capture; none where the calibration refuses it."""
    rng = np.random.default_rng([seed, 91])
    width, height = (360, 480) if rng.integers(2) else (480, 360)
    folder = work / f"calibration_{seed}"
    taken: dict[str, Any] = {
        "scene": SCENES[rng.integers(len(SCENES))],
        "rate_rad_s": float(rng.uniform(0.6, 1.5)),
        "exposure_ms": float(rng.uniform(3, 14)),
        "noise_levels": float(rng.uniform(1.0, 2.5)),
        "bitrate_bits_per_px": float(np.exp(rng.uniform(np.log(0.15), np.log(1.0)))),
    }
    simulate_command(folder, width=width, height=height, frames=FRAMES, seed=seed, effects=HIDDEN, **taken)
    try:
        plan = plan_calibration(folder, None, EXTRA)
        movie = plan.capture.movie
        pairs = track_guided(plan.capture, plan.profile, GrayReader(movie, probe_movie(movie)), plan.frames)
        found = calibrate_geometry(plan.capture, plan.profile, pairs, plan.extra)
    except VirestError:
        return []
    else:
        truth = read_profile(folder / "truth" / "camera.yaml")
        return [{"seed": seed, **taken, "noise_px": found.noise_px, **row} for row in errors_of(found, truth)]
    finally:
        shutil.rmtree(folder)


def errors_of(found: GeometryCalibration, truth: CameraProfile) -> list[Row]:
    """Error and deviation of each number of what was determined."""
    rows = []
    for value in found.values:
        true = _true_value(value, found.profile, truth)
        if not value.determined or true is None or value.std is None:
            continue
        off, std = (np.atleast_1d(np.asarray(v, float)) for v in (true, value.std))
        for k, (error, deviation) in enumerate(zip(off, std, strict=True)):
            name = value.name if len(off) == 1 else f"{value.name}[{k}]"
            rows.append({"value": name, "error": float(error), "std": float(deviation),
                         "error_in_std": float(error / deviation)})  # fmt: skip
    return rows


def _true_value(value: CalibratedValue, found: CameraProfile, truth: CameraProfile) -> Array | None:
    """Found − true, (k,); None for a word."""
    lens, true_lens = found.intrinsics, truth.intrinsics
    assert lens is not None
    assert true_lens is not None
    match value.name:
        case "time_offset_s":
            return np.array([(found.time_offset_s or 0.0) - (truth.time_offset_s or 0.0)])
        case "readout_time_s":
            return np.array([found.shutter.readout_time_s - truth.shutter.readout_time_s])
        case "rotation_rad":
            turn = found.rotation_cam_imu @ truth.rotation_cam_imu.T
            return Rotation.from_matrix(turn).as_rotvec()
        case "gyro_bias_rad_s":
            return np.subtract(found.gyro_bias_rad_s, truth.gyro_bias_rad_s)
        case "fx_px":
            return np.array([lens.fx_px - true_lens.fx_px])
        case "k1":
            return np.array([lens.coefficients[0] - (true_lens.coefficients or (0.0,))[0]])
        case "principal_point_px":
            return np.array([lens.cx_px - true_lens.cx_px, lens.cy_px - true_lens.cy_px])
        case _:
            return None


def summed(ratios: list[float]) -> dict[str, Any]:
    """What errors in deviations amount to."""
    known = np.array(ratios)
    return {
        "count": len(known),
        "median": float(np.median(np.abs(known))),
        "within_two": float(np.mean(np.abs(known) < 2)),
        "mean": float(known.mean()),
        "histogram": np.histogram(known, BINS)[0].tolist(),
    }


def _shown(name: str, one: dict[str, Any]) -> list[str]:
    counts = " ".join(str(count) for count in one["histogram"])
    return [name, str(one["count"]), f"{one['median']:.2f}", f"{one['within_two']:.0%}", f"{one['mean']:+.2f}", counts]
