"""Read a capture and plan its restoration: in the main process, or ahead of its turn in a worker."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest import __version__
from virest.app.finish import FinishOptions
from virest.app.outputs import file_facts, plain
from virest.app.run_folder import Mode, RunFolder, check_run
from virest.app.segments import PictureOptions
from virest.app.worker_processes import prepare_worker
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import profile_mapping
from virest.capture.folder import Capture, Frame, read_capture, resolve_profile, unpack_hint
from virest.capture.frame_coding import FrameCoding
from virest.capture.location import locate
from virest.capture.profile_source import PROFILE_NAME
from virest.capture.video import MovieIndex, probe_movie, read_decodable_gray, read_frames
from virest.errors import CaptureError, VirestError
from virest.inference.recorder_stall import at_shown_times, fit_stall, stall_window, start_up_stalls
from virest.report.words import with_deviation
from virest.restoration.capture import RestorationPlan, at_true_times
from virest.restoration.capture_estimation import plan_restoration
from virest.restoration.plan_notes import NoteCode
from virest.restoration.settings import RestorationSettings
from virest.restoration.undistortion import require_undistortable

log = logging.getLogger(__name__)

MOST_STALLS = 12
"""Maximum number of stalls that are corrected, the first ones: a bound on the cost for long movies."""
SHOWN_CHARACTERS = 200
"""Length to which messages cut longer names."""


@dataclass(frozen=True, slots=True)
class ProcessOptions:
    """The options of one ``virest process``."""

    out: Path
    settings: RestorationSettings
    config: Path | None = None
    frames: slice = field(default_factory=lambda: slice(None))
    """Selection by movie frame index."""
    jobs: int = 1
    scheduler: str | None = None
    mode: Mode = "new"
    command: str = ""
    pictures: PictureOptions = PictureOptions()  # noqa: RUF009  (frozen)
    finish: FinishOptions = FinishOptions()  # noqa: RUF009  (frozen)
    json_lines: bool = False
    """Print each frame's line on standard output, in frame order, as soon as it is finished."""
    quiet: bool = False
    verbose: bool = False


@dataclass(frozen=True, slots=True)
class Job:
    """One capture, read and checked, before its restoration is planned."""

    name: str
    path: str
    """The path as given."""
    run: RunFolder
    capture: Capture
    profile: CameraProfile
    profile_source: str
    selected: tuple[Frame, ...]
    request: dict[str, Any]
    """What must be equal for a run to be resumed; also stored in run.json."""
    inputs: tuple[Path, ...]
    """The input files that the request describes."""


@dataclass(frozen=True, slots=True)
class Message:
    """One line for the log."""

    logger: str
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class Planned:
    """The outcome of reading and planning a capture, here or in a worker; incomplete after an error."""

    job: Job | None = None
    index: MovieIndex | None = None
    """None if the run is already finished."""
    plan: RestorationPlan | None = None
    error: VirestError | None = None
    """The error that stopped planning."""
    seconds: float = 0.0
    """Wall-clock time of planning."""
    messages: tuple[Message, ...] = ()
    """Log messages of the worker, if planned in another process."""


def plan_capture(path: str, name: str, options: ProcessOptions) -> Planned:
    """Read a capture and plan its restoration. A VirestError is returned with what is known so far."""
    began = time.perf_counter()
    planned = Planned()
    try:
        require_startable(path, name, options)
        job = _read_job(path, name, RunFolder(options.out / name), options)
        planned = Planned(job)
        if check_run(job.run, job.request, options.mode) != "finished" or options.mode != "resume":
            index = probe_movie(job.capture.movie)
            plan = _plan(job, index, options.settings)
            job, plan = _with_stalls_followed(job, index, plan)
            job = dataclasses.replace(job, selected=_selected(job.capture, plan.profile, options))
            planned = Planned(job, index, plan)
    except VirestError as error:
        planned = dataclasses.replace(planned, error=error)
    return dataclasses.replace(planned, seconds=time.perf_counter() - began)


def plan_elsewhere(path: str, name: str, options: ProcessOptions) -> Planned:
    """The same in a worker; log messages are collected for the capture's turn."""
    prepare_worker()
    with _MessageCollector(logging.DEBUG if options.verbose else logging.INFO) as messages:
        planned = plan_capture(path, name, options)
    return dataclasses.replace(planned, messages=tuple(messages))


class _MessageCollector(logging.Handler):
    """Collects the log messages of one thread; a cluster's worker may run others in the same process."""

    at_work = 0
    """Number of active collectors; the first lowers the logger's level, the last restores it."""
    level_before = logging.NOTSET
    gate = threading.Lock()

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.thread = threading.get_ident()
        self.messages: list[Message] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Collect a message."""
        if record.thread == self.thread:
            self.messages.append(Message(record.name, record.levelno, record.getMessage()))

    def __enter__(self) -> list[Message]:
        logger = logging.getLogger("virest")
        with self.gate:
            if not _MessageCollector.at_work:
                _MessageCollector.level_before = logger.level
                logger.setLevel(self.level)
            _MessageCollector.at_work += 1
        logger.addHandler(self)
        return self.messages

    def __exit__(self, *_: object) -> None:
        logger = logging.getLogger("virest")
        logger.removeHandler(self)
        with self.gate:
            _MessageCollector.at_work -= 1
            if not _MessageCollector.at_work:
                logger.setLevel(_MessageCollector.level_before)


def log_messages(messages: Sequence[Message]) -> None:
    """Log messages that were collected in a worker."""
    for message in messages:
        logging.getLogger(message.logger).log(message.level, "%s", message.text)


def require_startable(path: str, name: str, options: ProcessOptions) -> None:
    """Raise errors that are known before reading: no capture, or an existing run in its output folder."""
    _require_capture(path)
    if options.mode == "new":
        check_run(RunFolder(options.out / name), {}, "new")


def shown(name: str) -> str:
    """A name for messages, cut to SHOWN_CHARACTERS."""
    return name if len(name) <= SHOWN_CHARACTERS else f"{name[:SHOWN_CHARACTERS]}…"


def _require_capture(path: str) -> None:
    """Raise CaptureError if the path is not a folder."""
    place = locate(path)
    try:
        if place.is_dir():
            return
        what = "is not a folder" if place.exists() else "no such folder"
    except (OSError, ValueError) as fault:  # a name too long, an address that does not answer
        what = getattr(fault, "strerror", None) or str(fault)
    hint = unpack_hint(path) or "pass the folder that holds movie.mp4 and the sensor logs"
    raise CaptureError(f"{shown(path)}: {what}", hint=hint)


def _read_job(path: str, name: str, run: RunFolder, options: ProcessOptions) -> Job:
    """Read the capture and the profile, select frames, and record the request."""
    capture = read_capture(locate(path))
    for note in capture.notes:
        log.log(logging.INFO if note.severity == "info" else logging.WARNING, "%s: %s", name, note.text)
    profile, source = resolve_profile(capture, options.config)
    log.info("%s: camera profile from %s", name, source)
    chosen = sorted(range(len(capture.frames))[options.frames])
    selected = _selected(capture, profile, options)
    inputs = tuple(_input_files(capture, options.config))
    request = _request(profile, options, chosen, inputs)
    return Job(name, path, run, capture, profile, str(source), selected, request, inputs)


def _selected(capture: Capture, profile: CameraProfile, options: ProcessOptions) -> tuple[Frame, ...]:
    """The selected frames, at their times by the profile."""
    frames = at_true_times(capture.frames, profile, capture.repeats)
    chosen = sorted(range(len(frames))[options.frames])
    return tuple(_admit(frames[i], keep_start_up=options.settings.keep_start_up) for i in chosen)


def _admit(frame: Frame, *, keep_start_up: bool) -> Frame:
    """The frame, without its skip reason if that is only the recorder's start-up and start-up frames are kept."""
    if keep_start_up and frame.only_startup:
        return dataclasses.replace(frame, skip_reason=None, skip_codes=())
    return frame


def _request(
    profile: CameraProfile, options: ProcessOptions, chosen: list[int], inputs: Sequence[Path]
) -> dict[str, Any]:
    mapping = json.dumps(plain(profile_mapping(profile)), sort_keys=True, allow_nan=False)
    step = chosen[1] - chosen[0] if len(chosen) > 1 else 1
    request = {
        "version": __version__,
        "command": options.command,
        "settings": dataclasses.asdict(options.settings),
        "frames": f"{chosen[0]}:{chosen[-1] + 1}:{step}" if chosen else "none",
        "profile_sha256": hashlib.sha256(mapping.encode()).hexdigest(),
        "inputs": [file_facts(file) for file in inputs],
    }
    outputs = {**dataclasses.asdict(options.pictures), **dataclasses.asdict(options.finish)}
    if options.pictures != PictureOptions() or options.finish != FinishOptions():
        request["outputs"] = outputs
    return plain(request)


def _input_files(capture: Capture, config: Path | None) -> Iterator[Path]:
    """Movie or list of images, logs, and the profile: the capture's own, or the one given by --config."""
    yield from (file for file in capture.inputs if file.is_file())
    own = capture.folder / PROFILE_NAME
    if config is not None:
        yield config
    elif own.is_file():
        yield own


def estimate_plan(
    capture: Capture, index: MovieIndex, profile: CameraProfile, settings: RestorationSettings
) -> RestorationPlan:
    """The plan for restoring a capture, with the values estimated from its movie that the profile does not know."""
    coding: dict[int, FrameCoding] = {}
    read = partial(read_decodable_gray, capture.movie, index, coding=coding)
    return plan_restoration(capture, profile, settings, read, coding)


def read_with_neighbours(
    movie: Path, index: MovieIndex, frames: Sequence[Frame], number: int, reach: int, coding: dict[int, FrameCoding]
) -> list[tuple[Frame, NDArray[np.uint8]]] | None:
    """A frame and its usable neighbours up to ``reach`` away, in order, RGB; None if the frame cannot be decoded.

    coding: filled with how each frame was coded.
    """
    first, last = max(number - reach, 0), min(number + reach, len(frames) - 1)
    decoded = {n: picture for n, picture in read_frames(movie, index, first, last, coding) if picture is not None}
    if number not in decoded:
        return None
    return [(frames[n], decoded[n]) for n in sorted(decoded) if n == number or frames[n].skip_reason is None]


def _plan(job: Job, index: MovieIndex, settings: RestorationSettings) -> RestorationPlan:
    """Estimate unknown profile values and log the results."""
    plan = estimate_plan(job.capture, index, job.profile, settings)
    for name, estimate in plan.profile.estimates.items():
        logged = name == "time_offset_s" and any(note.code is NoteCode.TIME_OFFSET for note in plan.said)
        if name not in job.profile.estimates and not logged:
            text = with_deviation(name, estimate.value, estimate.std)
            log.info("%s: %s %s (%s)", job.name, name, text, estimate.source)
    for note in plan.notes:
        log.info("%s: %s", job.name, note)
    for warning in plan.warnings:
        log.warning("%s: %s", job.name, warning)
    if settings.undistort:
        _check_lens(job.name, plan.profile.intrinsics)
    if plan.copy_reason:
        log.warning("%s: all frames are copied: %s", job.name, plan.copy_reason)
    return plan


def _with_stalls_followed(job: Job, index: MovieIndex, plan: RestorationPlan) -> tuple[Job, RestorationPlan]:
    """Give frames of encoder stalls the times of their content, if tracked points determine them; else they stay out.

    Their translations were computed for the logged times, and are dropped.
    """
    capture, found = job.capture, []
    if plan.copy_reason is not None:
        return job, plan
    for stall in (*start_up_stalls(capture, plan.profile), *capture.stalls)[:MOST_STALLS]:
        pictures = read_decodable_gray(capture.movie, index, stall_window(capture, stall))
        fit = fit_stall(capture, plan.profile, stall, dict(pictures))
        if fit is None:
            log.info("%s: the true times of frames %d-%d could not be determined from points", job.name, *stall)
            continue
        found.append(fit)
        moved_s = [
            capture.frames[shown].time_s - capture.frames[slot].time_s
            for slot, shown in zip(range(fit.first, fit.last + 1), fit.shows, strict=True)
        ]
        most_s = max(moved_s, key=abs)
        text = (
            f"encoder stall corrected: frames {fit.first} to {fit.last}, up to {1e3 * abs(most_s):.0f} ms "
            f"{'later' if most_s > 0 else 'earlier'} than stamped, are used at their true times (remaining error from "
            f"tracked points {1e3 * fit.rest_s[0]:+.1f} ± {1e3 * fit.rest_s[1]:.1f} ms)"
        )
        log.warning("%s: %s", job.name, text)
        plan = plan.noted(NoteCode.TRUE_TIMES, text)
    if not found:
        return job, plan
    moved = {slot for one in found for slot in range(one.first, one.last + 1)}
    if plan.translations is not None:
        kept = {number: motion for number, motion in plan.translations.items() if number not in moved}
        plan = dataclasses.replace(plan, translations=kept)
    return dataclasses.replace(job, capture=at_shown_times(capture, found)), plan


def _check_lens(name: str, lens: Intrinsics | None) -> None:
    """Warn if there is no distortion to remove.  Raises SettingsError if it cannot be removed."""
    if lens is not None and lens.is_distorted:
        require_undistortable(lens)
        return
    why = "the focal length is unknown" if lens is None else "the profile's lens has no distortion"
    log.warning("%s: --undistort has no effect: %s; virest calibrate --with distortion may find it", name, why)
