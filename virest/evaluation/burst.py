"""Published methods of merging a frame with its neighbours, given the true motion: baselines for joint restoration.

Neighbours are aligned to the frame by the same map as ours and merged in linear light, and the result is straightened
by the same warp.  Neither method deconvolves: they gain only from neighbours with a different blur.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from virest.arrays import Picture
from virest.camera.response import ResponseCurve
from virest.evaluation.baselines import ANCHOR
from virest.image_formation.neighbour import neighbour_view
from virest.image_formation.row_motion import RowMotion
from virest.motion.optics import MovingLens
from virest.motion.trajectory import Trajectory
from virest.restoration.encoding import encode_picture
from virest.restoration.shutter import rowwise_map, warp

Light = NDArray[np.float32]
REACHES = (1, 2, 3)
"""Numbers of neighbours on each side to try."""
EXPONENTS = (3.0, 11.0, 30.0)
"""Exponents of Fourier burst accumulation (11 in the paper: Delbracio & Sapiro 2015, doi:10.1109/CVPR.2015.7298855)."""
SMOOTHED_SIDE = 50
"""The smoothing σ of its weights is the frame's shorter side divided by this, as in the paper."""


@dataclass(frozen=True, slots=True)
class AlignedFrames:
    """A frame and its neighbours in linear light, aligned to the frame's pixels."""

    motion: RowMotion
    """Motion of the frame."""
    curve: ResponseCurve
    light: Mapping[int, Light]
    """(height, width, 3) by offset in frames; 0: the frame itself."""

    def within(self, reach: int) -> list[Light]:
        """Images at most ``reach`` frames away, in order."""
        return [self.light[k] for k in sorted(self.light) if abs(k) <= reach]

    def straightened(self, light: Light) -> Picture:
        """Grey levels of a merged image, every row warped to the reference time."""
        planes = [np.ascontiguousarray(light[..., k]) for k in range(3)]
        return warp(encode_picture(planes, self.curve), rowwise_map(self.motion, ANCHOR))


def align_frames(
    numbered: Sequence[tuple[int, Picture]],
    here: int,
    motions: Mapping[int, RowMotion],
    trajectory: Trajectory,
    lens: MovingLens,
) -> AlignedFrames:
    """Align frames, given with their movie index, to the pixels of frame ``here``."""
    motion = motions[here]
    curve = motion.profile.curve
    table = curve.linear_table()
    light = {}
    for number, picture in numbered:
        recorded = np.asarray(table[picture], np.float32)
        if number != here:
            source = neighbour_view(motion, motions[number], trajectory, lens, ANCHOR).map_px()
            recorded = cv2.remap(recorded, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        light[number - here] = recorded
    return AlignedFrames(motion, curve, light)


def align_and_average(frames: AlignedFrames) -> Iterator[Picture]:
    """Mean of the aligned frames, for each reach."""
    for reach in REACHES:
        yield frames.straightened(np.mean(frames.within(reach), axis=0, dtype=np.float32))


def fourier_burst(frames: AlignedFrames) -> Iterator[Picture]:
    """Fourier burst accumulation, for each reach and exponent (Delbracio & Sapiro 2015, eq. 4).

    Σ w_i F_i with w_i = |G F_i|^p / Σ |G F_j|^p: at each frequency a frame is weighted by its smoothed magnitude,
    averaged over the colours.
    """
    spectra = {k: np.asarray(fft.rfft2(light, axes=(0, 1))) for k, light in frames.light.items()}
    height, width = frames.motion.profile.height, frames.motion.profile.width
    sigma = min(height, width) / SMOOTHED_SIDE
    size = {k: _smoothed(np.abs(spectrum).mean(axis=2), sigma) for k, spectrum in spectra.items()}
    for reach, exponent in product(REACHES, EXPONENTS):
        near = [k for k in spectra if abs(k) <= reach]
        largest = np.max([size[k] for k in near], axis=0)
        powers = {k: (size[k] / largest) ** exponent for k in near}
        total = np.sum(list(powers.values()), axis=0)
        merged = np.sum([spectra[k] * (powers[k] / total)[..., None] for k in near], axis=0)
        yield frames.straightened(np.asarray(fft.irfft2(merged, (height, width), axes=(0, 1)), np.float32))


def _smoothed(magnitude: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Gaussian-smoothed magnitude of a half spectrum, periodic along y and mirrored along x."""
    border = int(np.ceil(3 * sigma))
    around = np.pad(np.pad(magnitude, ((border, border), (0, 0)), mode="wrap"), ((0, 0), (border, border)), "reflect")
    smooth = cv2.GaussianBlur(around.astype(np.float32), (0, 0), sigma)
    inside = smooth[border:-border, border:-border]
    return np.maximum(inside, np.float32(1e-12))


BURSTS = {"align and average": align_and_average, "Fourier burst": fourier_burst}
