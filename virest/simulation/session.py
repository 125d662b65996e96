"""A simulated recording session: scene, hand motion, exposure times of each frame, and logs.

Clocks (contract, section 4): ``t_imu − stamp_0 = (t_cam − stamp_0)(1 + clock_skew) + time_offset_s``.  A timestamp of
the exposure's middle or end lies half or one true exposure time after its start.  Row delays are on the IMU clock.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from virest.arrays import Array, Picture
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import ANDROID_R_CAM_IMU, LANDSCAPE_R_CAM_IMU, CameraProfile
from virest.camera.profile_file import require_usable
from virest.camera.response import ResponseCurve
from virest.camera.shutter import Shutter
from virest.capture.join import TICKS_PER_S
from virest.errors import SettingsError
from virest.simulation.auto_exposure import AutoExposure, Exposures, plan_exposures
from virest.simulation.exposure import View, expose, instant, make_view, pixel_rays
from virest.simulation.hand_motion import HandMotion, random_hand_motion
from virest.simulation.hidden import NOTHING, Hidden, defocused, gyro_reading, shaded
from virest.simulation.phone_gyro import averaging_window_s, filtered_rate, gyro_noise, jittered_ns, usual_delay_s
from virest.simulation.phone_isp import OFF, PhoneIsp
from virest.simulation.phone_pictures import PhonePictures, roll_off_highlights, tone_curve
from virest.simulation.scenes import LENS_SIGMA_PX, Scene, add_moving_objects, add_near_objects, make_scene
from virest.simulation.sensor import eight_bit, grey_of_light, noisy_levels, round_levels, sensor_light

GRAVITY_WORLD_M_S2 = np.array([0.0, 9.81, 0.0])
"""World y points down."""
STAMP_FRACTION = {"exposure_start": 0.0, "exposure_middle": 0.5, "exposure_end": 1.0}
"""Position of the timestamp within the exposure."""
DEFAULT_SWAY_M = 0.012
"""Default RMS sway of the hand for a scene of finite depth."""
LONGEST_EXPOSURE_S, LONGEST_OFFSET_S, FASTEST_HAND_RAD_S = 10.0, 600.0, 100.0
"""Limits of the renderer: 300 frame periods at 30 frames/s; 120 000 more inertial samples at 200 Hz; three times the
full scale of phone gyroscopes (35 rad/s)."""
FASTEST_OBJECT_PX_S = 2e4
"""Limit of the renderer: a car at 20 m/s, 1 m in front of a phone."""
NEAREST_M, FARTHEST_M = 0.001, 1e6
"""Limits of the renderer, far beyond any phone's recording."""
FOCAL_OF_LONG_SIDE = (0.05, 100.0)
"""Limits of the renderer, the focal length as a multiple of the long side; beyond them memory or precision runs out."""
WHOLE_FRAMES = ("delay", ("time",))
"""Kind and covariates of fields that delay all rows of a frame."""
_IMU_LEAD_S = 0.6
"""The log begins this long before the first frame and ends as long after the last: an offset of 0.4 s leaves 0.2 s."""
_SCENE_MARGIN = 1.12
"""The scene is drawn larger than the nominal view, so that a small hidden effect leaves it unchanged."""


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Recording settings; the camera itself is described by a profile."""

    scene: str = "leaves"
    frames: int = 12
    fps: float = 30.0
    exposure_s: tuple[float, ...] = (0.010,)
    """Logged exposure times, used cyclically; ISO compensates, so brightness is constant without auto-exposure."""
    auto_exposure: AutoExposure | None = None
    """Variation of exposure × ISO, and with it of brightness; None: constant."""
    rate_rad_s: float = 1.0
    """RMS angular rate; 0: no rotation by the hand, as on a tripod if there is no sway."""
    sway_m: float | None = None
    """RMS sway; None: DEFAULT_SWAY_M for a scene of finite depth, else 0."""
    pan_rad_s: float = 0.0
    """Constant rate about the camera's y axis, added to the hand's."""
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    """Rotation vector of the scene plane about world x and y; only with a finite depth."""
    near_m: float | None = None
    """Distance of objects in front of the scene; None: no objects."""
    moving_px_s: float = 0.0
    """Speed of objects that move across the scene, in the image of a stationary camera; 0: no objects."""
    noise_levels: float = 1.5
    """Standard deviation of the image noise, in grey levels of 0–255."""
    imu_rate_hz: float = 200.0
    gyro_noise_rad_s: float = 0.0015
    accel_noise_m_s2: float = 0.02
    seed: int = 0
    oversampling: float = 2.0
    """Chart pixels per frame pixel."""
    isp: PhoneIsp = OFF
    """The phone's own processing; its time offset and stabiliser belong in the true profile."""


@dataclass(frozen=True, slots=True)
class Session:
    """A planned recording, not yet rendered."""

    nominal: CameraProfile
    """Profile written to the capture's camera.yaml."""
    true: CameraProfile
    """Profile of the simulated camera."""
    settings: SessionSettings
    scene: Scene
    motion: HandMotion
    view: View
    stamp_tick: NDArray[np.int64]
    """(frames,) movie timestamps in ticks from the first frame."""
    stamp_ns: NDArray[np.int64]
    """(frames,) frame timestamps, camera clock."""
    shows: NDArray[np.int64]
    """(frames,) index of the capture that each movie slot shows; equal to the slot's index without start-up lag."""
    imu_span_s: tuple[float, float]
    """Times of the first and last inertial sample."""
    exposures: Exposures
    """Exposures of all captures: at least ``frames`` of them, shown or not."""
    capture_s: Array | None = None
    """(captures,) timestamp of each capture from stamp_0, camera clock; None: evenly spaced at settings.fps."""
    recorded_imu: ImuLog | None = None
    """A phone's samples, written unchanged; None: samples are computed from the motion."""
    hidden: Hidden = NOTHING
    """Effects that no profile describes."""

    def logged_exposure_s(self, capture: int) -> float:
        """Logged exposure time of a capture."""
        return float(self.exposures.logged_s[capture])

    def true_exposure_s(self, capture: int) -> float:
        """True exposure time of a capture."""
        return self.logged_exposure_s(capture) * self.true.shutter.exposure_scale

    def stamp_s(self, capture: int) -> float:
        """Timestamp of a capture from stamp_0, camera clock."""
        return _stamp_s(capture, self.settings.fps) if self.capture_s is None else float(self.capture_s[capture])

    def first_row_start_s(self, capture: int) -> float:
        """Start of the first row's exposure, IMU clock from stamp_0."""
        stamp_s = self.stamp_s(capture)
        late_s = 0.0 if self.hidden.clock_s is None else self.hidden.clock_s(stamp_s)
        return _first_row_start_s(self.true, stamp_s, self.true_exposure_s(capture)) + late_s

    def middle_s(self, capture: int) -> float:
        """Middle of the frame: start of the first row + half the readout + half the exposure."""
        half = 0.5 * (self.true.shutter.readout_time_s + self.true_exposure_s(capture))
        return self.first_row_start_s(capture) + half

    def blur_px(self) -> float:
        """Median over the frames of the image motion at the centre during one exposure, in pixels."""
        lens, captures = self.true.intrinsics, self.shows.tolist()
        assert lens is not None
        begin = np.array([self.first_row_start_s(k) for k in captures]) + 0.5 * self.true.shutter.readout_time_s
        lasting = np.array([self.true_exposure_s(k) for k in captures])
        turn = self.motion.rotation(begin).inv() * self.motion.rotation(begin + lasting)
        return round(lens.fx_px * float(np.median(np.linalg.norm(turn.as_rotvec()[:, :2], axis=1))), 2)


@dataclass(frozen=True, slots=True)
class ImuLog:
    """Inertial samples as the phone logs them."""

    time_ns: NDArray[np.int64]
    """(n,) sample times."""
    gyro_rad_s: Array
    """(n, 3) IMU axes."""
    accel_m_s2: Array
    """(n, 3) specific force, IMU axes."""


def nominal_camera(
    width: int,
    height: int,
    *,
    focal_px: float | None = None,
    readout_time_s: float = 0.020,
    readout_direction: str | None = None,
    response: ResponseCurve | None = None,
    distortion: tuple[str, tuple[float, ...]] = ("none", ()),
    depth_m: float = np.inf,
) -> CameraProfile:
    """Profile of a phone held in portrait (height > width) or landscape; default focal length 0.8 × the long side.

    readout_direction: default right_to_left in portrait, top_to_bottom in landscape.
    """
    focal = 0.8 * max(width, height) if focal_px is None else focal_px
    portrait = height > width
    return CameraProfile(
        width=width,
        height=height,
        device="simulated phone",
        intrinsics=Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, *distortion),
        shutter=Shutter(readout_time_s, readout_direction or ("right_to_left" if portrait else "top_to_bottom")),
        r_cam_imu=ANDROID_R_CAM_IMU if portrait else LANDSCAPE_R_CAM_IMU,
        time_offset_s=0.0,
        response=response or ResponseCurve("srgb"),
        focal_length_mm=3.95,
        depth_m=depth_m,
    )


def plan_session(
    nominal: CameraProfile,
    true: CameraProfile,
    settings: SessionSettings,
    *,
    scene: Scene | None = None,
    motion: HandMotion | None = None,
    hidden: Hidden = NOTHING,
) -> Session:
    """Draw scene and motion (unless given) and plan all times.  The same seed gives the same session."""
    _require_sizes(true, settings)
    duration = settings.frames / settings.fps
    offset = abs(true.time_offset_s or 0.0)
    lead = _IMU_LEAD_S if offset <= 0.4 else float(np.ceil(offset + _IMU_LEAD_S))
    span = (-lead, duration + lead)
    depth = scene_depth_m(true)
    if motion is None:
        sway = settings.sway_m if settings.sway_m is not None else (DEFAULT_SWAY_M if np.isfinite(depth) else 0.0)
        # whole seconds: a small effect must not move the start of the integration and so change its rounding
        spare = np.ceil(lead + 0.6 + true.extensions.frame_lag_s + abs(true.clock_skew) * duration)
        motion = random_hand_motion(
            np.random.default_rng([settings.seed, 1]),
            rate_rms_rad_s=settings.rate_rad_s,
            duration_s=duration,
            sway_rms_m=sway,
            pan_rad_s=settings.pan_rad_s,
            margin_s=float(spare),
        )
    shows = shown_captures(true, settings)
    if scene is None:
        scene = _draw_scene(nominal, true, motion, settings, duration)
        if np.isfinite(depth):
            tilt = Rotation.from_rotvec([*settings.tilt_rad, 0.0]).as_matrix()[:, 2]
            scene = _at_median_depth(scene.at_plane(depth, tuple(tilt.tolist())), motion, true, settings, shows)
        scene = _with_objects(scene, nominal, settings)
    base_ns = 1_000 * int(np.random.default_rng([settings.seed, 2]).integers(40_000_000_000, 60_000_000_000))
    ticks = np.array([_stamp_tick(k, settings.fps) for k in range(settings.frames)])
    stamps = base_ns + np.array([round(_stamp_s(k, settings.fps) * 1e9) for k in range(settings.frames)])
    view = make_view(true, motion, rest_s=span[0], hidden=hidden)
    exposures = _plan_exposures(settings, shows)
    return Session(
        nominal, true, settings, scene, motion, view, ticks, stamps.astype(np.int64), shows, span, exposures,
        hidden=hidden,
    )  # fmt: skip


def render_picture(session: Session, slot: int, phone: PhonePictures | None = None) -> Picture:
    """Render the frame of a movie slot as the encoder receives it: (h, w, 3) RGB.

    phone: the phone's pipeline, which keeps state from earlier frames; None: response curve and noise alone.
    """
    capture = int(session.shows[slot])
    light = expose(
        session.scene,
        session.motion,
        session.view,
        session.first_row_start_s(capture),
        session.true_exposure_s(capture),
    )
    light = defocused(session.true, session.hidden, light, session.stamp_s(capture))
    light = sensor_light(light, session.true, _gain(session, slot), defocus=True)
    light = shaded(session.hidden, light, session.stamp_s(capture))
    rng = np.random.default_rng([session.settings.seed, 3, capture])
    levels = noisy_levels(_grey(session, light), session.settings.noise_levels, rng)
    return round_levels(levels if phone is None else 255.0 * phone.develop(levels / 255.0))


def render_truth(session: Session, slot: int, *, middle: bool = False) -> Picture:
    """Render a slot as a global shutter sees it without blur, defocus, flicker or noise: (h, w, 3).

    middle: at the middle of the frame instead of the start of the first row.  Of the phone's processing only the
    per-pixel steps are applied, highlight roll-off and the global tone curve.
    """
    capture = int(session.shows[slot])
    time_s = session.middle_s(capture) if middle else session.first_row_start_s(capture)
    light = instant(session.scene, session.motion, session.view, time_s)
    light = sensor_light(light, session.true, _gain(session, slot), defocus=False)
    light = shaded(session.hidden, light, session.stamp_s(capture))
    return eight_bit(tone_curve(_grey(session, light), session.settings.isp.tone), 0.0, None)


def phone_pictures(session: Session) -> PhonePictures | None:
    """A new image pipeline of the session's phone; None if no step between noise and encoder is on."""
    settings = session.settings
    return PhonePictures(settings.isp, settings.noise_levels / 255) if settings.isp.develops else None


def sample_imu(session: Session) -> ImuLog:
    """Gyroscope (scale × true + bias + noise) and accelerometer samples, at the IMU's position and in its axes."""
    if session.recorded_imu is not None:
        return session.recorded_imu
    settings, true = session.settings, session.true
    grid_s = np.arange(session.imu_span_s[0], session.imu_span_s[1], 1 / settings.imu_rate_hz)
    time_ns: NDArray[np.int64] = np.rint(grid_s * 1e9).astype(np.int64)
    time_s: Array = time_ns.astype(float) * 1e-9
    rng = np.random.default_rng([settings.seed, 4])
    imu_from_cam = np.array(true.r_cam_imu).T
    rate = _gyro_rate(session, time_s) @ imu_from_cam.T
    force = session.motion.specific_force_m_s2(time_s, np.array(true.p_cam_imu_m), GRAVITY_WORLD_M_S2) @ imu_from_cam.T
    gyro = gyro_reading(true, time_s, rate, force) + _gyro_noise(session, rate.shape, rng)
    if session.hidden.gyro is not None:
        gyro = session.hidden.gyro(time_s, gyro, force)
    force = force + settings.accel_noise_m_s2 * rng.normal(size=force.shape)
    if settings.isp.gyro_jitter_s:
        time_ns = jittered_ns(time_ns, settings.isp.gyro_jitter_s, _jitter_rng(settings))
    return ImuLog(int(session.stamp_ns[0]) + time_ns, gyro, force)


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _require_sizes(profile: CameraProfile, settings: SessionSettings) -> None:
    """Raise SettingsError for a camera, timing or motion that is impossible or too expensive to render."""

    def refuse(what: str, hint: str) -> None:
        raise SettingsError(f"simulation: {what}", hint=hint)

    if profile.width <= 0 or profile.height <= 0:
        refuse(f"{profile.width}x{profile.height} is not a valid picture size", "ask for at least 16x16")
    if profile.width % 2 or profile.height % 2:
        refuse(f"{profile.width}x{profile.height} is odd", "H.264 needs even width and height")
    if settings.frames < 1:
        refuse(f"{settings.frames} frames", "ask for at least 1")
    if not 1 <= settings.fps <= 1000:
        refuse(f"{settings.fps:g} frames per second", "use 1 to 1000")
    if not settings.exposure_s or not min(settings.exposure_s) > 0:
        refuse("the exposure is not positive", "use about 1 to 20 ms")
    if not max(settings.exposure_s) <= LONGEST_EXPOSURE_S:
        refuse(f"an exposure of {max(settings.exposure_s):g} s", f"at most {LONGEST_EXPOSURE_S:g} s are rendered")
    if not 0 <= settings.moving_px_s <= FASTEST_OBJECT_PX_S:
        refuse(f"objects that move at {settings.moving_px_s:g} px/s", f"use 0 to {FASTEST_OBJECT_PX_S:g}")
    if not abs(settings.pan_rad_s) <= FASTEST_HAND_RAD_S:
        refuse(f"a pan of {settings.pan_rad_s:g} rad/s", f"use -{FASTEST_HAND_RAD_S:g} to {FASTEST_HAND_RAD_S:g}")
    far = scene_depth_m(profile)
    if settings.near_m is not None and not NEAREST_M <= settings.near_m < far:
        refuse(
            f"objects {settings.near_m:g} m away before a scene {far:g} m away", "they must be nearer than the scene"
        )
    if not (settings.imu_rate_hz >= 1 and settings.noise_levels >= 0 and settings.rate_rad_s >= 0):
        refuse("a negative rate or noise", "use 0 or more")
    if settings.noise_levels > 255:
        refuse(f"noise of {settings.noise_levels:g} grey levels", "use 0 to 255, about 1.5 for a phone")
    if settings.rate_rad_s > FASTEST_HAND_RAD_S:
        refuse(f"{settings.rate_rad_s:g} rad/s", f"use 0 to {FASTEST_HAND_RAD_S:g}; a hand reaches about 5")
    require_usable(profile, "simulation")
    _require_renderable(profile, refuse)


def _require_renderable(profile: CameraProfile, refuse: Callable[[str, str], None]) -> None:
    """Refuse profile values that are valid but beyond the renderer's limits."""
    lens, offset, depth = profile.intrinsics, profile.time_offset_s or 0.0, profile.depth_m
    if lens is not None:
        low, high = (times * max(profile.width, profile.height) for times in FOCAL_OF_LONG_SIDE)
        if not low <= min(lens.fx_px, lens.fy_px) <= max(lens.fx_px, lens.fy_px) <= high:
            refuse(f"a focal length of {lens.fx_px:g} px", f"use {low:g} to {high:g}; a phone has 0.8 of the long side")
    if abs(offset) > LONGEST_OFFSET_S:
        refuse(f"a time offset of {offset:g} s", f"at most {LONGEST_OFFSET_S:g} s, or the inertial log has no end")
    if depth is not None and depth != np.inf and not NEAREST_M <= depth <= FARTHEST_M:
        refuse(f"a scene {depth:g} m away", f"use {NEAREST_M:g} to {FARTHEST_M:g} m, or inf")


def scene_depth_m(profile: CameraProfile) -> float:
    """Distance of the scene; infinite if the profile has none."""
    return np.inf if profile.depth_m is None else profile.depth_m


def _stamp_tick(index: int, fps: float) -> int:
    return round(index * TICKS_PER_S / fps)


def _stamp_s(index: int, fps: float) -> float:
    """Timestamp of a capture from stamp_0, camera clock: its tick, truncated to a microsecond."""
    return (_stamp_tick(index, fps) * 1_000_000 // TICKS_PER_S) * 1e-6


def _first_row_start_s(true: CameraProfile, stamp_s: float, true_exposure_s: float) -> float:
    start_cam = stamp_s - STAMP_FRACTION[true.shutter.timestamp] * true_exposure_s
    late_s = sum(
        float(f.at_time(start_cam)[0]) for f in true.extensions.field if (f.kind, f.covariates) == WHOLE_FRAMES
    )
    return start_cam * (1 + true.clock_skew) + (true.time_offset_s or 0.0) + late_s


def shown_captures(true: CameraProfile, settings: SessionSettings) -> NDArray[np.int64]:
    """Capture shown by each slot k: k + lag − repeats up to k, repeats spread over slots 1 … frame_lag_frames."""
    slots = np.arange(settings.frames)
    last = true.extensions.frame_lag_frames
    lag = round(true.extensions.frame_lag_s * settings.fps)
    if not last or not lag:
        return slots
    if lag > last:
        raise SettingsError(
            f"a recorder lag of {lag} frames cannot be used up in {last} slots", hint="give more slots or a smaller lag"
        )
    repeats = np.round(np.arange(1, lag + 1) * last / lag).astype(int)
    return slots + lag - np.searchsorted(repeats, slots, side="right")


def _plan_exposures(settings: SessionSettings, shows: NDArray[np.int64]) -> Exposures:
    """Plan exposures for every capture that a slot shows or that shares a slot's index."""
    count = max(settings.frames, int(shows.max()) + 1)
    rng = np.random.default_rng([settings.seed, 6])
    return plan_exposures(settings.exposure_s, settings.auto_exposure, count, settings.fps, rng)


def _draw_scene(
    nominal: CameraProfile, true: CameraProfile, motion: HandMotion, settings: SessionSettings, duration_s: float
) -> Scene:
    """Draw a chart that covers the field of view over the motion and 0.5 s before and after it.

    Its detail follows the nominal focal length, or the whole multiple of it nearest the true one, so a small hidden
    effect leaves the scene unchanged.  The blur is that of the true camera's lens and pixels: twice the focal length
    resolves twice as much of the scene.
    """
    lens, true_lens = nominal.intrinsics, true.intrinsics
    if lens is None or true_lens is None:
        raise SettingsError("a simulated camera needs a focal length", hint="set intrinsics.fx_px")
    x, y = (
        max(np.abs(rays).max() * _SCENE_MARGIN, np.abs(true_rays).max())
        for rays, true_rays in zip(pixel_rays(lens), pixel_rays(true_lens), strict=True)
    )
    corners = np.array([[i, j, 1.0] for i in (-x, 0, x) for j in (-y, 0, y)])
    turns = motion.rotation(np.linspace(-0.5, duration_s + 0.5, 400)).as_matrix()
    rays = np.einsum("tij,kj->tki", turns, corners)
    plane = np.abs(rays[..., :2] / np.maximum(rays[..., 2:], 0.3)).max(axis=(0, 1))
    extent = np.minimum(plane, 3.0)
    focal_px, true_focal_px = (max(one.fx_px, one.fy_px) for one in (lens, true_lens))
    fine_px = focal_px * max(1, round(true_focal_px / focal_px))
    return make_scene(
        settings.scene,
        np.random.default_rng([settings.seed, 0]),
        focal_px=fine_px,
        half_extent=(float(extent[0]), float(extent[1])),
        oversampling=settings.oversampling,
        lens_sigma_px=LENS_SIGMA_PX * fine_px / true_focal_px,
    )


def _with_objects(scene: Scene, nominal: CameraProfile, settings: SessionSettings) -> Scene:
    """Add the objects in front of the scene and those that move across it."""
    assert nominal.intrinsics is not None
    focal_px = max(nominal.intrinsics.fx_px, nominal.intrinsics.fy_px)
    if settings.near_m is not None:
        rng = np.random.default_rng([settings.seed, 7])
        scene = add_near_objects(scene, rng, depth_m=settings.near_m, focal_px=focal_px)
    if settings.moving_px_s:
        rng = np.random.default_rng([settings.seed, 8])
        scene = add_moving_objects(scene, rng, speed_px_s=settings.moving_px_s, focal_px=focal_px)
    return scene


def _at_median_depth(
    scene: Scene, motion: HandMotion, true: CameraProfile, settings: SessionSettings, shows: NDArray[np.int64]
) -> Scene:
    """Shift the plane so that its median distance along the optical axis, over all frames, equals its depth."""
    exposure = settings.exposure_s[0] * true.shutter.exposure_scale
    times = np.array([_first_row_start_s(true, _stamp_s(int(k), settings.fps), exposure) for k in shows])
    axis = motion.rotation(times).as_matrix()[:, :, 2]
    normal = np.array(scene.normal)
    middle = true.depth_m or np.inf
    for _ in range(4):
        to_plane = (np.array([0, 0, middle]) - motion.position_m(times)) @ normal
        middle += scene.depth_m - float(np.median(to_plane / (axis @ normal)))
    return dataclasses.replace(scene, depth_m=middle)


def _gain(session: Session, slot: int) -> float:
    """Factor on the light: relative exposure × ISO times the hidden gain of the capture's first slot.

    The first slot's gain is used so that repeated frames are identical.
    """
    capture = int(session.shows[slot])
    first = int(np.argmax(session.shows == capture))
    return float(session.exposures.light[capture]) * float(session.true.extensions.gain_of(first))


def _gyro_rate(session: Session, time_s: Array) -> Array:
    """Rates (n, 3), camera axes, after the gyroscope's filters."""
    rate, corners_hz = session.motion.rate_rad_s, _corners_hz(session)
    window_s = averaging_window_s(session.true.extensions.gyro_averaging_s)
    if not corners_hz and not window_s:
        return rate(time_s)
    delay_s = usual_delay_s(session.settings.isp.gyro_lowpass_hz)
    return filtered_rate(rate, time_s, corners_hz, delay_s, window_s)


def _corners_hz(session: Session) -> list[float]:
    """Corners of the hidden low-pass, whose delay stays in the log, and of the phone's own, whose delay is removed."""
    both = (session.true.extensions.gyro_lowpass_hz, session.settings.isp.gyro_lowpass_hz)
    return [corner_hz for corner_hz in both if corner_hz]


def _jitter_rng(settings: SessionSettings) -> np.random.Generator:
    """Random stream of the timestamp jitter; objects in front of the scene use the stream [seed, 7].

    A trailing 0 leaves the stream [seed, 7] unchanged, so only captures with both draw from another.
    """
    return np.random.default_rng([settings.seed, 7, int(settings.near_m is not None)])


def _gyro_noise(session: Session, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    settings = session.settings
    if settings.isp.gyro_noise:
        return gyro_noise(settings.isp.gyro_noise, settings.imu_rate_hz, _corners_hz(session), shape, rng)
    return settings.gyro_noise_rad_s * rng.normal(size=shape)


def _grey(session: Session, light: Array) -> Array:
    """Grey in [0, 1]: highlight roll-off, then the response curve."""
    return grey_of_light(roll_off_highlights(light, session.settings.isp.highlights), session.true.curve)
