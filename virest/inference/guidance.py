"""The map between two frames that gyroscope and forward model predict: it guides tracking.

It is the map of :mod:`virest.image_formation.point_model` for a rotating camera, with each row at its own time.  It is
computed at Chebyshev nodes and interpolated by a polynomial: exact to 0.01 px at any rate of hand motion.

If the frames are blurred differently, the sharper one is blurred by the difference: a uniform blur path d has the
covariance d dᵀ / 12, and the positive part of the difference of both covariances is applied as a Gaussian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Mask, Picture
from virest.camera.profile import CameraProfile
from virest.capture.records import Capture
from virest.image_formation.point_model import IntegratedMotion, integrate_motion, predict
from virest.image_formation.row_clock import RowClock
from virest.inference.doubtful_log import doubtful_stretches
from virest.inference.observed_tracks import frame_times, track_table
from virest.inference.tracking import TrackPair

NODES = 8
"""Nodes along each side.  At 5 rad/s of hand motion, 6 nodes err by up to 0.03 px, 8 by less than 0.002 px."""
ROW_STEPS = 3
"""Row times depend on where a point lands; each step reduces the error about tenfold at 250 px per frame."""
INVERSE_STEPS, INVERSE_PX = 12, 1e-3
"""Most steps of the inverse map, which end when a step is shorter than this."""
LEAST_BLUR_PX, NARROWEST_PX, GAUSSIAN_REACH = 1.0, 0.2, 2.0
"""Smallest σ of blur that is applied; smallest σ of the Gaussian across the path; its extent in σ."""


@dataclass(frozen=True, slots=True)
class GyroGuide:
    """A camera that rotates as the gyroscope measures, at its profile's time offset."""

    known: IntegratedMotion
    stamp_s: Array
    """(frames,) by movie index, camera clock from stamp_0; NaN if the timestamp or the log is unreliable."""
    exposure_s: Array
    """(frames,) as of :func:`virest.inference.observed_tracks.frame_times`."""

    def seen_before(self, first: int, second: int, shape: tuple[int, int], factor: int) -> MapBetween | None:
        """The map from points of the second frame to the first; None without timestamps.

        shape, factor: (height, width) of the pictures to be compared, and their reduction factor.
        """
        if not np.isfinite(self.stamp_s[[first, second]]).all():
            return None
        at_px = nodes_px(shape, factor)
        blur = self._blur(first, second, at_px[:: NODES + 1]) / factor**2
        return replace(
            map_between(lambda points_px: self._moved(second, first, points_px), shape, factor),
            first_lacks=_positive_part(blur[1] - blur[0]),
            second_lacks=_positive_part(blur[0] - blur[1]),
        )

    def _moved(self, frame: int, other: int, points_px: Array) -> Array:
        """Positions in another frame of points (n, 2) of one frame."""
        table = track_table([TrackPair(frame, other, points_px, points_px)], self.stamp_s, self.exposure_s, np.ones(1))
        prediction = None
        for _ in range(ROW_STEPS):
            prediction = predict(self.known, table, None, like=prediction)
            table = replace(table, second_px=prediction.second_px)
        return table.second_px

    def _blur(self, first: int, second: int, at_px: Array) -> Array:
        """Covariances (2, 2, 2) of both frames' blur, px², from the chords of the blur paths at points (n, 2)."""
        pairs = [TrackPair(frame, frame, at_px, at_px) for frame in (first, second)]
        table = track_table(pairs, self.stamp_s, self.exposure_s, np.ones(2))
        half_s = 0.5 * np.asarray(self.known.profile.shutter.true_exposure_s(table.first_exposure_s))
        table = replace(table, first_stamp_s=table.first_stamp_s - half_s, second_stamp_s=table.second_stamp_s + half_s)
        path_px = (predict(self.known, table, None).second_px - table.first_px).reshape(2, -1, 2)
        return np.einsum("fni,fnj->fij", path_px, path_px) / (12 * len(at_px))


@dataclass(frozen=True, slots=True)
class SmoothField:
    """Vectors over a picture, polynomial in the position."""

    coefficients: Array
    """(NODES, NODES, 2) of the vectors in Chebyshev polynomials of y and x, pixels."""
    shape: tuple[int, int]

    def at(self, points_px: Array) -> Array:
        """Vectors (n, 2) at points (n, 2); beyond the picture, where a polynomial runs away, those of its edge."""
        height, width = self.shape
        down = _basis(np.clip(2 * points_px[:, 1] / (height - 1) - 1, -1.0, 1.0))
        across = _basis(np.clip(2 * points_px[:, 0] / (width - 1) - 1, -1.0, 1.0))
        return np.stack([((down @ self.coefficients[..., c]) * across).sum(axis=1) for c in (0, 1)], axis=-1)

    def at_pixels(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Their x and y (h, w) at all pixels."""
        down, across = (_pixel_basis(length) for length in self.shape)
        x, y = (np.asarray(down @ v.astype(np.float32) @ across.T) for v in np.moveaxis(self.coefficients, -1, 0))
        return x, y


@dataclass(frozen=True, slots=True)
class MapBetween(SmoothField):
    """A map from the second picture to the first: the field of its shifts."""

    first_lacks: Array | None = None
    """(2, 2) covariance of the blur that the first picture lacks relative to the second, px²; None: none."""
    second_lacks: Array | None = None

    def first_of(self, points_px: Array) -> Array:
        """Positions in the first picture of points (n, 2) of the second."""
        return points_px + self.at(points_px)

    def second_of(self, points_px: Array) -> Array:
        """Positions in the second picture of points (n, 2) of the first: the inverse, by fixed-point iteration."""
        found = points_px
        for _ in range(INVERSE_STEPS):
            off = points_px - self.first_of(found)
            found = found + off
            if np.abs(off).max(initial=0.0) < INVERSE_PX:
                break
        return found

    def mapped(self, first: Picture) -> Picture:
        """The first picture warped to the second."""
        height, width = self.shape
        grid_x, grid_y = self.at_pixels()
        grid_x += np.arange(width, dtype=np.float32)
        grid_y += np.arange(height, dtype=np.float32)[:, None]
        shown = cv2.remap(first, grid_x, grid_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(shown, np.uint8)

    def warped(self, first: Picture) -> Picture:
        """The first picture warped to the second, and blurred if the second is more blurred."""
        return _blurred(self.mapped(first), self.first_lacks)

    def blurred(self, second: Picture) -> Picture:
        """The second picture, blurred if the first is more blurred."""
        return _blurred(second, self.second_lacks)


def gyro_guide(capture: Capture, profile: CameraProfile) -> GyroGuide:
    """The guide of a capture at a profile's offset, 0 if it has none; the profile must have a focal length.

    Frames whose log looks interpolated or clipped are not guided: the guide would misplace points, and the points that
    survive would agree with it.
    """
    stamp_s, exposure_s, _ = frame_times(capture)
    stamp_s[[frame.skip_reason is not None for frame in capture.frames]] = np.nan
    stamp_s[_in_doubt(capture, profile, stamp_s, exposure_s)] = np.nan
    return GyroGuide(integrate_motion(capture.imu, profile, translation=False), stamp_s, exposure_s)


def _in_doubt(capture: Capture, profile: CameraProfile, stamp_s: Array, exposure_s: Array) -> Mask:
    """Mask (frames,): a doubtful, unbridged stretch of the log lies between a frame's first row and the next's last."""
    doubtful = [(stretch.from_s, stretch.to_s) for stretch in doubtful_stretches(capture.imu)]
    doubtful = [span for span in doubtful if not profile.bridges(*span)]
    clock, period_s = RowClock(profile), float(np.nanmedian(np.diff(stamp_s)))
    begin_s = np.asarray(clock.time_s(stamp_s, exposure_s))
    until_s = np.asarray(clock.end_s(stamp_s + period_s, exposure_s))
    found = np.zeros(len(stamp_s), bool)
    for from_s, to_s in (*doubtful, *profile.unbridged_s):
        found |= (begin_s < to_s) & (until_s > from_s)
    return found


def map_between(first_of: Callable[[Array], Array], shape: tuple[int, int], factor: int) -> MapBetween:
    """Interpolate a map of stored pixels (n, 2) to the first frame, for pictures (height, width) after reduction."""
    at_px = nodes_px(shape, factor)
    field = interpolated((first_of(at_px) - at_px) / factor, shape)
    return MapBetween(field.coefficients, shape)


def interpolated(vectors: Array, shape: tuple[int, int]) -> SmoothField:
    """The field through vectors (NODES², 2) at the nodes of a picture (height, width)."""
    at_nodes = vectors.reshape(NODES, NODES, 2)
    return SmoothField(np.einsum("ki,lj,ijc->klc", _weights(), _weights(), at_nodes), shape)


def nodes_px(shape: tuple[int, int], factor: int) -> Array:
    """Nodes (NODES², 2) over a reduced picture, in stored pixels, row by row."""
    height, width = shape
    x, y = (0.5 * (length - 1) * (1 + _nodes()) for length in (width, height))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2) * factor + (factor - 1) / 2


def _positive_part(covariance: Array) -> Array:
    values, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(axes, -1, -2))


def applied_blur(difference: Array) -> Array:
    """Covariances (..., 2, 2) of the Gaussians by which pictures are blurred that lack these covariances, px²."""
    lacking = np.linalg.eigvalsh(difference)[..., -1] >= LEAST_BLUR_PX**2
    return np.where(lacking[..., None, None], _positive_part(difference), 0.0)


def _blurred(picture: Picture, covariance: Array | None) -> Picture:
    """A picture blurred by a Gaussian of a covariance (2, 2), px²; unchanged if that is below LEAST_BLUR_PX."""
    if covariance is None:
        return picture
    values, axes = np.linalg.eigh(covariance)
    if values[-1] < LEAST_BLUR_PX**2:
        return picture
    reach = np.ceil(GAUSSIAN_REACH * np.sqrt(np.maximum(np.diag(covariance), NARROWEST_PX**2)))
    offset = np.stack(np.meshgrid(*(np.arange(-length, length + 1) for length in reach)), -1) @ axes
    kernel = np.exp(-0.5 * (offset**2 / np.maximum(values, NARROWEST_PX**2)).sum(axis=-1))
    return np.asarray(cv2.filter2D(picture, -1, kernel / kernel.sum()), np.uint8)


def _nodes() -> Array:
    """Chebyshev nodes (NODES,) in [-1, 1], ascending."""
    return -np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)


def _basis(positions: Array) -> Array:
    """Chebyshev polynomials (n, NODES) at positions (n,) in [-1, 1]."""
    return np.asarray(np.polynomial.chebyshev.chebvander(positions, NODES - 1), float)


@lru_cache(maxsize=1)
def _weights() -> Array:
    """(NODES, NODES): coefficients of the polynomial through values at the nodes."""
    return np.asarray(np.linalg.inv(_basis(_nodes())))


@lru_cache(maxsize=4)
def _pixel_basis(length: int) -> NDArray[np.float32]:
    """Chebyshev polynomials (length, NODES) at all pixels of a side."""
    return _basis(np.linspace(-1, 1, length)).astype(np.float32)
