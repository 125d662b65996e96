"""Flat patches of key frames and their brightness in other frames.

A patch's position is predicted by the rotation between its rows' times and corrected by measurement: corners tracked
from the key frame (pyramidal Lucas-Kanade on locally normalised frames, which brightness changes do not move) give a
smooth field of deviations.  Offset, readout, focal length and parallax of the profile may thus be wrong by many pixels;
the remaining error is small against the flat surround of a patch.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Picture
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.records import Frame
from virest.diagnosis.photometry import PhotometricObservations
from virest.diagnosis.photometry_noise import measured_noise
from virest.image_formation.row_clock import ROW_MIDDLE, RowClock
from virest.image_formation.turning_camera import TurningCamera, turning_camera
from virest.image_formation.warp import PIXELS_WITHIN_PX, moved_between, seen_by_rows
from virest.inference.tracking import TrackingSettings, find_corners
from virest.motion.trajectory import Trajectory

PATH_INSTANTS = 13
"""Instants of a path over the exposure, linear between: 20 ms at 50 rad/s² and f = 1000 px err by 0.02 px."""
HALVE_ABOVE_PX = 1000
"""Halve frames with a longer side than this first: patches are means over many pixels anyway."""
PATCH_PX, SURROUND_PX = 11.0, 23.0
"""Side of a patch, and of the square around it that must be flat, in frames 640 px long; both scale with the frame."""
CELLS = 9
"""Cells along the longer side of the frame; each contributes its flattest patch."""
MAX_SPREAD_LEVELS = 8.0
"""Largest standard deviation in the surround, grey levels."""
KEY_EVERY, ACTIVE_KEYS = 24, 2
"""Frames between key frames; number of key frames whose patches are searched for in each frame."""
LEAST_SEEN = 6
"""Drop patches seen less often."""
MIN_CORNERS, MAX_DEVIATION_PX = 24, 1.5
"""Skip frames with fewer corners, or whose corners scatter more about a smooth field (px in frames 640 px long)."""


@dataclass(frozen=True, slots=True)
class _Corners:
    """Corners of a frame, to be found in other frames."""

    frame: Frame
    normal: Picture
    points_px: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class _Key:
    """A key frame with the patches and corners to be found in other frames."""

    frame: Frame
    corners: _Corners
    patches_px: Array
    spread: Array
    first_place: int


def observe_photometry(
    pictures: Iterable[tuple[Frame, Picture | None]],
    trajectory: Trajectory | None,
    profile: CameraProfile,
    intra_frames: Collection[int],
) -> PhotometricObservations:
    """Track flat patches through a stream of (frame, RGB (h, w, 3) or None) in ascending order, in one pass.

    trajectory: the camera's orientation; None: without prediction, corners are searched from their key-frame positions.
    profile: its geometry, and its curve for the noise.  intra_frames: movie indices at which decoding can start
    (Capture.keyframes); they are intra-coded, so patches are best chosen there.  An exact repeat of the previous
    picture is skipped.
    """
    if max(profile.width, profile.height) > HALVE_ABOVE_PX:
        pictures, profile = ((frame, _halved(picture)) for frame, picture in pictures), halved_profile(profile)
    camera = None
    if trajectory is not None and profile.intrinsics is not None:
        camera = turning_camera(trajectory, profile)
    keys: list[_Key] = []
    places = since = 0
    rows: list[Array] = []
    seen: list[Frame] = []
    before: Picture | None = None
    for frame, picture in pictures:
        if picture is None or (before is not None and np.array_equal(picture, before)):
            continue
        before = picture
        seen.append(frame)
        maps = _patch_maps(picture)
        found = [_seen_patches(key, frame, maps, camera) for key in keys]
        rows += found
        fresh = since >= KEY_EVERY and (frame.index in intra_frames or since >= 2 * KEY_EVERY)
        lost = bool(keys) and since >= LEAST_SEEN and len(found[-1]) < 0.5 * len(keys[-1].patches_px)
        if not keys or fresh or lost:
            key = _make_key(frame, maps, places)
            rows.append(_read(key, key.patches_px, frame, maps))
            places += len(key.patches_px)
            keys, since = [*keys, key][-ACTIVE_KEYS:], 0
        since += 1
    table = np.concatenate(rows) if rows else np.zeros((0, 8))
    return _observations(table, seen, profile, intra_frames)


def halved_profile(profile: CameraProfile) -> CameraProfile:
    """The same camera with frames of half the size: pixel x becomes (x − ½) / 2."""
    width, height, lens = profile.width // 2, profile.height // 2, profile.intrinsics
    if lens is not None:
        focal, centre = (lens.fx_px / 2, lens.fy_px / 2), ((lens.cx_px - 0.5) / 2, (lens.cy_px - 0.5) / 2)
        lens = Intrinsics(width, height, *focal, *centre, lens.model, lens.coefficients)
    return replace(profile, width=width, height=height, intrinsics=lens)


def _halved(picture: Picture | None) -> Picture | None:
    if picture is None:
        return None
    even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]
    size = even.shape[1] // 2, even.shape[0] // 2
    return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), np.uint8)


# ── one frame ──────────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _PatchMaps:
    """Smoothed versions of one frame, from which patches are chosen and read."""

    mean: NDArray[np.float32]
    """(h, w, 3) mean over the patch square."""
    spread: NDArray[np.float32]
    """(h, w) standard deviation of grey in the patch square."""
    surround: NDArray[np.float32]
    """(h, w) the same in the surround."""
    normal: Picture
    """Grey image normalised by local mean and contrast, for tracking corners."""


def _scale(width: int, height: int) -> float:
    return max(width, height) / 640.0


def _odd(length: float) -> int:
    return 2 * int(length / 2) + 1


def _patch_maps(picture: Picture) -> _PatchMaps:
    scale = _scale(picture.shape[1], picture.shape[0])
    side, wide = _odd(PATCH_PX * scale), _odd(SURROUND_PX * scale)
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    squared = gray * gray
    near, far = (side, side), (wide, wide)
    mean = cv2.boxFilter(picture, cv2.CV_32F, near, borderType=cv2.BORDER_REFLECT)
    spread = _spread(gray, squared, near)
    return _PatchMaps(np.asarray(mean, np.float32), spread, _spread(gray, squared, far), _normalised(gray))


def _normalised(gray: NDArray[np.float32]) -> Picture:
    """Grey levels at equal local brightness and contrast, for tracking."""
    side = _odd(41 * _scale(gray.shape[1], gray.shape[0]))
    local = cv2.blur(gray, (side, side))
    contrast = np.sqrt(np.maximum(cv2.blur(gray * gray, (side, side)) - local * local, 0)) + 6.0
    return np.clip(128 + 45 * (gray - local) / contrast, 0, 255).astype(np.uint8)


def _spread(gray: NDArray[np.float32], squared: NDArray[np.float32], box: tuple[int, int]) -> NDArray[np.float32]:
    mean = cv2.blur(gray, box)
    return np.asarray(np.sqrt(np.maximum(cv2.blur(squared, box) - mean * mean, 0)), np.float32)


def _corners(frame: Frame, normal: Picture) -> _Corners:
    return _Corners(frame, normal, find_corners(normal, TrackingSettings(grid=(7, 7), points_per_cell=3)))


def _make_key(frame: Frame, maps: _PatchMaps, first_place: int) -> _Key:
    patches = _flat_patches(maps)
    column, row = patches[:, 0].astype(int), patches[:, 1].astype(int)
    spread = maps.spread[row, column].astype(float)
    return _Key(frame, _corners(frame, maps.normal), patches, spread, first_place)


def _flat_patches(maps: _PatchMaps) -> Array:
    """Centres (n, 2) of the flattest patch per cell, relative to its brightness, and of the darkest flat patches."""
    height, width = maps.normal.shape
    brightness = maps.mean.mean(axis=-1)
    edge = int(SURROUND_PX * _scale(width, height) / 2) + 1
    allowed = (maps.surround < MAX_SPREAD_LEVELS) & (maps.mean.max(axis=-1) < 244)
    allowed[:edge], allowed[-edge:], allowed[:, :edge], allowed[:, -edge:] = False, False, False, False
    relative = np.where(allowed, maps.surround / (brightness + 15.0), np.inf)
    dark = np.where(allowed & (maps.surround < 0.5 * MAX_SPREAD_LEVELS), brightness, np.inf)
    cell = max(width, height) / CELLS
    found = {*_best_of_cells(relative, cell), *_best_of_cells(dark, 2 * cell)}
    return np.array(sorted(found), float).reshape(-1, 2)


def _best_of_cells(score: NDArray[np.float32], cell: float) -> list[tuple[int, int]]:
    """(x, y) of the smallest finite score in each cell."""
    height, width = score.shape
    rows, columns = (np.linspace(0, n, max(round(n / cell), 1) + 1).astype(int) for n in (height, width))
    best = []
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            y, x = np.unravel_index(np.argmin(score[top:bottom, left:right]), (bottom - top, right - left))
            if np.isfinite(score[top + y, left + x]):
                best.append((int(left + x), int(top + y)))
    return best


# ── from frame to frame ────────────────────────────────────────────────────────────────────────────────────────────


def _seen_patches(key: _Key, frame: Frame, maps: _PatchMaps, camera: TurningCamera | None) -> Array:
    """Read the patches of a key frame in another frame; empty if the frames cannot be registered."""
    field = _deviation(key.corners, frame, maps.normal, camera)
    if field is None:
        return np.zeros((0, 8))
    patches = predicted_points(key.patches_px, key.frame, frame, camera)
    height, width = maps.normal.shape
    return _read(key, patches + _smooth_basis(patches, width, height) @ field, frame, maps)


def predicted_points(points_px: Array, key: Frame, frame: Frame, camera: TurningCamera | None) -> Array:
    """Positions in another frame of points (n, 2), by rotation alone, each at the mid-exposure of its own row.

    camera: None: the positions stay the same.
    """
    if camera is None:
        return points_px
    seen_s = camera.frame(key).row_time_s(points_px, ROW_MIDDLE)
    return seen_by_rows(camera.frame(frame), points_px, seen_s, ROW_MIDDLE, within_px=PIXELS_WITHIN_PX)


@dataclass(frozen=True, slots=True)
class GrayFrame:
    """A frame and its grey image, to be registered with another."""

    frame: Frame
    gray: Picture


def registered_points(
    at: GrayFrame, other: GrayFrame, camera: TurningCamera, points_px: Array
) -> NDArray[np.float32] | None:
    """Positions (..., 2) in another frame of points (..., 2), corrected by tracked corners; None if those fail."""
    here, there = (_normalised(one.gray.astype(np.float32)) for one in (at, other))
    field = _deviation(_corners(at.frame, here), other.frame, there, camera)
    if field is None:
        return None
    height, width = at.gray.shape
    seen = predicted_points(points_px.reshape(-1, 2), at.frame, other.frame, camera)
    seen = seen + _smooth_basis(seen, width, height) @ field
    return seen.reshape(points_px.shape).astype(np.float32)


def path_over_exposure(points_px: Array, frame: Frame, camera: TurningCamera) -> Array:
    """Displacements (n, PATH_INSTANTS, 2), over the exposure of their own rows, of points given at mid-exposure."""
    at = camera.frame(frame)
    points_px = points_px[:, None]
    time_s = at.row_time_s(points_px, np.linspace(0.0, 1.0, PATH_INSTANTS))
    return moved_between(at, points_px, at.row_time_s(points_px, ROW_MIDDLE), time_s) - points_px


def _deviation(corners: _Corners, frame: Frame, normal: Picture, camera: TurningCamera | None) -> Array | None:
    """Smooth field (6, 2) of tracked − predicted corners in a frame: quadratic in position; None if too few agree."""
    height, width = normal.shape
    guess = predicted_points(corners.points_px.astype(float), corners.frame, frame, camera)
    inside = ((guess > 0) & (guess < (width - 1, height - 1))).all(axis=-1)
    if inside.sum() < MIN_CORNERS:
        return None
    start = np.ascontiguousarray(guess[inside, None], np.float32)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        corners.normal, normal, np.ascontiguousarray(corners.points_px[inside, None]), start.copy(),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    found = status.ravel() == 1
    guess, deviation = guess[inside][found], (moved - start)[found, 0].astype(float)
    if len(guess) < MIN_CORNERS:
        return None
    scale = _scale(width, height)
    basis = _smooth_basis(guess, width, height)
    field = np.zeros((6, 2))
    field[0] = np.median(deviation, axis=0)
    for terms in (1, 3, 3, 6, 6, 6):
        off = np.linalg.norm(deviation - basis @ field, axis=-1)
        weight = np.sqrt(1 / (1 + (off / max(1.5 * np.median(off), 0.3 * scale)) ** 2))[:, None]
        field[:terms] = np.linalg.lstsq(weight * basis[:, :terms], weight * deviation, rcond=None)[0]
    off = np.linalg.norm(deviation - basis @ field, axis=-1)
    near = off < 2 * MAX_DEVIATION_PX * scale
    if near.sum() < MIN_CORNERS or np.median(off) > MAX_DEVIATION_PX * scale:
        return None
    return field


def _smooth_basis(points_px: Array, width: int, height: int) -> Array:
    x = (points_px[:, 0] - width / 2) / max(width, height)
    y = (points_px[:, 1] - height / 2) / max(width, height)
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _read(key: _Key, points_px: Array, frame: Frame, maps: _PatchMaps) -> Array:
    """Table (n, 8): place, frame, x, y, three means and the spread of each patch well inside the frame.

    A patch with much more contrast than in its key frame is dropped: it shows something else.
    """
    height, width = maps.normal.shape
    edge = SURROUND_PX * _scale(width, height) / 2
    inside = ((points_px > edge) & (points_px < (width - 1 - edge, height - 1 - edge))).all(axis=-1)
    if not inside.any():
        return np.zeros((0, 8))
    points = points_px[inside]
    at = points.astype(np.float32)[None]
    mean = cv2.remap(maps.mean, at, None, cv2.INTER_LINEAR)[0]
    spread = cv2.remap(maps.spread, at, None, cv2.INTER_LINEAR)[0]
    place = key.first_place + np.flatnonzero(inside)
    good = spread < 1.5 * key.spread[inside] + 2.0
    table = np.column_stack([place, np.full(len(place), frame.index), points, mean, spread])
    return np.asarray(table[good], float)


# ── the record ─────────────────────────────────────────────────────────────────────────────────────────────────────


def _observations(
    table: Array, frames: list[Frame], profile: CameraProfile, intra_frames: Collection[int]
) -> PhotometricObservations:
    """One entry per channel; clipped entries and patches seen too rarely are dropped."""
    place, index = table[:, 0].astype(np.intp), table[:, 1].astype(np.intp)
    channel = np.tile(np.arange(3), len(table))
    patch = 3 * np.repeat(place, 3) + channel
    grey, spread = table[:, 4:7].ravel(), np.repeat(table[:, 7], 3)
    # noise clipped at 0 raises the mean of black patches; clipped at 255 it lowers that of white ones
    keep = (grey - 2.5 * spread > 1.0) & (grey > 6.0) & (grey + 2.5 * spread < 250.0)
    often = np.bincount(patch[keep], minlength=int(patch.max(initial=0)) + 1) >= LEAST_SEEN
    keep &= often[patch]
    patch = np.unique(patch[keep] // 3, return_inverse=True)[1] * 3 + channel[keep]
    row = np.repeat(np.arange(len(table)), 3)[keep]
    order = np.lexsort((index[row], patch))
    row = row[order]
    product, product_std, known = _logged_products(frames)
    slot = {frame.index: i for i, frame in enumerate(frames)}
    which = np.array([slot[int(i)] for i in index], np.intp)[row] if len(table) else np.zeros(0, np.intp)
    points = table[row, 2:4]
    width, height = profile.width, profile.height
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    observations = PhotometricObservations(
        patch=patch[order],
        frame=index[row],
        stamp_s=np.array([f.time_s for f in frames])[which],
        row_fraction=RowClock(profile).readout_fraction(points),
        x_px=points[:, 0],
        y_px=points[:, 1],
        radius=np.linalg.norm(points - centre, axis=-1) / (0.5 * np.hypot(width, height)),
        grey=grey[keep][order],
        noise=np.ones(len(row)),
        exposure_s=np.array([f.exposure_s or 0.0 for f in frames])[which],
        log_product=product[which],
        log_product_std=product_std[which],
        intra=np.isin(index[row], list(intra_frames)),
        product_known=known,
        width=width,
        height=height,
    )
    return measured_noise(observations, profile.curve)


def _logged_products(frames: list[Frame]) -> tuple[Array, Array, bool]:
    """(log exposure × ISO relative to its median, its σ from ISO rounding, whether all frames have logged both)."""
    known = bool(frames) and all(f.exposure_s and f.iso for f in frames)
    if not known:
        return np.zeros(len(frames)), np.zeros(len(frames)), False
    iso = np.array([f.iso for f in frames], float)
    product = np.log(iso * np.array([f.exposure_s for f in frames], float))
    rounded = np.sqrt(1 / 12) / iso * (iso == np.rint(iso))
    return product - np.median(product), rounded, True
