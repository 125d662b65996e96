"""``virest import``: convert a ROS bag or MCAP file to a capture folder: images with timestamps, IMU, camera.yaml."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.outputs import output_error, write_picture, write_whole
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile_file import format_profile
from virest.capture.folder import read_capture
from virest.capture.profile_source import phone_profile
from virest.capture.rosbag import Bag, BagCamera
from virest.errors import CaptureError, OutputError

Json = dict[str, Any]
MODELS = {"plumb_bob": "radtan", "equidistant": "fisheye", "fisheye": "fisheye"}
AXES = "a bag does not hold the rotation between IMU and camera: virest calibrate estimates it"


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """The options of one ``virest import``."""

    out: Path
    image: str | None = None
    imu: str | None = None
    overwrite: bool = False


def run_import(path: Path, options: ImportOptions, progress: Callable[[int], Any] | None = None) -> tuple[Json, str]:
    """Convert a bag, atomically; returns the mapping for ``--json`` and the printed text."""
    out, step = options.out, progress or (lambda _: None)
    if out.exists() and not (options.overwrite and _is_import(out)):
        hint = "name another folder" if not out.is_dir() else "--overwrite replaces only an earlier import"
        raise OutputError(f"{out}: exists already", hint=hint)
    part = out.with_name(out.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        with Bag(path, options.image, options.imu) as bag:
            facts = _unpack(bag, part, step)
        read_capture(part)  # fail now if the result cannot be read back
        if out.exists():
            shutil.rmtree(out)
        part.rename(out)
    except OSError as error:
        raise output_error(out, error) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    facts |= {"bag": str(path), "folder": str(out)}
    text = [f"{path.name}: {facts['frames']} frames of {facts['image']}, {facts['samples']} samples of {facts['imu']}"]
    text += [f"note: {note}" for note in facts["notes"]]
    return facts, "\n".join([*text, f"wrote {out}"])


def _is_import(folder: Path) -> bool:
    """Whether the folder holds an earlier import and nothing else."""
    own = {"data", "data.csv", "imu.csv", "camera.yaml"}
    return folder.is_dir() and {p.name for p in folder.iterdir()} <= own


def _unpack(bag: Bag, part: Path, step: Callable[[int], Any]) -> Json:
    topics = bag.topics()
    time_ns, samples = bag.samples(topics.imu)
    if len(time_ns) < 2:
        raise CaptureError(f"{bag.path.name}: {len(time_ns)} samples in {topics.imu}", hint="record the IMU too")
    (part / "data").mkdir(parents=True)
    lines, size = [], (0, 0)
    for stamp_ns, picture in bag.pictures(topics.image):
        write_picture(part / "data" / f"{stamp_ns}.png", picture)
        lines.append(f"{stamp_ns},data/{stamp_ns}.png")
        size = (picture.shape[1], picture.shape[0])
        step(1)
    if not lines:
        raise CaptureError(f"{bag.path.name}: no images in {topics.image}", hint="choose another by --image")
    write_whole(part / "data.csv", ("#timestamp [ns],filename\n" + "\n".join(lines) + "\n").encode())
    rows = [",".join([str(t), *(f"{v:.9g}" for v in row)]) for t, row in zip(time_ns.tolist(), samples, strict=True)]
    head = "#timestamp [ns],gx [rad/s],gy,gz,ax [m/s^2],ay,az\n"
    write_whole(part / "imu.csv", (head + "\n".join(rows) + "\n").encode())
    camera = bag.camera(topics.camera) if topics.camera else None
    notes = [AXES]
    if camera is None or (camera.width, camera.height) != size:
        notes.append("no CameraInfo matches the image size: the lens is unknown")
    else:
        write_whole(part / "camera.yaml", _profile_text(camera).encode())
    return {
        "frames": len(lines), "samples": len(time_ns), "image": topics.image, "imu": topics.imu,
        "camera_info": topics.camera, "notes": notes,
    }  # fmt: skip


def _profile_text(camera: BagCamera) -> str:
    """A profile with the lens; values that the bag does not hold stay unknown."""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    values = np.array(camera.distortion)
    model = MODELS.get(camera.model, "none") if np.any(values) else "none"
    coefficients = tuple(values[: 4 if model == "fisheye" else 5].tolist()) if model != "none" else ()
    lens = Intrinsics(camera.width, camera.height, fx, fy, cx, cy, model, coefficients)
    profile = replace(phone_profile(camera.width, camera.height, "ROS bag"), intrinsics=lens)
    return f"# {AXES}\n" + format_profile(profile)
