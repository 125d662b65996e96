"""Restore one frame: recorded picture in, restored picture and all assumed parameters out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.capture.folder import Frame
from virest.image_formation.kernel_spread import KernelSpread, kernel_spread
from virest.image_formation.kernels import KernelField, smooth_field
from virest.image_formation.light import FrameLight, equivalent_length_px, frame_light, most_defocus_px
from virest.image_formation.row_motion import RowMotion
from virest.image_formation.warp import corner_points, straightened_points
from virest.motion.trajectory import Trajectory
from virest.restoration.blurred import BlurredPicture, blurred_picture, with_vignetting
from virest.restoration.clipped_light import keep_unmeasured, measured_share
from virest.restoration.coded_blur import Predicted, coded_blur
from virest.restoration.deblur import deblur
from virest.restoration.encoding import encode_picture
from virest.restoration.harmful_steps import OTHER_BLUR, OTHER_ROWS, deblurring_harms, straightening_harms
from virest.restoration.neighbours.confirmation import ConfirmedGain
from virest.restoration.neighbours.joint import ComparedNeighbours, JoinedNeighbours, joined_neighbours, static_part
from virest.restoration.neighbours.own_motion import own_motion
from virest.restoration.neighbours.refinement import RefinedMotion, unrefined_path_std_px
from virest.restoration.parameters import (
    Deblurring,
    DegradationParameters,
    JoinedNeighbour,
    Json,
    degradation_parameters,
    unknown_parameters,
)
from virest.restoration.row_chunks import RowRenderer, bands
from virest.restoration.settings import FEW_ITERATIONS, RestorationSettings
from virest.restoration.shutter import perspective_map, rounded, rowwise_map, valid_rectangle, warp
from virest.restoration.statistics.of_picture import measured_centres, picture_statistics
from virest.restoration.statistics.records import PictureStatistics, coded_variance
from virest.restoration.statistics.tile_power import FEW_TILES, MANY_TILES
from virest.restoration.taken_part import (
    LEAST_CONFIRMED_DB,
    blurred_part,
    gaining_share,
    no_gain_reason,
    share_map,
    trusted_share,
)
from virest.restoration.undistortion import undistortion_map

MIN_WARP_PX = 0.1
"""Skip straightening that moves no point further than this: gyroscope noise at rest has the same effect."""
WHOLE_PICTURE = ("hyper-laplacian-global", "richardson-lucy")
"""Methods whose kernels vary smoothly between tiles."""
NOTHING_LEFT = "straightening would leave no recorded pixel (check lens, axes and clock): not straightened"
MIN_RELIGHT = 0.002
"""Skip illumination corrections below this relative change: they are less than half a grey level everywhere."""

NeighbourFinder = Callable[[PictureStatistics, Callable[[Array], KernelField]], ComparedNeighbours]
"""Compare a frame's neighbours with it, and select those to restore it with, from its luma's statistics and its
kernels."""


@dataclass(frozen=True, slots=True)
class RestoredFrame:
    """The result for one frame."""

    frame: Frame
    status: str
    """``restored``, ``copied``, ``skipped`` or ``failed``."""
    picture: NDArray[np.uint8] | None
    """(height, width, 3) RGB; None where there is no output."""
    warnings: tuple[str, ...] = ()
    valid_px: tuple[int, int, int, int] = (0, 0, 0, 0)
    """x0, y0, x1, y1, end exclusive: the rectangle of recorded data."""
    exposure_s: float | None = None
    """True exposure: logged × scale."""
    degradation: DegradationParameters | None = None
    """The frame's degradation and how it was corrected; None: not analysed."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time spent on each of estimate, deblur and shutter."""
    source_px: NDArray[np.float32] | None = None
    """(height, width, 2) position in the recorded picture that each pixel came from; None: not moved."""
    undistorted: bool = False
    """Whether lens distortion was corrected, so that the picture is a pinhole camera's."""

    @property
    def parameters(self) -> Json:
        """``degradation`` with the keys of ``parameters.jsonl``; empty if it is None."""
        return {} if self.degradation is None else self.degradation.as_json()


def restore_frame(
    frame: Frame,
    picture: NDArray[np.uint8],
    motion: RowMotion,
    trajectory: Trajectory,
    settings: RestorationSettings,
    seen: RowMotion | None = None,
    refined: RefinedMotion | None = None,
    confirmed: ConfirmedGain | None = None,
    neighbours: NeighbourFinder | None = None,
    unmasked: NDArray[np.uint8] | None = None,
    coding_step: float | None = None,
    undetected_rad_s: float | None = None,
    predicted: Sequence[Predicted] = (),
) -> RestoredFrame:
    """Deblur in linear light, then straighten with one warp; steps that would not help are skipped, with a warning.

    picture: (height, width, 3) RGB as stored.  The restored picture shows the scene at ``motion.reference_s``.
    seen: the observed motion, where the frames contradict the profile.  refined: the motion refined from neighbouring
    frames; replaces ``motion``.  confirmed: how much of the predicted gain neighbours confirm.  neighbours: selects the
    frames for joint restoration and registers them.  unmasked: the picture with the phone's sharpening undone, to be
    deblurred; None: ``picture`` itself.  coding_step: the coder's quantiser step, grey levels; None: unknown.
    undetected_rad_s: standard deviation of the rotation rate of a motion that neighbours did not refine; None: unknown.
    predicted: the frames that the coder predicted this one from, one from the next, the nearest first.
    """
    clock, unrefined = _Clock(), motion
    if refined is not None:
        motion = refined.motion
        if seen is not None and refined.further is not None:
            seen = _with_observed_exposure(motion, seen)
    height, width = picture.shape[:2]
    curve = motion.profile.curve
    found = degradation_parameters(motion, trajectory)
    longest_px = float(equivalent_length_px(found.blur.longest_px, most_defocus_px(motion.profile)))
    method, why_not = deblur_method(motion, settings, longest_px)
    if seen is not None and method != "none" and deblurring_harms(motion, seen):
        method, why_not = "none", (OTHER_BLUR,)
    straighten = settings.shutter != "none"
    anchor = 0.5 if straighten or settings.reference == "frame-middle" or method == "none" else 0.0
    light = frame_light(motion, anchor, straighten and motion.profile.readout_known)
    clock.lap("estimate")
    restored: NDArray[Any] = picture
    deblurring: Deblurring | None = None
    if method != "none":
        covariance_px2 = np.zeros((2, 2)) if refined is None else refined.path_covariance_px2()
        position_std_px = refined.position_std_px() if refined is not None and straighten else 0.0
        stds_px = [] if refined is None else [float(np.sqrt(np.trace(covariance_px2) / 2))]
        if undetected_rad_s is not None:
            stds_px.append(unrefined_path_std_px(motion, undetected_rad_s))
        path_std_px = float(np.linalg.norm(stds_px)) if stds_px else None
        blur = _KnownBlur(
            motion, anchor, longest_px, covariance_px2, path_std_px, position_std_px, light, coding_step, unrefined,
            predicted,
        )  # fmt: skip
        restored, deblurring, why_not = _deblurred(picture, blur, settings, confirmed, neighbours, unmasked)
    if restored is picture and light is not None and light.most_change > MIN_RELIGHT:
        restored = _without_flicker(picture, curve, light)
    clock.lap("deblur")
    source = _source_map(motion, settings, anchor, deblurring is not None) if straighten else None
    if seen is not None and source is not None and straightening_harms(motion, seen, anchor):
        source, why_not = None, (*why_not, OTHER_ROWS)
    shutter = replace(found.shutter, method=settings.shutter if source is not None else "none")
    status = "copied" if restored is picture and source is None else "restored"
    if source is None:
        source = _lens_map(motion.profile, settings.undistort)
    valid_px = (0, 0, width, height)
    if source is not None:
        valid_px = valid_rectangle(source)
        if not any(valid_px):
            return copied_frame(frame, picture, motion.profile, NOTHING_LEFT, found, undistort=settings.undistort)
        restored = warp(restored, source)
    elif restored.dtype != np.uint8:
        restored = rounded(restored)
    clock.lap("shutter")
    warnings = (*_model_warnings(motion), *why_not)
    undistorted = settings.undistort and motion.optics.lens.is_distorted
    return RestoredFrame(
        frame, status, restored, warnings, valid_px, motion.exposure_s or None,
        replace(found, shutter=shutter, deblur=deblurring), clock.seconds, source, undistorted,
    )  # fmt: skip


def _with_observed_exposure(motion: RowMotion, seen: RowMotion) -> RowMotion:
    """The neighbour-refined motion over the observed exposure time, about the same mid-exposure.

    Neighbours show how the picture moved, whatever the clocks say, but not how long the exposure was.
    """
    start_s = motion.start_s + 0.5 * (motion.exposure_s - seen.exposure_s)
    return replace(motion, start_s=start_s, exposure_s=seen.exposure_s)


def _model_warnings(motion: RowMotion) -> tuple[str, ...]:
    """Warnings about effects that the motion model does not include."""
    depth_m = motion.profile.depth_m
    if depth_m is not None and np.isinf(depth_m):
        return ()
    if motion.translation is None:
        return ("camera translation unknown: rotation only",)
    if not np.any(motion.translation.inverse_depth_plane):
        return ("depth unknown: rotation only",)
    if not motion.translation.in_metres:
        return ("velocity over depth known, but not in metres",)
    return ()


def copied_frame(
    frame: Frame,
    picture: NDArray[np.uint8],
    profile: CameraProfile,
    reason: str,
    found: DegradationParameters | None = None,
    *,
    undistort: bool = False,
) -> RestoredFrame:
    """The decoded pixels unchanged, and the reason.  found: the frame's degradation; None: unknown.

    undistort: correct the lens distortion all the same, to match the run's other frames.  The lens is then the
    profile's, at stamp_0.
    """
    height, width = picture.shape[:2]
    clock, valid_px, source = _Clock(), (0, 0, width, height), _lens_map(profile, undistort)
    if source is not None:
        picture, valid_px = warp(picture, source), valid_rectangle(source)
        clock.lap("shutter")
    exposure_s = profile.shutter.true_exposure_s(frame.exposure_s) if frame.exposure_s else None
    found = found or unknown_parameters(profile)
    return RestoredFrame(
        frame, "copied", picture, (reason,), valid_px, exposure_s, found, clock.seconds, source, source is not None
    )


def _lens_map(profile: CameraProfile, undistort: bool) -> NDArray[np.float32] | None:
    """Undistortion map for frames that are not warped otherwise; None: not requested, or no intrinsics."""
    return undistortion_map(profile.intrinsics) if undistort and profile.intrinsics is not None else None


def _source_map(
    motion: RowMotion, settings: RestorationSettings, anchor: float, deblurred: bool
) -> NDArray[np.float32] | None:
    """Where each output pixel was recorded.

    None for a frame that is not deblurred and that either moves less than MIN_WARP_PX or has no known readout time.
    """
    corners = corner_points(motion.profile.width, motion.profile.height)
    moved_px = np.abs(straightened_points(motion, corners, anchor) - corners).max()
    if not deblurred and (moved_px < MIN_WARP_PX or not motion.profile.readout_known):
        return None
    mapped = perspective_map if settings.shutter == "perspective" else rowwise_map
    return mapped(motion, anchor, undistort=settings.undistort and motion.optics.lens.is_distorted)


def deblur_method(motion: RowMotion, settings: RestorationSettings, longest_px: float) -> tuple[str, tuple[str, ...]]:
    """The deblurring method for a blur of this length, and why it is ``none``."""
    if settings.deblur == "none":
        return "none", ("deblurring is switched off",)
    if motion.exposure_s <= 0:
        return "none", ("exposure time unknown: not deblurred",)
    if longest_px < settings.min_blur_px:
        return "none", (f"blur of {longest_px:.2f} px is below {settings.min_blur_px:g} px: not deblurred",)
    if longest_px >= min(motion.profile.width, motion.profile.height):  # most of its light is from outside
        return "none", (f"blur of {longest_px:.0f} px is longer than the picture: not deblurred",)
    return settings.deblur, ()


@dataclass(frozen=True, slots=True)
class _KnownBlur:
    """What is known about a frame's blur before its picture is analysed."""

    motion: RowMotion
    anchor: float
    """Instant that the restored picture shows, as a fraction of each row's exposure."""
    longest_px: float
    """Length of the longest blur path, defocus included."""
    covariance_px2: Array
    """(2, 2) covariance of the blur path that the restoration counts as noise."""
    path_std_px: float | None
    """Standard deviation of the blur path, per axis; None: unknown."""
    position_std_px: float
    """Standard deviation of the rows' positions after straightening, per axis."""
    light: FrameLight | None
    """Flicker and vignetting; None: neither."""
    coding_step: float | None
    """The coder's quantiser step, grey levels; None: unknown."""
    unrefined: RowMotion
    """The motion before neighbours refined it, as that of ``predicted``."""
    predicted: Sequence[Predicted]
    """The frames that the coder predicted this one from."""


@dataclass(frozen=True, slots=True)
class _BlurStatistics:
    """Noise and detail measured on a blurred picture, and the expected gain of deblurring it."""

    field: Callable[[Array], KernelField]
    spread: KernelSpread | None
    luma: PictureStatistics
    chroma: PictureStatistics
    luma_model: PictureStatistics
    """``luma`` with the kernels' uncertainty counted as noise."""
    expected_db: float
    """Expected gain according to the model, scaled by what the neighbours confirm."""
    share: float
    """Weight of the deblurred picture in the output."""


def _deblurred(
    picture: NDArray[np.uint8],
    blur: _KnownBlur,
    settings: RestorationSettings,
    confirmed: ConfirmedGain | None,
    neighbours: NeighbourFinder | None = None,
    unmasked: NDArray[np.uint8] | None = None,
) -> tuple[NDArray[Any], Deblurring | None, tuple[str, ...]]:
    """The deblurred picture, not rounded, and how it was made; or the picture as recorded, and why."""
    as_shown, picture = picture, picture if unmasked is None else unmasked
    curve, light = blur.motion.profile.curve, blur.light
    measured = _blur_statistics(picture, blur, settings, confirmed)
    why_not = no_gain_reason(measured.luma_model, measured.expected_db)
    if why_not:
        return as_shown, None, (why_not,)
    blurred = blurred_picture(picture, curve, (measured.luma, measured.chroma), measured.field, blur.longest_px)
    together = neighbours is not None and blur.anchor == 0.5
    compared = ComparedNeighbours()
    if together and neighbours is not None:
        compared = neighbours(measured.luma, measured.field)
    pictures = compared.pictures
    if (own := own_motion(compared.registrations)) is not None:
        pictures = own.of_neighbours(pictures)
        blurred = replace(blurred, field=own.kernels(blurred.field, blur.motion.exposure_s))
    joined = joined_neighbours(pictures, measured.luma_model)
    longest_px = max((blur.longest_px, *(one.longest_px for one in joined.registrations)))
    if own is not None:
        longest_px = max(longest_px, float(blurred.field(own.tiles_px).length_px.max()))
    blurred = replace(blurred, spread=measured.spread, neighbours=joined.pictures, longest_px=longest_px)
    recorded = picture
    if light is not None:
        blurred = _without_flicker_and_vignetting(blurred, light)
        recorded = encode_picture([with_vignetting(plane, blurred) for plane in blurred.light], curve)
    if joined.pictures:
        settings = replace(settings, iterations=min(settings.iterations, settings.joined_iterations))
    sharp = keep_unmeasured(deblur(blurred, settings), recorded, blurred)
    coded = coded_blur(picture, blur.unrefined, blur.predicted, measured.luma_model, joined.passed)
    if blur.anchor == 0.5:
        measured = replace(measured, share=measured.share * coded.share)
    touched, part = _blend_weights(blur, settings, blurred, measured, compared, confirmed)
    restored = _blended(sharp, recorded, part)
    changed = 0.0 if confirmed is None else _mean_square(restored, recorded)
    details = _details(blur, settings, measured, joined, confirmed, coded.lost, changed)
    if details.expected_gain_db is not None and details.expected_gain_std_db is not None:
        why_not = no_gain_reason(measured.luma_model, details.expected_gain_db, LEAST_CONFIRMED_DB)
        if why_not:
            return as_shown, None, (why_not,)
        share = gaining_share(details.expected_gain_db, details.expected_gain_std_db, bool(joined.pictures))
        if blur.anchor == 0.5 and share < details.share:
            less = share_map(blurred, share / details.share)
            restored, details = _blended(restored.__getitem__, recorded, less), replace(details, share=share)
    if unmasked is not None:  # unblurred regions keep the phone's sharpening
        restored = _blended(restored.__getitem__, as_shown, touched)
    return restored, details, ()


def _blur_statistics(
    picture: NDArray[np.uint8], blur: _KnownBlur, settings: RestorationSettings, confirmed: ConfirmedGain | None
) -> _BlurStatistics:
    """Statistics and kernels of a picture (height, width, 3)."""
    height, width = picture.shape[:2]
    curve = blur.motion.profile.curve
    centres_px = measured_centres(picture, blur.motion, blur.coding_step)
    few = settings.iterations <= FEW_ITERATIONS
    # with few iterations and an uncertain path, the path's error counts as noise: the coder's is no upper bound
    bounds_luma = not (few and blur.covariance_px2.any())
    field, most_tiles = smooth_field(blur.motion, blur.anchor), FEW_TILES if few else MANY_TILES
    luma, chroma = picture_statistics(picture, field(centres_px), curve, most_tiles, blur.coding_step, bounds_luma)
    if few and blur.coding_step is not None:  # few iterations amplify noise that the fit missed, and have no neighbours
        luma = luma.with_coder_noise(blur.coding_step)
    spread = kernel_spread(field, width, height, blur.covariance_px2)
    luma_model = luma.with_kernel_variance(spread)
    share = 1.0 if blur.anchor != 0.5 else trusted_share(luma_model)
    expected_db = luma_model.expected_gain_db
    if confirmed is not None:  # neighbours confirm or refute the gain, so the cautious bound for gratings is not needed
        expected_db = confirmed.expected_db(replace(luma_model, places=None).expected_gain_db)
    return _BlurStatistics(field, spread, luma, chroma, luma_model, expected_db, share)


def _blend_weights(
    blur: _KnownBlur,
    settings: RestorationSettings,
    blurred: BlurredPicture,
    measured: _BlurStatistics,
    compared: ComparedNeighbours,
    confirmed: ConfirmedGain | None,
) -> tuple[NDArray[np.float32] | np.float32, NDArray[np.float32] | np.float32]:
    """Masks of the blurred regions and of the deblurred picture's weight, each 0 to 1.

    (height, width), or one number for the whole picture.
    """
    if blur.anchor != 0.5:
        return np.float32(1.0), np.float32(1.0)
    by_tile = settings.deblur not in WHOLE_PICTURE or measured.luma.unevenness > 0
    touched = blurred_part(blur.motion, settings.min_blur_px, settings.tile_px if by_tile else 0)
    part, seen = touched * share_map(blurred, measured.share), measured_share(blurred)
    part = part if seen is None else part * seen
    still = static_part(compared.registrations)
    if still is not None and still.min() < 1:
        height, width = blurred.light[0].shape
        part = part * cv2.resize(still, (width, height), interpolation=cv2.INTER_LINEAR)
    if confirmed is not None:
        part = part * np.float32(confirmed.taken)
    return touched, part


def _details(
    blur: _KnownBlur,
    settings: RestorationSettings,
    measured: _BlurStatistics,
    joined: JoinedNeighbours,
    confirmed: ConfirmedGain | None,
    lost: float,
    changed: float,
) -> Deblurring:
    """How a frame was deblurred.

    lost: squared error by the stored frame's blur, over that of its path.  changed: mean square of the change by
    deblurring, grey levels squared.
    """
    model = measured.luma_model
    ideal, alone = model.ideal_error(joined.passed), model.ideal_error(np.zeros_like(joined.passed))
    misplaced = model.misplaced(blur.position_std_px, joined.passed)
    gain_db = None
    if confirmed is not None:
        colour = measured.chroma.colour_error()
        coded = measured.luma.noise_levels**2 if blur.coding_step is None else coded_variance(blur.coding_step)
        power = model.sharp_power
        gain_db = confirmed.of_change_db(changed, lost * model.blur_error, ideal, power, coded, misplaced, colour)
    return Deblurring(
        method=settings.deblur,
        preset=settings.preset,
        iterations=settings.iterations,
        strength=settings.strength,
        tile_px=settings.tile_px,
        noise_grey_levels=measured.luma.noise_levels,
        expected_gain_db=gain_db[0] if gain_db else None,
        expected_gain_std_db=gain_db[1] if gain_db else None,
        promised_gain_db=model.joint_gain_db(joined.passed) if joined.pictures else model.expected_gain_db,
        path_std_px=blur.path_std_px,
        neighbours=tuple(JoinedNeighbour(one.number, one.weight) for one in joined.registrations),
        neighbours_gain_db=10 * float(np.log10(alone / ideal)) if joined.pictures else 0.0,
        share=measured.share,
        defocus_sigma_px=most_defocus_px(blur.motion.profile),
    )


def _without_flicker_and_vignetting(blurred: BlurredPicture, light: FrameLight) -> BlurredPicture:
    """The picture without flicker and vignetting: they act after the blur, so they are undone before deblurring."""
    planes = [light.evened(plane, mask) for plane, mask in zip(blurred.light, blurred.clipped, strict=True)]

    def slopes(channel: int, side_px: int, size: tuple[int, int]) -> NDArray[np.float32]:
        lit = cv2.resize(light.recorded, size, interpolation=cv2.INTER_LINEAR)
        return blurred.slopes(channel, side_px, size) * lit

    return replace(blurred, light=planes, slopes=slopes, kept=light.kept)


def _without_flicker(picture: NDArray[np.uint8], curve: ResponseCurve, light: FrameLight) -> NDArray[np.uint8]:
    """A picture that is not deblurred, without flicker, and with the vignetting of the positions it is warped to."""
    clipped = cv2.LUT(picture, curve.clipped_table().astype(np.uint8))
    planes = zip(cv2.split(cv2.LUT(picture, curve.linear_table())), cv2.split(clipped), strict=True)
    return encode_picture([light.evened(plane, mask) * light.kept for plane, mask in planes], curve)


def _blended(
    sharp: RowRenderer, recorded: NDArray[np.uint8], part: NDArray[np.float32] | np.float32
) -> NDArray[np.float32]:
    """Blend of the sharp and the recorded picture, (height, width, 3): grey levels 0 to 255, not rounded.

    part: weight of the sharp picture, (height, width) or one number for the whole picture.
    """
    mixed = np.empty(recorded.shape, np.float32)
    for rows in bands(len(recorded)):
        picture = sharp(rows)
        if isinstance(part, np.ndarray):
            left = cv2.subtract(picture, recorded[rows], dtype=cv2.CV_32F)
            picture = cv2.add(cv2.multiply(left, cv2.merge([part[rows]] * 3)), recorded[rows], dtype=cv2.CV_32F)
        elif part < 1.0:
            picture = cv2.addWeighted(picture, float(part), recorded[rows], 1 - float(part), 0.0, dtype=cv2.CV_32F)
        mixed[rows] = picture
    return mixed


def _mean_square(restored: NDArray[np.float32], recorded: NDArray[np.uint8]) -> float:
    """Mean square of the change by restoring, (height, width, 3) each, over every fourth row."""
    changed = cv2.subtract(restored[::4], recorded[::4], dtype=cv2.CV_32F)
    return float(cv2.norm(changed, cv2.NORM_L2SQR)) / changed.size


class _Clock:
    """Measures the seconds of each step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now
