"""The records of a capture: what `capture.folder` hands to every later stage."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from pathlib import Path

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples

STARTUP = "start-up"
NO_IMU = "no-imu"
IMU_GAP = "imu-gap"
NO_STAMP = "no-stamp"
STALL = "stall"


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of the movie and what was logged for it."""

    index: int
    """Index in the movie, from 0."""
    timestamp_ns: int
    """As logged, converted to the IMU's clock (clock source UNKNOWN: by edge_epochs)."""
    time_s: float
    """The same in seconds from the capture's stamp_0 (row 0 of frame_timestamps.txt)."""
    exposure_s: float | None = None
    """As logged; None: unknown."""
    iso: float | None = None
    skip_reason: str | None = None
    """Why the frame cannot be processed (start-up content lag, no IMU, IMU gap, no stamp); None: it can."""
    skip_codes: tuple[str, ...] = ()
    """The same as stable names: ``start-up``, ``no-imu``, ``imu-gap``, ``no-stamp``, ``stall``."""
    focus_dioptres: float | None = None
    """Focus distance as logged, 1/m; None: unknown."""
    focal_scale: float | None = None
    """Focal length as logged over the recording's median; None: not logged, or it does not change."""

    @property
    def only_startup(self) -> bool:
        """Whether the recorder lag is the only reason to skip the frame, which diagnosis and calibration then use."""
        return self.skip_codes == (STARTUP,)


@dataclass(frozen=True, slots=True)
class CaptureMetadata:
    """What the recorder logged about the camera, medians over the frames; None: not logged or not usable."""

    fx_px: float | None = None
    """Along x of the stored picture (the logger's fx belongs to the sensor's long axis; swapped for portrait)."""
    fy_px: float | None = None
    readout_time_s: float | None = None
    exposure_s: float | None = None
    iso: float | None = None
    focal_length_mm: float | None = None
    device: str = ""


@dataclass(frozen=True, slots=True)
class Note:
    """One thing that a reader of the capture should know."""

    severity: str
    """``info``, ``warning`` or ``error`` (the capture is unusable)."""
    code: str
    """A stable short name, such as ``imu-gap`` or ``content-lag``."""
    text: str
    """What, where, how much, and what it means."""


@dataclass(frozen=True, slots=True)
class Capture:
    """One recording, checked and joined."""

    name: str
    """Name of its folder."""
    folder: Path
    movie: Path
    width: int
    height: int
    frames: tuple[Frame, ...]
    """Every frame of the movie, in order; those that cannot be used carry their reason."""
    imu: ImuSamples
    metadata: CaptureMetadata
    clock_source: str
    """``REALTIME``, ``UNKNOWN`` or ``not logged``."""
    clock_shift_ns: int
    """What was added to the camera's stamps to bring them to the IMU's clock."""
    clock_difference_ns: int | None = None
    """IMU clock − the camera's other clock by edge_epochs.txt, applied or not; None: no such rows."""
    imu_gaps_s: tuple[tuple[float, float], ...] = ()
    """(start, end) of each gap in the inertial data."""
    keyframes: tuple[int, ...] = ()
    """Indices of the frames that the decoder can start from."""
    bits_per_px: float = inf
    """The encoder's mean bits per pixel of a frame; inf for pictures that were not encoded as a movie."""
    notes: tuple[Note, ...] = ()
    counts: dict[str, int] = field(default_factory=dict)
    """Rows and frames read, joined, and dropped, by reason."""
    stamp_0_ns: int = 0
    """Row 0 of frame_timestamps.txt on the IMU's clock: the zero of every time_s."""
    repeats: tuple[int, ...] = ()
    """Frames of the first two seconds that repeat their predecessor although the phone rotated."""
    stalls: tuple[tuple[int, int], ...] = ()
    """(first, last) frame of each later encoder stall, whose content may be later than its timestamps."""
    startup_lag_s: float | None = None
    """Lower bound of the delay of frame 0's content after its timestamp; None: no lag seen."""
    kind: str = "MARSLogger"
    """The recorder, as detected from its files."""
    metadata_file: str = "movie_metadata.csv"
    """Where ``metadata`` comes from."""
    recorded_profile: CameraProfile | None = None
    """The recorder's description of camera and axes beyond ``metadata``; None: it has none."""
    inputs: tuple[Path, ...] = ()
    """Files that were read: logs, lists, sensor descriptions, the movie; for listed pictures only the list."""

    @property
    def usable(self) -> tuple[Frame, ...]:
        """The frames without a reason to skip them."""
        return tuple(frame for frame in self.frames if frame.skip_reason is None)
