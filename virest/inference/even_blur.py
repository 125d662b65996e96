"""Track points in equally blurred frames: each picture of a pair is blurred along the other's blur path.

Two exposures of a feature T are K₁ T and K₂ T.  Where their paths differ, the tracker's match is biased
(:mod:`virest.inference.blur_bias`).  Once a fit explains the motion both paths are known, and K₂ (K₁ T) and K₁ (K₂ T)
are the same picture, whatever the texture.  Paths are taken about their mean, at which the forward model sees a blurred
point, so that no point moves.  Light is linear while it is blurred.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from virest.arrays import Array, Picture
from virest.camera.response import ResponseCurve
from virest.capture.records import Capture
from virest.image_formation.point_model import TrackTable, predict
from virest.inference.blur_bias import SHORTEST_S, late_per_exposure
from virest.inference.guidance import GyroGuide, MapBetween, SmoothField, gyro_guide, interpolated, nodes_px
from virest.inference.observed_tracks import track_table
from virest.inference.track_fit import TrackFit
from virest.inference.tracking import TrackPair, shrink_factor
from virest.motion.scene_motion import InertialMotion

LEAST_BLUR_PX = 0.3
"""Shorter paths are not applied: as bent as they are long, they bias a match by up to 0.0004 px."""
FEWEST_SAMPLES, MOST_SAMPLES = 3, 32
"""Samples of a path: one for each pixel of its length within these limits."""
LEAST_SHARE = 0.5
"""Points that move along the readout are exposed for at most twice their row's exposure; faster ones get lost."""
INSTANTS = np.array([-1.0, -0.5, 0.5, 1.0])
"""Instants of the exposure through which a path is interpolated, beside its middle."""
WHITE_LEVEL = 255.0


@dataclass(frozen=True, slots=True)
class BlurPath:
    """A frame's blur path p(u) = Σ terms[k] u^(k+1), u from -1 to 1 over the exposure, apart from its mean."""

    terms: tuple[SmoothField, ...]
    length_px: float
    """The largest in the picture."""

    def blurred(self, picture: Picture, curve: ResponseCurve) -> Picture:
        """A picture blurred along the path, in linear light."""
        if self.length_px < LEAST_BLUR_PX:
            return picture
        light = cv2.LUT(picture, curve.linear_table())
        height, width = picture.shape
        places = np.arange(width, dtype=np.float32)[None], np.arange(height, dtype=np.float32)[:, None]
        terms = [term.at_pixels() for term in self.terms]
        samples = int(np.clip(np.ceil(self.length_px) + 1, FEWEST_SAMPLES, MOST_SAMPLES))
        instants = ((2 * np.arange(samples) + 1) / samples - 1).astype(np.float32)
        total = np.zeros_like(light)
        powers = instants[:, None] ** np.arange(1, len(terms) + 1, dtype=np.float32)
        for weights in powers - powers.mean(axis=0):
            x, y = places
            for weight, (across, down) in zip(weights, terms, strict=True):
                x, y = x - weight * across, y - weight * down
            total += cv2.remap(light, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        grey = curve.encode(total / np.float32(samples))
        return np.asarray(np.rint(WHITE_LEVEL * np.clip(grey, 0.0, 1.0)), np.uint8)


@dataclass(frozen=True, slots=True)
class EvenMap:
    """The map between two pictures, which blurs each of them along the other's path."""

    between: MapBetween
    first_path: BlurPath
    second_path: BlurPath
    curve: ResponseCurve

    def second_of(self, points_px: Array) -> Array:
        """Positions in the second picture of points (n, 2) of the first."""
        return self.between.second_of(points_px)

    def warped(self, first: Picture) -> Picture:
        """The first picture blurred along the second's path and warped to the second."""
        return self.between.mapped(self.second_path.blurred(first, self.curve))

    def blurred(self, second: Picture) -> Picture:
        """The second picture blurred along the first's path."""
        return self.first_path.blurred(second, self.curve)


@dataclass(frozen=True, slots=True)
class EvenGuide:
    """Predicts positions from the gyroscope, and blur paths from the rotation and the fitted translation."""

    gyro: GyroGuide
    scene: InertialMotion | None
    origin_s: Array
    """(windows,) of the scene, camera clock from stamp_0."""

    def seen_before(self, first: int, second: int, shape: tuple[int, int], factor: int) -> EvenMap | None:
        """The map between two frames' pictures; None without timestamps."""
        between = self.gyro.seen_before(first, second, shape, factor)
        if between is None:
            return None
        at_px = nodes_px(shape, factor)
        paths = [self._path(frame, at_px, shape, factor) for frame in (first, second)]
        return EvenMap(between, paths[0], paths[1], self.gyro.known.profile.curve)

    def _path(self, frame: int, at_px: Array, shape: tuple[int, int], factor: int) -> BlurPath:
        """A frame's blur path, through the points that are at the nodes in the middle of their rows' exposure.

        Points that move along the readout are exposed for longer (:func:`virest.inference.blur_bias.rolling_shift_px`).
        """
        gyro = self.gyro
        table = track_table([TrackPair(frame, frame, at_px, at_px)], gyro.stamp_s, gyro.exposure_s, np.ones(1))
        window = int(np.argmin(np.abs(self.origin_s - gyro.stamp_s[frame])))
        table = replace(table, window=np.full(len(at_px), window), origin_s=self.origin_s)
        half_s = 0.5 * np.asarray(gyro.known.profile.shutter.true_exposure_s(table.first_exposure_s))
        moved = np.stack([
            predict(gyro.known, replace(table, second_stamp_s=table.second_stamp_s + u * half_s), self.scene).second_px
            for u in INSTANTS
        ]) - at_px  # fmt: skip
        late = late_per_exposure(gyro.known.profile, at_px, table.first_stamp_s, np.maximum(half_s, SHORTEST_S))
        crossed = (0.5 * (moved[-1] - moved[0]) * late).sum(axis=-1)
        longer = 1 / np.maximum(1 - crossed, LEAST_SHARE)
        order = np.arange(1, len(INSTANTS) + 1)
        terms = np.einsum("kj,jni->kni", np.linalg.inv(INSTANTS[:, None] ** order), moved / factor)
        terms *= (longer ** order[:, None])[..., None]
        length_px = float((longer * np.linalg.norm(np.diff(moved, axis=0), axis=-1).sum(axis=0)).max()) / factor
        return BlurPath(tuple(interpolated(term, shape) for term in terms), length_px)


def is_blurred(fit: TrackFit, table: TrackTable) -> bool:
    """Whether half of the points have blur paths long enough to be applied."""
    profile, rate_rad_s = fit.profile, np.linalg.norm(fit.integrated.trajectory.rate_rad_s(fit.seconds), axis=-1)
    if profile.intrinsics is None:
        return False
    path_px = profile.intrinsics.fx_px * rate_rad_s * profile.shutter.true_exposure_s(table.second_exposure_s)
    return bool(np.median(path_px) > LEAST_BLUR_PX * shrink_factor(profile.width, profile.height))


def even_guide(capture: Capture, fit: TrackFit, table: TrackTable) -> EvenGuide:
    """The guide of a fit that explains a table of tracked points."""
    guide, scene = gyro_guide(capture, fit.profile), fit.scene
    if not isinstance(scene, InertialMotion):
        return EvenGuide(guide, None, np.zeros(1))
    return EvenGuide(replace(guide, known=fit.integrated), scene, table.origin_s)
