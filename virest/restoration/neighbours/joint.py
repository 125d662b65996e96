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
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.image_formation.blur import Image
from virest.image_formation.kernels import KernelField
from virest.image_formation.neighbour import NeighbourView
from virest.restoration.neighbours.reduced_tiles import TILE
from virest.restoration.neighbours.registration import TileAgreement
from virest.restoration.statistics.records import PictureStatistics
from virest.restoration.statistics.rings import RINGS, SIDE, place_ring
from virest.restoration.statistics.tile_power import passed_power

Array = NDArray[np.float64]
OWN_ERROR = 0.01
"""Part of the signal that differs in any two frames: the tone curve acts on each one's own blur."""
MOST_DIFFERENT = 4.0
"""A neighbour whose median difference is this many times what noise explains is not used.  Right ones were
seen to differ by 0.05 to 0.9 times that (3 at 0.08 bits a pixel), pictures of other places by 5 to 1500."""
LEAST_TRUST = 0.25
"""Where a neighbour weighs less it is not used."""
MOVING = 16.0
"""Difference around a place, over noise's, that is nothing else: edges of a chessboard reach it (at 8 its frames lose
up to 1 dB); things that move differ by 10 to 400 times and lose nothing by 16."""
RIM_PX = 0.2
"""Shift of a tile against the field at which half as much is ordinary, there and beside it: what lies nearer hides in
one frame what the other shows, rims as wide as the shift, which counts for less than a sixth of a chessboard's edges.
Chosen on relief at 1 and 0.7 m, two walks, a chessboard and a shake; 0.1 loses 0.1 dB on these."""
AROUND, CLOSE_BY = 17, 7
"""Sides of what lies around a place and close by, in reduced pixels: things, and their rims."""
LEAST_ALIKE = 0.5
"""Part of a picture that a neighbour must show in its place to tell what moves."""
SPARSE = 4
"""What lies around places changes so little from one to the next that medians need only every fourth."""
LEAST_SHIFTS = 6
"""An affine field of shifts has six unknowns; as many tiles again must bear it out."""
LOOKED_AT = 6
"""Places at which a neighbour's kernels are looked at for what it may bring."""
HUBER, ROBUST_STEPS = 1.5, 6
BESIDE = 1.1
"""Tiles no further apart than this, over their side, lie side by side; across a corner they are 1.3 to 1.4 apart."""
CUBIC = -0.75
"""Slope at one pixel of the kernel of OpenCV's cubic interpolation."""
HALF = 2
"""Colour is brought at this many times less resolution: a movie stores no more of it."""


@dataclass(frozen=True, slots=True)
class NeighbourPlace:
    """Where a neighbour's picture lies in the frame, and how far that and what it shows are to be trusted."""

    number: int
    """Index in the movie."""
    view: NeighbourView
    """As predicted."""
    affine: Array
    """(3, 2) coefficients of 1, x, y: how far on the neighbour shows what was predicted at a place."""
    gain: float
    """Its light over the frame's."""
    field: Callable[[Array], KernelField]
    """Its kernels at centres in the frame."""
    centres_px: Array
    """(n, 2) of the tiles in which it was compared."""
    trust: Image
    """Noise of the frame over that of the neighbour, 0 to 1, of a picture that is smaller than the frame."""
    alike: Image
    """How surely it shows what the frame shows, 0 to 1, of the same size."""
    seen: NDArray[np.bool_]
    """Of the same size: where it has a picture."""
    std_px: Array
    """(n,) how well it is known where it lies in those tiles, each axis."""
    finer: float = 1.0
    """The frame's noise over its own, where both are a coder's: more than 1 where it was coded with finer steps."""

    @property
    def longest_px(self) -> float:
        """Longest of its blur paths where its weights hold."""
        return float(self.field(self.centres_px).length_px.max())

    @property
    def weight(self) -> float:
        """Mean over the picture."""
        return self.finer * float(self.trust.mean())

    def passed(self, frequency: Array) -> Array:
        """(RINGS,) mean |K|² over some of the places, times the mean weight and what its uncertain place leaves of it.

        frequency: (RINGS,) cycles per pixel.
        """
        some = np.linspace(0, len(self.centres_px) - 1, min(len(self.centres_px), LOOKED_AT)).round().astype(int)
        sharpness = np.exp(-((2 * np.pi * self.std_px[:, None] * frequency) ** 2)).mean(axis=0)
        return np.asarray(self.weight * sharpness * rings_passed(self.field(self.centres_px[some])))

    def std_at_px(self, centres_px: Array) -> Array:
        """(m,) how well it is known where it lies around places (m, 2): that of the nearest four tiles."""
        x, y = (np.unique(along) for along in self.centres_px.T)
        power = np.square(self.std_px).reshape(len(y), len(x)).astype(np.float32)
        at = [np.interp(c, k, np.arange(len(k))).astype(np.float32) for c, k in zip(centres_px.T, (x, y), strict=True)]
        found = cv2.remap(power, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.sqrt(found.ravel().astype(float))


@dataclass(frozen=True, slots=True)
class NeighbourPicture:
    """One neighbour, brought to the frame's pixels."""

    place: NeighbourPlace
    light: Image
    """(height, width) luma of its light, as bright as the frame's."""
    half_light: Image
    """(height / 2, width / 2, 3), rounded up: its light in colour, as bright as the frame's."""


def neighbour_place(
    view: NeighbourView,
    field: Callable[[Array], KernelField],
    number: int,
    agreement: TileAgreement,
    independent_error: float,
) -> NeighbourPlace | None:
    """Where a neighbour's picture lies; None where it does not fit.

    field: of its kernels, from the view.  independent_error: what noise of their own makes them differ by.

    What is left between the two after the predicted motion is a smooth field, affine over the picture.
    """
    used = agreement.precision > 0
    if np.count_nonzero(used) < 2 * LEAST_SHIFTS:
        return None
    affine, typical_px = _affine(agreement.centres_px[used], agreement.shift_px[used], agreement.precision[used])
    off_px = agreement.shift_px[used] - _at(affine, agreement.centres_px[used])
    lasting_px = _lasting_px(agreement.centres_px[used], off_px, typical_px, TILE * agreement.times)
    noise_px = np.sqrt(max(typical_px**2 - lasting_px**2, 0.0))
    std_px = np.full(len(used), lasting_px)
    std_px[used] = _left_of_shifts_px(off_px, lasting_px, noise_px)
    std_px = np.hypot(std_px, noise_px * np.sqrt(LEAST_SHIFTS / len(off_px)))
    trust, alike = _trust(agreement, _at(affine, agreement.centres_px), noise_px, independent_error)
    height, width = trust.shape
    seen = (agreement.inside & ~agreement.clipped)[:height, :width]
    return NeighbourPlace(
        number, view, affine, agreement.gain, field, agreement.centres_px, trust * seen, alike * seen, seen, std_px
    )


def neighbour_picture(place: NeighbourPlace, light: Image, half_light: Image, detailed: bool) -> NeighbourPicture:
    """Bring a neighbour's luma of light (height, width), and its light at half that size, to the frame's pixels.

    detailed: see :func:`is_detailed`; the luma is then read by eight points along each axis, at four times the cost.
    """
    source = place.view.map_px(lambda points_px: points_px - _at(place.affine, points_px))
    reading = cv2.INTER_LANCZOS4 if detailed else cv2.INTER_CUBIC
    brought = cv2.remap(light, source, None, reading, borderMode=cv2.BORDER_REPLICATE)
    brought_half = cv2.remap(half_light, _halved(source), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    for one in (brought, brought_half):
        one *= np.float32(1 / place.gain)
    return NeighbourPicture(place, brought, brought_half)


def is_detailed(luma: PictureStatistics) -> bool:
    """Whether cubic interpolation takes more of some ring of a picture than its noise is."""
    return bool(np.any(np.interp(luma.frequency, *_cubic_error()) * luma.passed * luma.signal > luma.noise))


@lru_cache(maxsize=1)
def _cubic_error() -> tuple[Array, Array]:
    """Frequencies along an axis, cycles per pixel, and the part of their power that cubic interpolation makes wrong.

    Mean over all shifts of |1 − H|², with H the spectrum of the four weights about the place that is read.
    """
    frequency, shift = np.linspace(0, 0.5, 51), (np.arange(32) + 0.5) / 32
    distance = np.abs(np.arange(-1, 3)[:, None] - shift)
    near = (CUBIC + 2) * distance**3 - (CUBIC + 3) * distance**2 + 1
    far = CUBIC * (distance**3 - 5 * distance**2 + 8 * distance - 4)
    waves = np.exp(2j * np.pi * frequency[:, None, None] * (np.arange(-1, 3)[:, None] - shift))
    passed = (np.where(distance <= 1, near, far) * waves).sum(axis=1)
    return frequency, (np.abs(1 - passed) ** 2).mean(axis=1)


def _trust(agreement: TileAgreement, shift_px: Array, noise_px: float, independent_error: float) -> tuple[Image, Image]:
    """Noise of a frame over that of its neighbour, and how surely both show the same, 0 to 1, of the reduced picture.

    Of the difference's power around a place, noise of both making E, half is the frame's.  Rings take overtones of
    edges for noise, which is no more than what half of all places differ by; it scatters, and E is some times as much:
    less for what a neighbour is to weigh, which rims that hide other things in either frame make wrong, than for
    telling that something moves.  What a tile differs by only because its own shift is not the field's is another
    matter: it bends the picture near relief, and none of it is ordinary.  Of a tile's own shift counts what the noise
    of shifts, noise_px on each axis, does not explain (James & Stein 1961).
    """
    tiles = agreement.differences(shift_px)
    different, shown = agreement.side_by_side(tiles), agreement.side_by_side(agreement.shown())
    left, both = (_power_around(one, AROUND) for one in (different, shown))
    some = np.s_[::SPARSE, ::SPARSE]
    if np.median(left[some] / (OWN_ERROR * both[some] + np.float32(independent_error))) > MOST_DIFFERENT:
        return np.zeros_like(left), np.zeros_like(left)
    noise = np.float32(min(independent_error, float(np.median(left[some]))))
    expected = OWN_ERROR * both + noise
    alike = _explained(left, MOVING * expected)
    off_px = np.where(agreement.precision[:, None] > 0, agreement.shift_px - shift_px, 0.0)
    sure = np.maximum(1 - 2 * noise_px**2 / np.maximum((off_px**2).sum(axis=1), 1e-12), 0.0)
    near, shown_near = (_power_around(one, CLOSE_BY) for one in (different, shown))
    relief_px = agreement.over_picture(agreement.wholly_seen * sure * np.linalg.norm(off_px, axis=1))
    ordinary = MOVING / (1 + (relief_px / np.float32(RIM_PX)) ** 2)
    trust = _explained(near, cv2.max(ordinary, 1.0) * (OWN_ERROR * shown_near + noise))
    own = np.flatnonzero(sure)
    tiles[own] = agreement.differences(shift_px[own] + sure[own, None] * off_px[own], own)
    misplaced = left - _power_around(agreement.side_by_side(tiles), AROUND)
    trust *= expected / (expected + 2 * cv2.max(misplaced, 0.0))
    return _not_less(trust), _not_less(alike)


def _explained(power: Image, most: Image) -> Image:
    """1 where a difference's power is at most what is expected, and as much less as half of it is the neighbour's."""
    return np.float32(0.5) / cv2.max(power / most - np.float32(0.5), 0.5)


def _not_less(trust: Image) -> Image:
    return cv2.threshold(trust, LEAST_TRUST, 0.0, cv2.THRESH_TOZERO)[1]


def _power_around(picture: Image, side: int) -> Image:
    """Mean square over squares about each place."""
    return cv2.sqrBoxFilter(picture, cv2.CV_32F, (side, side))


def still_part(found: Sequence[NeighbourPlace]) -> Image | None:
    """How sure it is that the frame shows there what stands still, 0 to 1, by the neighbour that agrees best.

    What no neighbour shows in its place moves, and its blur is not the camera's.  Where none has a picture nothing
    speaks against it.  Those that show something else nearly everywhere tell nothing; None: no other.
    """
    telling = [one for one in found if one.alike[one.seen].mean() > LEAST_ALIKE]
    if not telling:
        return None
    best = np.maximum.reduce([one.alike for one in telling])
    return np.where(np.logical_or.reduce([one.seen for one in telling]), best, np.float32(1))


@dataclass(frozen=True, slots=True)
class JoinedNeighbours:
    """Those of a frame's neighbours that it is restored with, and what they bring by the spectra."""

    pictures: tuple[NeighbourPicture, ...]
    passed: Array
    """(RINGS,) sum of their |K|², weighted."""

    @property
    def places(self) -> tuple[NeighbourPlace, ...]:
        """Where they lie."""
        return tuple(one.place for one in self.pictures)


def joined_neighbours(found: Sequence[NeighbourPicture], luma: PictureStatistics) -> JoinedNeighbours:
    """What some neighbours bring together; luma: measured on the frame."""
    passed = [one.place.passed(luma.frequency) for one in found]
    return JoinedNeighbours(tuple(found), np.sum([np.zeros(RINGS), *passed], 0))


def most_telling(passed: Sequence[Array], taken: Array, luma: PictureStatistics) -> int:
    """Number of the further picture that leaves least wrong, by the ideal linear filter and the rings' spectra.

    passed: (RINGS,) weighted |K|² of each.  taken: (RINGS,) sum of those taken already.  luma: measured on the frame.
    """
    return int(np.argmin([luma.ideal_error(taken + one) for one in passed]))


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


def _lasting_px(centres_px: Array, off_px: Array, typical_px: float, spacing_px: float) -> float:
    """Deviation, each axis, of what shifts (n, 2) have in common with those beside them: the field's error, no noise.

    Noise of tiles side by side is independent, so the mean product of their shifts is the power of the rest.
    """
    length = np.linalg.norm(off_px, axis=1, keepdims=True)
    held = off_px * np.minimum(1.0, 2 * HUBER * typical_px / np.maximum(length, 1e-9))
    apart = np.linalg.norm(centres_px[:, None] - centres_px, axis=-1)
    beside = (apart > 0) & (apart <= BESIDE * spacing_px)
    products = (held @ held.T)[beside]
    return float(np.sqrt(max(products.mean() / 2, 0.0))) if len(products) else typical_px


def _left_of_shifts_px(off_px: Array, lasting_px: float, noise_px: float) -> Array:
    """(n,) root mean square, each axis, of what tiles (n, 2) off the field lie off, by what is known of both parts.

    Normal priors: of a measured shift the part share = lasting² / (lasting² + noise²) is expected, with the variance
    share · noise².
    """
    share = lasting_px**2 / max(lasting_px**2 + noise_px**2, 1e-12)
    return np.asarray(np.sqrt(share**2 * (off_px**2).sum(axis=1) / 2 + share * noise_px**2))


def _at(affine: Array, points_px: Array) -> Array:
    return np.asarray(affine[0] + points_px @ affine[1:])
