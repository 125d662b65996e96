"""``virest simulate OUT --like CAPTURE``: re-create a measured capture in the simulator, with known ground truth."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.simulate import recording_facts
from virest.camera.profile import CameraProfile
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.join import median_period_s
from virest.capture.pictures import is_picture_source, read_picture_list
from virest.capture.records import Capture, Frame
from virest.capture.video import probe_movie, read_decodable_gray, read_frames
from virest.errors import CaptureError, OutputError, SettingsError, VirestError
from virest.motion.integration import integrate_gyro
from virest.motion.trajectory import vector_from_rotation
from virest.restoration.capture import RestorationPlan, at_true_times, restore_frames
from virest.restoration.capture_estimation import plan_restoration
from virest.restoration.settings import PRESETS
from virest.simulation.effects import EffectContext, hidden_isp, hide_effects
from virest.simulation.recording import RecordingOptions, write_recording
from virest.simulation.recreation import ScenePicture, known_frames, recreate_session
from virest.simulation.session import SessionSettings

log = logging.getLogger(__name__)

Json = dict[str, Any]
NEAREST_PART = 0.25
"""The scene is the frame with the least motion among this fraction of frames, those nearest the mean view."""
MAX_TRIES = 5
"""Frames to restore as the scene before giving up."""
MOST_PICTURES = 64
"""Number of image files that are measured for the bits per pixel of a capture without a movie."""
BITS_PER_PX = (0.03, 2.0)
"""The recording's own bit rate is used, within these limits."""


def simulate_like(
    out: Path,
    like: Path,
    *,
    config: Path | None = None,
    frames: slice | None = None,
    noise_levels: float = 1.5,
    effects: Sequence[str] = (),
    reference: str = "exposure-start",
    seed: int = 0,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Json:
    """Write a capture with the timestamps, exposures, inertial samples, size and profile of another; returns a summary.

    The scene is one of its frames, restored.  effects: stated only in ``truth/``, as in any simulation.
    """
    if Path(out).resolve() == Path(like).resolve():
        raise OutputError(f"{out}: is the capture to re-create", hint="name another folder")
    capture = read_capture(like)
    given, source = resolve_profile(capture, config)
    log.info("%s: camera profile from %s", capture.name, source)
    kept = _kept(capture, frames)
    plan = scene_plan(capture, given)
    for warning in (*plan.warnings, *([plan.copy_reason] if plan.copy_reason else [])):
        log.warning("%s: %s", capture.name, warning)
    nominal = plan.profile
    scene = find_scene(capture, plan, kept)
    context = EffectContext(len(kept), _fps(kept), np.random.default_rng([seed, 5]))
    true, applied = hide_effects(nominal, list(effects), context)
    settings = SessionSettings(noise_levels=noise_levels, seed=seed, isp=hidden_isp(applied))
    session = recreate_session(capture, kept, nominal, true, scene, settings)
    options = RecordingOptions(bits_per_px=_bits_per_px(capture), middle_truth=reference == "frame-middle")
    folder = write_recording(session, out, applied=applied, options=options, overwrite=overwrite, progress=progress)
    return {
        "capture": str(folder),
        "like": str(capture.folder),
        **recording_facts(session, f"frame {scene.frame}, restored", round(session.settings.fps, 4), _range_ms(kept)),
        "effects": [dataclasses.asdict(effect) for effect in applied],
    }


def count_frames(like: Path, frames: slice | None = None) -> int:
    """Number of frames to render, for the progress bar; 0 if the capture cannot be read."""
    try:
        capture = read_capture(like, look_at_pictures=False)
    except VirestError:  # reported when rendering starts
        return 0
    return len(known_frames(capture.frames[frames or slice(None)]))


def scene_plan(capture: Capture, profile: CameraProfile) -> RestorationPlan:
    """The capture's restoration plan, unknown values estimated. Raises SettingsError without a focal length."""
    read = partial(read_decodable_gray, capture.movie, probe_movie(capture.movie))
    plan = plan_restoration(capture, profile, PRESETS["balanced"], read)
    if plan.profile.intrinsics is None:
        raise SettingsError(
            f"{capture.name}: {plan.copy_reason or 'focal length unknown'}", hint="--config takes a camera profile"
        )
    return plan


def find_scene(capture: Capture, plan: RestorationPlan, frames: Sequence[Frame]) -> ScenePicture:
    """Restore the frame that becomes the scene: near the mean view, with little motion."""
    for number in _scene_order(capture, plan.profile, frames)[:MAX_TRIES]:
        scene = restored_scene(capture, plan, number)
        if scene is not None:
            return scene
    raise CaptureError(f"{capture.name}: no frame can be restored as the scene", hint="virest process shows why")


def restored_scene(capture: Capture, plan: RestorationPlan, number: int) -> ScenePicture | None:
    """One restored frame, or the decoded frame if it is copied; None if it is not available."""
    frames = at_true_times(capture.frames, plan.profile, capture.repeats)
    frame = dataclasses.replace(frames[number], skip_reason=None, skip_codes=())
    _, picture = next(read_frames(capture.movie, probe_movie(capture.movie), number, number), (number, None))
    restored = next(restore_frames([(frame, picture)], capture.imu, plan), None)
    if restored is None or restored.picture is None:
        return None
    return ScenePicture(restored.picture, number, restored.valid_px)


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _kept(capture: Capture, frames: slice | None) -> tuple[Frame, ...]:
    if frames is not None and frames.step not in (None, 1):
        raise SettingsError("--like needs consecutive frames", hint="write --frames A:B")
    chosen = capture.frames[frames or slice(None)]
    kept = known_frames(chosen)
    if len(kept) < len(chosen):
        log.warning("%s: skipped %d frames without time or motion", capture.name, len(chosen) - len(kept))
    if not kept:
        raise CaptureError(f"{capture.name}: --frames selects no frame", hint=f"it has {len(capture.frames)}")
    return kept


def _scene_order(capture: Capture, profile: CameraProfile, frames: Sequence[Frame]) -> list[int]:
    """Movie indices, best scene first: by least motion within the frames nearest the mean view."""
    trajectory = integrate_gyro(capture.imu, profile)
    usable = [frame for frame in frames if frame.skip_reason is None] or list(frames)
    time_s = np.array([float(profile.imu_time_s(frame.time_s)) for frame in usable])
    turned = trajectory.orientation(time_s)
    u, _, v = np.linalg.svd(turned.mean(axis=0))
    away = np.linalg.norm(vector_from_rotation(turned @ (u @ v).T), axis=-1)
    streak = np.linalg.norm(trajectory.rate_rad_s(time_s), axis=-1) * [frame.exposure_s or 0.0 for frame in usable]
    near = away <= np.quantile(away, NEAREST_PART)
    order = np.lexsort((streak, ~near))
    return [usable[i].index for i in order]


def _fps(frames: Sequence[Frame]) -> float:
    period_s = median_period_s(np.array([frame.time_s for frame in frames]))
    return 1 / period_s if len(frames) > 1 else 30.0


def _bits_per_px(capture: Capture) -> float:
    """Bits per pixel of the movie, or of listed image files: the mean of evenly spaced ones."""
    if is_picture_source(capture.movie):
        found = read_picture_list(capture.movie)
        files = [found.base / name for name in found.names[:: -(-len(found.names) // MOST_PICTURES)]]
        frame_bytes = float(np.mean([file.stat().st_size for file in files]))
    else:
        frame_bytes = capture.movie.stat().st_size / len(capture.frames)
    return float(np.clip(8 * frame_bytes / (capture.width * capture.height), *BITS_PER_PX))


def _range_ms(frames: Sequence[Frame]) -> list[float]:
    exposures = sorted({round(1000 * (frame.exposure_s or 0.0), 4) for frame in frames})
    return exposures if len(exposures) == 1 else [exposures[0], exposures[-1]]
