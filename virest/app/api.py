"""The public API of ``import virest``: a few functions on numpy arrays and records.  Files are written only on request.

The functions raise the errors of :mod:`virest.errors`; each carries a hint.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack, cast

import numpy as np
from numpy.typing import NDArray

from virest.app.api_records import CalibrationFacts, DiagnosisFacts, SimulationFacts, SimulationOptions
from virest.arrays import Picture
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.capture.folder import Frame, read_capture, resolve_profile
from virest.capture.frame_coding import FrameCoding
from virest.capture.imu import ImuSamples, checked_samples
from virest.capture.profile_source import read_any_profile, require_size
from virest.capture.records import Capture as CaptureRecord
from virest.capture.records import Note
from virest.capture.video import MovieIndex, probe_movie, read_frames
from virest.errors import CaptureError, SettingsError
from virest.image_formation.row_motion import FrameTranslation, row_motion
from virest.motion.integration import integrate_gyro
from virest.motion.optics import moving_lens
from virest.motion.trajectory import Trajectory
from virest.restoration.capture import RestorationPlan, at_true_times, restore_frames
from virest.restoration.frame import RestoredFrame, restore_frame
from virest.restoration.one_kernel import as_colour, deblur_along, even_path, path_of_kernel
from virest.restoration.settings import PRESETS, RestorationSettings

PathLike = str | os.PathLike[str]
LONGEST_EXPOSURE_S = 10.0
"""As of a recorder's log."""


class Capture:
    """An opened capture: logs are read at once, frames are decoded on demand.  Created by :func:`open`."""

    def __init__(self, record: CaptureRecord, profile: CameraProfile, profile_source: str) -> None:
        self.record = record
        """All logs, checked and joined."""
        self.profile = profile
        """The camera profile in use."""
        self.profile_source = profile_source
        """Where the profile comes from."""
        self._index: MovieIndex | None = None
        self._plans: dict[RestorationSettings, RestorationPlan] = {}

    def __repr__(self) -> str:
        return f"<Capture {self.name}: {len(self)} frames of {self.record.width}x{self.record.height}>"

    def __len__(self) -> int:
        return len(self.record.frames)

    @property
    def name(self) -> str:
        """Name of the capture's folder."""
        return self.record.name

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The log of each frame: timestamp, time, exposure, and why it cannot be used, if so."""
        return at_true_times(self.record.frames, self.profile, self.record.repeats)

    @property
    def imu(self) -> ImuSamples:
        """Gyroscope and accelerometer samples, on the time axis of ``frames``."""
        return self.record.imu

    @property
    def notes(self) -> tuple[Note, ...]:
        """Notes about the capture: problems found, values assumed."""
        return self.record.notes

    def read_frames(self, start: int = 0, stop: int | None = None) -> Iterator[tuple[int, Picture]]:
        """Index and RGB pixels (height, width, 3) of the decodable frames in ``range(start, stop)``."""
        chosen = range(len(self))[start:stop]
        if len(chosen):
            for index, picture in read_frames(self.record.movie, self._movie(), chosen[0], chosen[-1]):
                if picture is not None:
                    yield index, picture

    def read_frame(self, index: int) -> Picture:
        """RGB pixels (height, width, 3) of one frame.  Raises CaptureError if it cannot be decoded."""
        number = self._number(index)
        for _, picture in self.read_frames(number, number + 1):
            return picture
        raise self._undecodable(number)

    def restore(self, index: int, preset: str = "balanced", **settings: Any) -> RestoredFrame:
        """Restore one frame as ``virest process`` does; unknown profile values and translation are estimated once."""
        from virest.app.planning import read_with_neighbours

        number = self._number(index)
        plan = self.plan(preset, **settings)
        frame = self.frames[number]
        if frame.skip_reason is not None:
            return RestoredFrame(frame, "skipped", None, (frame.skip_reason,))
        coding: dict[int, FrameCoding] = {}
        near = read_with_neighbours(self.record.movie, self._movie(), self.frames, number, plan.reach, coding)
        if near is None:
            raise self._undecodable(number)
        return next(restore_frames(near, self.imu, plan, {number}, coding))

    def plan(self, preset: str = "balanced", **settings: Any) -> RestorationPlan:
        """The plan for restoring this capture: the completed profile, translations, warnings."""
        from virest.app.planning import estimate_plan

        composed = _settings(preset, settings)
        if composed not in self._plans:
            self._plans[composed] = estimate_plan(self.record, self._movie(), self.profile, composed)
        return self._plans[composed]

    def _undecodable(self, number: int) -> CaptureError:
        hint = "virest inspect shows what is wrong with it"
        return CaptureError(f"{self.name}: frame {number} cannot be decoded", hint=hint)

    def _movie(self) -> MovieIndex:
        if self._index is None:
            self._index = probe_movie(self.record.movie)
        return self._index

    def _number(self, index: int) -> int:
        if not -len(self) <= index < len(self):
            raise CaptureError(f"{self.name}: no frame {index}", hint=f"the movie has {len(self)} frames")
        return index % len(self)


def open(path: PathLike, config: PathLike | CameraProfile | None = None) -> Capture:
    """Open a capture folder of any supported recorder.

    config: a profile file (virest's or Kalibr's) or record; by default the folder's ``camera.yaml``, or the recorder's
    own metadata.  Raises CaptureError, SettingsError.
    """
    record = read_capture(Path(path))
    if isinstance(config, CameraProfile):
        require_size(config, record, "the profile")
        return Capture(record, config, "given")
    profile, source = resolve_profile(record, None if config is None else Path(config))
    return Capture(record, profile, str(source))


def restore(
    frame: Picture,
    motion: ImuSamples | Trajectory,
    profile: CameraProfile | PathLike,
    *,
    time_s: float,
    exposure_s: float | None,
    preset: str = "balanced",
    translation: FrameTranslation | None = None,
    **settings: Any,
) -> RestoredFrame:
    """Deblur and straighten one frame.

    frame: (height, width) or (height, width, 3) RGB, uint8, as stored.  motion: inertial samples, or a trajectory of
    the camera's orientation, on the IMU's clock.  time_s: the frame's timestamp on the camera's clock; the profile's
    ``time_offset_s`` must be known.  exposure_s: as logged; None straightens only.  translation: of the camera, if
    known; otherwise only rotation is corrected.  settings: fields of RestorationSettings, such as ``shutter``.
    The result's ``picture`` has the shape of ``frame``; ``parameters`` are those of ``parameters.jsonl``.
    """
    camera = profile if isinstance(profile, CameraProfile) else read_any_profile(Path(profile))
    picture = as_colour(frame)
    if picture.shape[:2] != (camera.height, camera.width):
        raise SettingsError(
            f"the frame is {picture.shape[1]}x{picture.shape[0]}, the profile {camera.width}x{camera.height}",
            hint="a profile applies to one stored frame size",
        )
    for name, value in (("time_offset_s", camera.time_offset_s), ("intrinsics", camera.intrinsics)):
        if value is None:
            raise SettingsError(
                f"the profile's {name} is unknown", hint="fit it with virest.calibrate, or use Capture.restore"
            )
    _require_times(time_s, exposure_s)
    composed = _settings(preset, settings)
    trajectory = motion if isinstance(motion, Trajectory) else integrate_gyro(checked_samples(motion), camera)
    lens = moving_lens(trajectory, camera)
    rows = row_motion(trajectory, camera, time_s, exposure_s, composed.reference, translation, lens)
    stamp = Frame(0, round(1e9 * time_s), time_s, exposure_s)
    restored = restore_frame(stamp, picture, rows, trajectory, composed)
    if frame.ndim == 2 and restored.picture is not None:
        return dataclasses.replace(restored, picture=restored.picture[..., 1])
    return restored


def deblur(
    picture: Picture,
    kernel: NDArray[Any] | None = None,
    *,
    path_px: NDArray[Any] | None = None,
    response: str | ResponseCurve = "srgb",
    preset: str = "balanced",
    **settings: Any,
) -> Picture:
    """Deblur a picture with one kernel or one blur path for the whole picture.

    picture: (height, width) or (height, width, 3) RGB, uint8.  kernel: 2-D, of the convolution ``recorded light =
    sharp light ∗ kernel``; any positive sum.  path_px: (k, 2) displacement of a point during the exposure, x
    right, y down; the result shows displacement (0, 0).  response: the exposure curve between light and grey, ``srgb``,
    ``linear``, ``gamma:2.2`` or a record.  Noise is measured in the picture.  Returns an array of the same shape.
    """
    from virest.app.simulate import parse_response

    if (kernel is None) == (path_px is None):
        raise SettingsError("deblur needs a kernel or path_px", hint="pass exactly one of the two")
    curve = response if isinstance(response, ResponseCurve) else parse_response(response)
    path, light = path_of_kernel(np.asarray(kernel)) if path_px is None else (even_path(np.asarray(path_px)), None)
    sharp = deblur_along(as_colour(picture), path, light, curve, _settings(preset, settings))
    return np.ascontiguousarray(sharp[..., 1]) if picture.ndim == 2 else sharp


def calibrate(
    path: PathLike, config: PathLike | None = None, extra: Sequence[str] = (), out: PathLike | None = None
) -> CalibrationFacts:
    """Fit clock, readout, axes and gyroscope bias to a capture; returns the mapping of ``virest calibrate --json``.

    extra: names of ``--with``.  out: write the calibrated profile here.  Raises CalibrationError if the motion does
    not determine the time offset.
    """
    from virest.app.calibrate import (
        CalibrationOutput,
        find_calibration,
        plan_calibration,
        run_calibration,
        unknown_extra,
    )

    for name in extra:
        if wrong := unknown_extra(name):
            raise SettingsError(wrong, hint="virest calibrate --help lists the names of --with")
    plan = plan_calibration(Path(path), None if config is None else Path(config), extra)
    if out is not None:
        return cast(CalibrationFacts, run_calibration(plan, CalibrationOutput(Path(out)))[0])
    return cast(CalibrationFacts, find_calibration(plan)[0])


def diagnose(path: PathLike, config: PathLike | None = None, out: PathLike | None = None) -> DiagnosisFacts:
    """Test the camera model on a capture; returns the mapping of ``virest diagnose --json``.

    ``extended_profile`` is the profile with the causes included, as a mapping; ``residuals`` are the residuals of the
    tracked points before and after.  out: also write ``OUT/<capture>/`` as the command does.
    """
    from virest.app.diagnose import DiagnosisOptions, find_diagnosis, run_diagnosis

    chosen = None if config is None else Path(config)
    if out is not None:
        return cast(DiagnosisFacts, run_diagnosis(os.fspath(path), DiagnosisOptions(Path(out), chosen)).facts)
    return cast(DiagnosisFacts, find_diagnosis(Path(path), chosen))


def simulate(out: PathLike, **options: Unpack[SimulationOptions]) -> SimulationFacts:
    """Write a capture with known ground truth to the folder ``out``; returns the mapping of ``virest simulate --json``.

    options: those of :func:`virest.app.simulate.simulate_command`, such as ``scene``, ``frames``, ``effects``.
    """
    from virest.app.simulate import simulate_command

    return cast(SimulationFacts, simulate_command(Path(out), **options))


def _require_times(time_s: float, exposure_s: float | None) -> None:
    if not math.isfinite(time_s):
        raise SettingsError(f"time_s is {time_s}", hint="pass the frame's timestamp in seconds")
    if exposure_s is not None and not 0.0 <= exposure_s <= LONGEST_EXPOSURE_S:
        text = f"exposure_s is {exposure_s:g}, outside 0 to {LONGEST_EXPOSURE_S:g}"
        raise SettingsError(text, hint="pass seconds, or None to straighten only")


def _settings(preset: str, given: Mapping[str, Any]) -> RestorationSettings:
    from virest.app.settings import checked_settings, compose_settings

    unknown = set(given) - {field.name for field in dataclasses.fields(RestorationSettings)}
    if unknown:
        raise SettingsError(f"unknown setting '{sorted(unknown)[0]}'", hint="see the fields of RestorationSettings")
    if preset not in PRESETS:
        raise SettingsError(f"preset '{preset}' is unknown", hint=f"choose from {', '.join(PRESETS)}")
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in given.items()}
    return compose_settings(None, preset=preset, **checked_settings(plain, "settings"))
