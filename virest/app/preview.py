"""``virest preview``: the frame with the most blur, recorded | restored | blur arrows, as one picture."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from virest.app import api
from virest.app.outputs import require_file, require_no_input, write_whole
from virest.arrays import Array
from virest.capture.folder import Frame
from virest.errors import CaptureError
from virest.image_formation.row_clock import RowClock
from virest.report.concepts import preview_figure
from virest.restoration.frame import RestoredFrame
from virest.restoration.parameters import DegradationParameters

log = logging.getLogger(__name__)

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class PreviewOptions:
    """The options of one ``virest preview``."""

    out: Path | None = None
    config: Path | None = None
    frame: int | None = None
    preset: str = "balanced"
    overwrite: bool = False


def run_preview(path: str, options: PreviewOptions) -> tuple[Json, str]:
    """Restore one frame and write the picture; returns the mapping for ``--json`` and the printed text."""
    capture = api.open(path, options.config)
    out = options.out or Path(f"{capture.name}-preview.png")
    require_no_input(out, capture.record.inputs)
    require_file(out, overwrite=options.overwrite)
    number = most_blurred(capture) if options.frame is None else options.frame
    restored = capture.restore(number, options.preset)
    found = restored.degradation
    if restored.picture is None or found is None:
        raise CaptureError(
            f"{capture.name}: frame {number} is {restored.status}: {'; '.join(restored.warnings)}",
            hint="choose another with --frame",
        )
    title = f"{capture.name}, frame {number}"
    write_whole(out, preview_figure(capture.read_frame(number), restored.picture, found.blur.tiles, title))
    facts = _facts(capture.name, restored, found, out)
    return facts, "\n".join([_describe(facts), *(f"note: {text}" for text in facts["warnings"]), f"wrote {out}"])


def most_blurred(capture: api.Capture) -> int:
    """The usable frame whose exposure × turn rate is largest, by the gyroscope alone."""
    usable = [frame for frame in capture.frames if frame.skip_reason is None]
    if not usable:
        raise CaptureError(f"{capture.name}: no frame can be used", hint="virest inspect shows why")
    return max(usable, key=lambda frame: _turned_rad(capture, frame)).index


def _turned_rad(capture: api.Capture, frame: Frame) -> float:
    """Rotation during the frame's exposure and readout, in rad; pitch and yaw count, roll does not."""
    profile = capture.profile
    readout_s = profile.shutter.readout_time_s if profile.readout_known else 0.0
    exposure_s = (frame.exposure_s or 0.0) * profile.shutter.exposure_scale
    middle_s = RowClock(profile).middle_s(frame.time_s, frame.exposure_s or 0.0)
    imu = capture.imu
    rate = np.array([np.interp(middle_s, imu.time_s, imu.gyro_rad_s[:, axis]) for axis in range(3)])
    turning: Array = profile.rotation_cam_imu @ (rate - np.array(profile.gyro_bias_rad_s))
    return float(np.hypot(turning[0], turning[1])) * (exposure_s or readout_s or 1.0)


def _facts(name: str, restored: RestoredFrame, found: DegradationParameters, out: Path) -> Json:
    return {
        "capture": name,
        "frame": restored.frame.index,
        "status": restored.status,
        "blur_px": found.blur.length_px,
        "max_displacement_px": found.shutter.max_displacement_px,
        "expected_gain_db": found.expected_gain_db,
        "warnings": list(restored.warnings),
        "path": str(out),
    }


def _describe(facts: Json) -> str:
    parts = [f"{facts['capture']}: frame {facts['frame']} {facts['status']}"]
    if facts["blur_px"] is not None:
        parts.append(f"blur {facts['blur_px']:.1f} px at the centre")
    if facts["max_displacement_px"] is not None:
        parts.append(f"rows moved by up to {facts['max_displacement_px']:.1f} px")
    if facts["expected_gain_db"] is not None:
        parts.append(f"predicted gain {facts['expected_gain_db']:.1f} dB")
    return ", ".join(parts)
