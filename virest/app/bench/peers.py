"""Deconvolution by other libraries: scikit-image (:mod:`virest.evaluation.baselines`) and deepinv."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Picture
from virest.camera.response import ResponseCurve
from virest.capture.folder import read_capture, resolve_profile
from virest.evaluation.baselines import SCIKIT, Deconvolve, baseline_pictures, centre_psf, deblurred
from virest.image_formation.row_motion import RowMotion, row_motion
from virest.motion.integration import integrate_gyro

Plane = NDArray[np.float32]
PEERS: dict[str, tuple[Deconvolve, tuple[float, ...]]] = {
    name: (baseline.deconvolve, baseline.settings) for name, baseline in SCIKIT.items()
}
"""Methods and the settings tried on every frame; the setting with the best PSNR against truth counts."""


def frame_motions(capture_folder: Path) -> tuple[ResponseCurve, dict[int, RowMotion]]:
    """Response curve of a capture, and the motion of each usable frame."""
    capture = read_capture(capture_folder)
    profile, _ = resolve_profile(capture, None)
    trajectory = integrate_gyro(capture.imu, profile)
    usable = [frame for frame in capture.frames if frame.skip_reason is None]
    motions = {f.index: row_motion(trajectory, profile, f.time_s, f.exposure_s) for f in usable}
    return profile.curve, motions


def peer_pictures(name: str, picture: Picture, motion: RowMotion, curve: ResponseCurve) -> Iterator[Picture]:
    """Restored and straightened frames of one peer, one per setting."""
    return baseline_pictures(SCIKIT[name], picture, motion, curve)


def peer_deblurred(
    method: Deconvolve, setting: float, picture: Picture, motion: RowMotion, curve: ResponseCurve
) -> Picture:
    """Deconvolve the linear light of each channel of a frame with the kernel at the frame's centre."""
    psf = centre_psf(motion)
    return deblurred(picture, lambda plane: method(plane, psf, setting), psf, curve)


# ── deepinv ──────────────────────────────────────────────────────────────────────────────────────────────────────


DEEPINV = "deepinv"
GET_DEEPINV = "not installed: pip install 'virest[peers]'"


def deepinv_available() -> bool:
    """Whether deepinv, and with it torch, is installed."""
    return find_spec(DEEPINV) is not None


def deepinv_wiener(plane: Plane, psf: Plane, noise_to_signal: Any) -> Plane:
    """Wiener filter conj(K) / (|K|² + N/S) by deepinv on one thread: circular BlurFFT, WienerDeconvolution, flat prior.

    psf: convolution kernel, which is also deepinv's convention.
    """
    import torch
    from deepinv.models import WienerDeconvolution
    from deepinv.physics import BlurFFT

    torch.set_num_threads(1)
    kernel, observed = (torch.from_numpy(np.ascontiguousarray(array, np.float32))[None, None] for array in (psf, plane))
    blur = BlurFFT(img_size=(1, *plane.shape), filter=kernel)
    with torch.no_grad():
        restored = WienerDeconvolution(lambda_reg=float(noise_to_signal), prior=None)(observed, blur)
    return np.asarray(restored[0, 0].numpy(), np.float32)
