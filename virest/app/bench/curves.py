"""Benefit of the response curve: the same frames restored with the right curve, none, and wrong ones.

Everything but the curve is known and equal, so differences in PSNR against truth are due to the curve.  A second table
measures the benefit of masking clipped pixels: with the curve's clipping mask, without it, and without clipping.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from virest.app.bench.workload import FINE_BITS, Scale, recorded_frames, simulated
from virest.app.console import cell, numeric_table
from virest.app.evaluation_captures import truth_frame
from virest.arrays import Array, Mask, Picture
from virest.camera.response import ResponseCurve
from virest.capture.folder import read_capture, resolve_profile
from virest.evaluation.fidelity import MARGIN_PX
from virest.restoration.capture import RestorationPlan, restore_frames
from virest.restoration.frame import RestoredFrame
from virest.restoration.settings import PRESETS, RestorationSettings

BASE: dict[str, Any] = {"width": 640, "height": 480, "exposure_ms": 16.0, "rate_rad_s": 1.4, "noise_levels": 1.0,
                        "bitrate_bits_per_px": FINE_BITS}  # fmt: skip
SEEDS = (11, 12, 13)
"""Three draws of the scene, so that a mean has a spread."""
GAMMA, LINEAR, SRGB = ResponseCurve("gamma", gamma=2.2), ResponseCurve("linear"), ResponseCurve("srgb")
BENT = ResponseCurve("five_segment", b=(0.065, 0.048), c=(0.4, 0.6), y_max=1.0)
"""With dead leaves, toe and shoulder together hold about 20 % of the pixels."""
OTHER_KNOTS = ResponseCurve("five_segment", b=(0.12, 0.14), c=(0.62, 0.88), y_max=1.0)
CURVES: dict[str, tuple[ResponseCurve, dict[str, ResponseCurve]]] = {
    "gamma 2.2": (GAMMA, {"none (linear)": LINEAR, "gamma 1.2": ResponseCurve("gamma", gamma=1.2),
                          "gamma 1 / 2.2": ResponseCurve("gamma", gamma=1 / 2.2)}),
    "toe and shoulder": (BENT, {"none (linear)": LINEAR, "other knots": OTHER_KNOTS, "srgb": SRGB}),
}  # fmt: skip
"""The camera's curve, and the wrong curves used for restoration."""
CODED_PX = 8
"""Transform block size of the codec, over which coding errors spread."""


class UnmaskedCurve(ResponseCurve):
    """The same curve, treating clipped grey levels as measured ones."""

    __slots__ = ()

    def censored_table(self, margin_levels: float = 0.5) -> Mask:
        """No grey level is censored."""
        return np.zeros(256, bool)

    def clipped_table(self, margin_levels: float = 0.5) -> Mask:
        """No grey level is clipped."""
        return np.zeros(256, bool)


def unmasked(curve: ResponseCurve) -> UnmaskedCurve:
    """The curve without its clipping mask."""
    return UnmaskedCurve(**{f.name: getattr(curve, f.name) for f in fields(curve)})


# ── right, none, wrong ───────────────────────────────────────────────────────────────────────────────────────────


def curves_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Measure both tables; PSNR in dB against truth, preset balanced."""
    seeds, frames = (SEEDS[:2], 3) if scale.quick else (SEEDS, 6)
    curves = [row for name in CURVES for row in curve_rows(work, name, seeds, frames)]
    clipping = [row for name in CLIPPING for row in clipping_rows(work, name, seeds, frames)]
    return {"curves": curves, "clipping": clipping}, _curves_text(curves) + "\n\n" + _clipping_text(clipping)


def curve_rows(work: Path, name: str, seeds: tuple[int, ...], frames: int) -> list[dict[str, Any]]:
    """PSNR of all frames with the camera's own curve and with others, one record per curve."""
    true, others = CURVES[name]
    captures = [_capture(work, f"{name}-{seed}", response=true, seed=seed, frames=frames) for seed in seeds]
    used = {"right": true, **others}
    found = {t: np.concatenate([_psnrs_db(c, curve) for c in captures]) for t, curve in used.items()}
    plain = np.concatenate([_psnrs_db(c, true, deblur="none") for c in captures])
    ends = tuple(round(float(share), 3) for share in np.mean([end_shares(c, true) for c in captures], axis=0))
    return [
        {
            "camera": name,
            "told": t,
            "toe_and_shoulder": ends,
            "psnr_db": float(db.mean()),
            "gain_db": float((db - plain).mean()),
            "right_minus_this_db": float((found["right"] - db).mean()),
            "least_right_minus_this_db": float((found["right"] - db).min()),
        }
        for t, db in found.items()
    ]


def end_shares(capture: Path, curve: ResponseCurve) -> tuple[float, float]:
    """Fraction of the first truth frame in the curve's toe (below B) and in its shoulder (above C)."""
    truth = truth_frame(capture, 0).astype(np.float64) / 255
    if curve.kind != "five_segment":
        return 0.0, 0.0
    return float(np.mean(truth < curve.b[1])), float(np.mean(truth > curve.c[1]))


def _capture(work: Path, name: str, **options: Any) -> Path:
    return simulated(work, name.replace(" ", "-"), **{**BASE, **options})


def _psnrs_db(capture: Path, curve: ResponseCurve, deblur: str | None = None) -> Array:
    """PSNR (frames,) of each frame inside its valid rectangle less a margin."""
    results = [(r, truth_frame(capture, r.frame.index)) for r in restored(capture, curve, deblur)]
    return np.array([masked_psnr_db(r.picture, truth, inside(r, truth.shape)) for r, truth in results])


def restored(capture: Path, curve: ResponseCurve, deblur: str | None = None) -> list[RestoredFrame]:
    """All frames of a capture restored with preset balanced and ``curve`` as the camera's curve.

    Each frame is restored alone, since neighbours are not used near clipped highlights and only masks are compared.
    """
    recorded = read_capture(capture)
    settings: RestorationSettings = replace(PRESETS["balanced"], neighbours=0)
    profile = replace(resolve_profile(recorded)[0], response=curve)
    plan = RestorationPlan(profile, replace(settings, deblur=deblur or settings.deblur))
    frames = ((recorded.frames[number], picture) for number, picture in recorded_frames(capture))
    return list(restore_frames(frames, recorded.imu, plan))


def inside(result: RestoredFrame, shape: tuple[int, ...]) -> Mask:
    """(h, w) mask of a frame's recorded data, less a margin."""
    x0, y0, x1, y1 = result.valid_px
    mask = np.zeros(shape[:2], bool)
    mask[y0 + MARGIN_PX : y1 - MARGIN_PX, x0 + MARGIN_PX : x1 - MARGIN_PX] = True
    return mask


def masked_psnr_db(picture: Picture | None, truth: Picture, mask: Mask) -> float:
    """PSNR in dB over the channels of the pixels in a mask."""
    assert picture is not None
    error = picture[mask].astype(np.float64) - truth[mask]
    return float(10 * np.log10(255.0**2 / np.mean(error**2)))


# ── clipped light ────────────────────────────────────────────────────────────────────────────────────────────────


CLIPPING = ("sunlit", "highlights")
"""Leaves exposed so that CLIPPED_SHARE of the pixels clip; leaves with highlights of up to 12 times the clip level on
about 3 % of the area."""
CLIPPED_SHARE = 0.03
"""As many pixels as the highlights of the other scene."""


def clipping_rows(work: Path, name: str, seeds: tuple[int, ...], frames: int) -> list[dict[str, Any]]:
    """PSNR near clipped highlights and elsewhere: with the mask, without it, and for the capture without clipping."""
    pairs = [_clipping_pair(work, name, seed, frames) for seed in seeds]
    readers: dict[str, Callable[[Path, Path, float], list[RestoredFrame]]] = {
        "with the mask": lambda clipped, _less, _gain: restored(clipped, GAMMA),
        "without": lambda clipped, _less, _gain: restored(clipped, unmasked(GAMMA)),
        "not deblurred": lambda clipped, _less, _gain: restored(clipped, GAMMA, "none"),
        "nothing clipped": lambda _clipped, less, gain: _exposed_up(restored(less, GAMMA), gain),
    }
    rows = []
    for reader, read in readers.items():
        found = np.array([f for pair in pairs for f in _near_and_far(read(*pair), pair[0])])
        near, far, whole, share = found.mean(axis=0).tolist()
        comparable = reader != "nothing clipped"
        rows.append({"scene": name, "told": reader, "clipped": share, "elsewhere_db": far,
                     "near_db": near if comparable else None, "whole_db": whole if comparable else None})  # fmt: skip
    return rows


def _clipping_pair(work: Path, name: str, seed: int, frames: int) -> tuple[Path, Path, float]:
    """Captures (clipped, unclipped) and the exposure ratio of the first to the second.

    Both have the same motion and, for ``sunlit``, the same scene and the same noise relative to light.
    """
    options = {"response": GAMMA, "seed": seed, "frames": frames}
    less = _capture(work, f"less-{seed}", **options)
    if name == "highlights":
        return _capture(work, f"highlights-{seed}", scene="bright", **options), less, 1.0
    light = np.stack([GAMMA.linearise(truth_frame(less, k) / 255).max(axis=2) for k in range(frames)])
    gain = float(1 / np.quantile(light, 1 - CLIPPED_SHARE))
    drift = "gain_drift=" + ",".join([f"{gain:.6f}"] * frames)
    noise_levels = BASE["noise_levels"] * gain ** (1 / GAMMA.gamma)
    return _capture(work, f"sunlit-{seed}", **{**options, "effects": [drift], "noise_levels": noise_levels}), less, gain


def _exposed_up(results: list[RestoredFrame], gain: float) -> list[RestoredFrame]:
    """Raise the exposure of restored frames to that of the clipped capture."""
    light = GAMMA.linear_table().astype(np.float64) * gain
    table = np.clip(np.rint(255 * GAMMA.encode(light)), 0, 255).astype(np.uint8)
    return [replace(r, picture=None if r.picture is None else table[r.picture]) for r in results]


def _near_and_far(results: list[RestoredFrame], clipped: Path) -> list[list[float]]:
    """Per frame: PSNR within a blur path of clipped highlights, elsewhere, and overall; fraction of clipped pixels."""
    found: list[list[float]] = []
    for result in results:
        truth = truth_frame(clipped, result.frame.index)
        white = (truth == 255).any(axis=2)
        length_px = (result.degradation.blur.length_px if result.degradation else None) or 0.0
        reach = int(np.ceil(length_px)) + CODED_PX
        near = cv2.dilate(white.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0
        there = inside(result, truth.shape)
        parts = (there & near & ~white, there & ~near, there)
        found.append([*(masked_psnr_db(result.picture, truth, p) for p in parts), float(white.mean())])
    return found


# ── as text ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _curves_text(rows: list[dict[str, Any]]) -> str:
    head = ["camera's curve", "used", "PSNR", "gain", "right curve better by", "min"]
    cells = [
        [row["camera"], row["told"], f"{row['psnr_db']:.2f}", f"{row['gain_db']:+.2f}",
         f"{row['right_minus_this_db']:+.2f}", f"{row['least_right_minus_this_db']:+.2f}"]
        for row in rows
    ]  # fmt: skip
    toe, shoulder = rows[-1]["toe_and_shoulder"]
    return (
        "CURVES: mean PSNR in dB against truth, gain over straightening alone, and what the right curve adds\n"
        f"(preset balanced; toe and shoulder hold {toe:.0%} and {shoulder:.0%} of the pixels; min: over all frames)\n"
        + numeric_table(head, cells)
    )


def _clipping_text(rows: list[dict[str, Any]]) -> str:
    head = ["clipped light", "restored", "clipped", "near it", "elsewhere", "whole"]
    cells = [
        [row["scene"], row["told"], f"{row['clipped']:.1%}",
         *(cell(row[key]) for key in ("near_db", "elsewhere_db", "whole_db"))]
        for row in rows
    ]  # fmt: skip
    return (
        "CLIPPED LIGHT: mean PSNR in dB, near it (within a blur path, not clipped itself) and elsewhere\n"
        + numeric_table(head, cells)
    )
