"""How far two neighbouring frames lie apart once the predicted motion is undone, tile by tile.

Never sharp against blurred: the first frame is blurred along the second one's paths and the second along the first
one's, so both are the same blur of one scene, and only a shift is left between them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.image_formation.blur import Image
from virest.image_formation.kernels import KernelField, smooth_field
from virest.image_formation.neighbour import NeighbourView, turn_jacobian_px
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

Array = NDArray[np.float64]
LEAST_TILES = 4
"""A turn has three unknowns and a tile's shift tells two; fewer tiles leave nothing to check it by."""
FAR_PX = 3.0
"""A common shift beyond this is taken out before the fits, in reduced pixels: tiles then show the same again."""
CLIPPED_LIGHT = 0.95
"""Brighter places are not judged: light that was clipped cannot be blurred again."""
LEAST_SEEN = 0.5
"""Part of a tile that must be seen for it to be judged."""
HUBER = 1.5
"""Standard deviations beyond which a tile's weight falls (95 % efficiency at normal errors is 1.345)."""
ROBUST_STEPS = 8
WORST_CONDITION = 1e12
"""Of the normal equations: beyond it nothing of a turn about some axis is seen."""


@dataclass(frozen=True, slots=True)
class PairTurn:
    """The turn rate that the prediction lacks between two frames, by what they show."""

    start_s: float
    """Middle of the exposure of the first frame's middle row, IMU clock."""
    end_s: float
    """The same of the second frame."""
    rate_rad_s: Array
    """(3,) to be added, camera axes: x_t' = exp(rate · t) x_t."""
    covariance: Array
    """(3, 3) of the rate, by the scatter of the tiles."""
    scatter_px_s: float
    """One standard deviation, per axis, of the tiles' speeds about the fitted turn: relief, moving things, noise."""
    tiles: int


@dataclass(frozen=True, slots=True)
class FrameTiles:
    """Tiles of a reduced frame and their kernels, to be compared with those of any of its neighbours."""

    tops_lefts: NDArray[np.intp]
    """(n, 2) in the reduced picture."""
    times: int
    """How many times smaller that is."""
    light: Image
    """The whole of it."""
    means: Array
    """(n,) of the light."""
    spectra: NDArray[np.complex64]
    """(n, WIDE, WIDE / 2 + 1) of the light with what lies around."""
    kernels: NDArray[np.complex64]
    """(n, WIDE, WIDE / 2 + 1) transposes of the kernels."""

    @property
    def centres_px(self) -> Array:
        """(n, 2) in the recorded picture."""
        return full_px(self.tops_lefts, self.times, (TILE - 1) / 2)


def frame_tiles(
    light: Image, profile: CameraProfile, field: Callable[[Array], KernelField], everywhere: bool = False
) -> FrameTiles | None:
    """Tiles of a frame's light, from :func:`reduced_light`; None where a path does not fit into a tile.

    everywhere: tiles all over the picture instead of a few.
    """
    times = reduction(profile.height, profile.width)
    tops_lefts = spread_tiles(light.shape[0], light.shape[1], light.size if everywhere else MOST_TILES)
    kernels = kernel_spectra(field, tops_lefts, times)
    if kernels is None:
        return None
    tiles = cut(light, tops_lefts)
    wide = wide_spectra(light, tops_lefts)
    return FrameTiles(tops_lefts, times, light, tiles.mean(axis=(1, 2)), wide, kernels)


def pair_turn(view: NeighbourView, first: Image, second: Image) -> PairTurn | None:
    """The turn rate missing between two frames; None where they do not show it.

    first, second: from :func:`reduced_light`, of the view's frame and its neighbour.
    """
    tiles = frame_tiles(first, view.frame.profile, smooth_field(view.frame, view.anchor))
    if tiles is None:
        return None
    tops_lefts, times = tiles.tops_lefts, tiles.times
    there = kernel_spectra(view.field(), tops_lefts, times)
    if there is None:
        return None
    a, apart = spectra_of(inner(tiles.spectra * there)), np.zeros(2)
    for _ in range(2):
        b = wide_spectra(_brought(view, second, times, apart), tops_lefts)
        b = spectra_of(inner(b * tiles.kernels))
        common = common_shift(a, b)
        if np.abs(common).max() <= FAR_PX:
            break
        apart = apart + common
    shift, precision = tile_shifts(a, b, common)
    return _turn(view, tops_lefts, times, shift + apart, precision)


@dataclass(frozen=True, slots=True)
class TileAgreement:
    """How a neighbour's tiles agree with a frame's, each blurred as the other was and shifted onto it."""

    tops_lefts: NDArray[np.intp]
    """(n, 2) in the reduced picture."""
    centres_px: Array
    """(n, 2) in the frame."""
    shift_px: Array
    """(n, 2): the neighbour shows at a predicted place what the frame has so far on."""
    precision: Array
    """(n,) of the shifts, relative; 0: the tile shows something else."""
    here: NDArray[np.complex64]
    """(n, WIDE, WIDE / 2 + 1) spectra of the frame's tiles, blurred, in light over its mean."""
    there: Image
    """(n, TILE, TILE) the neighbour's, blurred, in light over its mean."""
    gain: float
    """The neighbour's light over the frame's."""
    light: float
    """The frame's light, median of the tiles."""
    inside: NDArray[np.bool_]
    """Of the reduced picture: where the neighbour has one."""
    clipped: NDArray[np.bool_]
    """Of the reduced picture: where light that was too bright to be measured may reach, in either frame."""
    blur_px: int
    """How far both kernels reach together, reduced pixels."""
    passed: Array
    """(WIDE, WIDE / 2 + 1) mean of both kernels' |K|²: independent noise N makes the error Σ passed N."""
    times: int
    """How many times smaller the compared pictures are."""

    def differences(self, shift_px: Array, numbers: NDArray[np.intp] | slice = slice(None)) -> Image:
        """What the frame's tiles, so far (n, 2) on, have less than the neighbour's: (n, TILE, TILE), light over mean.

        numbers: of those tiles.
        """
        return np.asarray(self.there[numbers] - inner(shifted(self.here[numbers], shift_px / self.times)))

    def shown(self) -> Image:
        """What both show, (n, TILE, TILE), in light over its mean."""
        return self.there - 1

    def side_by_side(self, tiles: Image) -> Image:
        """Tiles (n, TILE, TILE) as a picture (height, width) of the reduced size.

        Nearer to its edges than the blur reaches, where what lies beyond decides, stands what is next to that.
        """
        height, width = self.tops_lefts.max(axis=0) + TILE
        whole = np.zeros((height, width), np.float32)
        for (top, left), tile in zip(self.tops_lefts.tolist(), tiles, strict=True):
            whole[top : top + TILE, left : left + TILE] = tile
        inner = whole[self.blur_px : height - self.blur_px, self.blur_px : width - self.blur_px]
        return cv2.copyMakeBorder(inner, *(self.blur_px,) * 4, cv2.BORDER_REFLECT)

    @property
    def wholly_seen(self) -> NDArray[np.bool_]:
        """(n,) whether the neighbour shows all of a tile."""
        seen = self.inside.astype(np.float32)
        return np.asarray(cut(seen, self.tops_lefts).min(axis=(1, 2)) > 0)

    def over_picture(self, values: Array) -> Image:
        """The largest of tiles (n,) and those beside them, at all places (height, width) of the reduced size."""
        rows = len(np.unique(self.tops_lefts[:, 0]))
        height, width = self.tops_lefts.max(axis=0) + TILE
        largest = cv2.dilate(values.reshape(rows, -1).astype(np.float32), np.ones((3, 3), np.uint8))
        return cv2.resize(largest, (int(width), int(height)), interpolation=cv2.INTER_LINEAR)

    def expected_error(self, frequency: Array, noise: Array, slope: float) -> float:
        """The mean square difference that independent noise makes, in light over its mean.

        noise: (rings,) power in grey levels at frequencies in cycles per recorded pixel.  slope: grey levels per light.
        """
        recorded = radii(WIDE) / self.times
        power = np.interp(recorded, frequency, noise) / (self.times * slope * max(self.light, 1e-6)) ** 2
        return float(np.mean(self.passed * power))


def tile_agreement(
    view: NeighbourView, tiles: FrameTiles, field: Callable[[Array], KernelField], second: Image
) -> TileAgreement | None:
    """Compare a frame's tiles with its neighbour's reduced picture; None where a path does not fit into a tile.

    field: of the neighbour's kernels, from the view.
    """
    kernels = kernel_spectra(field, tiles.tops_lefts, tiles.times)
    if kernels is None:
        return None
    source = view.map_px(times=tiles.times)
    there = read_at(second, source)
    wide, blur_px = tiles.spectra * kernels, min(_reach_px(field, tiles.tops_lefts, tiles.times), TILE // 4)
    here, there_blurred = inner(wide), inner(wide_spectra(there, tiles.tops_lefts) * tiles.kernels)
    a, b = spectra_of(here), spectra_of(there_blurred)
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
        _near_lamps(tiles.light, there, blur_px) > 0,
        blur_px,
        np.asarray(power_of(tiles.kernels).mean(axis=0) + power_of(kernels).mean(axis=0)),
        tiles.times,
    )


def _reach_px(field: Callable[[Array], KernelField], tops_lefts: NDArray[np.intp], times: int) -> int:
    """Half of the longest path of a neighbour's kernels, reduced pixels, rounded up."""
    centres_px = full_px(tops_lefts, times, (TILE - 1) / 2)
    return int(np.ceil(0.5 * field(centres_px).length_px.max() / times))


def judged_change(
    view: NeighbourView, recorded: Image, restored: Image, second: Image
) -> tuple[float, float, float, float] | None:
    """What restoring a frame gains by a neighbour's account, what it changed, and what was and is left.

    With D what restoring changed, M what the recorded frame lacks of the neighbour, both blurred as that one was, and G
    what the neighbour shows: |M|² − |M − D|² and |D|², mean squares in grey levels, and |M|² and |M − D|² over |G|².
    What only shifts a tile is no error of the blur: both pictures are shifted alike.  Tiles that the neighbour
    does not show whole are left out, and places that light may reach that the frame does not show: what was clipped,
    and what lies beyond its edges.  All are reduced; None where a path does not fit into a tile, or where less than
    LEAST_TILES tiles are seen, by half at least.
    """
    times = reduction(view.frame.profile.height, view.frame.profile.width)
    tops_lefts, field = spread_tiles(*recorded.shape), view.field()
    kernels = kernel_spectra(field, tops_lefts, times)
    if kernels is None:
        return None
    source = view.map_px(times=times)
    brought = read_at(second, source)
    unknown = _near_lamps(recorded, brought, _reach_px(field, tops_lefts, times), beyond=1)
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
    """Grey levels that a change by a part of the mean light makes in each tile, (n, 1, 1)."""
    curve = profile.response or ResponseCurve("srgb")
    light = tiles.mean(axis=(1, 2), keepdims=True)
    grey = np.rint(255 * curve.encode(light)).astype(np.uint8)
    return np.asarray(light * curve.slope_table()[grey], np.float32)


def _inside(source: NDArray[np.float32], second: Image) -> NDArray[np.bool_]:
    """Whether a map (h, w, 2) finds something in the neighbour's picture."""
    height, width = second.shape
    return np.asarray(cv2.inRange(source, (-0.5, -0.5), (width - 0.5, height - 0.5)) > 0)


def _near_lamps(light: Image, there: Image, reach_px: int, beyond: int = 0) -> NDArray[np.uint8]:
    """1 where light that was too bright to be measured may reach, in either of two reduced pictures of one scene.

    beyond: 1 if what lies beyond their edges is not to reach either.
    """
    lamps = (cv2.max(light, there) > CLIPPED_LIGHT).astype(np.uint8)
    around = np.ones((4 * reach_px + 1, 4 * reach_px + 1), np.uint8)
    return cv2.dilate(lamps, around, borderType=cv2.BORDER_CONSTANT, borderValue=beyond)


def _brought(view: NeighbourView, second: Image, times: int, apart: Array) -> Image:
    """The neighbour's reduced picture where the prediction puts the frame's, less a common shift (2,), reduced pixels.

    Row by row: over the rows of a tile, 5 ms, a hand's shake bends the map by up to half a pixel.
    """
    return read_at(second, view.map_px(lambda p: p - times * apart, times))


def _turn(
    view: NeighbourView, tops_lefts: NDArray[np.intp], times: int, shift: Array, precision: Array
) -> PairTurn | None:
    """Fit one turn rate to the tiles' shifts, by Huber's weights."""
    used = precision > 0
    if np.count_nonzero(used) < LEAST_TILES:
        return None
    centres_px = full_px(tops_lefts, times, (TILE - 1) / 2)[used]
    apart_s = view.apart_s(centres_px)
    speed = -shift[used] * times / apart_s[:, None]  # b(x) = a(x + d): the neighbour saw x + d where x was predicted
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
        typical = max(float(np.median(distance)) / 1.1774, 1e-9)  # of a plane normal distribution
        robust = np.minimum(1.0, HUBER * typical / np.maximum(distance, 1e-12))
    freedom = max(2 * len(left) - 3, 1)
    variance = float((both[:, None] * left**2).sum() / both.sum() * 2 * len(left) / freedom) / 2
    inverse = np.linalg.inv(normal)
    spread = np.einsum("n,nki,nkj,n->ij", both, jacobian, jacobian, both)
    covariance = 2 * variance * inverse @ spread @ inverse
    middle_s, neighbour_s = view.middles_s()
    return PairTurn(middle_s, neighbour_s, rate, covariance, float(np.sqrt(2 * variance)), len(left))
