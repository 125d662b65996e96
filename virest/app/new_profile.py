"""``virest profile``: create a camera profile, and list the readout times of known phones."""

from __future__ import annotations

import math
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from virest.app.console import table
from virest.app.outputs import require_file, write_whole
from virest.camera.intrinsics import Intrinsics
from virest.camera.phones import READOUTS, Readout, find_readouts
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import format_profile, profile_mapping
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.pictures import MAX_SIDE_PX
from virest.capture.profile_source import phone_profile
from virest.errors import SettingsError

Json = dict[str, Any]
COMMENTS = {
    "intrinsics": "fx_px null: estimated from the capture; virest calibrate --with focal",
    "shutter": "readout: first row to one past the last, null: no straightening; direction in the stored picture",
    "scene": "depth_m null: estimated; .inf: rotation only",
    "T_cam_imu": "x_cam = T_cam_imu @ x_imu",
    "time_offset_s": "t_imu = t_cam (1 + clock_skew) + this; null: estimated from the capture",
    "gyro_bias_rad_s": "measured = gyro_scale x true + bias",
    "response": "linear | srgb | gamma | five_segment | table; virest calibrate-curve",
}


@dataclass(frozen=True, slots=True)
class NewProfile:
    """The options of one ``virest profile new``."""

    capture: Path | None = None
    device: str | None = None
    size: tuple[int, int] | None = None
    """Width, height."""
    focal_px: float | None = None
    fov_deg: float | None = None
    """Along the frame's long side."""
    out: Path = Path("camera.yaml")
    overwrite: bool = False


def run_new_profile(request: NewProfile) -> tuple[Json, str]:
    """Write the profile; returns the mapping for ``--json`` and the printed text."""
    require_file(request.out, overwrite=request.overwrite)
    profile, source = _base(request)
    notes = [f"base: {source}"]
    if (focal := _focal_px(request, profile)) is not None:
        centre = (profile.width - 1) / 2, (profile.height - 1) / 2
        lens = Intrinsics(profile.width, profile.height, focal, focal, *centre)
        profile = replace(profile, intrinsics=lens)
    if request.device is not None:
        entry = _entry(request.device, profile)
        shutter = replace(profile.shutter, readout_time_s=entry.readout_s)
        profile = profile.with_estimate(
            "readout_time_s", entry.readout_s, entry.std_s, entry.source, shutter=shutter, readout_known=True
        )
        profile = replace(profile, device=entry.device)
        notes.append(
            f"readout {1e3 * entry.readout_s:.2f} ms of {entry.device} at {entry.width}x{entry.height}: {entry.source}"
        )
    write_whole(request.out, commented(profile, notes).encode())
    unknown = [name for name, known in (
        ("focal length", profile.intrinsics is not None), ("readout time", profile.readout_known),
        ("time offset", profile.time_offset_s is not None), ("response", profile.response is not None),
    ) if not known]  # fmt: skip
    if unknown:
        notes.append(f"unknown: {', '.join(unknown)}; virest calibrate fits what the motion determines")
    facts = {"profile": profile_mapping(profile), "path": str(request.out), "notes": notes}
    return facts, "\n".join([*notes, f"wrote {request.out}"])


def commented(profile: CameraProfile, notes: list[str]) -> str:
    """The profile's YAML with comments on its main keys."""
    lines = [f"# {note}" for note in notes]
    for line in format_profile(profile).splitlines():
        key = line.strip().partition(":")[0]
        comment = COMMENTS.get(key)
        if comment and "#" not in line:
            lines.append(f"{line[: len(line) - len(line.lstrip())]}# {key}: {comment}")
        lines.append(line)
    return "\n".join(lines) + "\n"


def known_devices(text: str) -> tuple[Json, str]:
    """Entries of the table of readout times whose device matches."""
    entries = find_readouts(text) if text else READOUTS
    facts = {"devices": [asdict(entry) for entry in entries]}
    if not entries:
        return facts, f"no device matches {text!r}; virest calibrate measures a readout time from a capture"
    rows = [
        [e.device, f"{e.width}x{e.height}", _ms(e.readout_s, 4), _ms(e.std_s, 2), e.source.partition(",")[0]]
        for e in entries
    ]
    return facts, table(["device", "mode", "readout ms", "±", "source"], rows, words=1)


def _ms(seconds: float | None, digits: int) -> str:
    return "" if seconds is None else f"{1e3 * seconds:.{digits}g}"


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of ``WxH``."""
    found = re.fullmatch(r"\s*(\d{1,5})\s*[x×]\s*(\d{1,5})\s*", text)
    width, height = (int(found[1]), int(found[2])) if found else (0, 0)
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise SettingsError(f"size {text!r} is not WxH", hint="write 1920x1080, as stored in the movie")
    return width, height


def _base(request: NewProfile) -> tuple[CameraProfile, str]:
    if request.capture is not None:
        capture = read_capture(request.capture)
        profile, source = resolve_profile(capture)
        return profile, f"{capture.name}, {source}"
    if request.size is None:
        raise SettingsError("neither a capture nor a frame size is given", hint="pass CAPTURE, or --size WxH")
    return phone_profile(*request.size), "typical phone axes"


def _focal_px(request: NewProfile, profile: CameraProfile) -> float | None:
    if request.focal_px is not None:
        return request.focal_px
    if request.fov_deg is None:
        return None
    if not 1 < request.fov_deg < 170:
        raise SettingsError(
            f"field of view {request.fov_deg:g} is not in 1 to 170 degrees", hint="give the angle along the long side"
        )
    return max(profile.width, profile.height) / 2 / math.tan(math.radians(request.fov_deg) / 2)


def _entry(device: str, profile: CameraProfile) -> Readout:
    """The table's entry for the device, in the profile's mode where there are several."""
    found = find_readouts(device)
    if not found:
        raise SettingsError(f"no readout time of {device!r} is known", hint="virest profile devices lists them")
    size = sorted((profile.width, profile.height))
    same = [entry for entry in found if sorted((entry.width, entry.height)) == size]
    if not same:
        modes = ", ".join(f"{entry.device} {entry.width}x{entry.height}" for entry in found)
        raise SettingsError(
            f"no readout time of {device!r} at {profile.width}x{profile.height} is known ({modes})",
            hint="a readout time applies to one mode; virest calibrate measures it",
        )
    return same[0]
