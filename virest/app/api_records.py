"""Types of what ``virest.calibrate``, ``diagnose`` and ``simulate`` take and return: the mappings of ``--json``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NotRequired, TypedDict

from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.simulation.hidden import Hidden
from virest.simulation.phone_isp import PhoneIsp

Mapped = dict[str, Any]
"""A mapping whose keys depend on the capture, or a profile as its file has it."""


class CalibratedFacts(TypedDict):
    """One value of a calibration; lists where it has components."""

    name: str
    start: float | list[float] | str | None
    value: float | list[float] | str | None
    std: float | list[float] | None
    determined: bool
    note: str
    rough: bool


_ExtraValues = TypedDict("_ExtraValues", {"with": list[str]})
"""The values that ``--with`` names; its key is a word of Python's own."""


class CalibrationFacts(_ExtraValues):
    """What ``virest calibrate --json`` prints."""

    capture: str
    folder: str
    profile_source: str
    frames: int
    frames_recorded: int
    pairs: int
    tracks: int
    values: list[CalibratedFacts]
    not_determined: list[str]
    correlations: list[Mapped]
    translation: str
    explained: float
    moving_fraction: float
    before_px: float
    residual_px: float
    noise_px: float
    imu: Mapped | None
    notes: list[str]
    verdict: str
    profile: Mapped
    written: NotRequired[list[str]]
    """Files, with ``out``."""


class DiagnosisFacts(TypedDict):
    """What ``virest diagnose --json`` prints."""

    schema: int
    verdict: str
    nominal: Mapped
    causes: list[Mapped]
    fields: list[Mapped]
    unexplained: Mapped
    restoration_gain: Mapped
    extended_profile: Any
    """The profile as a mapping; with ``out`` the name of its file."""
    residuals: NotRequired[Mapped]
    """Of the points, ``before`` and ``after``; without ``out``."""


class SimulationFacts(TypedDict):
    """What ``virest simulate --json`` prints."""

    capture: str
    scene: str
    width: int
    height: int
    frames: int
    fps: float
    exposure_ms: list[float]
    readout_ms: float
    readout_direction: str
    seed: int
    blur_px: float
    auto_exposure_ev: NotRequired[float]
    """With auto-exposure, as the two below."""
    exposure_range_ms: NotRequired[list[float]]
    iso_range: NotRequired[list[int]]
    isp: NotRequired[Mapped]
    """Strengths of the phone's own processing that are on."""
    effects: list[Mapped]


class SimulationOptions(TypedDict, total=False):
    """What :func:`virest.app.simulate.simulate_command` takes beside the folder, with its defaults."""

    scene: str
    width: int
    height: int
    frames: int
    fps: float
    exposure_ms: float | Sequence[float]
    auto_exposure_ev: float | None
    auto_exposure_steps: int | None
    readout_ms: float
    direction: str | None
    focal_px: float | None
    distortion: tuple[str, tuple[float, ...]]
    rate_rad_s: float
    pan_rad_s: float
    near_m: float | None
    moving_px_s: float
    noise_levels: float
    response: str | ResponseCurve
    depth_m: float | None
    tilt_deg: tuple[float, float]
    sway_m: float | None
    imu_rate_hz: float
    gyro_noise_rad_s: float
    accel_noise_m_s2: float
    seed: int
    effects: Sequence[str]
    layout: str
    clock: str
    bitrate_bits_per_px: float
    crf: float | None
    reference: str
    truth_frames: bool
    overwrite: bool
    profile: CameraProfile | None
    hidden: Hidden
    isp: PhoneIsp
    progress: Callable[[int, int], None] | None
