"""A frame's neighbours as further measurements of its sharp picture.

Each neighbour, brought to the frame's pixels, is a blur of the same sharp picture along another path, with noise of
its own: Σ_k ‖w_k (A_k x − y_k)‖² has in each tile the numerator Σ w K_k* Y_k and the denominator Σ w E|K_k|², and what
one path cancels another passes (Delbracio & Sapiro 2015, doi:10.1109/CVPR.2015.7298855, weigh by the pictures' own
spectra instead).  What a neighbour shows otherwise, blurred as the frame is and the frame as it, is noise of its own:
things that move, parallax, shadows.  Its weight is the frame's noise over that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.image_formation.blur import Image
from virest.image_formation.kernels import KernelField
from virest.image_formation.neighbour import NeighbourView
from virest.restoration.neighbours.registration import TileAgreement
from virest.restoration.statistics.records import PictureStatistics
from virest.restoration.statistics.rings import RINGS, SIDE, place_ring
from virest.restoration.statistics.tile_power import passed_power

Array = NDArray[np.float64]
OWN_ERROR = 0.01
"""Part of the signal that differs in any two frames: the tone curve acts on each one's own blur."""
LEAST_WEIGHT = 0.25
"""A tile whose neighbour weighs less does without: it differs by four times what noise explains.  Right neighbours were
seen to differ by 0.05 to 0.9 times that (3 at 0.08 bits a pixel), pictures of other places by 5 to 1500."""
LEAST_SHIFTS = 6
"""An affine field of shifts has six unknowns; as many tiles again must bear it out."""
LOOKED_AT = 6
"""Places at which a neighbour's kernels are looked at for what it may bring."""
HUBER, ROBUST_STEPS = 1.5, 6
HALF = 2
"""Colour is brought at this many times less resolution: a movie stores no more of it."""


@dataclass(frozen=True, slots=True)
class NeighbourPicture:
    """One neighbour, brought to the frame's pixels."""

    number: int
    """Index in the movie."""
    light: Image
    """(height, width) luma of its light, as bright as the frame's."""
    half_light: Image
    """(height / 2, width / 2, 3), rounded up: its light in colour, as bright as the frame's."""
    field: Callable[[Array], KernelField]
    """Its kernels at centres in the frame."""
    places_px: Array
    """(n, 2) where the weights hold."""
    weights: Array
    """(n,) of its squared difference, over the frame's own."""
    shift_std_px: float
    """How well it is known where it lies, each axis."""
    shared_noise: float
    """Part of the frame's noise that it has too, 0 to 1: a coder repeats the frame before, a denoiser averages."""

    @property
    def longest_px(self) -> float:
        """Longest of its blur paths where its weights hold."""
        return float(self.field(self.places_px).length_px.max())

    def passed(self, frequency: Array) -> Array:
        """(RINGS,) mean |K|² over some of the places, times the mean weight and what its uncertain place leaves of it.

        frequency: (RINGS,) cycles per pixel.
        """
        some = np.linspace(0, len(self.places_px) - 1, min(len(self.places_px), LOOKED_AT)).round().astype(int)
        sharpness = np.exp(-((2 * np.pi * self.shift_std_px * frequency) ** 2))
        return np.asarray(self.weights.mean() * sharpness * rings_passed(self.field(self.places_px[some])))

    def weight_at(self, centres_px: Array, half_side_px: float) -> Array:
        """(m,) least weight near each centre: within half a tile's side, and at the nearest place."""
        distance = np.abs(centres_px[:, None] - self.places_px).max(axis=-1)
        near = distance <= np.maximum(half_side_px, distance.min(axis=1, keepdims=True) + 1e-9)
        weight = np.where(near, self.weights, np.inf).min(axis=1)
        return np.where(weight < LEAST_WEIGHT, 0.0, weight)


def neighbour_picture(
    view: NeighbourView,
    field: Callable[[Array], KernelField],
    number: int,
    light: Image,
    half_light: Image,
    agreement: TileAgreement,
    independent_error: float,
) -> NeighbourPicture | None:
    """Bring a neighbour's luma of light (height, width), and its light at half that size, to the frame's pixels.

    None where it does not fit.

    field: of its kernels, from the view.  independent_error: what the frame's noise would make them differ by if the
    neighbour had none of it.

    What is left between the two after the predicted motion is a smooth field, affine over the picture.
    """
    used = agreement.precision > 0
    if np.count_nonzero(used) < 2 * LEAST_SHIFTS:
        return None
    affine, std_px = _affine(agreement.centres_px[used], agreement.shift_px[used], agreement.precision[used])
    height, width = light.shape
    source = view.map_px(lambda points_px: points_px - _at(affine, points_px))
    brought = cv2.remap(light, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    brought_half = cv2.remap(half_light, _halved(source), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    noise = float(np.median(agreement.error[used]))
    expected = independent_error + OWN_ERROR * agreement.signal
    weights = np.where(used, expected / np.maximum(agreement.error, expected), 0.0)
    places = view.places_px(agreement.centres_px)
    inside = ((places > 0) & (places < (width - 1, height - 1))).all(axis=1)
    return NeighbourPicture(
        number,
        brought / np.float32(agreement.gain),
        brought_half / np.float32(agreement.gain),
        field,
        agreement.centres_px,
        np.where(inside, weights, 0.0),
        std_px,
        float(np.clip(1 - noise / independent_error, 0.0, 1.0)),
    )


@dataclass(frozen=True, slots=True)
class JoinedNeighbours:
    """Those of a frame's neighbours that it is restored with, and what they bring by the spectra."""

    pictures: tuple[NeighbourPicture, ...]
    passed: Array
    """(RINGS,) sum of their |K|², weighted."""
    shared: float
    """Sum of their weights times the part of the noise that they have in common with the frame."""


def worth_joining(found: Sequence[NeighbourPicture], luma: PictureStatistics) -> JoinedNeighbours:
    """Choose neighbours one by one, each time the one that leaves least wrong by the ideal linear filter.

    Those that lose the same frequencies and repeat the frame's noise bring nothing but the error of their place.
    luma: measured on the frame.
    """
    found_passed = [one.passed(luma.frequency) for one in found]
    found_shared = [float(one.weights.mean()) * one.shared_noise for one in found]
    taken = most_telling(found_passed, found_shared, luma, len(found))
    passed = np.sum([np.zeros(RINGS), *(found_passed[k] for k in taken)], axis=0)
    return JoinedNeighbours(tuple(found[k] for k in taken), passed, sum(found_shared[k] for k in taken))


def most_telling(passed: Sequence[Array], shared: Sequence[float], luma: PictureStatistics, most: int) -> list[int]:
    """Numbers, in order, of at most ``most`` further pictures: one by one that which leaves least wrong.

    By the ideal linear filter and the rings' spectra; the choice ends where the next one would leave more.

    passed: (RINGS,) weighted |K|² of each.  shared: its weight times the part of the frame's noise that it repeats.
    luma: measured on the frame.
    """
    taken: list[int] = []
    sum_passed, sum_shared = np.zeros(RINGS), 0.0
    error = luma.ideal_error(sum_passed, sum_shared) if luma.measured else 0.0
    while len(taken) < min(most, len(passed)):
        errors = {
            k: luma.ideal_error(sum_passed + passed[k], sum_shared + shared[k])
            for k in range(len(passed))
            if k not in taken
        }
        best = min(errors, key=errors.__getitem__)
        if errors[best] >= error:
            break
        taken.append(best)
        error, sum_passed, sum_shared = errors[best], sum_passed + passed[best], sum_shared + shared[best]
    return sorted(taken)


def rings_passed(kernels: KernelField) -> Array:
    """(RINGS,) mean |K|² of some kernels; 0 where one does not fit into a measured tile."""
    arrays = kernels.arrays()
    if arrays.shape[1] > SIDE:
        return np.zeros(RINGS)
    power = np.mean([passed_power(kernel) for kernel in arrays], axis=0)
    counts = np.maximum(np.bincount(place_ring().ravel(), minlength=RINGS), 1)
    return np.asarray(np.bincount(place_ring().ravel(), power.ravel(), RINGS) / counts)


def half_size(picture: Image) -> Image:
    """Means over squares of HALF pixels; a picture of odd sides repeats its last row or column."""
    height, width = picture.shape[:2]
    if height % HALF or width % HALF:
        picture = cv2.copyMakeBorder(picture, 0, height % HALF, 0, width % HALF, cv2.BORDER_REPLICATE)
    return cv2.resize(picture, (-(-width // HALF), -(-height // HALF)), interpolation=cv2.INTER_AREA)


def _halved(source_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """A map (height, width, 2) between pictures of half the size, sides rounded up."""
    return (half_size(source_px) + np.float32(0.5)) / np.float32(HALF) - np.float32(0.5)


def _affine(centres_px: Array, shift_px: Array, precision: Array) -> tuple[Array, float]:
    """Coefficients (3, 2) of 1, x, y, by Huber's weights, and the deviation, each axis, of what they give."""
    design = np.column_stack([np.ones(len(centres_px)), centres_px])
    robust = np.ones(len(design))
    for _ in range(ROBUST_STEPS):
        root = np.sqrt(precision * robust)[:, None]
        found = np.linalg.lstsq(root * design, root * shift_px, rcond=None)[0]
        distance = np.linalg.norm(shift_px - design @ found, axis=1)
        typical = max(float(np.median(distance)) / 1.1774, 1e-6)
        robust = np.minimum(1.0, HUBER * typical / np.maximum(distance, 1e-9))
    return found, typical


def _at(affine: Array, points_px: Array) -> Array:
    return np.asarray(affine[0] + points_px @ affine[1:])
