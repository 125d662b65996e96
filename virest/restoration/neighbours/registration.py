"""Residual shift between two neighbouring frames after compensating the predicted motion, tile by tile.

Both are compared under the same blur: the first frame is blurred along the second one's paths and the second along the
first one's, so only a shift remains between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.image_formation.blur import Image
from virest.image_formation.kernels import KernelField, smooth_field
from virest.image_formation.neighbour import NeighbourView, turn_jacobian_px
from virest.image_formation.reach import along_paths
from virest.restoration.neighbours.reduced_tiles import (
    MOST_TILES,
    TILE,
    WIDE,
    common_shift,
    cut,
    full_px,
    inner,
    kernel_spectra,
    power_of,
    radii,
    read_at,
    reduction,
    shifted,
    spectra_of,
    spread_tiles,
    tile_shifts,
    wide_spectra,
)

LEAST_TILES = 4
"""A rotation has three unknowns and a tile's shift gives two equations; fewer tiles leave too little redundancy."""
FAR_PX = 3.0
"""Compensate a larger common shift, reduced pixels, before the fits, so that tiles show the same content."""
CLIPPED_LIGHT = 0.95
"""Brighter pixels are not compared: clipped light cannot be blurred again."""
RIM_PX, SOFT_PX = 1, 3
"""Reduced pixels around clipped light that the codec and the resampling change; width of the edges of what is
compared."""
LEAST_SEEN = 0.5
"""Least fraction of a tile that must be comparable."""
HUBER = 1.5
"""Standard deviations beyond which a tile's weight falls (1.345 gives 95 % efficiency for normal errors)."""
ROBUST_STEPS = 8
"""Passes against outliers: of 16 tiles, 15 % of them outliers, half as many passes change a rate by 0.09 σ (rms), twice
as many by 0.002 σ."""
WORST_CONDITION = 1e12
"""Condition number of the normal equations above which rotation about some axis is unobservable."""


@dataclass(frozen=True, slots=True)
class PairTurn:
    """The rotation rate that the prediction lacks between two frames, measured on them."""

    start_s: float
    """Mid-exposure of the first frame's middle row, IMU clock."""
    end_s: float
    """The same for the second frame."""
    rate_rad_s: Array
    """(3,) rate to be added, camera axes: x_t' = exp(rate · t) x_t."""
    covariance: Array
    """(3, 3) covariance of the rate, from the tiles' scatter."""
    scatter_px_s: float
    """Standard deviation, per axis, of the tiles' speeds about the fitted rotation: relief, moving objects, noise."""
    tiles: int
    """Number of tiles used."""


@dataclass(frozen=True, slots=True)
class FrameTiles:
    """Tiles of a reduced frame and their kernels, to be compared with those of its neighbours."""

    tops_lefts: Index
    """(n, 2) positions in the reduced picture."""
    times: int
    """Recorded size over reduced size."""
    light: Image
    """The whole reduced picture, linear light."""
    means: Array
    """(n,) mean light of each tile."""
    spectra: NDArray[np.complex64]
    """(n, WIDE, WIDE / 2 + 1) spectra of the tiles' light with margins."""
    kernels: NDArray[np.complex64]
    """(n, WIDE, WIDE / 2 + 1) spectra of the transposed kernels."""
    field: Callable[[Array], KernelField]
    """The kernels at given centres in the recorded picture."""

    @property
    def centres_px(self) -> Array:
        """(n, 2) tile centres in the recorded picture."""
        return full_px(self.tops_lefts, self.times, (TILE - 1) / 2)


def frame_tiles(
    light: Image, profile: CameraProfile, field: Callable[[Array], KernelField], everywhere: bool = False
) -> FrameTiles | None:
    """Tiles of a frame's light, from :func:`reduced_light`; None if a path does not fit into half a tile.

    everywhere: cover the whole picture instead of MOST_TILES tiles.
    """
    times = reduction(profile.height, profile.width)
    tops_lefts = spread_tiles(light.shape[0], light.shape[1], light.size if everywhere else MOST_TILES)
    kernels = kernel_spectra(field, tops_lefts, times)
    if kernels is None:
        return None
    tiles = cut(light, tops_lefts)
    wide = wide_spectra(light, tops_lefts)
    return FrameTiles(tops_lefts, times, light, tiles.mean(axis=(1, 2)), wide, kernels, field)


def pair_turn(view: NeighbourView, first: Image, second: Image) -> PairTurn | None:
    """The rotation rate missing between two frames; None if it cannot be measured on them.

    first, second: from :func:`reduced_light`, of the view's frame and its neighbour.
    """
    tiles = frame_tiles(first, view.frame.profile, smooth_field(view.frame, view.anchor))
    if tiles is None:
        return None
    tops_lefts, times = tiles.tops_lefts, tiles.times
    field = view.field()
    there = kernel_spectra(field, tops_lefts, times)
    if there is None:
        return None
    blurred, apart = inner(tiles.spectra * there), np.zeros(2)
    for _ in range(2):
        registered = _registered(view, second, times, apart)
        seen = _comparable(_reached_by_clipped_light(tiles, registered, field), tops_lefts)
        beside = inner(wide_spectra(registered, tops_lefts) * tiles.kernels)
        a, b = (spectra_of(tile, seen, masked=True) for tile in (blurred, beside))
        common = common_shift(a, b)
        if np.abs(common).max() <= FAR_PX:
            break
        apart = apart + common
    shift, precision = tile_shifts(a, b, common)
    return _turn(view, tops_lefts, times, shift + apart, precision)


@dataclass(frozen=True, slots=True)
class TileAgreement:
    """Comparison of a neighbour's tiles with a frame's, each blurred along the other's path."""

    tops_lefts: Index
    """(n, 2) positions in the reduced picture."""
    centres_px: Array
    """(n, 2) tile centres in the frame."""
    shift_px: Array
    """(n, 2): the neighbour shows at the predicted position of x what the frame shows at x + shift."""
    precision: Array
    """(n,) relative precision of the shifts; 0: the tile shows different content."""
    here: NDArray[np.complex64]
    """(n, WIDE, WIDE / 2 + 1) spectra of the frame's tiles, blurred, light over its mean."""
    there: Image
    """(n, TILE, TILE) the neighbour's tiles, blurred, light over its mean."""
    gain: float
    """The neighbour's light over the frame's."""
    light: float
    """The frame's light, median of the tiles."""
    inside: Mask
    """At the reduced size: where the neighbour covers the frame."""
    clipped: Mask
    """At the reduced size: where clipped light of either frame may reach."""
    blur_px: int
    """Half the neighbour's longest blur path, reduced pixels, at most TILE / 4."""
    passed: Array
    """(WIDE, WIDE / 2 + 1) sum of both kernels' mean |K|²: independent noise N makes the error Σ passed N."""
    times: int
    """Recorded size over reduced size."""

    def differences(self, shift_px: Array, numbers: Index | slice = slice(None)) -> Image:
        """The neighbour's tiles minus the frame's shifted by shift_px (n, 2): (n, TILE, TILE), light over its mean.

        numbers: indices of the tiles.
        """
        return np.asarray(self.there[numbers] - inner(shifted(self.here[numbers], shift_px / self.times)))

    def shown(self) -> Image:
        """Contrast of the neighbour's tiles, (n, TILE, TILE): light over its mean, minus 1."""
        return self.there - 1

    def side_by_side(self, tiles: Image) -> Image:
        """Tiles (n, TILE, TILE) assembled into a picture (height, width) of the reduced size.

        A border of blur_px, which depends on content beyond the picture, is replaced by reflection of the inside.
        """
        height, width = self.tops_lefts.max(axis=0) + TILE
        whole = np.zeros((height, width), np.float32)
        for (top, left), tile in zip(self.tops_lefts.tolist(), tiles, strict=True):
            whole[top : top + TILE, left : left + TILE] = tile
        inner = whole[self.blur_px : height - self.blur_px, self.blur_px : width - self.blur_px]
        return cv2.copyMakeBorder(inner, *(self.blur_px,) * 4, cv2.BORDER_REFLECT)

    @property
    def wholly_seen(self) -> Mask:
        """(n,) whether the neighbour covers all of a tile."""
        seen = self.inside.astype(np.float32)
        return np.asarray(cut(seen, self.tops_lefts).min(axis=(1, 2)) > 0)

    def over_picture(self, values: Array) -> Image:
        """Tiles' values (n,), each the largest of its 3 × 3 neighbourhood, interpolated to the reduced size."""
        rows = len(np.unique(self.tops_lefts[:, 0]))
        height, width = self.tops_lefts.max(axis=0) + TILE
        largest = cv2.dilate(values.reshape(rows, -1).astype(np.float32), np.ones((3, 3), np.uint8))
        return cv2.resize(largest, (int(width), int(height)), interpolation=cv2.INTER_LINEAR)

    def expected_error(self, frequency: Array, noise: Array, slope: float) -> float:
        """The mean square difference that independent noise makes, in light over its mean.

        noise: (rings,) power, grey levels squared, at ``frequency``, cycles per recorded pixel.  slope: grey levels per
        unit of light.
        """
        recorded = radii(WIDE) / self.times
        power = np.interp(recorded, frequency, noise) / (self.times * slope * max(self.light, 1e-6)) ** 2
        return float(np.mean(self.passed * power))


def tile_agreement(
    view: NeighbourView, tiles: FrameTiles, field: Callable[[Array], KernelField], second: Image
) -> TileAgreement | None:
    """Compare a frame's tiles with its neighbour's reduced picture; None if a path does not fit into half a tile.

    field: the neighbour's kernels, from the view.  second: the neighbour, from :func:`reduced_light`.
    """
    kernels = kernel_spectra(field, tiles.tops_lefts, tiles.times)
    if kernels is None:
        return None
    source = view.map_px(times=tiles.times)
    there = read_at(second, source)
    wide, blur_px = tiles.spectra * kernels, min(_reach_px(field, tiles.tops_lefts, tiles.times), TILE // 4)
    here, there_blurred = inner(wide), inner(wide_spectra(there, tiles.tops_lefts) * tiles.kernels)
    clipped = _reached_by_clipped_light(tiles, there, field)
    seen = _comparable(clipped, tiles.tops_lefts)
    a, b = (spectra_of(tile, seen, masked=True) for tile in (here, there_blurred))
    shift, precision = tile_shifts(a, b, np.zeros(2))
    per_mean = [1 / np.maximum(tile.mean(axis=(1, 2), keepdims=True), 1e-3) for tile in (here, there_blurred)]
    return TileAgreement(
        tiles.tops_lefts,
        tiles.centres_px,
        shift * tiles.times,
        precision,
        wide * per_mean[0],
        there_blurred * per_mean[1],
        float(np.median(cut(there, tiles.tops_lefts).mean(axis=(1, 2)) / np.maximum(tiles.means, 1e-6))),
        float(np.median(tiles.means)),
        _inside(source, second),
        clipped,
        blur_px,
        np.asarray(power_of(tiles.kernels).mean(axis=0) + power_of(kernels).mean(axis=0)),
        tiles.times,
    )


def _reach_px(field: Callable[[Array], KernelField], tops_lefts: Index, times: int) -> int:
    """Half the longest path of a neighbour's kernels, reduced pixels, rounded up."""
    centres_px = full_px(tops_lefts, times, (TILE - 1) / 2)
    return int(np.ceil(0.5 * field(centres_px).length_px.max() / times))


def judged_change(
    view: NeighbourView, recorded: Image, restored: Image, second: Image
) -> tuple[float, float, float, float] | None:
    """Judge the restoration of a frame by a neighbour: its gain, its change, and the error before and after.

    Let D be the change by restoring and M the neighbour's picture minus the recorded frame, frames blurred along the
    neighbour's path, and G the neighbour's picture.  Returns |M|² − |M − D|² and |D|², mean squares in grey levels
    squared, and |M|² / |G|² and |M − D|² / |G|².  A shift of a tile is not an error of the blur, so recorded and
    restored tiles are shifted onto the neighbour.  Left out are tiles that the neighbour does not fully cover, and
    pixels that the blur reaches from clipped light or from beyond the frame's edges.  All pictures are reduced.  None
    if a path does not fit into half a tile, or if fewer than LEAST_TILES tiles are usable over at least LEAST_SEEN of
    their area.
    """
    times = reduction(view.frame.profile.height, view.frame.profile.width)
    tops_lefts, field = spread_tiles(*recorded.shape), view.field()
    kernels = kernel_spectra(field, tops_lefts, times)
    if kernels is None:
        return None
    source = view.map_px(times=times)
    brought = read_at(second, source)
    unknown = _near_clipped_light(recorded, brought, _reach_px(field, tops_lefts, times))
    seen = cut(np.float32(1) - unknown, tops_lefts)
    b = spectra_of(cut(brought, tops_lefts), seen)
    onto = [spectra_of(inner(wide_spectra(picture, tops_lefts) * kernels), seen) for picture in (recorded, restored)]
    shift, precision = tile_shifts(onto[0] + onto[1], b, np.zeros(2))
    onto = [shifted(a, shift) for a in onto]
    used = (precision > 0) & (cut(_inside(source, second), tops_lefts).min(axis=(1, 2)) > 0)
    used &= seen.mean(axis=(1, 2)) > LEAST_SEEN
    if np.count_nonzero(used) < LEAST_TILES:
        return None
    levels = seen[used] * _levels_per_part(cut(recorded, tops_lefts)[used], view.frame.profile)
    pixels = float(seen[used].sum())

    def mean_square(spectra: NDArray[np.complex64]) -> float:
        return float(np.sum((fft.irfft2(spectra[used], (TILE, TILE)) * levels) ** 2)) / pixels

    shown, lacked, left, changed = map(mean_square, (b, b - onto[0], b - onto[1], onto[1] - onto[0]))
    return lacked - left, changed, lacked / shown, left / shown


def _levels_per_part(tiles: Image, profile: CameraProfile) -> Image:
    """Grey levels per unit of light over the tile's mean, (n, 1, 1)."""
    curve = profile.curve
    light = tiles.mean(axis=(1, 2), keepdims=True)
    grey = np.rint(255 * curve.encode(light)).astype(np.uint8)
    return np.asarray(light * curve.slope_table()[grey], np.float32)


def _inside(source: NDArray[np.float32], second: Image) -> Mask:
    """Where a map (h, w, 2) points inside the neighbour's picture."""
    height, width = second.shape
    return np.asarray(cv2.inRange(source, (-0.5, -0.5), (width - 0.5, height - 0.5)) > 0)


def _reached_by_clipped_light(tiles: FrameTiles, there: Image, field: Callable[[Array], KernelField]) -> Mask:
    """Where clipped light of a frame, blurred along its neighbour's paths, may reach, and the neighbour's, vice versa.

    there: the registered neighbour, reduced.
    """
    reached = np.zeros(there.shape, np.uint8)
    for light, paths in ((tiles.light, field), (there, tiles.field)):
        mask = (light > CLIPPED_LIGHT).astype(np.uint8)
        if cv2.hasNonZero(mask):
            reached |= along_paths(mask, paths, cv2.dilate, tiles.times)
    rim = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
    return np.asarray(cv2.dilate(reached, rim) > 0)


def _comparable(clipped: Mask, tops_lefts: Index) -> Image | None:
    """Weights (n, TILE, TILE) of tiles' pixels, 0 where clipped light may reach, with soft edges; None: all 1."""
    return cut(cv2.blur(np.float32(~clipped), (SOFT_PX, SOFT_PX)), tops_lefts) if clipped.any() else None


def _near_clipped_light(light: Image, there: Image, reach_px: int) -> NDArray[np.uint8]:
    """1 where clipped light of either of two registered reduced pictures, or light from beyond, may reach by blur."""
    clipped_light = (cv2.max(light, there) > CLIPPED_LIGHT).astype(np.uint8)
    around = np.ones((4 * reach_px + 1, 4 * reach_px + 1), np.uint8)
    return cv2.dilate(clipped_light, around, borderType=cv2.BORDER_CONSTANT, borderValue=1)


def _registered(view: NeighbourView, second: Image, times: int, apart: Array) -> Image:
    """The neighbour's reduced picture registered by the prediction, minus a common shift (2,), reduced pixels.

    The map is computed per row: over the rows of a tile, 5 ms, hand shake bends it by up to half a pixel.
    """
    return read_at(second, view.map_px(lambda p: p - times * apart, times))


def _turn(view: NeighbourView, tops_lefts: Index, times: int, shift: Array, precision: Array) -> PairTurn | None:
    """Fit one rotation rate to the tiles' shifts with Huber's weights; None: too few tiles, or ill-conditioned."""
    used = precision > 0
    if np.count_nonzero(used) < LEAST_TILES:
        return None
    centres_px = full_px(tops_lefts, times, (TILE - 1) / 2)[used]
    apart_s = view.apart_s(centres_px)
    speed = -shift[used] * times / apart_s[:, None]  # b(x) = a(x + d): the neighbour shows x + d where x was predicted
    jacobian = turn_jacobian_px(view.frame, centres_px)
    weight = precision[used] / precision[used].max()
    robust, squares = np.ones_like(weight), np.einsum("nki,nkj->nij", jacobian, jacobian)
    if np.linalg.cond(np.einsum("n,nij->ij", weight, squares)) > WORST_CONDITION:
        return None
    for _ in range(ROBUST_STEPS):
        both = weight * robust
        normal = np.einsum("n,nij->ij", both, squares)
        rate = np.linalg.solve(normal, np.einsum("n,nki,nk->i", both, jacobian, speed))
        left = speed - jacobian @ rate
        distance = np.linalg.norm(left, axis=1)
        typical = max(float(np.median(distance)) / 1.1774, 1e-9)  # median of a 2-D normal distribution's radius
        robust = np.minimum(1.0, HUBER * typical / np.maximum(distance, 1e-12))
    freedom = max(2 * len(left) - 3, 1)
    variance = float((both[:, None] * left**2).sum() / both.sum() * 2 * len(left) / freedom) / 2
    inverse = np.linalg.inv(normal)
    spread = np.einsum("n,nki,nkj,n->ij", both, jacobian, jacobian, both)
    covariance = 2 * variance * inverse @ spread @ inverse
    middle_s, neighbour_s = view.middles_s()
    return PairTurn(middle_s, neighbour_s, rate, covariance, float(np.sqrt(2 * variance)), len(left))
