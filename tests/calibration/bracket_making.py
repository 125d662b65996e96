"""Brackets with known truth: a scene of soft patches with a wide range of brightness, at several exposures."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.calibration.bracket_samples import BracketPicture
from virest.camera.response import ResponseCurve

FIVE = ResponseCurve("five_segment", b=(0.12, 0.08), c=(0.62, 0.80), y_max=1.0)
FIVE_LOW_TOP = ResponseCurve("five_segment", b=(0.2, 0.1), c=(0.5, 0.6), y_max=0.93)
GAMMA = ResponseCurve("gamma", gamma=2.2)
GAMMA_WEAK = ResponseCurve("gamma", gamma=1.7)
SRGB = ResponseCurve("srgb")
LINEAR = ResponseCurve("linear")


def make_scene(width: int, height: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Light (h, w, 3) over about 5 EV: patches of many sizes, a gradient, a little colour; its median is about 0.18."""
    log_light = np.zeros((height, width, 3), np.float32)
    for cells, size in ((7, 1.0), (23, 0.8), (60, 0.3)):
        shape = (max(cells * height // width, 2), cells)
        patch = size * rng.standard_normal((*shape, 1)) + 0.25 * size * rng.standard_normal((*shape, 3))
        log_light += cv2.resize(patch.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
    log_light += np.linspace(-0.8, 0.7, width, dtype=np.float32)[None, :, None]
    log_light = cv2.GaussianBlur(log_light, (0, 0), 0.8)
    return 0.18 * np.exp(log_light - np.median(log_light))


def take(light: NDArray[np.float32], exposure: float, curve: ResponseCurve, rng: np.random.Generator,
         noise: float = 1.5) -> NDArray[np.uint8]:  # fmt: skip
    """One 8-bit picture."""
    levels = 255 * curve.encode(light * np.float32(exposure))
    levels = levels + noise * rng.standard_normal(levels.shape, dtype=np.float32)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def make_bracket(curve: ResponseCurve, rng: np.random.Generator, *, width: int = 420, height: int = 310,
                 count: int = 8, span_ev: float = 6.0, noise: float = 1.5) -> list[BracketPicture]:  # fmt: skip
    """``count`` pictures over ``span_ev`` in order of capture, with exposure times around 1/60 s."""
    light = make_scene(width, height, rng)
    factors = 2.0 ** np.linspace(-span_ev / 2, span_ev / 2, count)
    return [BracketPicture(f"{i:02d}.png", take(light, f, curve, rng, noise), float(f / 60))
            for i, f in enumerate(factors)]  # fmt: skip


def as_jpeg(levels: NDArray[np.float64], quality: int) -> NDArray[np.uint8]:
    """A picture written as JPEG with half-resolution colour, and read again."""
    whole = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    halved = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    _, data = cv2.imencode(".jpg", whole[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality, *halved])
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def make_dark_jpegs(
    curve: ResponseCurve, rng: np.random.Generator, colour: float = 0.7, read_noise: float = 12.0
) -> list[BracketPicture]:
    """Nine pictures 1 EV apart, most of them dark, as from a small sensor.

    Electron noise is cut off at black, a matrix with negative entries mixes the colours, and greys are rounded and
    compressed.
    """
    light = make_scene(420, 310, rng).astype(np.float64)
    patch = colour * rng.standard_normal((14, 18, 3)).astype(np.float32)
    light *= np.exp(cv2.resize(patch, (420, 310), interpolation=cv2.INTER_NEAREST))
    mix = np.array([[1.7, -0.5, -0.2], [-0.25, 1.5, -0.25], [0.05, -0.5, 1.45]])
    seen = np.clip(light @ np.linalg.inv(mix).T, 0.0, None)
    out = []
    for i, ev in enumerate(np.arange(-9.0, 0.0)):
        electrons = rng.poisson(np.minimum(seen * 2.0**ev, 3.0) * 1000) + read_noise * rng.standard_normal(seen.shape)
        raw = np.clip(np.rint(electrons / 4) * 4 / 1000, 0.0, 1.0)
        out.append(BracketPicture(f"{i}.jpg", as_jpeg(255 * curve.encode(raw @ mix.T), 80), float(2.0**ev)))
    return out


def make_scans(curve: ResponseCurve, rng: np.random.Generator, ends: NDArray[np.float64]) -> list[BracketPicture]:
    """Scanned film, 1 EV apart: each channel runs between its own black and white level (2, 3)."""
    light = make_scene(420, 310, rng) ** 1.6
    out = []
    for i, ev in enumerate(np.linspace(-7.0, 6.0, 14)):
        grey = curve.encode(np.clip(light * 2.0**ev, 0.0, 1.0))
        levels = ends[0] + (ends[1] - ends[0]) * grey + 0.8 * rng.standard_normal(light.shape)
        out.append(BracketPicture(f"{i:02d}.png", np.clip(np.rint(levels), 0, 255).astype(np.uint8), float(2.0**ev)))
    return out
