"""Captures with ground truth for evaluation, and the frames that the program restores from them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from virest import __version__
from virest.app.machine import installed_version
from virest.app.planning import estimate_plan
from virest.arrays import Picture
from virest.camera.profile import CameraProfile
from virest.capture.folder import Capture, Frame, read_capture, resolve_profile
from virest.capture.frame_coding import FrameCoding
from virest.capture.video import MovieIndex, probe_movie, read_frames
from virest.errors import CaptureError
from virest.image_formation.row_motion import RowMotion, row_motion
from virest.motion.integration import integrate_gyro
from virest.motion.trajectory import Trajectory
from virest.restoration.capture import RestorationPlan, at_true_times, restore_frames
from virest.restoration.frame import RestoredFrame
from virest.restoration.settings import RestorationSettings
from virest.simulation.recording import truth_picture


@dataclass(frozen=True, slots=True)
class TrueCapture:
    """A capture with sharp global-shutter images of its frames in truth/frames."""

    name: str
    capture: Capture
    profile: CameraProfile
    index: MovieIndex
    frames: tuple[Frame, ...]
    """Frames to evaluate, in order: usable frames with truth."""
    usable: tuple[Frame, ...]
    """All frames of the movie that are not skipped, in order."""

    def recorded(self, reach: int = 0, coding: dict[int, FrameCoding] | None = None) -> Iterator[tuple[Frame, Picture]]:
        """The evaluated frames and up to ``reach`` movie frames before and after each, with RGB pixels.

        coding: filled with how each frame was coded.
        """
        judged = {frame.index for frame in self.frames}
        near = {number + step for number in judged for step in range(-reach, reach + 1)}
        wanted = {frame.index: frame for frame in self.usable if frame.index in near}
        for number, picture in read_frames(self.capture.movie, self.index, min(wanted), max(wanted), coding):
            if number in wanted and picture is not None:
                yield wanted[number], picture

    def truth(self, number: int) -> Picture:
        """The sharp picture of a frame, RGB."""
        return truth_frame(self.capture.folder, number)

    def plan(self, settings: RestorationSettings, **profile: Any) -> RestorationPlan:
        """The plan of ``virest process``, with some profile values changed."""
        return estimate_plan(self.capture, self.index, replace(self.profile, **profile), settings)

    def restored(self, plan: RestorationPlan) -> Iterator[RestoredFrame]:
        """The evaluated frames as ``virest process`` restores them."""
        judged = {frame.index for frame in self.frames}
        coding: dict[int, FrameCoding] = {}
        return restore_frames(self.recorded(plan.reach, coding), self.capture.imu, plan, judged, coding)

    def motions(self, plan: RestorationPlan) -> dict[int, RowMotion]:
        """The motion over each usable frame according to the plan."""
        trajectory = self.trajectory(plan)
        reference, known = plan.settings.reference, plan.translations or {}
        return {
            f.index: row_motion(trajectory, plan.profile, f.time_s, f.exposure_s, reference, known.get(f.index))
            for f in self.usable
        }

    def trajectory(self, plan: RestorationPlan) -> Trajectory:
        """The orientations integrated from the inertial log with the plan's profile."""
        return integrate_gyro(self.capture.imu, plan.profile)


def open_true_capture(folder: Path, config: Path | None = None, chosen: slice = slice(None)) -> TrueCapture:
    """Read a capture that ``virest simulate`` wrote; CaptureError if no chosen frame has truth."""
    capture = read_capture(folder)
    profile, _ = resolve_profile(capture, config)
    frames = at_true_times(capture.frames, profile, capture.repeats)
    numbers = sorted(range(len(frames))[chosen])
    usable = tuple(frame for frame in frames if frame.skip_reason is None)
    chosen_ones = {frames[k].index for k in numbers}
    judged = tuple(f for f in usable if f.index in chosen_ones and truth_picture(folder, f.index).is_file())
    if not judged:
        raise CaptureError(
            f"{folder}: none of {len(numbers)} selected frames has ground truth in {folder.name}/truth/frames",
            hint="virest simulate writes captures with ground truth",
        )
    return TrueCapture(capture.folder.resolve().name, capture, profile, probe_movie(capture.movie), judged, usable)


@contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """A folder for simulated captures, removed at the end, as far as possible."""
    with tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def truth_frame(capture: Path, number: int) -> Picture:
    """The sharp global-shutter picture of a frame, RGB."""
    return read_picture(truth_picture(capture, number))


def read_picture(path: Path) -> Picture:
    """Read an 8-bit RGB picture."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise CaptureError(f"{path}: cannot be read as a picture", hint="give PNG or JPEG files")
    return picture[..., ::-1].astype(np.uint8)


def peer_versions() -> str:
    """Versions of virest, OpenCV and the peer library."""
    peer = installed_version("scikit-image") or "not installed"
    return f"virest {__version__}, OpenCV {cv2.__version__}, scikit-image {peer}"
