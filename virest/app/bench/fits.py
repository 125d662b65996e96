"""Fit constants that a single capture cannot determine, on captures with truth: best values and standard deviations.

The captures are those of the honesty table with other seeds, so ``--only honesty`` is an independent test of the fit.
Standard deviations are jackknife estimates over captures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from virest.app.bench.workload import Scale, Workload, honesty_workloads, simulated
from virest.app.console import CONSOLE, numeric_table
from virest.app.evaluation_captures import TrueCapture, open_true_capture
from virest.arrays import Array
from virest.evaluation.fidelity import psnr_db
from virest.inference.robust import MEDIAN_TO_STD
from virest.restoration.capture import RestorationPlan
from virest.restoration.frame import RestoredFrame
from virest.restoration.neighbours import confirmation
from virest.restoration.neighbours.confirmation import ConfirmedGain
from virest.restoration.settings import PRESETS
from virest.restoration.statistics import of_picture, ring_fit
from virest.restoration.statistics.records import Misplaced
from virest.restoration.taken_part import CERTAIN_GAIN_DB

Row = dict[str, Any]
OTHER_SEEDS = 1000
"""Added to the seeds of the test captures."""
LEFT_OVER_NAMES = ("constant", "ideal filter's", "neighbours'", "coder's", "colour's")
LEFT_OVER_PRESETS = ("fast", "balanced")
OUTLYING_DB = 0.5
"""Error of the predicted gain at which the soft-L1 loss departs from the square."""


@dataclass(frozen=True, slots=True)
class Swept:
    """A module constant and the values to try on all captures."""

    name: str
    module: ModuleType
    attribute: str
    values: tuple[float, ...]


SWEPT = (
    Swept("curve error", of_picture, "CURVE_SLOPE_STD", (0.03, 0.06, 0.1, 0.15, 0.25)),
    Swept("coder's slope", ring_fit, "_CODER_SLOPE", (0.5, 1.0, 1.5, 2.0, 2.5)),
)


def fits_section(work: Path, scale: Scale) -> tuple[Row, str]:
    """Fit the constants of the predicted gain to measured gains, and find the best values of the swept constants."""
    rows: list[Row] = []
    gains: dict[str, list[Array]] = {swept.name: [] for swept in SWEPT}
    for workload in fit_workloads(scale):
        truth = _opened(work, workload)
        plan = truth.plan(PRESETS["fast"])
        straight_db = _psnr_db(truth, replace(plan, settings=replace(plan.settings, deblur="none")))
        rows += list(_promises(truth, plan, workload, straight_db))
        for swept in SWEPT:
            gains[swept.name].append(_swept_gains(truth, plan, swept, straight_db))
        CONSOLE.line(f"{workload.name}: {len(straight_db)} frames")
    promise = fit_left_over(rows)
    best = {swept.name: best_value(swept.values, np.array(gains[swept.name])) for swept in SWEPT}
    facts = {"left_over": promise, "swept": best, "frames": rows}
    return facts, _text(promise, best, {s.name: (s.values, np.mean(gains[s.name], axis=0)) for s in SWEPT})


def fit_workloads(scale: Scale) -> list[Workload]:
    """The captures of the honesty table with other seeds."""
    return [
        dataclasses.replace(w, name=f"fit-{w.name}", options={**w.options, "seed": w.options["seed"] + OTHER_SEEDS})
        for w in honesty_workloads(scale)
    ]


def fit_left_over(rows: Sequence[Row]) -> Row:
    """Fit the coefficients of :data:`confirmation.LEFT_OVER` to the gains: values, standard deviations and scatter.

    rows: with ``capture``, ``removed``, ``misplaced``, ``regressors`` (of
    :func:`confirmation.gain_regressors`) and ``gain_db``.  Captures have equal weight.
    """
    captures = np.array([row["capture"] for row in rows])
    names = list(dict.fromkeys(captures.tolist()))
    fitted = _fitted(rows, captures)
    left_out = [_fitted([r for r in rows if r["capture"] != n], captures[captures != n]) for n in names]
    std = np.sqrt((len(names) - 1) * np.var(left_out, axis=0)) if len(names) > 1 else np.full(len(fitted), np.nan)
    off_db = np.abs(_promised_db(rows, fitted) - [row["gain_db"] for row in rows])
    slopes = (_promised_db(rows, fitted - (0.05, 0, 0, 0, 0)) - _promised_db(rows, fitted)) / 0.05
    return {
        "coefficients": fitted.tolist(),
        "std": std.tolist(),
        "scatter": float(MEDIAN_TO_STD * np.median(off_db / np.maximum(slopes, 1e-3))),
        "off_db": float(np.median(off_db)),
        "captures": len(names),
        "frames": len(rows),
    }


def best_value(values: Sequence[float], gains_db: Array) -> Row:
    """Value with the largest mean of gains_db (captures, values), by a parabola over its logarithm, and its std."""
    found = _peak(values, gains_db.mean(axis=0))
    count = len(gains_db)
    left_out = [_peak(values, np.delete(gains_db, k, axis=0).mean(axis=0)) for k in range(count)] if count > 1 else []
    log_std = float(np.sqrt((count - 1) * np.var(left_out))) if left_out else float("nan")
    return {"best": float(np.exp(found)), "std": float(np.exp(found) * log_std), "captures": count}


# ── parts ────────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _RecordingGain(ConfirmedGain):
    """A ConfirmedGain that records the arguments of its calls, and promises every frame enough to be deblurred.

    A fit to the frames whose prediction was high enough would follow the prediction.  All of the change is taken.
    """

    asked: list[tuple[float, float, float, float, float, Misplaced, tuple[float, float]]] = field(default_factory=list)

    def of_change_db(
        self,
        changed: float,
        lost: float,
        ideal: float,
        power: float,
        coded: float,
        misplaced: Misplaced = confirmation.IN_PLACE,
        colour: tuple[float, float] = (0.0, 0.0),
    ) -> tuple[float, float]:
        self.asked.append((changed, lost, ideal, power, coded, misplaced, colour))
        return CERTAIN_GAIN_DB, 0.0


def _opened(work: Path, workload: Workload) -> TrueCapture:
    folder = simulated(work, workload.name, **workload.options)
    return open_true_capture(folder, folder / "truth" / "camera.yaml" if workload.true_profile else None)


def _psnr_db(truth: TrueCapture, plan: RestorationPlan) -> dict[int, tuple[float, tuple[int, int, int, int]]]:
    """PSNR and valid rectangle of each frame restored by a plan."""
    return {r.frame.index: (_against_truth(truth, r, r.valid_px), r.valid_px) for r in truth.restored(plan)}


def _against_truth(truth: TrueCapture, restored: RestoredFrame, valid_px: tuple[int, int, int, int]) -> float:
    assert restored.picture is not None
    return float(psnr_db(restored.picture, truth.truth(restored.frame.index), valid_px))


def _promises(
    truth: TrueCapture, plan: RestorationPlan, workload: Workload, straight_db: dict[int, Any]
) -> Iterator[Row]:
    """Terms of the predicted gain of each deblurred frame, and its measured gain."""
    if plan.confirmed is None or plan.confirmed.share <= 0:
        return
    for preset in LEFT_OVER_PRESETS:
        recorder = _RecordingGain(
            **{f.name: getattr(plan.confirmed, f.name) for f in dataclasses.fields(ConfirmedGain)}
        )
        for restored in truth.restored(replace(plan, settings=PRESETS[preset], confirmed=recorder)):
            if restored.degradation is None or restored.degradation.deblur is None:
                continue
            changed, lost, ideal, power, coded, misplaced, colour = recorder.asked[-1]
            gone = confirmation.removed(changed, lost + colour[0])
            before_db, valid_px = straight_db[restored.frame.index]
            yield {
                "capture": workload.name,
                "preset": preset,
                "frame": restored.frame.index,
                "removed": gone,
                "misplaced": np.stack((*misplaced.errors(gone), misplaced.weight)).tolist(),
                "regressors": confirmation.gain_regressors(ideal, power, recorder.left, coded, colour[1]).tolist(),
                "gain_db": _against_truth(truth, restored, valid_px) - before_db,
            }


def _swept_gains(truth: TrueCapture, plan: RestorationPlan, swept: Swept, straight_db: dict[int, Any]) -> Array:
    """Mean gain (values,) of a capture's frames with the constant set to each value."""
    usual, found = getattr(swept.module, swept.attribute), []
    try:
        for value in swept.values:
            setattr(swept.module, swept.attribute, value)
            gains = [
                _against_truth(truth, r, straight_db[r.frame.index][1]) - straight_db[r.frame.index][0]
                for r in truth.restored(plan)
            ]
            found.append(np.mean(gains))
    finally:
        setattr(swept.module, swept.attribute, usual)
    return np.array(found)


def _promised_db(rows: Sequence[Row], coefficients: Array) -> Array:
    left = confirmation.remaining_error(np.array([row["regressors"] for row in rows]), coefficients)
    gone = np.array([row["removed"] for row in rows])
    blurred, restored, weight = np.array([row["misplaced"] for row in rows]).transpose(1, 0, 2)
    before, after = confirmation.errors(left[:, None], gone[:, None], blurred, restored)
    return np.asarray(np.sum(weight * 10 * np.log10(before / after), axis=1))


def _fitted(rows: Sequence[Row], captures: NDArray[Any]) -> Array:
    """Coefficients (5,) by robust least squares; none below 0 but the constant."""
    gain_db = np.array([row["gain_db"] for row in rows])
    weight = 1 / np.sqrt([np.count_nonzero(captures == name) for name in captures])
    weight /= weight.mean()

    def off(coefficients: Array) -> Array:
        return np.asarray((_promised_db(rows, coefficients) - gain_db) * weight)

    bounds = ([-np.inf, 0, 0, 0, 0], np.inf)
    return np.asarray(least_squares(off, confirmation.LEFT_OVER, bounds=bounds, loss="soft_l1", f_scale=OUTLYING_DB).x)


def _peak(values: Sequence[float], gains_db: Array) -> float:
    """Log of the value at the peak of a parabola through the best value and its neighbours."""
    logarithms, at = np.log(values), int(np.clip(np.argmax(gains_db), 1, len(values) - 2))
    bend, slope, _ = np.polyfit(logarithms[at - 1 : at + 2], gains_db[at - 1 : at + 2], 2)
    peak = -slope / (2 * bend) if bend < 0 else logarithms[int(np.argmax(gains_db))]
    return float(np.clip(peak, logarithms[at - 1], logarithms[at + 1]))


def _text(promise: Row, best: dict[str, Row], swept: dict[str, tuple[Sequence[float], Array]]) -> str:
    header = ["constant", "in use", "fits best", "std"]
    lines = [
        [f"LEFT_OVER, {name}", f"{used:.2f}", f"{value:.2f}", f"{std:.2f}"]
        for name, used, value, std in zip(
            LEFT_OVER_NAMES, confirmation.LEFT_OVER, promise["coefficients"], promise["std"], strict=True
        )
    ]
    lines.append(["LEFT_OVER_STD", f"{confirmation.LEFT_OVER_STD:.2f}", f"{promise['scatter']:.2f}", "-"])
    for one in SWEPT:
        found = best[one.name]
        used = getattr(one.module, one.attribute)
        lines.append([one.name, f"{used:g}", f"{found['best']:.3g}", f"{found['std']:.2g}"])
    curves = [
        f"{name}: " + ", ".join(f"{value:g} {gain:+.3f} dB" for value, gain in zip(values, gains, strict=True))
        for name, (values, gains) in swept.items()
    ]
    return (
        f"FITS: {promise['frames']} frames of {promise['captures']} captures with separate seeds\n"
        f"median |predicted - measured gain| of the best fit: {promise['off_db']:.2f} dB\n"
        + numeric_table(header, lines)
        + "\n"
        + "\n".join(curves)
    )
