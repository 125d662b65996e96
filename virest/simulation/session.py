"""One simulated recording session: what is looked at, how the hand moves, when each frame is exposed, what is logged.

Clocks (contract, section 4): ``t_imu − stamp_0 = (t_cam − stamp_0)(1 + clock_skew) + time_offset_s``; a stamp that
means the middle or the end lies half or one true exposure after the start.  Rows follow on the IMU's clock.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import ANDROID_R_CAM_IMU, CameraProfile
from virest.camera.profile_file import require_usable
from virest.camera.response import ResponseCurve
from virest.camera.shutter import Shutter
from virest.errors import SettingsError
from virest.simulation.auto_exposure import AutoExposure, Exposures, plan_exposures
from virest.simulation.exposure import View, expose, instant, make_view, pixel_rays
from virest.simulation.hand_motion import HandMotion, random_hand_motion
from virest.simulation.hidden import NOTHING, Hidden, defocused, gyro_reading, shaded
from virest.simulation.phone_gyro import gyro_noise, jittered_ns, low_passed_rate, usual_delay_s
from virest.simulation.phone_isp import OFF, PhoneIsp
from virest.simulation.phone_pictures import PhonePictures, roll_off_highlights, tone_curve
from virest.simulation.scenes import LENS_SIGMA_PX, Scene, hang_before, make_scene, move_things_before
from virest.simulation.sensor import eight_bit, grey_of_light, noisy_levels, round_levels, sensor_light

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

LANDSCAPE_R_CAM_IMU = ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
GRAVITY_WORLD_M_S2 = np.array([0.0, 9.81, 0.0])
"""World y points down."""
TICKS_PER_S = 90_000
"""Time base of the movie; stamps are its ticks, cut to whole microseconds."""
STAMP_PLACE = {"exposure_start": 0.0, "exposure_middle": 0.5, "exposure_end": 1.0}
DEFAULT_SWAY_M = 0.012
"""RMS sway of the hand where the scene has a depth and no sway is asked for."""
LONGEST_EXPOSURE_S = 10.0
LONGEST_OFFSET_S = 600.0
FASTEST_HAND_RAD_S = 100.0
NEAREST_M, FARTHEST_M = 0.001, 1e6
FOCAL_OF_LONG_SIDE = (0.05, 100.0)
"""What the renderer takes; beyond, arrays outgrow the memory or numbers lose their digits."""
WHOLE_FRAMES = ("delay", ("time",))
"""Fields that make all rows of a frame late."""
_IMU_LEAD_S = 0.6
_SCENE_MARGIN = 1.12


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """What is recorded and how; the camera itself is a profile."""

    scene: str = "leaves"
    frames: int = 12
    fps: float = 30.0
    exposure_s: tuple[float, ...] = (0.010,)
    """As logged; frame k takes entry k modulo the length. The ISO compensates for a change: the light stays."""
    auto_exposure: AutoExposure | None = None
    """Exposure × ISO moves, and the picture's brightness with it; None: it stays."""
    rate_rad_s: float = 1.0
    """RMS of the angular rate; 0: the camera does not turn, and without a sway stands still, as on a tripod."""
    sway_m: float | None = None
    """RMS of the sway; None: DEFAULT_SWAY_M where the scene has a depth, else none."""
    pan_rad_s: float = 0.0
    """Steady turn about the camera's vertical axis, on top of the hand's."""
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    """Turn of the scene's plane about world x and y; only with a finite depth."""
    near_m: float | None = None
    """Distance of things that hang before the scene; None: none do."""
    moving_px_s: float = 0.0
    """Speed of things that move across the scene, in the picture of a camera at rest; 0: there are none."""
    noise_levels: float = 1.5
    """Standard deviation of the noise in grey levels of 255."""
    imu_rate_hz: float = 200.0
    gyro_noise_rad_s: float = 0.0015
    accel_noise_m_s2: float = 0.02
    seed: int = 0
    oversampling: float = 2.0
    """Chart pixels per picture pixel."""
    isp: PhoneIsp = OFF
    """The phone's own processing; its offset and stabiliser stand in the true profile."""


@dataclass(frozen=True, slots=True)
class Session:
    """A recording that is planned and not yet rendered."""

    nominal: CameraProfile
    """What the capture's camera.yaml will say."""
    true: CameraProfile
    """What the simulated camera is."""
    settings: SessionSettings
    scene: Scene
    motion: HandMotion
    view: View
    stamp_tick: NDArray[np.int64]
    """(frames,) movie time stamps in ticks, first 0."""
    stamp_ns: NDArray[np.int64]
    """(frames,) frame stamps, on the camera's clock."""
    shows: NDArray[np.int64]
    """(frames,) which capture each slot of the movie shows; the slot's own index without start-up lag."""
    imu_span_s: tuple[float, float]
    """First and last inertial sample."""
    exposures: Exposures
    """Of every capture, the first ``frames`` of them shown or not."""
    capture_s: Array | None = None
    """(captures,) stamp of every capture from stamp_0, camera clock; None: even, at the settings' frame rate."""
    recorded_imu: ImuLog | None = None
    """Samples of a phone, to be written as they are; None: worked out from the motion."""
    hidden: Hidden = NOTHING
    """Effects that no profile names."""

    def logged_exposure_s(self, capture: int) -> float:
        """Exposure that the log gives for a capture."""
        return float(self.exposures.logged_s[capture])

    def true_exposure_s(self, capture: int) -> float:
        """Exposure that the sensor made."""
        return self.logged_exposure_s(capture) * self.true.shutter.exposure_scale

    def stamp_s(self, capture: int) -> float:
        """Stamp of a capture from stamp_0, camera clock."""
        return _stamp_s(capture, self.settings.fps) if self.capture_s is None else float(self.capture_s[capture])

    def first_row_start_s(self, capture: int) -> float:
        """Start of the first row's exposure, IMU clock from stamp_0."""
        stamp_s = self.stamp_s(capture)
        late_s = 0.0 if self.hidden.clock_s is None else self.hidden.clock_s(stamp_s)
        return _first_row_start_s(self.true, stamp_s, self.true_exposure_s(capture)) + late_s

    def middle_s(self, capture: int) -> float:
        """Start of the first row + half the readout + half the exposure."""
        half = 0.5 * (self.true.shutter.readout_time_s + self.true_exposure_s(capture))
        return self.first_row_start_s(capture) + half


@dataclass(frozen=True, slots=True)
class ImuLog:
    """Inertial samples as the phone logs them."""

    time_ns: NDArray[np.int64]
    """(n,)."""
    gyro_rad_s: Array
    """(n, 3) IMU axes."""
    accel_m_s2: Array
    """(n, 3) IMU axes, specific force."""


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
    """Describe a phone held upright (height > width) or on its side, focal length 0.8 of the long side unless given.

    readout_direction: right_to_left for an upright phone and top_to_bottom for one on its side, unless given.
    """
    focal = 0.8 * max(width, height) if focal_px is None else focal_px
    upright = height > width
    return CameraProfile(
        width=width,
        height=height,
        device="simulated phone",
        intrinsics=Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, *distortion),
        shutter=Shutter(readout_time_s, readout_direction or ("right_to_left" if upright else "top_to_bottom")),
        r_cam_imu=ANDROID_R_CAM_IMU if upright else LANDSCAPE_R_CAM_IMU,
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
    """Draw scene and motion (unless given) and lay out the times. The same seed gives the same session."""
    _require_sizes(true, settings)
    duration = settings.frames / settings.fps
    offset = abs(true.time_offset_s or 0.0)
    lead = _IMU_LEAD_S if offset <= 0.4 else float(np.ceil(offset + _IMU_LEAD_S))
    span = (-lead, duration + lead)
    depth = scene_depth_m(true)
    if motion is None:
        sway = settings.sway_m if settings.sway_m is not None else (DEFAULT_SWAY_M if np.isfinite(depth) else 0.0)
        # whole seconds: a small effect must not change where the integration starts, nor its last digits
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
        scene = _with_things_before(scene, nominal, settings)
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
    """Take the picture for a slot of the movie, before the encoder: (h, w, 3) RGB.

    phone: the phone's pipeline, which remembers the pictures before this one; None: the curve and noise alone.
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
    """Take what a global shutter without blur, defocus, flicker, noise sees at the slot's reference time: (h, w, 3).

    Of the phone's processing it has what acts on every pixel alike, the highlights and the global tone curve.
    """
    capture = int(session.shows[slot])
    time_s = session.middle_s(capture) if middle else session.first_row_start_s(capture)
    light = instant(session.scene, session.motion, session.view, time_s)
    light = sensor_light(light, session.true, _gain(session, slot), defocus=False)
    light = shaded(session.hidden, light, session.stamp_s(capture))
    return eight_bit(tone_curve(_grey(session, light), session.settings.isp.tone), 0.0, None)


def phone_pictures(session: Session) -> PhonePictures | None:
    """A new pipeline of the session's phone; None where it does nothing between the noise and the encoder."""
    settings = session.settings
    return PhonePictures(settings.isp, settings.noise_levels / 255) if settings.isp.develops else None


def sample_imu(session: Session) -> ImuLog:
    """Gyroscope (scale × true + bias + noise) and accelerometer, at the IMU's place and in its axes."""
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
        time_ns = jittered_ns(time_ns, settings.isp.gyro_jitter_s, np.random.default_rng([settings.seed, 7]))
    return ImuLog(int(session.stamp_ns[0]) + time_ns, gyro, force)


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _require_sizes(profile: CameraProfile, settings: SessionSettings) -> None:
    """Refuse what no camera does and what would never end: a value of the camera, of the times, of the motion."""

    def refuse(what: str, hint: str) -> None:
        raise SettingsError(f"simulation: {what}", hint=hint)

    if profile.width <= 0 or profile.height <= 0:
        refuse(f"{profile.width}x{profile.height} is no picture size", "ask for at least 16x16")
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
    if settings.moving_px_s < 0:
        refuse(f"things that move at {settings.moving_px_s:g} px/s", "use 0 or more")
    if abs(settings.pan_rad_s) > FASTEST_HAND_RAD_S:
        refuse(f"a pan of {settings.pan_rad_s:g} rad/s", f"use -{FASTEST_HAND_RAD_S:g} to {FASTEST_HAND_RAD_S:g}")
    far = scene_depth_m(profile)
    if settings.near_m is not None and not NEAREST_M <= settings.near_m < far:
        refuse(f"things {settings.near_m:g} m away before a scene {far:g} m away", "they must be nearer than the scene")
    if not (settings.imu_rate_hz >= 1 and settings.noise_levels >= 0 and settings.rate_rad_s >= 0):
        refuse("a negative rate or noise", "use 0 or more")
    if settings.noise_levels > 255:
        refuse(f"noise of {settings.noise_levels:g} grey levels", "use 0 to 255, about 1.5 for a phone")
    if settings.rate_rad_s > FASTEST_HAND_RAD_S:
        refuse(f"{settings.rate_rad_s:g} rad/s", f"use 0 to {FASTEST_HAND_RAD_S:g}; a hand reaches about 5")
    require_usable(profile, "simulation")
    _require_renderable(profile, refuse)


def _require_renderable(profile: CameraProfile, refuse: Callable[[str, str], None]) -> None:
    """Sizes that a profile may have and the renderer cannot."""
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
    """Distance of the scene; infinite where the profile names none."""
    return np.inf if profile.depth_m is None else profile.depth_m


def _stamp_tick(index: int, fps: float) -> int:
    return round(index * TICKS_PER_S / fps)


def _stamp_s(index: int, fps: float) -> float:
    """Stamp of a capture from stamp_0, camera clock: its tick, cut to a whole microsecond."""
    return (_stamp_tick(index, fps) * 1_000_000 // TICKS_PER_S) * 1e-6


def _first_row_start_s(true: CameraProfile, stamp_s: float, true_exposure_s: float) -> float:
    start_cam = stamp_s - STAMP_PLACE[true.shutter.timestamp] * true_exposure_s
    late_s = sum(
        float(f.at_time(start_cam)[0]) for f in true.extensions.field if (f.kind, f.covariates) == WHOLE_FRAMES
    )
    return start_cam * (1 + true.clock_skew) + (true.time_offset_s or 0.0) + late_s


def shown_captures(true: CameraProfile, settings: SessionSettings) -> NDArray[np.int64]:
    """Slot k shows capture k + lag − repeats so far; the repeats are spread over slots 1 … frames."""
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
    """Of every capture that a slot shows or that has a slot's number."""
    count = max(settings.frames, int(shows.max()) + 1)
    rng = np.random.default_rng([settings.seed, 6])
    return plan_exposures(settings.exposure_s, settings.auto_exposure, count, settings.fps, rng)


def _draw_scene(
    nominal: CameraProfile, true: CameraProfile, motion: HandMotion, settings: SessionSettings, duration_s: float
) -> Scene:
    """Draw a chart that covers all that the motion shows, half a second before and after too.

    The detail that is drawn follows the nominal camera, so a small hidden effect leaves the scene as it is, or a whole
    multiple of its focal length where the true one is that long.  The lens and the pixels that blur it are the true
    camera's: one with twice the focal length resolves twice as much of the scene.
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


def _with_things_before(scene: Scene, nominal: CameraProfile, settings: SessionSettings) -> Scene:
    """The scene with what hangs or moves before it."""
    assert nominal.intrinsics is not None
    focal_px = max(nominal.intrinsics.fx_px, nominal.intrinsics.fy_px)
    if settings.near_m is not None:
        rng = np.random.default_rng([settings.seed, 7])
        scene = hang_before(scene, rng, depth_m=settings.near_m, focal_px=focal_px)
    if settings.moving_px_s:
        rng = np.random.default_rng([settings.seed, 8])
        scene = move_things_before(scene, rng, speed_px_s=settings.moving_px_s, focal_px=focal_px)
    return scene


def _at_median_depth(
    scene: Scene, motion: HandMotion, true: CameraProfile, settings: SessionSettings, shows: NDArray[np.int64]
) -> Scene:
    """Move the plane so that the median over the frames of the distance along the optical axis is its depth."""
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
    """Factor on the light: the capture's exposure × ISO, and the hidden gain of the first slot that shows it.

    The first slot's, so that repeats are exact.
    """
    gain = session.true.extensions.gain
    capture = int(session.shows[slot])
    first = int(np.argmax(session.shows == capture))
    return float(session.exposures.light[capture]) * (gain[first] if first < len(gain) else 1.0)


def _gyro_rate(session: Session, time_s: Array) -> Array:
    """Rates (n, 3) as the gyroscope passes them on, camera axes."""
    rate, corners_hz = session.motion.rate_rad_s, _corners_hz(session)
    if not corners_hz:
        return rate(time_s)
    return low_passed_rate(rate, time_s, corners_hz, usual_delay_s(session.settings.isp.gyro_lowpass_hz))


def _corners_hz(session: Session) -> list[float]:
    """Of the hidden low pass, whose delay is in the log, and of the phone's own, whose delay its stamps leave out."""
    both = (session.true.extensions.gyro_lowpass_hz, session.settings.isp.gyro_lowpass_hz)
    return [corner_hz for corner_hz in both if corner_hz]


def _gyro_noise(session: Session, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    settings = session.settings
    if settings.isp.gyro_noise:
        return gyro_noise(settings.isp.gyro_noise, settings.imu_rate_hz, _corners_hz(session), shape, rng)
    return settings.gyro_noise_rad_s * rng.normal(size=shape)


def _grey(session: Session, light: Array) -> Array:
    """Grey in [0, 1] behind the sensor's curve, highlights rolled off before it."""
    return grey_of_light(roll_off_highlights(light, session.settings.isp.highlights), _curve(session))


def _curve(session: Session) -> ResponseCurve:
    return session.true.response or ResponseCurve("srgb")
