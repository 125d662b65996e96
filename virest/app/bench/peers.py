"""scikit-image's deconvolutions at their best: true kernel of the picture's centre, linear light, no circular border.

scikit-image takes one kernel for the picture, as a *convolution*; ours are correlations, so they are turned round.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from skimage import restoration

from virest.camera.response import ResponseCurve
from virest.capture.folder import read_capture, resolve_profile
from virest.degradation.kernels import kernel_field
from virest.degradation.row_motion import RowMotion, row_motion
from virest.motion.integration import integrate_gyro
from virest.restoration.frame import encode_picture
from virest.restoration.shutter import rowwise_map, warp

Picture = NDArray[np.uint8]
Plane = NDArray[np.float32]
Deconvolve = Callable[[Plane, Plane, float], Plane]
ANCHOR = 0.5
BORDER_RADII = 2
"""The blended border is this many kernel radii wide on each side."""


def _wiener(plane: Plane, psf: Plane, balance: float) -> Plane:
    return np.asarray(restoration.wiener(plane, psf, balance, clip=False))


def _unsupervised_wiener(plane: Plane, psf: Plane, _unused: float) -> Plane:
    return np.asarray(restoration.unsupervised_wiener(plane, psf, clip=False, rng=0)[0])


def _richardson_lucy(plane: Plane, psf: Plane, iterations: float) -> Plane:
    result = restoration.richardson_lucy(np.maximum(plane, np.float32(1e-6)), psf, num_iter=int(iterations), clip=False)
    return np.asarray(result)


PEERS: dict[str, tuple[Deconvolve, tuple[float, ...]]] = {
    "wiener": (_wiener, (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)),
    "unsupervised_wiener": (_unsupervised_wiener, (0.0,)),
    "richardson_lucy": (_richardson_lucy, (3, 8, 20)),
}
"""Each with the settings that are tried on every frame; the best by PSNR against truth counts."""


def frame_motions(capture_folder: Path) -> tuple[ResponseCurve, dict[int, RowMotion]]:
    """Read the curve, and each usable frame's motion."""
    capture = read_capture(capture_folder)
    profile, _ = resolve_profile(capture, None)
    trajectory = integrate_gyro(capture.imu, profile)
    usable = [frame for frame in capture.frames if frame.skip_reason is None]
    motions = {f.index: row_motion(trajectory, profile, f.time_s, f.exposure_s) for f in usable}
    return profile.response or ResponseCurve("srgb"), motions


def peer_pictures(name: str, picture: Picture, motion: RowMotion, curve: ResponseCurve) -> Iterator[Picture]:
    """Restored and straightened pictures of one peer, one for each of its settings."""
    method, settings = PEERS[name]
    source = rowwise_map(motion, ANCHOR)
    for setting in settings:
        yield warp(peer_deblurred(method, setting, picture, motion, curve), source)


def peer_deblurred(
    method: Deconvolve, setting: float, picture: Picture, motion: RowMotion, curve: ResponseCurve
) -> Picture:
    """One picture, each channel's linear light deconvolved with the centre's kernel."""
    psf = centre_psf(motion)
    table = curve.linear_table()
    light = [deconvolved_inside(lambda p: method(p, psf, setting), table[picture[..., k]], psf) for k in range(3)]
    return encode_picture([plane.astype(np.float32, copy=False) for plane in light], curve)


def centre_psf(motion: RowMotion) -> Plane:
    """Give the true kernel at the picture's centre, zero at mid-exposure, as a convolution takes it."""
    centre = np.array([[(motion.profile.width - 1) / 2, (motion.profile.height - 1) / 2]])
    kernel = kernel_field(motion, centre, ANCHOR).arrays(positive=True)[0]
    return kernel[::-1, ::-1] / kernel.sum()


def deconvolved_inside(deconvolve: Callable[[Plane], Plane], plane: Plane, psf: Plane) -> Plane:
    """Deconvolve a picture with a border that goes on smoothly around the corner, and cut the border off."""
    border = BORDER_RADII * (psf.shape[0] // 2)
    result = deconvolve(blended(plane, border))
    return result[border : border + plane.shape[0], border : border + plane.shape[1]]


def blended(plane: Plane, border: int) -> Plane:
    """Widen on all sides by at least ``border``: mirror pictures of both edges, blended into each other by a cosine."""
    for axis in (0, 1):
        plane = _blended_rows(plane.swapaxes(0, axis), border).swapaxes(0, axis)
    return np.ascontiguousarray(plane)


def _blended_rows(plane: Plane, border: int) -> Plane:
    """After the last row comes its mirror picture, which fades into the one that leads to the first row."""
    between = next_fast_len(len(plane) + 2 * border, real=True) - len(plane)
    part = (0.5 - 0.5 * np.cos(np.pi * (np.arange(between) + 0.5) / between)).astype(plane.dtype)
    after, before = plane[::-1][:between], plane[:between][::-1]
    bridge = (1 - part)[:, None] * after + part[:, None] * before
    return np.roll(np.concatenate([plane, bridge]), border, axis=0)
