"""The plan of an export, made before anything is written: frames, timestamps, profile, times of the samples."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from virest.app.outputs import capture_name
from virest.app.run_folder import RunFolder, read_lines
from virest.arrays import Array
from virest.camera.kalibr import ImuNoise, field_notes
from virest.camera.lens_fit import standard_lens
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import parse_profile
from virest.camera.recounting import counted_from, on_camera_clock
from virest.capture.files import label, scan_text
from virest.capture.folder import Capture, Frame, read_capture, require_folder, resolve_profile
from virest.capture.imu_noise import measure_imu_noise
from virest.capture.profile_source import for_capture, with_logged_focal
from virest.capture.records import STALL
from virest.errors import CaptureError, OutputError
from virest.image_formation.row_clock import RowClock
from virest.motion.integration import missing_rate_rad_s
from virest.restoration.capture import at_true_times

if TYPE_CHECKING:
    from virest.app.export_scenes import GivenPoses

log = logging.getLogger(__name__)

SCENES = ("nerfstudio", "colmap")
RECORD = "export.json"
PLAIN_PICTURES = ("restored", "copied")

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """The options of one export."""

    out: Path
    """Write the export to a folder named after the capture in here."""
    format: str = "euroc"
    restored: Path | None = None
    """A finished run of ``virest process``, whose frames replace the movie's."""
    config: Path | None = None
    frames: slice = field(default_factory=lambda: slice(None))
    """Selection by movie frame index."""
    stamps: str = "logged"
    overwrite: bool = False
    poses: Path | None = None
    """Camera trajectory (TUM format), for nerfstudio and COLMAP."""


@dataclass(frozen=True, slots=True)
class ExportFrame:
    """One frame to write."""

    index: int
    time_ns: int
    """The timestamp to write."""
    exposure_s: float | None
    picture: Path | None
    """File of the restored frame; None: decode the movie."""


@dataclass(frozen=True, slots=True)
class ExportNote:
    """A note for users of the export."""

    text: str
    on_stamps: bool = False
    """Whether the note explains the timestamps; the written files have their own text for that."""


@dataclass(frozen=True, slots=True)
class ExportPlan:
    """All decisions of an export, before anything is written."""

    target: Path
    capture: Capture
    options: ExportOptions
    frames: tuple[ExportFrame, ...]
    left_out: dict[str, int]
    """Number of omitted frames by reason."""
    profile: CameraProfile
    """Profile of the written frames and samples: their offset, shutter and timestamps, not the capture's."""
    instant_s: float
    """From a written timestamp to the instant that its frame shows."""
    imu_time_ns: NDArray[np.int64]
    noise: ImuNoise | None
    source: str
    notes: tuple[ExportNote, ...]
    camera: CameraProfile
    """Profile of the capture itself."""
    velocities: Mapping[int, list[float]]
    """Camera velocity in m/s, camera axes, by frame, if the run estimated it."""
    restored_start: bool
    """Whether restored frames show the start of the first row's exposure."""
    standard: CameraProfile
    """The profile in a form that other tools support: the closest standard lens model, no fields."""
    gyro_rad_s: Array
    """(n, 3) gyroscope readings including the profile's rate fields."""
    poses: GivenPoses | None = None


def plan_export(path: str, options: ExportOptions) -> ExportPlan:
    """Read the capture, and the run if given, and plan the export. Raises CaptureError, OutputError."""
    folder, target = require_folder(Path(path)), options.out / capture_name(path)
    _require_free(target, folder, options)
    capture = read_capture(folder)
    profile, source = resolve_profile(capture, options.config)
    pictures: dict[int, Path] | None = None
    velocities: dict[int, list[float]] = {}
    left_out: dict[str, int] = {}
    reference = "middle"
    if options.restored is not None:
        run = RunFolder(options.restored)
        account = _read_account(run, capture)
        profile, source = parse_profile(account["profile"], "run.json"), f"{options.restored.name}/run.json"
        profile = with_logged_focal(for_capture(profile, capture), capture)
        reference = account.get("settings", {}).get("reference", "exposure-start")
        pictures = _restored_pictures(run, capture, left_out)
        velocities = _velocities(run)
    chosen = _choose(capture, profile, options, pictures, left_out)
    if not chosen:
        why = ", ".join(f"{number} {reason}" for reason, number in left_out.items()) or "--frames selects none"
        raise CaptureError(f"{capture.name}: no frame to export: {why}", hint="see `virest inspect`")
    instants_s = _instants_s(chosen, profile, reference)
    frames = _stamped(chosen, capture, instants_s, options, pictures, left_out)
    written, instant_s = _written_profile(profile, instants_s, options)
    written = _for_frames(written, frames, capture, options)
    lens, off_px = (None, 0.0) if written.intrinsics is None else standard_lens(written.intrinsics)
    imu = capture.imu
    of_fields = (ExportNote(text) for text in field_notes(written, off_px))
    notes = (*_notes(capture, profile, options, instants_s), *of_fields)
    for note in notes:
        log.warning("%s: %s", capture.name, note.text)
    return ExportPlan(
        target=target,
        capture=capture,
        options=options,
        frames=frames,
        left_out=left_out,
        profile=written,
        instant_s=instant_s,
        imu_time_ns=_imu_time_ns(capture, profile),
        noise=measure_imu_noise(imu),
        source=source,
        notes=notes,
        camera=profile,
        velocities=velocities,
        restored_start=options.restored is not None and reference == "exposure-start",
        standard=replace(written, intrinsics=lens).with_fields(()),
        gyro_rad_s=_corrected_gyro(capture, profile),
        poses=None if options.poses is None else _read_poses(options.poses),
    )


def _require_free(target: Path, capture: Path, options: ExportOptions) -> None:
    """Raise OutputError if the target exists and is not an export that may be replaced."""
    for kept in (capture, options.restored):
        place = target.resolve()
        if kept is not None and (place == kept.resolve() or place in kept.resolve().parents):
            raise OutputError(f"{target}: would overwrite {kept}", hint="choose another folder with --out")
    if not target.exists() and not target.is_symlink():
        return
    if not (target / RECORD).is_file():
        raise OutputError(f"{target}: exists and is not a virest export", hint="choose another folder with --out")
    if not options.overwrite:
        raise OutputError(f"{target}: holds an export", hint="--overwrite replaces it, --out chooses another folder")


def _read_account(run: RunFolder, capture: Capture) -> Json:
    """run.json of a finished run of this capture."""
    try:
        account = json.loads(run.run_json.read_bytes())
    except (OSError, ValueError):
        account = None
    if not isinstance(account, dict) or not isinstance(account.get("profile"), dict) or account.get("failure"):
        raise CaptureError(f"{run.path}: holds no finished run", hint="pass OUT/<capture> of virest process")
    if account.get("capture") != capture.name:
        text = f"{run.path}: is a run of {str(account.get('capture'))[:60]!r}, not of {capture.name!r}"
        raise CaptureError(text, hint="pass the run of this capture")
    return account


def _restored_pictures(run: RunFolder, capture: Capture, left_out: dict[str, int]) -> dict[int, Path]:
    """File of each frame that the run has written. Raises CaptureError if its frames are not the capture's."""
    pictures: dict[int, Path] = {}
    try:
        lines = read_lines(run.parameters)
    except (OSError, ValueError, AttributeError):
        raise CaptureError(f"{run.parameters}: cannot be read", hint="run virest process again") from None
    for line in lines:
        index, status = int(line.get("frame", -1)), line.get("status")
        known = 0 <= index < len(capture.frames)
        if not known or line.get("timestamp_ns") != capture.frames[index].timestamp_ns:
            text = f"{run.parameters}: frame {index} is not one of {capture.name}: its stamp differs"
            raise CaptureError(text, hint="pass the run of this capture")
        picture = run.picture(index)
        if status in PLAIN_PICTURES and picture.is_file():
            pictures[index] = picture
        else:
            reason = str(status) if status not in PLAIN_PICTURES else "picture is missing"
            left_out[reason] = left_out.get(reason, 0) + 1
    return pictures


def _velocities(run: RunFolder) -> dict[int, list[float]]:
    """Camera velocity by frame, if the run estimated it."""
    motions = {line["frame"]: line.get("motion") or {} for line in read_lines(run.parameters)}
    return {number: motion["velocity_m_s"] for number, motion in motions.items() if motion.get("velocity_m_s")}


def _read_poses(path: Path) -> GivenPoses:
    from virest.app.export_scenes import GivenPoses

    scan_text(path, CaptureError, "a trajectory: time x y z qx qy qz qw")
    return GivenPoses(path.read_text(encoding="utf-8"), label(path))


def _choose(
    capture: Capture,
    profile: CameraProfile,
    options: ExportOptions,
    pictures: dict[int, Path] | None,
    left_out: dict[str, int],
) -> list[Frame]:
    """The frames to write: selected usable ones, or those that the run has written."""
    frames = at_true_times(capture.frames, profile, capture.repeats)
    chosen = [frames[i] for i in sorted(range(len(frames))[options.frames])]
    if pictures is not None:
        stalled = [frame for frame in chosen if frame.index in pictures and STALL in frame.skip_codes]
        if stalled:  # restored at times that the run estimated and the capture does not hold
            left_out["of an encoder's stall"] = len(stalled)
        return [frame for frame in chosen if frame.index in pictures and frame not in stalled]
    for frame in chosen:
        if frame.skip_reason is not None:
            reason = f"skipped: {', '.join(frame.skip_codes)}"
            left_out[reason] = left_out.get(reason, 0) + 1
    return [frame for frame in chosen if frame.skip_reason is None]


def _instants_s(frames: list[Frame], profile: CameraProfile, reference: str) -> Array:
    """(n,) seconds from each timestamp to the instant that its frame shows.

    reference: ``exposure-start`` of the first row, else the middle: half the readout and half the exposure later.
    """
    exposures_s = np.array([np.nan if frame.exposure_s is None else frame.exposure_s for frame in frames])
    usual_s = float(np.nanmedian(exposures_s)) if np.isfinite(exposures_s).any() else 0.0
    exposures_s = np.where(np.isfinite(exposures_s), exposures_s, usual_s)
    # samples are written on the camera's clock, and rows are late relative to an even readout
    even = profile.with_fields([field for field in profile.fields if field.kind != "delay"])
    clock = RowClock(replace(even, time_offset_s=0.0, clock_skew=0.0))
    instant = clock.time_s if reference == "exposure-start" else clock.middle_s
    return np.asarray(instant(np.zeros(len(frames)), exposures_s), np.float64)


def _stamped(
    chosen: list[Frame],
    capture: Capture,
    instants_s: Array,
    options: ExportOptions,
    pictures: dict[int, Path] | None,
    left_out: dict[str, int],
) -> tuple[ExportFrame, ...]:
    """The frames with the timestamps to write; repeats of the previous frame's time are omitted."""
    found: list[ExportFrame] = []
    for frame, instant_s in zip(chosen, instants_s.tolist(), strict=True):
        moved = frame.time_s != capture.frames[frame.index].time_s
        time_ns = capture.stamp_0_ns + round(frame.time_s * 1e9) if moved else frame.timestamp_ns
        time_ns += round(instant_s * 1e9) if options.stamps == "instant" else 0
        if found and time_ns <= found[-1].time_ns:
            left_out["repeats a frame"] = left_out.get("repeats a frame", 0) + 1
            continue
        exposure_s = None if pictures is not None else frame.exposure_s
        found.append(ExportFrame(frame.index, time_ns, exposure_s, pictures[frame.index] if pictures else None))
    return tuple(found)


def _written_profile(profile: CameraProfile, instants_s: Array, options: ExportOptions) -> tuple[CameraProfile, float]:
    """The profile of the written data, and the seconds from a written timestamp to the instant of its frame.

    Samples are on the camera's clock, so offset, skew and delay over time vanish, as do rate fields, which the samples
    include.  A restored frame has no readout and no exposure; a recorded one keeps both, and if its timestamp is moved
    to its middle, the first row is half a readout earlier.
    """
    logged = options.stamps == "logged"
    instant_s = float(np.median(instants_s)) if logged else 0.0
    shutter, offset_s = profile.shutter, 0.0
    if options.restored is not None:
        shutter = replace(shutter, readout_time_s=0.0, timestamp="exposure_start", uneven=None)
        offset_s = instant_s
    elif not logged:
        shutter = replace(shutter, timestamp="exposure_middle")
        offset_s = -0.5 * shutter.readout_time_s
    known = profile.time_offset_s is not None
    estimates = {k: v for k, v in profile.estimates.items() if k not in ("time_offset_s", "clock_skew")}
    trusted = replace(profile, imu_untrusted_s=profile.unbridged_s)
    corrected = trusted.with_fields([field for field in profile.fields if field.kind != "rate"])
    written = replace(
        on_camera_clock(corrected.with_extensions(gyro_misalignment_rad=(0.0, 0.0, 0.0))),
        shutter=shutter,
        readout_known=profile.readout_known or options.restored is not None,
        time_offset_s=offset_s if known else None,
        estimates=estimates,
    )
    return written, instant_s


def _for_frames(
    profile: CameraProfile, frames: tuple[ExportFrame, ...], capture: Capture, options: ExportOptions
) -> CameraProfile:
    """The profile for these frames alone: their gains, and time-dependent terms counted from the first of them.

    Restored frames have no flicker and no defocus, no frame lags its timestamp, and bridged stretches of the log can be
    trusted.
    """
    later_s = (frames[0].time_ns - capture.stamp_0_ns) / 1e9
    profile = counted_from(profile, later_s, frames[0].time_ns)
    ext, whole = profile.extensions, options.restored is None
    extensions = replace(
        ext,
        frame_lag_s=0.0,
        frame_lag_frames=0,
        exposures_late_frames=0,
        exposure_gain=(),
        gain=tuple(ext.gain[frame.index] for frame in frames) if ext.gain else (),
        flicker_amplitude=ext.flicker_amplitude if whole else 0.0,
        defocus_sigma_px=ext.defocus_sigma_px if whole else 0.0,
        field=tuple(field for field in ext.field if whole or field.kind != "blur"),
    )
    return replace(profile, extensions=extensions)


def _corrected_gyro(capture: Capture, profile: CameraProfile) -> Array:
    """Gyroscope readings (n, 3) corrected for misalignment and fields; bias, scale, filter and noise stay."""
    gyro, missing = capture.imu.gyro_rad_s, missing_rate_rad_s(capture.imu, profile)
    if missing is None and not any(profile.extensions.gyro_misalignment_rad):
        return gyro
    true = profile.true_rate_rad_s(gyro) + (0.0 if missing is None else missing)
    return np.asarray(true * np.array(profile.gyro_scale) + np.array(profile.gyro_bias_rad_s))


def _imu_time_ns(capture: Capture, profile: CameraProfile) -> NDArray[np.int64]:
    """Times of the samples on the camera's clock, whole nanoseconds, ascending."""
    camera_s = profile.camera_time_s(capture.imu.time_s)
    return np.asarray(capture.stamp_0_ns + np.rint(camera_s * 1e9).astype(np.int64), np.int64)


def _notes(capture: Capture, profile: CameraProfile, options: ExportOptions, instants_s: Array) -> list[ExportNote]:
    notes = []
    if profile.time_offset_s is None:
        notes.append(
            "the time offset between camera and IMU is unknown: samples keep their times; run `virest calibrate`"
        )
    if profile.intrinsics is None:
        notes.append("the focal length is unknown: no camera calibration is written; give --config, or calibrate")
    if rates := {field.covariates[0]: 1 for field in profile.fields if field.kind == "rate"}:
        over = ", ".join(rates)
        notes.append(f"gyroscope readings are written with the profile's rate fields over {over} added")
    if unbridged := profile.unbridged_s:
        spans = ", ".join(f"{begin:.2f} to {end:.2f} s" for begin, end in unbridged[:3])
        more = f" and {len(unbridged) - 3} more" if len(unbridged) > 3 else ""
        notes.append(f"the inertial log cannot be trusted from {spans}{more} after the first stamp: written as logged")
    if not capture.imu.has_accelerometer:
        notes.append("no accelerometer: its columns are nan, and tools can use the camera alone")
    found = [ExportNote(text) for text in notes]
    shift_ms = 1e3 * float(np.median(instants_s))
    if options.stamps == "logged" and abs(shift_ms) > 1.0:
        text = (
            f"a frame shows the instant {shift_ms:.1f} ms after its timestamp (timeshift_cam_imu); for tools without "
            "a time shift, such as ORB-SLAM3, export with --stamps instant"
        )
        found.append(ExportNote(text, on_stamps=True))
    return found
