"""A recorded frame with known truth, by brute force: many sharp instants of a scene, averaged in linear light.

Row times, rotations and sampling are computed here and in ``laws``; only the response curve is the package's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from laws import TurningCamera, phone, texture
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.capture.records import Frame

MARGIN = 60
INSTANTS = 24
FRAME = Frame(3, 123_000_000_000, 0.1, 0.012)


@dataclass(frozen=True)
class Recorded:
    """One frame."""

    camera: TurningCamera
    picture: NDArray[np.uint8]
    """The recorded frame: blurred, distorted by the readout, encoded, noisy."""
    truth: NDArray[np.uint8]
    """The frame at the reference time, without blur and noise."""


_RECORDED: dict[str, Recorded] = {}
_SOURCES: dict[str, list[NDArray[np.float32]]] = {}


def camera(
    rate_rad_s: tuple[float, float, float] = (0.9, -2.0, 0.6),
    readout_time_s: float = 0.0,
    readout_direction: str = "top_to_bottom",
    width: int = 336,
    height: int = 240,
    **changes: object,
) -> TurningCamera:
    """A phone with a plain lens, off-centre, rotating about all three axes with about 10 px of blur."""
    profile = phone(
        width, height, 380.0, readout_time_s=readout_time_s, readout_direction=readout_direction,
        response=ResponseCurve("srgb"),
    )  # fmt: skip
    return replace(TurningCamera(profile, rate_rad_s), **changes)  # type: ignore[arg-type]


def record(camera: TurningCamera, grey: bool = False, noise_levels: float = 1.0) -> Recorded:
    """Record a textured scene, in colour or grey; equal frames are made only once."""
    key = repr((camera, grey, noise_levels))
    if key not in _RECORDED:
        _RECORDED[key] = _record(camera, grey, noise_levels)
    return _RECORDED[key]


def _record(camera: TurningCamera, grey: bool, noise_levels: float) -> Recorded:
    height, width = camera.profile.height + 2 * MARGIN, camera.profile.width + 2 * MARGIN
    return record_canvas(camera, _canvas(height, width, grey), 1 if grey else 3, noise_levels)


def record_canvas(
    camera: TurningCamera, canvas: NDArray[np.float32], noise_channels: int = 1, noise_levels: float = 1.0
) -> Recorded:
    """Record light on a canvas (height + 2 MARGIN, width + 2 MARGIN, 3), with noise in the given number of channels."""
    profile = camera.profile
    width, height = profile.width, profile.height
    light = np.zeros((height, width, 3))
    for source in _sources_px(camera):
        light += cv2.remap(canvas, source, None, cv2.INTER_CUBIC) / INSTANTS
    rng = np.random.default_rng(1)
    noise = rng.normal(0, noise_levels, (height, width, noise_channels))
    inner = canvas[MARGIN : MARGIN + height, MARGIN : MARGIN + width]
    return Recorded(camera, _stored(light, profile.response, noise), _stored(inner, profile.response, 0))


def _sources_px(camera: TurningCamera) -> list[NDArray[np.float32]]:
    """Canvas positions of each pixel at each instant of its row, (h, w, 2); cached for two cameras."""
    key = repr(camera)
    if key not in _SOURCES:
        profile, motion = camera.profile, camera.motion
        x, y = np.meshgrid(np.arange(profile.width), np.arange(profile.height))
        pixels = np.stack([x, y], -1).reshape(-1, 2).astype(float)
        start_s = camera.row_start_s(pixels, motion.start_s)
        times_s = (start_s + (k + 0.5) / INSTANTS * motion.exposure_s for k in range(INSTANTS))
        seen = (camera.seen(pixels, time_s, motion.reference_s, motion.reference_s) for time_s in times_s)
        for old in list(_SOURCES)[:-1]:
            del _SOURCES[old]
        _SOURCES[key] = [(one + MARGIN).astype(np.float32).reshape(*x.shape, 2) for one in seen]
    return _SOURCES[key]


def _canvas(height: int, width: int, grey: bool) -> NDArray[np.float32]:
    luma, red, blue = (texture(height, width, seed) for seed in (11, 12, 13))
    planes = [luma, luma, luma] if grey else [0.8 * luma + 0.2 * red, luma, 0.7 * luma + 0.25 * blue]
    return np.stack(planes, -1).astype(np.float32)


def _stored(
    light: NDArray[np.float64], curve: ResponseCurve | None, noise: NDArray[np.float64] | float
) -> NDArray[np.uint8]:
    assert curve is not None
    return np.clip(np.rint(255 * curve.encode(np.clip(light, 0, 1)) + noise), 0, 255).astype(np.uint8)
