"""``virest calibrate CAPTURE``: clock, readout, axes, bias and more, fitted to an ordinary capture."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.console import table
from virest.app.outputs import output_error, require_no_input, require_writable, write_whole
from virest.calibration.calibrated_values import CalibratedValue
from virest.calibration.geometry import FRAME_LAG, GeometryCalibration, calibrate_geometry
from virest.calibration.unfitted_parameters import OPTIONAL
from virest.camera.kalibr import ImuNoise, format_camchain, format_imu, is_kalibr, parse_imu
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import format_profile, profile_mapping
from virest.camera.yaml_mapping import load_yaml_mapping
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.imu_noise import measure_imu_noise
from virest.capture.records import Capture
from virest.capture.video import GrayReader, probe_movie
from virest.errors import CalibrationError, OutputError
from virest.inference.frame_selection import high_motion_frames
from virest.inference.guide_choice import track_guided
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.tracking import Guide, TrackPair, track_frames
from virest.report.words import residual_words

EXTRA_NAMES = tuple(dict.fromkeys((*OPTIONAL, FRAME_LAG)))
"""Names that ``--with`` accepts."""
MAX_FRAMES = 400
"""Captures up to this length (13 s at 30 frames/s) use every frame; longer ones use runs with this total."""
MAX_AGAIN = 120
"""Most frames that are tracked again in equally blurred frames: with 60 points each, as many as the fit uses."""
FIT_STEPS = 3
MORE_MOTION = "record a few more seconds while rotating the phone about all three axes"
UNEXPLAINED = 1.5
"""Ratio of residual to tracking noise above which a note is given."""
RATE_TOLERANCE, NOISE_FACTOR = 0.1, 3.0
"""Relative difference in sample rate, and ratio of noise densities, above which a note compares data and imu.yaml."""
CAMCHAIN_NAME, IMU_NAME = "camchain-imucam.yaml", "imu.yaml"
DIGITS = 6

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class CalibrationPlan:
    """A capture with its profile, and the frames to use."""

    capture: Capture
    profile: CameraProfile
    source: str
    """Where the profile comes from."""
    imu_file: ImuNoise | None
    """Noise from the imu.yaml next to a Kalibr camera chain."""
    extra: tuple[str, ...]
    frames: tuple[int, ...]
    """Movie indices of the frames to track."""
    again: tuple[int, ...] = ()
    """Movie indices of the frames to track again in equally blurred frames."""

    @property
    def steps(self) -> int:
        """Most steps that ``progress`` counts."""
        return len(self.frames) + len(self.again) + FIT_STEPS


@dataclass(frozen=True, slots=True)
class CalibrationOutput:
    """Where to write the results."""

    profile: Path
    kalibr: Path | None = None
    """Folder for camchain-imucam.yaml and imu.yaml."""
    overwrite: bool = False

    @property
    def files(self) -> tuple[Path, ...]:
        """Everything that will be written."""
        return (self.profile, *((self.kalibr / CAMCHAIN_NAME, self.kalibr / IMU_NAME) if self.kalibr else ()))

    def require(self) -> None:
        """Raise OutputError, before any work, if a result could not be written later."""
        for path in (self.profile, *([self.kalibr] if self.kalibr else [])):
            if not path.absolute().parent.is_dir():
                raise OutputError(f"{path}: its folder does not exist", hint="create it first")
        if self.kalibr and self.kalibr.exists() and not self.kalibr.is_dir():
            raise OutputError(f"{self.kalibr}: is not a folder", hint="name a folder for Kalibr's files")
        for path in self.files:
            if path.is_dir():
                raise OutputError(f"{path}: is a folder", hint="name a file")
            if path.exists() and not self.overwrite:
                raise OutputError(f"{path}: exists already", hint="name another by --out, or pass --overwrite")
            require_writable(path.absolute().parent)


def unknown_extra(name: str) -> str | None:
    """Error text for a name that ``--with`` does not accept, with the closest accepted name; None: accepted."""
    if name in EXTRA_NAMES:
        return None
    near = difflib.get_close_matches(name.replace("_", "-").lower(), EXTRA_NAMES, n=1, cutoff=0.5)
    meant = f"did you mean '{near[0]}'?" if near else f"one of {', '.join(EXTRA_NAMES)}"
    return f"'{name}' cannot be calibrated, {meant}"


# ── which frames ─────────────────────────────────────────────────────────────────────────────────────────────────


def plan_calibration(path: Path, config: Path | None = None, extra: Sequence[str] = ()) -> CalibrationPlan:
    """Read the capture and its profile, and choose the frames. Raises CaptureError, SettingsError, CalibrationError."""
    capture = read_capture(path)
    profile, source = resolve_profile(capture, config)
    frames = choose_frames(capture, profile, FRAME_LAG in extra)
    if not frames:
        raise CalibrationError(
            f"{capture.name}: no frame can be used: {capture.frames[0].skip_reason}",
            hint="run virest inspect on it, or record longer",
        )
    again = frames
    if len(frames) > MAX_AGAIN:
        again = high_motion_frames(capture.frames, capture.imu, MAX_AGAIN, profile.time_offset_s or 0.0)
    return CalibrationPlan(capture, profile, source, _imu_file(source), tuple(extra), tuple(frames), tuple(again))


def choose_frames(capture: Capture, profile: CameraProfile, with_startup: bool = False) -> list[int]:
    """Movie indices to track, ascending: every usable frame or high-motion runs; with start-up frames if asked."""
    chosen = high_motion_frames(capture.frames, capture.imu, MAX_FRAMES, profile.time_offset_s or 0.0)
    if with_startup:
        chosen += [frame.index for frame in capture.frames if frame.only_startup]
    return sorted(set(chosen))


def _imu_file(source: str) -> ImuNoise | None:
    """The imu.yaml next to a Kalibr camera chain."""
    path = Path(source)
    beside = path.with_name(IMU_NAME)
    if not path.is_file() or not beside.is_file() or not is_kalibr(load_yaml_mapping(path)):
        return None
    return parse_imu(load_yaml_mapping(beside), IMU_NAME)


# ── the command ──────────────────────────────────────────────────────────────────────────────────────────────────


def run_calibration(
    plan: CalibrationPlan,
    output: CalibrationOutput,
    progress: Callable[[int], Any] | None = None,
    each: ParallelMap = one_by_one,
) -> tuple[Json, str]:
    """Track, fit and write; returns the mapping for ``--json`` and the printed table.

    progress is called with the number of the plan's steps just done.  each: maps calls over processes.  Raises
    CalibrationError, OutputError; nothing is written then.
    """
    output.require()
    require_no_input(output.profile, plan.capture.inputs)
    facts, found, noise = find_calibration(plan, progress, each)
    text = describe(facts)
    _write(output, facts, found, noise, plan.capture)
    facts["written"] = [str(path) for path in output.files]
    return facts, "\n".join([text, *(f"wrote {path}" for path in output.files)])


def find_calibration(
    plan: CalibrationPlan, progress: Callable[[int], Any] | None = None, each: ParallelMap = one_by_one
) -> tuple[Json, GeometryCalibration, ImuNoise | None]:
    """Track and fit; the mapping for ``--json``, the calibration and the IMU noise.  Raises CalibrationError."""
    step = progress or (lambda _: None)
    movie = plan.capture.movie
    gray = GrayReader(movie, probe_movie(movie))
    pairs = track_guided(plan.capture, plan.profile, gray, plan.frames, each, step)

    def track_again(guide: Guide) -> list[TrackPair]:
        return track_frames(gray, plan.again, each, step, guide)

    found = calibrate_geometry(plan.capture, plan.profile, pairs, plan.extra, lambda _stage: step(1), track_again)
    _require_offset(found)
    noise = measure_imu_noise(plan.capture.imu)
    return as_json(plan, found, noise), found, noise


def _require_offset(found: GeometryCalibration) -> None:
    """Raise CalibrationError if the time offset is unknown: every other value depends on it."""
    offset = next((value for value in found.values if value.name == "time_offset_s"), None)
    if offset is not None and not offset.determined and not offset.rough:
        std = f" (± {1e3 * float(np.max(offset.std)):.1f} ms)" if offset.std is not None else ""
        if blamed := _blamed(found):
            raise CalibrationError(
                f"the time offset is not determined{std}: the points contradict the given {', '.join(blamed)}",
                hint=f"correct the profile, or pass --with {','.join(blamed)}",
            )
        raise CalibrationError(
            f"the motion does not determine the time offset{std}",
            hint=MORE_MOTION,
        )


def _write(
    output: CalibrationOutput, facts: Json, found: GeometryCalibration, noise: ImuNoise | None, capture: Capture
) -> None:
    contents = [_profile_text(facts, found.profile)]
    if output.kalibr:
        if noise is None:
            raise CalibrationError("too few inertial samples to measure their noise", hint="omit --kalibr")
        contents += [format_camchain(found.profile, capture.metadata.exposure_s), format_imu(noise)]
        _make_folder(output.kalibr)
    for path, content in zip(output.files, contents, strict=True):
        write_whole(path, content.encode())


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise output_error(path, error) from error


def _profile_text(facts: Json, profile: CameraProfile) -> str:
    head = [
        f"Camera profile by virest calibrate, from {facts['capture']}: {facts['verdict']}",
        f"residual {residual_words(facts['residual_px'], facts['noise_px'])}",
        *(f"note: {note}" for note in facts["notes"]),
    ]
    return "".join(f"# {_one_line(line)}\n" for line in head) + format_profile(profile)


# ── JSON results ─────────────────────────────────────────────────────────────────────────────────────────────────


def as_json(plan: CalibrationPlan, found: GeometryCalibration, noise: ImuNoise | None) -> Json:
    """All results as one mapping."""
    values = [_value_facts(value) for value in found.values]
    undetermined = [value["name"] for value in values if not value["determined"] and not value["rough"]]
    return {
        "capture": plan.capture.name,
        "folder": str(plan.capture.folder),
        "profile_source": plan.source,
        "with": list(plan.extra),
        "frames": len(plan.frames),
        "frames_recorded": len(plan.capture.frames),
        "pairs": found.pairs,
        "tracks": found.tracks,
        "values": values,
        "not_determined": undetermined,
        "correlations": [{"first": a, "second": b, "correlation": c} for a, b, c in found.correlations],
        "translation": found.translation,
        "explained": found.explained,
        "moving_fraction": found.moving_fraction,
        "before_px": found.before_px,
        "residual_px": found.residual_px,
        "noise_px": found.noise_px,
        "imu": _imu_facts(noise),
        "notes": [*found.notes, *_own_notes(plan, found, noise)],
        "verdict": _verdict(undetermined, [value.name for value in found.values if value.implausible], _blamed(found)),
        "profile": profile_mapping(found.profile),
    }


def _blamed(found: GeometryCalibration) -> tuple[str, ...]:
    """Fixed values that the points contradict, if the residual says that they widen the other standard deviations."""
    return found.contradicted if found.residual_px > UNEXPLAINED * found.noise_px else ()


def _verdict(undetermined: list[str], odd: list[str], blamed: Sequence[str]) -> str:
    """The verdict in one line; odd: the undetermined parameters whose fitted values no camera has."""
    if not undetermined:
        return "calibrated"
    open_yet = [name for name in undetermined if name not in odd]
    reason = f"with the given {', '.join(blamed)}, which the points contradict" if blamed else "by this motion"
    parts = [f"{', '.join(open_yet)} (not determined {reason})"] if open_yet else []
    parts += [f"{', '.join(odd)} (implausible value)"] if odd else []
    return f"calibrated, except {' and '.join(parts)}"


def _value_facts(value: CalibratedValue) -> Json:
    return {
        "name": value.name,
        "start": value.start,
        "value": value.value,
        "std": value.std,
        "determined": value.determined,
        "note": value.note,
        "rough": value.rough,
    }


def _imu_facts(noise: ImuNoise | None) -> Json | None:
    if noise is None:
        return None
    return {
        "update_rate_hz": noise.update_rate_hz,
        "gyro_noise_density_rad_s_sqrt_hz": noise.gyro_density,
        "accel_noise_density_m_s2_sqrt_hz": noise.accel_density,
    }


def _own_notes(plan: CalibrationPlan, found: GeometryCalibration, noise: ImuNoise | None) -> list[str]:
    notes = []
    if found.residual_px > UNEXPLAINED * found.noise_px:
        notes.append(
            f"the residual is {found.residual_px / found.noise_px:.1f} times the tracking noise: part of it is "
            "unexplained, and the standard deviations treat it as noise"
        )
    notes += [
        f"the time offset is written but known only to ± {1e3 * float(np.max(value.std)):.1f} ms"
        f"{'' if _blamed(found) else ': ' + MORE_MOTION}"
        for value in found.values
        if value.rough and value.std is not None
    ]
    if plan.imu_file and noise:
        notes += _imu_disagreements(plan.imu_file, noise)
    return notes


def _imu_disagreements(file: ImuNoise, measured: ImuNoise) -> list[str]:
    """Notes where a capture's inertial data differ from what imu.yaml states."""
    notes = []
    if abs(measured.update_rate_hz / file.update_rate_hz - 1) > RATE_TOLERANCE:
        notes.append(
            f"{IMU_NAME} states {file.update_rate_hz:g} Hz, this capture has {measured.update_rate_hz:.4g} Hz: another "
            "phone or mode?"
        )
    pairs = (
        ("gyroscope", file.gyro_density, measured.gyro_density),
        ("accelerometer", file.accel_density, measured.accel_density),
    )
    for name, stated, density in pairs:
        if stated and density and density > NOISE_FACTOR * stated:
            notes.append(f"{name}: noise density {density:.2g} here, {stated:.2g} in {IMU_NAME}")
    return notes


# ── printed results ──────────────────────────────────────────────────────────────────────────────────────────────


def describe(facts: Json) -> str:
    """A table of the values, then residual, translation, correlations and notes."""
    rows = [row for value in facts["values"] for row in _rows(value)]
    share = 100 * facts["moving_fraction"]
    lines = [
        f"{facts['capture']}: {facts['verdict']}",
        table(["value", "start", "calibrated", "±", "determined", "note"], rows),
        f"residual {facts['before_px']:.3f} -> {residual_words(facts['residual_px'], facts['noise_px'])}",
        f"{facts['tracks']} tracks in {facts['pairs']} pairs of frames, {share:.1f} % of them on moving objects; "
        f"the gyroscope explains {facts['explained']:.1%} of the rotation",
        f"camera translation: {_TRANSLATIONS.get(facts['translation'], facts['translation'])}",
    ]
    if facts["frames"] < facts["frames_recorded"]:
        lines.append(f"used {facts['frames']} of {facts['frames_recorded']} frames: runs spread over the capture")
    lines += [
        f"errors of {pair['first']} and {pair['second']} are correlated: {pair['correlation']:+.2f}"
        for pair in facts["correlations"]
    ]
    if facts["not_determined"]:
        lines.append(f"kept at the starting value: {', '.join(facts['not_determined'])}")
    return "\n".join(lines + [f"note: {_one_line(note)}" for note in facts["notes"]])


_TRANSLATIONS = {
    "none": "none detected",
    "inertial": "from the accelerometer, scene modelled as a plane",
    "direction": "one direction per pair of frames, any depth",
    "free": "a smooth path, scene modelled as a plane; not determined by the accelerometer",
}


def _rows(value: Json) -> list[list[str]]:
    """One row for a number or a word, one per component for a list."""
    count = len(value["value"]) if isinstance(value["value"], list) else 0
    if not count:
        return [_row(value, value["name"], value["start"], value["value"], value["std"])]
    starts = value["start"] if isinstance(value["start"], list) else [value["start"]] * count
    stds = value["std"] if isinstance(value["std"], list) else [value["std"]] * count
    named = [f"{value['name']}[{k}]" for k in range(count)]
    return [_row(value, *parts) for parts in zip(named, starts, value["value"], stds, strict=True)]


def _row(value: Json, name: str, start: Any, found: Any, std: Any) -> list[str]:
    shown = _cell(found, std) if value["determined"] or value.get("rough") else "–"
    spread = "" if std is None else f"{std:.2g}"
    return [name, _cell(start, std), shown, spread, "yes" if value["determined"] else "no", _one_line(value["note"])]


def _cell(value: Any, std: float | None) -> str:
    """A number rounded to two digits of its standard deviation, a word, or ``unknown``."""
    if value is None:
        return "unknown"
    if isinstance(value, str):
        return value
    if not std or not math.isfinite(std):
        return f"{value:.{DIGITS}g}"
    return f"{round(value, 12) + 0.0:.{int(np.clip(1 - math.floor(math.log10(std)), 0, 9))}f}"


def _one_line(text: str) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
