"""One frame's result as a line of ``parameters.jsonl``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from virest.camera.profile import CameraProfile
from virest.restoration.frame import RestoredFrame
from virest.restoration.parameters import Json


def frame_line(
    capture: str, profile: CameraProfile, restored: RestoredFrame, picture: Path, seconds: dict[str, float]
) -> Json:
    """The measured degradation and the result of one frame.  picture: where it is written, if at all."""
    frame, found = restored.frame, restored.degradation
    line: Json = {
        "capture": capture,
        "frame": frame.index,
        "timestamp_ns": frame.timestamp_ns,
        "exposure_s": None if frame.exposure_s is None else frame.exposure_s * profile.shutter.exposure_scale,
        "status": restored.status,
        "done": steps_done(restored),
        "output": None if restored.picture is None else f"frames/{picture.name}",
        "warnings": list(restored.warnings),
        "valid_px": list(restored.valid_px),
    }
    line |= _not_looked_at(profile) if found is None else found.as_json()
    return line | {"seconds": {name: round(s, 4) for name, s in seconds.items()}}


def steps_done(restored: RestoredFrame) -> list[str]:
    """Steps applied to a frame: ``deblurred``, ``straightened``, ``undistorted``."""
    found, is_restored = restored.degradation, restored.status == "restored"
    steps = {
        "deblurred": is_restored and found is not None and found.deblur is not None,
        "straightened": is_restored and found is not None and found.shutter.method != "none",
        "undistorted": restored.undistorted and restored.picture is not None,
    }
    return [name for name, done in steps.items() if done]


def _not_looked_at(profile: CameraProfile) -> dict[str, Any]:
    """The entries of a frame that was skipped, or failed, before its motion was computed."""
    return {
        "motion": None,
        "depth_m": None,
        "depth_source": "none",
        "blur": None,
        "shutter": None,
        "response": profile.response.kind if profile.response else "srgb",
        "deblur": {"method": "none"},
    }
