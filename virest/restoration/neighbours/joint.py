"""A frame's neighbours as further measurements of its sharp picture.

Each neighbour, registered to the frame's pixels, is a blur of the same sharp picture along another path, with
independent noise.  Σ_k ‖w_k (A_k x − y_k)‖² has in each tile the numerator Σ w K_k* Y_k and the denominator
Σ w E|K_k|², and frequencies that one path cancels another passes (Delbracio & Sapiro 2015,
doi:10.1109/CVPR.2015.7298855, weigh by the pictures' own spectra instead).  With each picture blurred along the other's
path, any further difference (moving objects, parallax, shadows) counts as the neighbour's noise.  The neighbour's
weight is the frame's noise over its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Mask
from virest.image_formation.blur import Image
from virest.image_formation.kernel_spread import KernelSpread
from virest.image_formation.kernels import KernelField
from virest.image_formation.neighbour import NeighbourView
from virest.restoration.neighbours.reduced_tiles import TILE
from virest.restoration.neighbours.registration import HUBER, TileAgreement
from virest.restoration.statistics.records import PictureStatistics
from virest.restoration.statistics.rings import RINGS, SIDE, place_ring
from virest.restoration.statistics.tile_power import passed_power

OWN_ERROR = 0.01
"""Part of the signal's power that differs between any two frames: the tone curve acts on different blurs."""
MOST_DIFFERENT = 4.0
"""Reject a neighbour whose median difference is this many times what noise explains.  True neighbours differed by 0.05
to 0.9 times that (3 at 0.08 bits per pixel), pictures of other scenes by 5 to 1500 times."""
LEAST_TRUST = 0.25
"""A neighbour is not used where its trust is lower."""
MOVING = 16.0
"""Local difference power over the expected one that is still ordinary: chessboard edges reach it (at 8 their frames
lose up to 1 dB); moving objects differ by 10 to 400 times and lose nothing at 16."""
RIM_PX = 0.2
"""Shift of a tile relative to the affine field, px, at which the ordinary difference is halved, there and in the tiles
beside it.  A near object hides in one frame what the other shows, along rims as wide as the shift; these differ by less
than a sixth of what chessboard edges do.  Chosen on relief at 1 and 0.7 m, two walks, a chessboard and a shake; 0.1
loses 0.1 dB on these."""
AROUND, CLOSE_BY = 17, 7
"""Sides, reduced pixels, of the squares for local power: at the size of objects, and of their rims."""
LEAST_COUNTED = 0.1
"""Least part of such a square that must count for its power to be known."""
LEAST_ALIKE = 0.5
"""Least mean ``alike`` for a neighbour to be used to detect motion."""
SPARSE = 4
"""Medians of local powers use every fourth row and column: they change little between pixels."""
LEAST_SHIFTS = 6
"""An affine field of shifts has six unknowns; twice as many tiles are required."""
LOOKED_AT = 6
"""Number of kernels from which a neighbour's |K|² is estimated."""
ROBUST_STEPS = 6
"""Passes against outliers: half or twice as many change restored frames by 0.10 or 0.03 grey levels (rms)."""
REACHES, PARTS = (1.0, 2.0, 4.0), tuple(np.sort(1 - np.geomspace(1.0, 1e-4, 17)).tolist())
"""Tried reaches of the shifts' common part, in tiles' sides, and its parts of their power; the rest is noise, never
0."""
CUBIC = -0.75
"""Slope at one pixel of the kernel of OpenCV's cubic interpolation."""
LONGEST_ROW = 2**14
"""Points that OpenCV interpolates at once: its pictures are less than 2¹⁵ pixels long."""
HALF = 2
"""Neighbours' colour is registered at this many times lower resolution: a movie stores no more of it."""


@dataclass(frozen=True, slots=True)
class ShiftField:
    """Shift, px, of what a neighbour shows, over the frame's picture: affine, plus a smooth rest."""

    affine: Array
    """(3, 2) coefficients of 1, x, y."""
    centres_px: Array
    """(n, 2) centres of a grid of tiles."""
    rest_px: Array
    """(n, 2) rest at the centres."""

    def at(self, points_px: Array) -> Array:
        """The shift at points (..., 2)."""
        return affine_at(self.affine, points_px) + between_tiles(self.rest_px, self.centres_px, points_px)


@dataclass(frozen=True, slots=True)
class NeighbourRegistration:
    """A neighbour's registration to the frame, and how far that and its content can be trusted."""

    number: int
    """Movie index."""
    view: NeighbourView
    """The predicted registration."""
    shift: ShiftField
    """How far what the neighbour shows lies from its predicted position."""
    gain: float
    """The neighbour's light over the frame's."""
    field: Callable[[Array], KernelField]
    """The neighbour's kernels at given centres in the frame."""
    centres_px: Array
    """(n, 2) centres of the compared tiles."""
    trust: Image
    """The frame's noise over the neighbour's, 0 to 1, at the reduced size."""
    alike: Image
    """How surely it shows the same as the frame, 0 to 1, at the reduced size."""
    seen: Mask
    """Where the neighbour has unclipped pixels, at the reduced size."""
    std_px: Array
    """(n,) standard deviation of the registration in those tiles, per axis."""
    own_shift_px: Array
    """(n, 2) each tile's own shift."""
    precision: Array
    """(n,) relative precision of these; 0: the neighbour shows something else."""
    apart_s: Array
    """(n,) time from the frame's to the neighbour's observation of those tiles."""
    coding_noise_ratio: float = 1.0
    """The frame's coding noise over the neighbour's: above 1 if the neighbour was coded with a finer step."""
    spread: KernelSpread | None = None
    """Uncertainty of its kernels; None: exact."""

    @property
    def longest_px(self) -> float:
        """Length of its longest blur path over the compared tiles."""
        return float(self.field(self.centres_px).length_px.max())

    @property
    def weight(self) -> float:
        """Mean weight over the picture."""
        return self.coding_noise_ratio * float(self.trust.mean())

    def passed(self, frequency: Array) -> Array:
        """(RINGS,) mean |K|² over some tiles, times the mean weight and the attenuation by the registration error.

        frequency: (RINGS,) cycles per pixel.
        """
        some = np.linspace(0, len(self.centres_px) - 1, min(len(self.centres_px), LOOKED_AT)).round().astype(int)
        sharpness = np.exp(-((2 * np.pi * self.std_px[:, None] * frequency) ** 2)).mean(axis=0)
        return np.asarray(self.weight * sharpness * rings_passed(self.field(self.centres_px[some])))

    def std_at_px(self, centres_px: Array) -> Array:
        """(m,) registration deviation at points (m, 2), interpolated between the nearest four tiles."""
        return np.sqrt(between_tiles(np.square(self.std_px), self.centres_px, centres_px))


@dataclass(frozen=True, slots=True)
class NeighbourPicture:
    """One neighbour, registered to the frame's pixels."""

    registration: NeighbourRegistration
    light: Image
    """(height, width) luma of its linear light, scaled to the frame's brightness."""
    half_light: Image
    """(height / 2, width / 2, 3), rounded up: its linear light in colour, scaled to the frame's brightness."""


@dataclass(frozen=True, slots=True)
class ComparedNeighbours:
    """The neighbours that show what in a frame moves on its own, and those with which it is restored."""

    registrations: tuple[NeighbourRegistration, ...] = ()
    """Of the joined neighbours, or of the adjacent frames if the frame is restored alone."""
    pictures: tuple[NeighbourPicture, ...] = ()
    """The joined neighbours; empty if the frame is restored alone."""


def register_neighbour(
    view: NeighbourView,
    field: Callable[[Array], KernelField],
    number: int,
    agreement: TileAgreement,
    independent_error: float,
) -> NeighbourRegistration | None:
    """Register a neighbour to the frame; None with fewer than 2 LEAST_SHIFTS usable tiles.

    field: the neighbour's kernels, from the view.  independent_error: expected mean square difference by independent
    noise.
    """
    used = agreement.precision > 0
    if np.count_nonzero(used) < 2 * LEAST_SHIFTS:
        return None
    shift, noise_px, std_px = _shift_field(agreement, used)
    trust, alike = _trust(agreement, shift.at(agreement.centres_px), noise_px, independent_error)
    height, width = trust.shape
    inside = agreement.inside[:height, :width]
    seen = inside & ~agreement.clipped[:height, :width]
    return NeighbourRegistration(
        number, view, shift, agreement.gain, field, agreement.centres_px, trust * inside, alike * seen, seen, std_px,
        agreement.shift_px, agreement.precision, view.apart_s(agreement.centres_px),
    )  # fmt: skip


def resample_neighbour(
    registration: NeighbourRegistration, light: Image, half_light: Image, detailed: bool
) -> NeighbourPicture:
    """Resample a neighbour's luma of light (height, width), and its light at half that size, to the frame's pixels.

    detailed: see :func:`is_detailed`; the luma is then interpolated from 8 × 8 pixels, at four times the cost.
    """
    source = registration.view.map_px(lambda points_px: points_px - registration.shift.at(points_px))
    reading = cv2.INTER_LANCZOS4 if detailed else cv2.INTER_CUBIC
    registered = cv2.remap(light, source, None, reading, borderMode=cv2.BORDER_REPLICATE)
    registered_half = cv2.remap(half_light, _halved(source), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    for one in (registered, registered_half):
        one *= np.float32(1 / registration.gain)
    return NeighbourPicture(registration, registered, registered_half)


def is_detailed(luma: PictureStatistics) -> bool:
    """Whether the error of cubic interpolation exceeds the noise in some ring."""
    return bool(np.any(np.interp(luma.frequency, *_cubic_error()) * luma.passed * luma.signal > luma.noise))


@lru_cache(maxsize=1)
def _cubic_error() -> tuple[Array, Array]:
    """Frequencies along an axis, cycles per pixel, and the relative error power of cubic interpolation at each.

    It is the mean over all subpixel shifts of |1 − H|², with H the spectrum of the four weights.
    """
    frequency, shift = np.linspace(0, 0.5, 51), (np.arange(32) + 0.5) / 32
    distance = np.abs(np.arange(-1, 3)[:, None] - shift)
    near = (CUBIC + 2) * distance**3 - (CUBIC + 3) * distance**2 + 1
    far = CUBIC * (distance**3 - 5 * distance**2 + 8 * distance - 4)
    waves = np.exp(2j * np.pi * frequency[:, None, None] * (np.arange(-1, 3)[:, None] - shift))
    passed = (np.where(distance <= 1, near, far) * waves).sum(axis=1)
    return frequency, (np.abs(1 - passed) ** 2).mean(axis=1)


def _trust(agreement: TileAgreement, shift_px: Array, noise_px: float, independent_error: float) -> tuple[Image, Image]:
    """The neighbour's trust, and how surely both frames show the same, 0 to 1 each, at the reduced size.

    Trust is the frame's noise over the neighbour's: if noise alone makes a local difference of power E, half of that is
    the frame's, and any excess is the neighbour's.  The ring fit counts overtones of edges as noise, so the noise is
    limited to the median difference.  Since local differences scatter, E is a multiple of the expected power: MOVING
    when detecting motion, less near relief when weighing a neighbour, because of rims that are hidden in one frame.
    A difference that vanishes with a tile's own shift in place of the field's distorts the picture near relief, and
    none of it is ordinary.  Only the part of a tile's own shift counts that the shifts' noise, noise_px per axis, does
    not explain (James & Stein 1961).
    """
    tiles = agreement.differences(shift_px)
    different, shown = agreement.side_by_side(tiles), agreement.side_by_side(agreement.shown())
    unclipped = (~agreement.clipped[: len(different), : different.shape[1]]).astype(np.float32)
    left, both = (_power_around(one, AROUND, unclipped) for one in (different, shown))
    some = np.s_[::SPARSE, ::SPARSE]
    if np.median(left[some] / (OWN_ERROR * both[some] + np.float32(independent_error))) > MOST_DIFFERENT:
        return np.zeros_like(left), np.zeros_like(left)
    noise = np.float32(min(independent_error, float(np.median(left[some]))))
    expected = OWN_ERROR * both + noise
    alike = _relative_noise(left, MOVING * expected)
    off_px = np.where(agreement.precision[:, None] > 0, agreement.shift_px - shift_px, 0.0)
    sure = np.maximum(1 - 2 * noise_px**2 / np.maximum((off_px**2).sum(axis=1), 1e-12), 0.0)
    near, shown_near = (_power_around(one, CLOSE_BY, unclipped) for one in (different, shown))
    relief_px = agreement.over_picture(agreement.wholly_seen * sure * np.linalg.norm(off_px, axis=1))
    ordinary = MOVING / (1 + (relief_px / np.float32(RIM_PX)) ** 2)
    trust = _relative_noise(near, cv2.max(ordinary, 1.0) * (OWN_ERROR * shown_near + noise))
    own = np.flatnonzero(sure)
    tiles[own] = agreement.differences(shift_px[own] + sure[own, None] * off_px[own], own)
    misplaced = left - _power_around(agreement.side_by_side(tiles), AROUND, unclipped)
    trust *= expected / (expected + 2 * cv2.max(misplaced, 0.0))
    return _thresholded(trust), _thresholded(alike)


def _relative_noise(power: Image, most: Image) -> Image:
    """The frame's noise over the neighbour's: 1 up to the power ``most``, above it ½ most / (power − ½ most)."""
    return np.float32(0.5) / cv2.max(power / most - np.float32(0.5), 0.5)


def _thresholded(trust: Image) -> Image:
    return cv2.threshold(trust, LEAST_TRUST, 0.0, cv2.THRESH_TOZERO)[1]


def _power_around(picture: Image, side: int, weight: Image) -> Image:
    """Mean square over the ``side`` × ``side`` square around each pixel; weight: 0 for pixels that do not count.

    Where none counts it is that of the nearest squares in which some do.
    """
    power = cv2.sqrBoxFilter(picture * weight, cv2.CV_32F, (side, side))
    counted = cv2.blur(weight, (side, side))
    missing = counted < LEAST_COUNTED
    found = power / cv2.max(counted, LEAST_COUNTED)
    while missing.any() and not missing.all():
        power, counted = (cv2.blur(one, (side, side)) for one in (power, counted))
        np.divide(power, counted, out=found, where=missing & (counted >= LEAST_COUNTED))
        missing &= counted < LEAST_COUNTED
    return found


def static_part(found: Sequence[NeighbourRegistration]) -> Image | None:
    """How surely the frame shows the static scene, 0 to 1, according to the neighbour that agrees best.

    Content that no neighbour shows at the registered position moves, and its blur is not the camera's.  Regions that
    no neighbour covers count as static.  Neighbours that differ almost everywhere are ignored; None: none is left.
    """
    agreeing = [one for one in found if one.alike[one.seen].mean() > LEAST_ALIKE]
    if not agreeing:
        return None
    best = np.maximum.reduce([one.alike for one in agreeing])
    return np.where(np.logical_or.reduce([one.seen for one in agreeing]), best, np.float32(1))


@dataclass(frozen=True, slots=True)
class JoinedNeighbours:
    """The neighbours that a frame is restored with, and the |K|² that they contribute."""

    pictures: tuple[NeighbourPicture, ...]
    passed: Array
    """(RINGS,) weighted sum of their |K|²."""

    @property
    def registrations(self) -> tuple[NeighbourRegistration, ...]:
        """Their registrations."""
        return tuple(one.registration for one in self.pictures)


def joined_neighbours(found: Sequence[NeighbourPicture], luma: PictureStatistics) -> JoinedNeighbours:
    """Join registered neighbours; luma: the frame's statistics."""
    passed = [one.registration.passed(luma.frequency) for one in found]
    return JoinedNeighbours(tuple(found), np.sum([np.zeros(RINGS), *passed], 0))


def most_useful(passed: Sequence[Array], taken: Array, luma: PictureStatistics) -> int:
    """Index into ``passed`` of the further picture with which the ideal linear filter's error is least.

    passed: (RINGS,) weighted |K|² of each.  taken: (RINGS,) their sum over the pictures already chosen.  luma: the
    frame's statistics.
    """
    return int(np.argmin([luma.ideal_error(taken + one) for one in passed]))


def rings_passed(kernels: KernelField) -> Array:
    """(RINGS,) mean |K|² of kernels; all 0 if one does not fit into a measured tile."""
    arrays = kernels.arrays()
    if arrays.shape[1] > SIDE:
        return np.zeros(RINGS)
    power = np.mean([passed_power(kernel) for kernel in arrays], axis=0)
    counts = np.maximum(np.bincount(place_ring().ravel(), minlength=RINGS), 1)
    return np.asarray(np.bincount(place_ring().ravel(), power.ravel(), RINGS) / counts)


def half_size(picture: Image) -> Image:
    """Means over HALF × HALF pixels; a picture with an odd side repeats its last row or column."""
    height, width = picture.shape[:2]
    if height % HALF or width % HALF:
        picture = cv2.copyMakeBorder(picture, 0, height % HALF, 0, width % HALF, cv2.BORDER_REPLICATE)
    return cv2.resize(picture, (-(-width // HALF), -(-height // HALF)), interpolation=cv2.INTER_AREA)


def _halved(source_px: NDArray[np.float32]) -> NDArray[np.float32]:
    """A coordinate map (height, width, 2) for pictures of half the size, sides rounded up."""
    return (half_size(source_px) + np.float32(0.5)) / np.float32(HALF) - np.float32(0.5)


def affine_fit(centres_px: Array, shift_px: Array, precision: Array) -> tuple[Array, float]:
    """Robust fit to shifts (n, 2) at points (n, 2), with Huber's weights.

    Returns the coefficients (3, 2) of 1, x, y, and the residuals' standard deviation per axis.
    """
    design = np.column_stack([np.ones(len(centres_px)), centres_px])
    robust = np.ones(len(design))
    for _ in range(ROBUST_STEPS):
        root = np.sqrt(precision * robust)[:, None]
        found = np.linalg.lstsq(root * design, root * shift_px, rcond=None)[0]
        distance = np.linalg.norm(shift_px - design @ found, axis=1)
        typical = max(float(np.median(distance)) / 1.1774, 1e-6)
        robust = np.minimum(1.0, HUBER * typical / np.maximum(distance, 1e-9))
    return found, typical


def _shift_field(agreement: TileAgreement, used: Mask) -> tuple[ShiftField, float, Array]:
    """The shifts over the picture, the tiles' noise per axis, px, and the field's deviation (n,) per axis, px.

    Affine, plus what adjacent tiles share: a rest of the stabiliser, rolling-shutter wobble, relief.  That part is
    taken for a random field with the correlation exp(−½ (d / reach)²) over the distance d, in which tiles' noise is
    independent, and is estimated with the least expected error (kriging; Cressie 1993,
    doi:10.1002/9781119115151).
    """
    centres_px, side_px = agreement.centres_px, float(TILE * agreement.times)
    affine, typical_px = affine_fit(centres_px[used], agreement.shift_px[used], agreement.precision[used])
    off_px = agreement.shift_px[used] - affine_at(affine, centres_px[used])
    doubt = np.maximum(1.0, np.linalg.norm(off_px, axis=1) / (HUBER * typical_px)) ** 2
    apart = np.linalg.norm(centres_px[:, None] - centres_px, axis=-1) / side_px
    common_px, noise_px, reach = _likeliest_field(off_px, doubt, apart[np.ix_(used, used)])
    together = common_px**2 * np.exp(-0.5 * (apart / reach) ** 2)
    gain = np.linalg.solve(together[np.ix_(used, used)] + np.diag(noise_px**2 * doubt), together[used]).T
    left_px2 = np.maximum(common_px**2 - np.einsum("ij,ji->i", gain, together[used]), 0.0)
    of_affine_px2 = noise_px**2 * LEAST_SHIFTS / len(off_px)
    return ShiftField(affine, centres_px, gain @ off_px), noise_px, np.sqrt(left_px2 + of_affine_px2)


def _likeliest_field(off_px: Array, doubt: Array, apart: Array) -> tuple[float, float, float]:
    """Deviations, per axis, of a random field and of tiles' noise, px, and the field's reach in tiles' sides.

    Those with the greatest likelihood of the shifts off_px (n, 2).  doubt: (n,) each tile's noise power over the usual.
    apart: (n, n) distances in tiles' sides.
    """
    root, parts = np.sqrt(doubt), np.array(PARTS)[:, None]
    best = (np.inf, 0.0, 0.0, 1.0)
    for reach in REACHES:
        together = np.exp(-0.5 * (apart / reach) ** 2)
        values, vectors = np.linalg.eigh(together / np.outer(root, root))
        spread = parts * np.maximum(values, 0.0) + 1 - parts
        seen = ((vectors.T @ (off_px / root[:, None])) ** 2).sum(axis=1)
        power = np.maximum((seen / spread).sum(axis=1) / off_px.size, 1e-6)
        unlikely = off_px.size * np.log(power) + off_px.shape[1] * np.log(spread).sum(axis=1)
        likeliest = int(np.argmin(unlikely))
        best = min(best, (float(unlikely[likeliest]), float(power[likeliest]), PARTS[likeliest], reach))
    _, power, part, reach = best
    return float(np.sqrt(part * power)), float(np.sqrt((1 - part) * power)), reach


def between_tiles(values: Array, tiles_px: Array, points_px: Array) -> Array:
    """Values (n,) or (n, 2) at the centres of a grid of tiles, interpolated linearly at points (..., 2)."""
    x, y = (np.unique(along) for along in tiles_px.T)
    grid = values.reshape(len(y), len(x), -1).astype(np.float32)
    flat = points_px.reshape(-1, 2)
    at = [np.interp(c, k, np.arange(len(k))).astype(np.float32) for c, k in zip(flat.T, (x, y), strict=True)]
    rows = np.array_split(np.arange(len(flat)), len(flat) // LONGEST_ROW + 1)
    found = [cv2.remap(grid, at[0][r], at[1][r], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for r in rows]
    return np.concatenate(found).reshape(points_px.shape[:-1] + values.shape[1:]).astype(float)


def affine_at(affine: Array, points_px: Array) -> Array:
    """An affine map, coefficients (3, 2) of 1, x, y, at points (..., 2)."""
    return np.asarray(affine[0] + points_px @ affine[1:])
