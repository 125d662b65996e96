"""Recreate a recorded capture with a known scene: same timestamps, exposures, inertial samples and camera.

The scene is one sharp image without rolling-shutter distortion, placed at infinity in the camera's viewing direction
when it was taken and mirrored beyond its edges.  Camera translation is omitted, since one image carries no depth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array
from virest.camera.profile import CameraProfile, Extensions
from virest.camera.recounting import counted_from
from virest.capture.join import TICKS_PER_S
from virest.capture.records import IMU_GAP, NO_IMU, NO_STAMP, Capture, Frame
from virest.errors import CaptureError, SettingsError
from virest.simulation.auto_exposure import NOMINAL_ISO, Exposures
from virest.simulation.exposure import View, make_view
from virest.simulation.hand_motion import HandMotion
from virest.simulation.hidden import NOTHING, Hidden, focal_changes, focal_scale, seen_radius_px
from virest.simulation.recorded_motion import recorded_motion
from virest.simulation.scenes import MAX_CHART_PX, Scene
from virest.simulation.sensor import sensor_light
from virest.simulation.session import ImuLog, Session, SessionSettings, shown_captures

NOT_RECREATABLE = frozenset({NO_IMU, IMU_GAP, NO_STAMP})
"""Skip codes of frames without a known time or motion; they cannot be recreated."""
LEAST_AHEAD = 0.15
"""Minimum z, scene axes, of the unit rays through a frame's corners; below it the scene plane does not cover them."""
IMU_MARGIN_S = 1.0
"""As much of the log beyond the frames as `virest process` uses."""
_CHART_MARGIN = 1.02
"""Room for the lens's blur at the chart's edge."""
_LEAST_FACTOR = 1e-3
"""Keeps the inverse of the scale finite for absurd fields."""
_RADIUS_ITERATIONS = 5
"""If the focal length varies over the radius by a few per cent, each iteration reduces the error by that factor."""


@dataclass(frozen=True, slots=True)
class ScenePicture:
    """Source image of the scene, as a global shutter without blur captures it, and its time."""

    picture: NDArray[np.uint8]
    """(h, w, 3) RGB with the profile's lens, vignetting and response curve."""
    frame: int
    """Movie index of the frame; the picture shows the start of its first row's exposure."""
    valid_px: tuple[int, int, int, int]
    """Valid region x0, y0, x1, y1; the end is exclusive."""


def known_frames(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Frames with a known time and motion, including those of the recorder's start-up."""
    return tuple(frame for frame in frames if not NOT_RECREATABLE & set(frame.skip_codes) and np.isfinite(frame.time_s))


def recreate_session(
    capture: Capture,
    frames: Sequence[Frame],
    nominal: CameraProfile,
    true: CameraProfile,
    scene: ScenePicture,
    settings: SessionSettings,
) -> Session:
    """Plan a recreation of these frames; slot k of the new movie is frames[k].

    frames: in order, with times and exposures.  nominal, true: profiles of the capture as read; values counted from
    stamp_0 are shifted to the first of ``frames``.  settings: noise_levels, seed, oversampling and isp apply.
    """
    _require(frames, true)
    begin_s = frames[0].time_s
    nominal, true = (from_frame(p, frames) for p in (nominal, true))
    stamp_s = np.array([frame.time_s - begin_s for frame in frames])
    period_s = float(np.median(np.diff(stamp_s))) if len(frames) > 1 else 1 / settings.fps
    settings = dataclasses.replace(
        settings,
        scene=f"frame {scene.frame}",
        frames=len(frames),
        fps=float(np.clip(1 / period_s, 1.0, 1000.0)),
        exposure_s=tuple(frame.exposure_s or 0.0 for frame in frames),
    )
    shows = shown_captures(true, settings)
    later = np.arange(1, max(int(shows.max()) + 1 - len(frames), 0) + 1)
    capture_s = np.concatenate([stamp_s, stamp_s[-1] + period_s * later])
    slot = [frame.index for frame in frames].index(scene.frame)
    exposures = _exposures(frames, len(capture_s), int(shows[slot]))
    imu, sample_s = _cut_imu(capture, begin_s, stamp_s[-1], true)
    session = Session(
        nominal, true, settings, _NO_SCENE,
        recorded_motion(sample_s, imu.gyro_rad_s, true, 0.0, imu.accel_m_s2), _NO_VIEW,
        np.rint(stamp_s * TICKS_PER_S).astype(np.int64), np.array([f.timestamp_ns for f in frames], np.int64), shows,
        (float(sample_s[0]), float(sample_s[-1])), exposures, capture_s, imu, _logged_focus(frames),
    )  # fmt: skip
    seen_s = session.first_row_start_s(int(shows[slot]))
    motion = recorded_motion(sample_s, imu.gyro_rad_s, true, seen_s, imu.accel_m_s2)
    view = make_view(true, motion, rest_s=session.imu_span_s[0])
    _require_ahead(motion, view, session, shows)
    chart = _scene(scene, view, motion, seen_s, _slot_gain(true, shows, slot), settings.oversampling)
    return dataclasses.replace(session, scene=chart, motion=motion, view=view)


def from_frame(profile: CameraProfile, frames: Sequence[Frame]) -> CameraProfile:
    """Shift the profile's times to the first of these frames, and put the scene at infinity."""
    changed = counted_from(profile, frames[0].time_s, frames[0].timestamp_ns)
    extensions, index = changed.extensions, [frame.index for frame in frames]
    lag_s, lag_frames = _lag_left(extensions, index[0])
    gain = tuple(extensions.gain_of(index).tolist()) if extensions.gain else ()
    extensions = dataclasses.replace(
        extensions,
        gain=gain,
        frame_lag_s=lag_s,
        frame_lag_frames=lag_frames,
        exposures_late_frames=0,
        exposure_gain=(),
    )
    return dataclasses.replace(
        changed, time_offset_s=changed.time_offset_s or 0.0, depth_m=np.inf, extensions=extensions
    )


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _require(frames: Sequence[Frame], profile: CameraProfile) -> None:
    if not frames:
        raise CaptureError("no frame whose time and motion are known", hint="see `virest inspect`")
    if profile.intrinsics is None:
        raise SettingsError("the focal length is not known", hint="give fx_px in camera.yaml, or --config")
    without = [frame.index for frame in frames if not frame.exposure_s]
    if without:
        raise CaptureError(
            f"frame {without[0]} and {len(without) - 1} more have no exposure time", hint="check movie_metadata.csv"
        )


def _lag_left(extensions: Extensions, first: int) -> tuple[float, int]:
    """Remaining start-up lag at slot ``first``, seconds and slots; the lag declines evenly over the first slots."""
    last = extensions.frame_lag_frames
    left = max(last - first, 0)
    return (extensions.frame_lag_s * left / last if last else 0.0), left


def _exposures(frames: Sequence[Frame], captures: int, scene: int) -> Exposures:
    """Logged exposure times and ISO; light is their product relative to capture ``scene``, 1 if an ISO is missing."""
    padded = [*frames, *[frames[-1]] * (captures - len(frames))]
    exposure_s = np.array([frame.exposure_s or 0.0 for frame in padded])
    iso = np.array([round(frame.iso) if frame.iso else NOMINAL_ISO for frame in padded], np.int64)
    known = all(frame.iso for frame in frames)
    light = exposure_s * iso if known else np.ones(captures)
    return Exposures(exposure_s, iso, light / light[scene])


def _cut_imu(capture: Capture, begin_s: float, lasting_s: float, true: CameraProfile) -> tuple[ImuLog, Array]:
    """Inertial samples of the capture and their times in seconds from the first frame.

    All samples if the frames span the whole capture, else those within IMU_MARGIN_S of the frames.  With a stabiliser
    the samples before the frames are kept, since it is at rest at the capture's first sample.
    """
    imu, rows = capture.imu, np.arange(len(capture.imu))
    first_s = begin_s + (true.time_offset_s or 0.0) - IMU_MARGIN_S
    last_s = begin_s + (true.time_offset_s or 0.0) + lasting_s * (1 + true.clock_skew) + IMU_MARGIN_S
    last_s += true.extensions.frame_lag_s + true.shutter.readout_time_s
    whole = begin_s == capture.frames[0].time_s and begin_s + lasting_s == capture.frames[-1].time_s
    inside = (imu.time_s <= last_s) & ((imu.time_s >= first_s) | bool(true.extensions.stabilisation_fraction))
    rows = rows if whole else rows[inside]
    time_ns = capture.stamp_0_ns + np.rint(imu.time_s[rows] * 1e9).astype(np.int64)
    log = ImuLog(time_ns, imu.gyro_rad_s[rows], imu.accel_m_s2[rows])
    return log, imu.time_s[rows] - begin_s


def _logged_focus(frames: Sequence[Frame]) -> Hidden:
    """Focus distances as logged by the recorder, interpolated over time."""
    known = [frame for frame in frames if frame.focus_dioptres is not None]
    if not known:
        return NOTHING
    times = np.array([frame.time_s - frames[0].time_s for frame in known])
    dioptres = np.array([frame.focus_dioptres for frame in known], float)
    return Hidden(focus_dioptres=lambda time_s: np.interp(time_s, times, dioptres))


def _slot_gain(true: CameraProfile, shows: NDArray[np.int64], slot: int) -> float:
    """Hidden gain of a slot's capture: that of the first slot that shows it."""
    return float(true.extensions.gain_of(int(np.argmax(shows == shows[slot]))))


def _require_ahead(motion: HandMotion, view: View, session: Session, shows: NDArray[np.int64]) -> None:
    """Raise CaptureError if a frame's viewing direction falls outside the scene plane."""
    right, below = float(np.abs(view.x).max()), float(np.abs(view.y).max())
    corners = np.array([[i, j, 1.0] for i in (-right, right) for j in (-below, below)])
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    turns = motion.rotation(np.array([session.first_row_start_s(int(k)) for k in shows])).as_matrix()
    ahead = np.einsum("tj,kj->tk", turns[:, 2], corners).min(axis=1)
    if ahead.min() < LEAST_AHEAD:
        far = int(np.argmin(ahead))
        raise CaptureError(
            f"frame {far} of those selected looks {np.degrees(np.arccos(turns[far, 2, 2])):.0f} degrees past the "
            "picture that the scene is made of",
            hint="choose fewer frames with --frames A:B",
        )


def _scene(
    scene: ScenePicture, view: View, motion: HandMotion, seen_s: float, gain: float, oversampling: float
) -> Scene:
    """Chart at infinity from the picture's light, in the viewing direction at ``seen_s``; mirrored beyond valid_px."""
    profile = view.profile
    curve = profile.curve
    factor = sensor_light(np.ones((profile.height, profile.width, 1), np.float32), profile, gain, defocus=False)
    light = curve.linearise(scene.picture.astype(np.float32) / 255).astype(np.float32) / np.maximum(
        factor, _LEAST_FACTOR
    )
    x, y = view.rays(seen_s, slice(None), slice(None))
    reach = [_CHART_MARGIN * float(np.abs(plane).max()) for plane in (x, y)]
    lens = profile.intrinsics
    assert lens is not None
    focal = oversampling * max(lens.fx_px, lens.fy_px)
    focal = min(focal, float(np.sqrt(MAX_CHART_PX / (4 * reach[0] * reach[1]))))
    width, height = (2 * int(np.ceil(extent * focal)) for extent in reach)
    u, v = np.meshgrid((np.arange(width) - (width - 1) / 2) / focal, (np.arange(height) - (height - 1) / 2) / focal)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ motion.rotation(np.array([seen_s])).as_matrix()[0]
    x0, y0, x1, y1 = scene.valid_px if scene.valid_px[2] > scene.valid_px[0] else (0, 0, profile.width, profile.height)
    source = (_pixels(view, rays, seen_s) - [x0, y0]).astype(np.float32)
    valid = np.ascontiguousarray(light[y0:y1, x0:x1])
    chart = cv2.remap(valid, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return Scene(np.maximum(chart, 0.0), focal)


def _pixels(view: View, rays: Array, time_s: float) -> Array:
    """Pixels (..., 2) whose rays at a time are (..., 3): the inverse of :meth:`View.rays`."""
    profile, lens = view.profile, view.profile.intrinsics
    assert lens is not None
    plane = rays[..., :2] / rays[..., 2:]
    if len(view.lens_s):
        pitch, yaw = (np.interp(time_s, view.lens_s, view.lens_rad[:, i]) for i in (0, 1))
        plane = plane + np.array([yaw, -pitch])
    pixels = lens.project(np.concatenate([plane, np.ones_like(plane[..., :1])], -1))
    if not focal_changes(profile, view.hidden):
        return pixels
    centre, seen = np.array([lens.cx_px, lens.cy_px]), pixels
    for _ in range(_RADIUS_ITERATIONS):
        radius_px = seen_radius_px(profile, seen[..., 0], seen[..., 1])
        seen = centre + (pixels - centre) * focal_scale(profile, view.hidden, time_s, radius_px)[..., None]
    return seen


_NO_SCENE = Scene(np.zeros((2, 2, 3), np.float32), 1.0)
_NO_VIEW = View(CameraProfile(2, 2), np.zeros((1, 2)), np.zeros((2, 1)), None, None, np.empty(0), np.empty((0, 2)))
