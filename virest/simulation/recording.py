"""Write a session as a MARSLogger Android capture folder with its ground truth.

Outside ``truth/`` the folder contains only what a phone logs and what the nominal profile claims.  It appears complete
or not at all.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from virest.arrays import Picture
from virest.camera.profile_file import write_profile
from virest.capture.join import TICKS_PER_S
from virest.capture.pixels import BT601
from virest.errors import OutputError, SettingsError
from virest.simulation.effects import AppliedEffect
from virest.simulation.session import (
    ImuLog,
    Session,
    phone_pictures,
    render_picture,
    render_truth,
    sample_imu,
)

LAYOUTS = ("2021", "v2.0")
"""With Unix-time columns (builds after April 2021) and without (the release tagged v2.0)."""
CLOCKS = ("REALTIME", "UNKNOWN")
_UNIX_MINUS_BOOT_NS = 1_663_377_777_000_000_000
"""The phone was started on 2022-09-17."""
_SLEPT_NS = 22_319_432_485_000
"""CLOCK_BOOTTIME − CLOCK_MONOTONIC: time that the phone has spent asleep."""
_EPOCH_JITTER_NS = 8_301
"""Time between the reading of two clocks for edge_epochs.txt."""
_TRAJECTORY_STEP_S = 1e-3
"""Finer than the samples, so that interpolation between its rows is exact enough for truth."""
_PNG_OPTIONS = [
    cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG,
]  # fmt: skip
"""Same file size as trying all filters at level 1, in 60 % of the time."""
FOCUS_DIOPTRES = 0.16422288
"""Logged focus distance if the focus is constant."""
_EDGE_HEADER = """\
#Camera frame timestamp source according to CameraCharacteristics.SENSOR_INFO_TIMESTAMP_SOURCE is \
SENSOR_INFO_TIMESTAMP_SOURCE_{source}.
#If SENSOR_INFO_TIMESTAMP_SOURCE is SENSOR_INFO_TIMESTAMP_SOURCE_REALTIME, then camera frame timestamps of the \
attribute CaptureResult.SENSOR_TIMESTAMP
#and IMU reading timestamps of the field SensorEvent.timestamp are on the same timebase CLOCK_BOOTTIME which is used \
by elapsedRealtimeNanos().
#In this case, no offline sync is necessary.
#Otherwise, the camera frame timestamp is assumed to be on the timebase of CLOCK_MONOTONIC which is generally used by \
nanoTime().
#To sync camera frames to the IMU, the timestamps of both time bases at the start and end of a session are recorded.
#IMU data clock\tSENSOR_INFO_TIMESTAMP_SOURCE_UNKNOWN camera clock\tDifference
#elapsedRealtimeNanos()\tnanoTime()\tDifference
"""


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """File format options."""

    layout: str = "2021"
    """One of LAYOUTS."""
    clock: str = "REALTIME"
    """Clock of the camera timestamps, one of CLOCKS."""
    bits_per_px: float = 0.25
    """Bit rate per pixel and frame; ignored with crf."""
    crf: float | None = None
    """x264 constant rate factor, in place of a bit rate; 0 is nearly lossless."""
    middle_truth: bool = False
    """Also write truth/frame_middle."""
    truth_frames: bool = True
    """Write truth/frames."""


def truth_picture(capture: Path, frame: int, kind: str = "frames") -> Path:
    """Path of the truth of a frame; kind: ``frames`` (at the start of the first row) or ``frame_middle``."""
    return capture / "truth" / kind / f"{frame:06d}.png"


def write_recording(
    session: Session,
    out: Path,
    *,
    applied: tuple[AppliedEffect, ...] = (),
    options: RecordingOptions | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render and write a capture folder: its path.

    overwrite: replace an existing simulated capture.  progress(done, total) is called after each frame.  Raises
    OutputError if ``out`` is a file, or a non-empty folder without ``overwrite`` or not written by the simulator.
    """
    options = options or RecordingOptions()
    _require_options(options)
    out = Path(out)
    _require_free(out, overwrite)
    part = out.parent / f".{out.name}.part-{secrets.token_hex(4)}"
    try:
        part.mkdir(parents=True)
        _fill_folder(part, session, applied, options, progress)
        _put_in_place(part, out)
    except OSError as error:
        raise OutputError(f"{out}: {error.strerror or error}", hint="check space and permissions") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return out


def write_movie(
    path: Path, pictures: Iterable[Picture], ticks: NDArray[np.int64], fps: float, options: RecordingOptions
) -> None:
    """Encode H.264: yuv420p, BT.601 limited range, no B-frames, key frame every 30 frames, exact 90 kHz timestamps."""
    with av.open(str(path), "w", format="mp4") as container:
        stream: Any = None
        for picture, tick in zip(pictures, ticks.tolist(), strict=True):
            if stream is None:
                stream = _add_stream(container, picture.shape[1], picture.shape[0], fps, options)
            frame = av.VideoFrame.from_ndarray(yuv_planes(picture), format="yuv420p")
            frame.pts, frame.time_base = tick, Fraction(1, TICKS_PER_S)
            frame.colorspace, frame.color_range = 6, 1
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def yuv_planes(picture: Picture) -> Picture:
    """Convert RGB to rounded BT.601 limited-range Y, Cb, Cr, chroma subsampled 2 × 2: (3 h / 2, w), plane after plane.

    Chroma is sited at the left luma column, midway between two rows (the H.264 default): weights 1 2 1 horizontally,
    1 1 vertically.
    """
    height, width = picture.shape[:2]
    red, green, blue = (picture[..., i].astype(np.float32) for i in range(3))
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    planes = [np.rint(16 + luma * (219 / 255))]
    for difference, scale in ((blue - luma, 224 / 255 / 1.772), (red - luma, 224 / 255 / 1.402)):
        rows = 0.5 * (difference[0::2] + difference[1::2])
        left = np.concatenate([rows[:, :1], rows[:, 1:-1:2]], axis=1)
        planes.append(np.rint(128 + scale * (0.25 * left + 0.5 * rows[:, 0::2] + 0.25 * rows[:, 1::2])))
    flat = np.concatenate([plane.ravel() for plane in planes])
    return np.clip(flat, 0, 255).astype(np.uint8).reshape(height * 3 // 2, width)


# ── parts ──────────────────────────────────────────────────────────────────────────────────────────────────────────


def _require_options(options: RecordingOptions) -> None:
    for value, known, name in ((options.layout, LAYOUTS, "layout"), (options.clock, CLOCKS, "clock")):
        if value not in known:
            raise SettingsError(f"{name} '{value}' is not known", hint=f"use one of {', '.join(known)}")


def _require_free(out: Path, overwrite: bool) -> None:
    if not out.exists():
        return
    if not out.is_dir():
        raise OutputError(f"{out} is a file", hint="choose another name")
    if not any(out.iterdir()):
        return
    if not overwrite:
        raise OutputError(f"{out} exists and is not empty", hint="choose another folder, or pass --overwrite")
    if not (out / "truth" / "effects.json").is_file():
        raise OutputError(f"{out} holds something else, not a simulated capture", hint="choose another folder")


def _put_in_place(part: Path, out: Path) -> None:
    """Rename the finished folder to ``out``; an existing folder is moved aside first and then deleted."""
    aside = part.with_name(part.name + ".old")
    if out.exists():
        os.replace(out, aside)
    try:
        os.replace(part, out)
    except OSError:
        if aside.exists():
            os.replace(aside, out)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _fill_folder(
    folder: Path,
    session: Session,
    applied: tuple[AppliedEffect, ...],
    options: RecordingOptions,
    progress: Callable[[int, int], None] | None,
) -> None:
    imu = sample_imu(session)
    truth = folder / "truth"
    for name in ("frames",) * options.truth_frames + ("frame_middle",) * options.middle_truth:
        (truth / name).mkdir(parents=True)
    truth.mkdir(exist_ok=True)
    _write_stamps(folder, session, options)
    _write_metadata(folder, session, options)
    _write_imu(folder, imu, options)
    _write_edge_epochs(folder, imu, options)
    write_profile(session.nominal, folder / "camera.yaml")
    write_profile(session.true, truth / "camera.yaml")
    _write_trajectory(truth, session)
    _write_effects(truth, session, applied)
    pictures = _rendered(session, folder, options, progress)
    write_movie(folder / "movie.mp4", pictures, session.stamp_tick, session.settings.fps, options)


def _rendered(
    session: Session, folder: Path, options: RecordingOptions, progress: Callable[[int, int], None] | None
) -> Iterable[Picture]:
    """Yield each slot's frame and write its truth frames.  Repeated captures are not rendered again."""
    total = len(session.shows)
    phone = phone_pictures(session)
    picture: Picture | None = None
    for slot in range(total):
        if picture is None or session.shows[slot] != session.shows[slot - 1]:
            picture = render_picture(session, slot, phone)
        if options.truth_frames:
            _write_png(truth_picture(folder, slot), render_truth(session, slot))
        if options.middle_truth:
            _write_png(truth_picture(folder, slot, "frame_middle"), render_truth(session, slot, middle=True))
        if progress:
            progress(slot + 1, total)
        yield picture


def _add_stream(container: Any, width: int, height: int, fps: float, options: RecordingOptions) -> Any:
    stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    stream.time_base = Fraction(1, TICKS_PER_S)
    coder = stream.codec_context
    coder.time_base, coder.gop_size, coder.max_b_frames = Fraction(1, TICKS_PER_S), 30, 0
    coder.thread_count = 1
    coder.colorspace, coder.color_range = BT601, 1
    coder.color_primaries, coder.color_trc = BT601, BT601
    stream.options = {"preset": "veryfast", "profile": "baseline", "x264-params": "scenecut=0:keyint=30:min-keyint=30"}
    if options.crf is None:
        stream.bit_rate = int(options.bits_per_px * width * height * fps)
    else:
        stream.options = {**stream.options, "crf": f"{options.crf:g}"}
    return stream


def _write_png(path: Path, picture: Picture) -> None:
    if not cv2.imwrite(str(path), picture[..., ::-1], _PNG_OPTIONS):
        raise OutputError(f"{path} cannot be written", hint="check space and permissions")


def _unix_ns(boot_ns: int, delay_ns: int = 0) -> int:
    """Unix time of a callback, truncated to milliseconds as the app prints it."""
    return (boot_ns + delay_ns + _UNIX_MINUS_BOOT_NS) // 1_000_000 * 1_000_000


def _logged_ns(stamp_ns: int, options: RecordingOptions) -> int:
    """Convert a camera timestamp to the clock that the phone logs."""
    return stamp_ns - (_SLEPT_NS if options.clock == "UNKNOWN" else 0)


def _write_table(path: Path, columns: list[str], rows: Iterable[list[str]], options: RecordingOptions) -> None:
    """Write CSV as the app does; layout v2.0 omits the last (Unix time) column."""
    unix = options.layout == "2021"
    last = None if unix else -1
    separator = ", " if path.name == "gyro_accel.csv" and not unix else ","
    lines = [separator.join(columns[:last])] + [",".join(row[:last]) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _write_stamps(folder: Path, session: Session, options: RecordingOptions) -> None:
    rows = ([str(_logged_ns(t, options)), str(_unix_ns(t, 150_000_000))] for t in session.stamp_ns.tolist())
    _write_table(
        folder / "frame_timestamps.txt", ["Frame timestamp[nanosec]", "Unix time[nanosec]"], rows, options
    )  # fmt: skip


def _write_metadata(folder: Path, session: Session, options: RecordingOptions) -> None:
    """Write per-frame metadata as the phone reports it: nominal focal length and readout, logged exposure and ISO."""
    nominal, lens = session.nominal, session.nominal.intrinsics
    fx, fy = (f"{lens.fx_px:.7g}", f"{lens.fy_px:.7g}") if lens else ("1.0", "1.0")
    readout = round(nominal.shutter.readout_time_s * 1e9)
    rows = []
    last = len(session.stamp_ns) - 1
    late = nominal.extensions.exposures_late_frames + session.hidden.exposures_late_frames
    for k, stamp in enumerate(session.stamp_ns.tolist()):
        own = min(max(k - late, 0), last)
        exposure, iso = session.logged_exposure_s(own), int(session.exposures.iso[own])
        exposure /= float(nominal.extensions.exposure_gain_of(own))
        numbers = [
            _logged_ns(stamp, options),
            fx,
            fy,
            205 + k,
            round(exposure * 1e9),
            round(1e9 / session.settings.fps),
        ]
        focus = FOCUS_DIOPTRES
        if session.hidden.focus_dioptres is not None:
            focus = float(session.hidden.focus_dioptres(np.array((stamp - session.stamp_ns[0]) * 1e-9)))
        numbers += [readout, iso, nominal.focal_length_mm or 3.95, focus, 3]
        rows.append([str(n) for n in [*numbers, _unix_ns(stamp, 50_000_000)]])
    columns = ["Timestamp[nanosec]", "fx[px]", "fy[px]", "Frame No.", "Exposure time[nanosec]"]
    columns += [
        "Sensor frame duration[nanosec]",
        "Frame readout time[nanosec]",
        "ISO",
        "Focal length",
        "Focus distance",
    ]
    _write_table(folder / "movie_metadata.csv", [*columns, "AF mode", "Unix time[nanosec]"], rows, options)


def _write_imu(folder: Path, imu: ImuLog, options: RecordingOptions) -> None:
    values = np.concatenate([imu.gyro_rad_s, imu.accel_m_s2], axis=1).tolist()
    rows = (
        [str(t), *(f"{v:.8g}" for v in row), str(_unix_ns(t))]
        for t, row in zip(imu.time_ns.tolist(), values, strict=True)
    )
    columns = ["Timestamp[nanosec]", *(f"g{a}[rad/s]" for a in "xyz"), *(f"a{a}[m/s^2]" for a in "xyz")]
    _write_table(folder / "gyro_accel.csv", [*columns, "Unix time[nanosec]"], rows, options)


def _write_edge_epochs(folder: Path, imu: ImuLog, options: RecordingOptions) -> None:
    lines = []
    for boot, jitter in ((int(imu.time_ns[0]), -_EPOCH_JITTER_NS), (int(imu.time_ns[-1]), _EPOCH_JITTER_NS)):
        lines.append(f"{boot}\t{boot - _SLEPT_NS - jitter}\t{_SLEPT_NS + jitter}\n")
    text = _EDGE_HEADER.format(source=options.clock) + "".join(lines)
    (folder / "edge_epochs.txt").write_text(text, encoding="ascii")


def _write_trajectory(truth: Path, session: Session) -> None:
    """Write the camera pose in world axes (y down) every millisecond."""
    time_s = np.arange(session.imu_span_s[0], session.imu_span_s[1], _TRAJECTORY_STEP_S)
    table = np.column_stack([time_s, session.motion.position_m(time_s), session.motion.quat_world_cam(time_s)])
    header = "time_s,px_m,py_m,pz_m,qw,qx,qy,qz"
    lines = [",".join([f"{row[0]:.6f}", *(f"{v:.12g}" for v in row[1:])]) for row in table.tolist()]
    (truth / "trajectory.csv").write_text("\n".join([header, *lines]) + "\n", encoding="ascii")


def _write_effects(truth: Path, session: Session, applied: tuple[AppliedEffect, ...]) -> None:
    """Write the effects with their values, the session settings and the true capture time of each slot."""
    scene = session.scene
    slots = [
        {
            "frame": slot,
            "shows": capture,
            "first_row_start_s": round(session.first_row_start_s(capture), 9),
            "middle_s": round(session.middle_s(capture), 9),
            "exposure_s": session.true_exposure_s(capture),
            **({"light": float(session.exposures.light[capture])} if session.settings.auto_exposure else {}),
        }
        for slot, capture in enumerate(session.shows.tolist())
    ]
    content = {
        "effects": [{"name": a.name, "parameters": a.parameters} for a in applied],
        "settings": {k: v for k, v in asdict(session.settings).items() if k != "isp" and (k != "auto_exposure" or v)},
        **({"isp": session.settings.isp.in_force()} if session.settings.isp.in_force() else {}),
        "scene_plane": {"depth_m": scene.depth_m, "normal": list(scene.normal)},
        "times": "seconds on the IMU clock from stamp_0",
        "slots": slots,
    }
    text = json.dumps(_finite(content), indent=1, default=str, allow_nan=False)
    (truth / "effects.json").write_text(text + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    """A value that JSON can hold: infinities as the words of the contract, NaN as null."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return None if math.isnan(value) else "inf" if value > 0 else "-inf"
