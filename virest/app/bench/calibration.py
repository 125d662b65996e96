"""Validity of calibrate's standard deviations σ: errors on simulated captures compared with σ.

Each seed draws the hidden values and the conditions: motion, translation, blur, exposures, noise, bit rate, scene,
lens, orientation.  Seeds below FIRST_SEED are reserved for choosing constants.

For each value the table shows median |error| / deviation (0.67 where deviations hold), the fraction of errors within
two deviations (0.95), the mean error in deviations, which a bias moves from 0, and a histogram.  "share" is the
fraction of a step's noise that is correlated with the value's own pattern: the one that these errors imply (with it
the median would be 0.67) and the one that :data:`virest.inference.tracking_bias.EVEN_SHARED` uses.  The last line gives
the most likely one for all values, with the part of the blur's bias that equally blurred frames leave.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from virest.app.bench.workload import Scale
from virest.app.calibrate import find_calibration, plan_calibration
from virest.app.console import numeric_table
from virest.app.simulate import simulate_command
from virest.arrays import Array
from virest.calibration.calibrated_values import CalibratedValue
from virest.calibration.geometry import GeometryCalibration
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import read_profile
from virest.errors import VirestError
from virest.inference.blur_bias import LEFT_BY_EVEN_BLUR
from virest.inference.robust import NORMAL_MEDIAN
from virest.inference.tracking_bias import EVEN_SHARED, shared_std
from virest.report.figures import deviation_figure

Row = dict[str, Any]
FRAMES, QUICK_SEEDS = 90, 12
"""Three seconds, as long as the captures of the other sections; seeds of a quick run."""
EXTRA = ("focal", "distortion", "principal-point")
HIDDEN = ("time_offset", "readout_time", "gyro_bias", "imu_rotation", "focal_length", "radial_distortion",
          "principal_point")  # fmt: skip
SCENES = ("leaves", "text", "board", "photographs")
FIRST_SEED = 4001
"""First of this section's seeds."""
SHARES, LEFTS = np.arange(0.0, 0.0151, 0.001), np.arange(0.0, 0.51, 0.05)
"""Shared fractions and parts of the blur's bias of which the most likely are sought."""
LEAST_REST = 0.01
"""Smallest part of a variance that is neither of them."""
FIGURE = "calibration.png"
BINS = np.array([-np.inf, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, np.inf])
"""Edges of the printed histogram of e / σ, with the tails beyond 3 σ apart."""


def calibration_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Calibrate one capture per seed; draw the histograms into the folder for figures, if given."""
    seeds = QUICK_SEEDS if scale.quick else scale.seeds
    rows = [row for k in range(seeds) for row in calibrated_rows(work, FIRST_SEED + k)]
    names = list(dict.fromkeys(row["value"] for row in rows))
    summary = {name: summed([row for row in rows if row["value"] == name]) for name in names}
    header = ["value", "errors", "median |e|/σ", "within 2σ", "mean e/σ", "share implied", "share used",
              "e/σ below -3, -2, -1, 0, 1, 2, 3, above"]  # fmt: skip
    text = numeric_table(header, [_shown(name, one) for name, one in summary.items()])
    if scale.figures is not None:
        ratios = {name: [row["error_in_std"] for row in rows if row["value"] == name] for name in names}
        title = f"Errors of calibrate in standard deviations, {seeds} simulated captures"
        (scale.figures / FIGURE).write_bytes(deviation_figure(ratios, title))
    share, left = most_likely(rows)
    closing = (
        f"most likely for all values: share {share:.3f} ({EVEN_SHARED:.3f} used), "
        f"blur left {left:.2f} ({LEFT_BY_EVEN_BLUR:.2f} used)"
    )
    return {"summary": summary, "rows": rows}, f"Deviations of calibrate: {seeds} simulated captures\n{text}\n{closing}"


def drawn_capture(seed: int) -> tuple[dict[str, Any], tuple[str, ...], tuple[str, ...]]:
    """The seed's capture options, its hidden effects, and the extra parameters to calibrate."""
    rng = np.random.default_rng([seed, 93])
    width, height = (360, 480) if rng.integers(2) else (480, 360)
    exposure_ms, vary, travels = float(rng.uniform(2, 14)), bool(rng.integers(2)), rng.uniform() < 0.2
    taken: dict[str, Any] = {
        "width": width,
        "height": height,
        "scene": SCENES[rng.integers(len(SCENES))],
        "rate_rad_s": float(rng.uniform(0.5, 1.6)),
        "exposure_ms": exposure_ms,
        "noise_levels": float(rng.uniform(0.7, 3.0)),
        "bitrate_bits_per_px": float(np.exp(rng.uniform(np.log(0.15), np.log(2.0)))),
        "readout_ms": float(rng.uniform(14, 26)),
    }
    depth_m, range_ev = float(rng.uniform(1.5, 5.0)), float(rng.uniform(0.8, 2.0))
    taken |= {"depth_m": depth_m} if travels else {}
    taken |= {"auto_exposure_ev": range_ev} if vary else {}
    if rng.integers(2):
        taken["distortion"] = ("radtan", (float(rng.uniform(-0.12, 0.12)), 0.0, 0.0, 0.0, 0.0))
    hidden, extra = ((*HIDDEN, "exposure_time"), (*EXTRA, "exposure-scale")) if vary else (HIDDEN, EXTRA)
    return taken, hidden, extra


def calibrated_rows(work: Path, seed: int) -> list[Row]:
    """Errors and standard deviations of all values of one capture; none if the calibration refuses it."""
    taken, hidden, extra = drawn_capture(seed)
    folder = work / f"calibration_{seed}"
    simulate_command(folder, frames=FRAMES, seed=seed, effects=hidden, **taken)
    try:
        found = calibrate_folder(folder, extra)
    except VirestError:
        return []
    else:
        truth = read_profile(folder / "truth" / "camera.yaml")
        return [{"seed": seed, **taken, "noise_px": found.noise_px, **row} for row in errors_of(found, truth)]
    finally:
        shutil.rmtree(folder)


def calibrate_folder(folder: Path, extra: Sequence[str] = ()) -> GeometryCalibration:
    """Calibrate a capture as ``virest calibrate --with EXTRA`` does, without writing a profile."""
    return find_calibration(plan_calibration(folder, None, extra))[1]


def errors_of(found: GeometryCalibration, truth: CameraProfile) -> list[Row]:
    """Error and standard deviation of each determined number."""
    rows = []
    for value in found.values:
        difference = _error(value, found.profile, truth)
        if not value.determined or difference is None or value.std is None:
            continue
        errors, stds = (np.atleast_1d(np.asarray(v, float)) for v in (difference, value.std))
        name, unit = _TERMS[value.name]
        shared = unit(found.profile) * shared_std(found.fit, name)
        blurred = unit(found.profile) * found.fit.by_error[found.fit.slices[name]]
        for k, (error, std) in enumerate(zip(errors, stds, strict=True)):
            rows.append({"value": value.name, "component": k, "error": float(error), "std": float(std),
                         "shared_std": float(shared[k]), "blur_std": float(blurred[k]),
                         "error_in_std": float(error / std)})  # fmt: skip
    return rows


_TERMS: dict[str, tuple[str, Callable[[CameraProfile], float]]] = {
    "time_offset_s": ("time_offset", lambda _: 1.0),
    "readout_time_s": ("readout_time", lambda _: 1.0),
    "rotation_rad": ("imu_rotation", lambda _: 1.0),
    "gyro_bias_rad_s": ("gyro_bias", lambda _: 1.0),
    "fx_px": ("focal_length", lambda p: p.intrinsics.fx_px if p.intrinsics else 0.0),
    "k1": ("radial_distortion", lambda _: 1.0),
    "principal_point_px": ("principal_point", lambda _: 1.0),
    "exposure_scale": ("exposure_time", lambda p: p.shutter.exposure_scale),
}
"""Term of each value, and the factor from the term's unit to the value's."""


def _error(value: CalibratedValue, found: CameraProfile, truth: CameraProfile) -> Array | None:
    """Error (k,) of a value, found − true; None for a word."""
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
        case "exposure_scale":
            return np.array([found.shutter.exposure_scale - truth.shutter.exposure_scale])
        case _:
            return None


def summed(rows: Sequence[Row]) -> dict[str, Any]:
    """Statistics of one value's errors in standard deviations, and the shared fraction of the noise that they imply."""
    errors = np.array([row["error_in_std"] for row in rows])
    return {
        "count": len(errors),
        "median": float(np.median(np.abs(errors))),
        "within_two": float(np.mean(np.abs(errors) < 2)),
        "mean": float(errors.mean()),
        "share_asked": EVEN_SHARED * _implied_factor(rows),
        "share_in_use": EVEN_SHARED,
        "histogram": np.histogram(errors, BINS)[0].tolist(),
    }


def _implied_factor(rows: Sequence[Row]) -> float:
    """Factor on the shared standard deviation for which the median |error| / σ would be NORMAL_MEDIAN."""
    error, std, shared = (np.array([row[key] for row in rows]) for key in ("error", "std", "shared_std"))
    rest = np.maximum(std**2 - shared**2, 0.0)
    factors = np.linspace(0.0, 4.0, 401)
    medians = [float(np.median(np.abs(error) / np.sqrt(rest + (factor * shared) ** 2))) for factor in factors]
    return float(factors[int(np.argmin(np.abs(np.array(medians) - NORMAL_MEDIAN)))])


def most_likely(rows: Sequence[Row]) -> tuple[float, float]:
    """Shared fraction and part of the blur's bias left, for which these errors are most likely if they are normal."""
    error, std, shared, blurred = (
        np.array([row[k] for row in rows]) for k in ("error", "std", "shared_std", "blur_std")
    )
    rest = np.maximum(std**2 - shared**2 - blurred**2, LEAST_REST * std**2)
    costs = {}
    for share, left in product(SHARES, LEFTS):
        variance = rest + (share / EVEN_SHARED * shared) ** 2 + (left / LEFT_BY_EVEN_BLUR * blurred) ** 2
        costs[float(share), float(left)] = float((np.log(variance) + error**2 / variance).sum())
    return min(costs, key=costs.__getitem__)


def _shown(name: str, one: dict[str, Any]) -> list[str]:
    counts = " ".join(str(count) for count in one["histogram"])
    shares = [f"{one['share_asked']:.3f}", f"{one['share_in_use']:.3f}"]
    return [name, str(one["count"]), f"{one['median']:.2f}", f"{one['within_two']:.0%}", f"{one['mean']:+.2f}",
            *shares, counts]  # fmt: skip
