"""``virest export CAPTURE``: frames and inertial samples in the folder layouts that SLAM tools read, without ROS.

    euroc   mav0/cam0/{data/<ns>.png, data.csv, sensor.yaml}, mav0/imu0/{data.csv, sensor.yaml}, dso/cam0/times.txt
    tum     rgb/<s>.png, rgb.txt, accelerometer.txt, imu.txt
    nerfstudio, colmap, gyroflow    see export_scenes
    both    camchain-imucam.yaml, imu.yaml, orb_slam3.yaml, times.txt, camera.yaml, export.json

All data use one clock: samples are converted to the camera's by the profile's offset and skew.  Frames keep their
logged timestamps (``stamps: logged``); ``timeshift_cam_imu`` leads to the instant that a frame shows: its middle, or
the reference of a restored frame.  For tools without such a shift (ORB-SLAM3), ``stamps: instant`` writes that instant.
"""

from __future__ import annotations

import logging
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest import __version__
from virest.app.export_plan import (
    RECORD,
    SCENES,
    ExportFrame,
    ExportOptions,
    ExportPlan,
    Json,
    plan_export,
)
from virest.app.export_scenes import colmap_files, frame_poses, gyroflow_profile, transforms_json
from virest.app.outputs import json_text, output_error, write_picture
from virest.arrays import Array
from virest.camera.kalibr import ImuNoise, format_camchain, format_imu
from virest.camera.orb_slam import format_orb_slam
from virest.camera.profile_file import format_profile
from virest.camera.yaml_mapping import commented
from virest.capture.euroc import (
    format_camera_sensor,
    format_exposure_times,
    format_imu_rows,
    format_imu_sensor,
    format_picture_list,
    seconds,
)
from virest.capture.join import median_period_s
from virest.capture.video import probe_movie, read_frames
from virest.errors import CaptureError

__all__ = ["ExportOptions", "plan_export", "run_export"]

log = logging.getLogger(__name__)

PICTURES = {"euroc": "mav0/cam0/data", "tum": "rgb"}
"""Image folder of a format; ``images`` for the others."""


# ── write ────────────────────────────────────────────────────────────────────────────────────────────────────────


def run_export(plan: ExportPlan, progress: Callable[[int], Any] | None = None) -> tuple[Json, str]:
    """Write the folder; returns the mapping for ``--json`` and the printed lines.

    progress is called with 1 for each frame.  The folder is written atomically.  Raises OutputError.
    """
    step = progress or (lambda _: None)
    with _whole_folder(plan.target) as part:
        if plan.options.format == "gyroflow":
            return _write_lens_profile(plan, part)
        written = _write_pictures(plan, part, step)
        if not written:
            raise CaptureError(f"{plan.capture.name}: no frame can be decoded", hint="copy the movie again")
        if plan.options.format in SCENES:
            _write_scene(plan, written, part)
        else:
            _write_tables(plan, written, part)
        facts = _facts(plan, written)
        _write(part / RECORD, json_text(facts))
    return facts, describe(facts)


def _write_lens_profile(plan: ExportPlan, part: Path) -> tuple[Json, str]:
    """Write only Gyroflow's lens profile; Gyroflow reads the gyroscope data from the capture."""
    if plan.profile.intrinsics is None:
        raise CaptureError(
            f"{plan.capture.name}: the focal length is unknown", hint="fit it with virest calibrate --with focal"
        )
    rate_hz = _rate_hz([frame.time_ns for frame in plan.frames])
    text, error_px = gyroflow_profile(replace(plan.profile, intrinsics=plan.standard.intrinsics), rate_hz)
    _write(part / "lens.json", text)
    facts = _facts(plan, list(plan.frames)) | {"frames": 0, "lens_error_px": error_px}
    _write(part / RECORD, json_text(facts))
    readout = f"{1e3 * plan.profile.shutter.readout_time_s:.2f} ms" if plan.profile.readout_known else "unknown"
    lines = [
        f"{plan.capture.name}: lens profile for Gyroflow, readout {readout}",
        f"its fisheye model matches this lens within {error_px:.2f} px",
        f"wrote {plan.target / 'lens.json'}",
    ]
    return facts, "\n".join(lines)


def _write_scene(plan: ExportPlan, frames: list[ExportFrame], part: Path) -> None:
    """Write the files that nerfstudio or COLMAP reads in addition to the images."""
    poses = frame_poses(plan, frames, [_picture_name(plan, frame) for frame in frames])
    if plan.options.format == "nerfstudio":
        files = {"transforms.json": transforms_json(plan, poses)}
    else:
        files = colmap_files(plan, poses)
    for name, text in files.items():
        _write(part / name, text)
    _write(part / "camera.yaml", commented(_header_comments(plan)) + format_profile(plan.profile))


@contextmanager
def _whole_folder(target: Path) -> Iterator[Path]:
    """A temporary folder that is renamed to its target at the end; an existing target is kept until then."""
    mark = secrets.token_hex(4)
    part = target.with_name(f".{target.name}.{mark}.part")
    try:
        part.mkdir(parents=True)
        yield part
        old = target.with_name(f".{target.name}.{mark}.old")
        if target.exists():
            target.rename(old)
        part.rename(target)
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise output_error(target, error) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write_pictures(plan: ExportPlan, part: Path, step: Callable[[int], Any]) -> list[ExportFrame]:
    """Write the images; returns the written frames and counts those that cannot be decoded."""
    folder = part / PICTURES.get(plan.options.format, "images")
    folder.mkdir(parents=True)
    written = []
    for frame, picture in _pictures(plan):
        place = folder / _picture_name(plan, frame)
        if isinstance(picture, Path):
            shutil.copyfile(picture, place)
        elif picture is None:
            plan.left_out["cannot be decoded"] = plan.left_out.get("cannot be decoded", 0) + 1
            log.warning("%s: frame %d cannot be decoded", plan.capture.name, frame.index)
        else:
            write_picture(place, picture)
        if picture is not None:
            written.append(frame)
        step(1)
    return written


def _picture_name(plan: ExportPlan, frame: ExportFrame) -> str:
    if plan.options.format in SCENES:
        return f"{frame.index:06d}.png"
    return f"{frame.time_ns}.png" if plan.options.format == "euroc" else f"{seconds(frame.time_ns)}.png"


def _pictures(plan: ExportPlan) -> Iterator[tuple[ExportFrame, Path | NDArray[np.uint8] | None]]:
    if plan.options.restored is not None:
        for frame in plan.frames:
            yield frame, frame.picture
        return
    wanted = {frame.index: frame for frame in plan.frames}
    movie = plan.capture.movie
    for index, picture in read_frames(movie, probe_movie(movie), min(wanted), max(wanted)):
        if index in wanted:
            yield wanted[index], picture


def _write_tables(plan: ExportPlan, frames: list[ExportFrame], part: Path) -> None:
    """Write file lists, samples, and the calibration of camera and IMU."""
    times = [frame.time_ns for frame in frames]
    imu = plan.capture.imu
    accel = _without_holes(imu.time_s, imu.accel_m_s2)
    rows = format_imu_rows(plan.imu_time_ns, plan.gyro_rad_s, accel)
    rate_hz = _rate_hz(times)
    if plan.options.format == "euroc":
        _write(part / "mav0/cam0/data.csv", format_picture_list(times))
        _write(part / "mav0/imu0/data.csv", rows)
        noise = plan.noise or ImuNoise(1.0 / median_period_s(imu.time_s), None, None)
        _write(part / "mav0/imu0/sensor.yaml", format_imu_sensor(noise, _header_comments(plan)))
        if all(frame.exposure_s is not None for frame in frames):
            exposures = [frame.exposure_s or 0.0 for frame in frames]
            _write(part / "dso/cam0/times.txt", format_exposure_times(times, exposures))
    else:
        listed = "".join(f"{seconds(time)} rgb/{seconds(time)}.png\n" for time in times)
        _write(part / "rgb.txt", f"# color images\n# file: '{plan.capture.name}'\n# timestamp filename\n{listed}")
        _write(part / "imu.txt", _tum_imu(rows))
        if imu.has_accelerometer:
            _write(part / "accelerometer.txt", _tum_accelerometer(plan.imu_time_ns, accel))
    _write(part / "times.txt", "".join(f"{time}\n" for time in times))
    _write(part / "camera.yaml", commented(_header_comments(plan)) + format_profile(plan.profile))
    if plan.noise is not None:
        _write(part / "imu.yaml", format_imu(plan.noise, "export"))
    if plan.profile.intrinsics is not None:
        _write_calibration(plan, part, rate_hz)


def _write_calibration(plan: ExportPlan, part: Path, rate_hz: float) -> None:
    lens = plan.standard.intrinsics
    if lens is not None and lens.model == "none":
        # readers of camera chains support radtan and equidistant, but rarely a lens without distortion
        lens = replace(lens, model="radtan", coefficients=(0.0,) * 5)
    known = plan.profile.time_offset_s is not None
    base = replace(plan.standard, intrinsics=lens, time_offset_s=0.0 if known else None)
    chain = format_camchain(base, command="export", instant_s=plan.instant_s)
    _write(part / "camchain-imucam.yaml", chain)
    _write(part / "orb_slam3.yaml", format_orb_slam(plan.standard, rate_hz, plan.noise, _header_comments(plan)))
    if plan.options.format == "euroc":
        _write(part / "mav0/cam0/sensor.yaml", format_camera_sensor(plan.standard, rate_hz, _header_comments(plan)))


def _header_comments(plan: ExportPlan) -> list[str]:
    """Comments for the written files: the kind of the frames, and the meaning of their timestamps."""
    kind = "restored by virest process" if plan.options.restored else "as recorded"
    return [
        f"{plan.capture.name}, pictures {kind}; profile from {Path(plan.source).name}",
        f"a frame shows the instant {1e3 * plan.instant_s:.4f} ms after its timestamp",
        *(note.text for note in plan.notes if not note.on_stamps),
    ]


def _rate_hz(times_ns: list[int]) -> float:
    period_s = median_period_s(np.array(times_ns) / 1e9 - times_ns[0] / 1e9)
    return round(1.0 / period_s, 3) if period_s else 1.0


def _without_holes(time_s: Array, accel: Array) -> Array:
    """Accelerations with missing rows interpolated linearly; all NaN without an accelerometer."""
    known = np.isfinite(accel).all(axis=1)
    if known.all() or not known.any():
        return accel
    return np.stack([np.interp(time_s, time_s[known], accel[known, axis]) for axis in range(3)], axis=1)


def _tum_imu(rows: str) -> str:
    """TUM-VI's imu.txt: EuRoC's rows, with spaces."""
    body = rows.partition("\n")[2].replace(",", " ")
    return "# timestamp[ns] w.x w.y w.z a.x a.y a.z\n" + body


def _tum_accelerometer(time_ns: NDArray[np.int64], accel: Array) -> str:
    head = "# accelerometer data\n# timestamp ax ay az\n"
    rows = zip(time_ns.tolist(), accel.tolist(), strict=True)
    return head + "".join(f"{seconds(time)} {' '.join(map(repr, row))}\n" for time, row in rows)


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


# ── results ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _facts(plan: ExportPlan, frames: list[ExportFrame]) -> Json:
    return {
        "virest_export": 1,
        "version": __version__,
        "capture": plan.capture.name,
        "folder": str(plan.target),
        "format": plan.options.format,
        "pictures": "restored" if plan.options.restored else "raw",
        "stamps": plan.options.stamps,
        "frames": len(frames),
        "left_out": dict(plan.left_out),
        "span_ns": [frames[0].time_ns, frames[-1].time_ns],
        "imu_rows": len(plan.imu_time_ns),
        "instant_after_stamp_s": plan.instant_s,
        "time_offset_known": plan.profile.time_offset_s is not None,
        "profile_source": plan.source,
        "notes": [note.text for note in plan.notes],
    }


def describe(facts: Json) -> str:
    """The printed lines."""
    span_s = (facts["span_ns"][1] - facts["span_ns"][0]) / 1e9
    lines = [
        f"{facts['capture']}: {facts['frames']} {facts['pictures']} frames over {span_s:.2f} s and "
        f"{facts['imu_rows']} IMU samples in {facts['format']} format"
    ]
    lines += [f"left out: {number} frames ({reason})" for reason, number in facts["left_out"].items()]
    lines.append(f"a frame shows the instant {1e3 * facts['instant_after_stamp_s']:.2f} ms after its timestamp")
    return "\n".join([*lines, f"wrote {facts['folder']}"])
