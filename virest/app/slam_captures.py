"""The captures that ``virest evaluate slam`` simulates by default: a camera that moves past a scene.

Their profiles omit what a phone does not know: the scene distance and the clock offset.  Readout times are measured
ones; exposures, speeds and the rest are chosen.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from virest.app.simulate import parse_response
from virest.simulation.hand_motion import random_hand_motion
from virest.simulation.recording import RecordingOptions, write_recording
from virest.simulation.session import SessionSettings, nominal_camera, plan_session

DEVICE_FRAMES = 24
"""Fewer than the 36 of the standard captures: there are many phones."""
_MARGIN_S = 2.0
"""Motion before and after the frames, longer than the 0.6 s of samples there."""
_BITS_PER_PX = 0.6
"""More than twice the usual 0.25: coding loss is not what is compared."""


@dataclass(frozen=True, slots=True)
class SlamCapture:
    """One capture to simulate."""

    name: str
    note: str
    """Source of its numbers, for the table."""
    scene: str = "leaves"
    width: int = 640
    height: int = 480
    focal_px: float = 512.0
    distortion: tuple[str, tuple[float, ...]] = ("none", ())
    readout_ms: float = 25.0
    direction: str | None = None
    exposure_ms: float = 8.0
    response: str = "srgb"
    frames: int = 36
    fps: float = 15.0
    rate_rad_s: float = 1.0
    sway_m: float = 0.02
    walk_m: tuple[float, float, float] = (0.5, 0.05, 0.10)
    """Travel along x, and back-and-forth amplitude along y and z."""
    depth_m: float = 1.5
    tilt_deg: tuple[float, float] = (14.0, -22.0)
    near_m: float | None = None
    """Distance of objects in front of the scene's plane; None: no objects."""
    offset_ms: float = 8.0
    """Hidden clock offset; unknown in the profile."""
    imu_rate_hz: float = 200.0
    seed: int = 31

    @property
    def field_of_view_deg(self) -> float:
        """Field of view along the long side of the frame."""
        long = max(self.width, self.height)
        angle = 2 * np.arctan(0.5 * long / self.focal_px) if self.distortion[0] != "fisheye" else long / self.focal_px
        return float(np.rad2deg(angle))


SEQUENCES = (
    SlamCapture("relief", "leaves, some at 1 m", depth_m=1.6, near_m=1.0),
    SlamCapture(
        "print",
        "text, sideways",
        scene="text",
        readout_ms=29.5,
        exposure_ms=6.0,
        rate_rad_s=0.8,
        walk_m=(0.4, -0.08, 0.05),
        depth_m=1.2,
        tilt_deg=(-16.0, 18.0),
        offset_ms=-5.0,
        seed=32,
    ),
    SlamCapture(
        "shaken",
        "leaves, upright",
        width=480,
        height=640,
        focal_px=490.0,
        readout_ms=20.733,
        exposure_ms=12.0,
        rate_rad_s=1.6,
        walk_m=(0.45, 0.06, -0.10),
        tilt_deg=(18.0, 15.0),
        response="five_segment",
        offset_ms=11.0,
        seed=36,
    ),
)
"""The same number as in Table 4 of Ye et al. 2026."""

DEVICES = (
    SlamCapture(
        "HTC Desire", "readout [1]", focal_px=560.0, readout_ms=57.84, exposure_ms=12.0, rate_rad_s=0.6, seed=41
    ),
    SlamCapture("iPhone 3GS", "readout [1]", focal_px=640.0, readout_ms=30.84, exposure_ms=10.0, seed=42),
    SlamCapture(
        "Xperia X10", "readout [1], read upwards", focal_px=590.0, readout_ms=28.386, direction="bottom_to_top", seed=43
    ),
    SlamCapture(
        "Honor View 10",
        "readout [3], upright",
        width=480,
        height=640,
        focal_px=490.0,
        readout_ms=20.733,
        exposure_ms=10.0,
        imu_rate_hz=100.0,
        offset_ms=3.0,
        seed=44,
    ),
    SlamCapture(
        "Xiaomi CC9", "readout [4]", focal_px=459.0, readout_ms=31.7, exposure_ms=5.4, offset_ms=-5.1, seed=45
    ),
    SlamCapture(
        "GoPro Hero3+", "readout [2], wide", focal_px=430.0, distortion=("radtan", (-0.12, 0.02, 0.0, 0.0, 0.0)),
        readout_ms=14.82, exposure_ms=4.0, offset_ms=-20.0, seed=46,
    ),
    SlamCapture(
        "GoPro HERO7", "readout [4], fisheye", focal_px=415.0, distortion=("fisheye", (0.0, 0.0, 0.0, 0.0)),
        readout_ms=8.015, exposure_ms=2.0, rate_rad_s=0.8, offset_ms=-25.0, seed=47,
    ),
    SlamCapture(
        "phone in a dim room", "chosen", readout_ms=18.0, exposure_ms=22.0, rate_rad_s=0.8, seed=48
    ),
)  # fmt: skip
"""The same number as in Table 5 of Ye et al. 2026."""
DEVICE_SOURCES = (
    "[1] measured with an LED panel, [2] by panning past an edge: doc/rolling-shutter-table.md of JzHuai0108/kalibr",
    "[3] logged by the phone, [4] measured from, or recorded in, a published capture",
)


def smaller(plan: SlamCapture, frames: int) -> SlamCapture:
    """The same capture with fewer frames and a proportionally shorter path."""
    part = frames / plan.frames
    x, y, z = plan.walk_m
    return dataclasses.replace(plan, frames=frames, walk_m=(x * part, y * part, z * part))


def make_capture(plan: SlamCapture, folder: Path) -> Path:
    """Simulate a capture with its truth: a sharp global-shutter image of each frame, and the trajectory."""
    true = nominal_camera(
        plan.width,
        plan.height,
        focal_px=plan.focal_px,
        readout_time_s=plan.readout_ms / 1000,
        readout_direction=plan.direction,
        response=parse_response(plan.response),
        distortion=plan.distortion,
        depth_m=plan.depth_m,
    )
    nominal = dataclasses.replace(true, depth_m=None, time_offset_s=None)
    true = dataclasses.replace(true, time_offset_s=plan.offset_ms / 1000)
    settings = SessionSettings(
        scene=plan.scene,
        frames=plan.frames,
        fps=plan.fps,
        exposure_s=(plan.exposure_ms / 1000,),
        rate_rad_s=plan.rate_rad_s,
        sway_m=plan.sway_m,
        near_m=plan.near_m,
        tilt_rad=(float(np.deg2rad(plan.tilt_deg[0])), float(np.deg2rad(plan.tilt_deg[1]))),
        imu_rate_hz=plan.imu_rate_hz,
        seed=plan.seed,
    )
    motion = random_hand_motion(
        np.random.default_rng([plan.seed, 1]),
        rate_rms_rad_s=plan.rate_rad_s,
        duration_s=plan.frames / plan.fps,
        sway_rms_m=plan.sway_m,
        walk_m=plan.walk_m,
        margin_s=_MARGIN_S,
    )
    session = plan_session(nominal, true, settings, motion=motion)
    return write_recording(session, folder, options=RecordingOptions(bits_per_px=_BITS_PER_PX))
