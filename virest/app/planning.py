"""Reading a capture and planning its restoration: in the program itself, or ahead of its turn in a worker."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest import __version__
from virest.app.finish import FinishWishes
from virest.app.outputs import file_facts, plain
from virest.app.run_folder import Mode, RunFolder, check_run
from virest.app.segments import PictureWishes
from virest.app.worker_processes import prepare_worker
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.camera.profile_file import profile_mapping
from virest.capture.folder import Capture, Frame, read_capture, resolve_profile, unpack_hint
from virest.capture.location import locate
from virest.capture.profile_source import PROFILE_NAME
from virest.capture.video import MovieIndex, probe_movie, read_gray
from virest.errors import CaptureError, VirestError
from virest.inference.recorder_stall import at_shown_times, fit_stall, stall_window
from virest.report.words import with_deviation
from virest.restoration.capture import RestorationPlan, at_true_times
from virest.restoration.capture_estimation import plan_restoration
from virest.restoration.plan_notes import NoteCode
from virest.restoration.settings import RestorationSettings
from virest.restoration.undistortion import require_undistortable

log = logging.getLogger(__name__)

MOST_STALLS = 6
"""Stalls whose frames are told, the first ones: the cost does not grow with the movie."""
SHOWN_CHARACTERS = 200
"""Of a name that is longer, in messages."""


@dataclass(frozen=True, slots=True)
class ProcessOptions:
    """What one ``virest process`` was asked for, beside the captures."""

    out: Path
    settings: RestorationSettings
    config: Path | None = None
    frames: slice = field(default_factory=lambda: slice(None))
    """Of the movie's frame indices."""
    jobs: int = 1
    scheduler: str | None = None
    mode: Mode = "new"
    command: str = ""
    pictures: PictureWishes = PictureWishes()  # noqa: RUF009  (frozen)
    finish: FinishWishes = FinishWishes()  # noqa: RUF009  (frozen)
    json_lines: bool = False
    """Give each frame's line on standard output, in frame order, as they are done."""
    quiet: bool = False
    verbose: bool = False


@dataclass(frozen=True, slots=True)
class Job:
    """One capture, read and checked, before its restoration is planned."""

    name: str
    path: str
    """As it was given."""
    run: RunFolder
    capture: Capture
    profile: CameraProfile
    profile_source: str
    selected: tuple[Frame, ...]
    request: dict[str, Any]
    """What must be equal for a run to be continued, and what run.json repeats."""
    inputs: tuple[Path, ...]
    """The files that the request tells of."""


@dataclass(frozen=True, slots=True)
class Message:
    """One line for the log."""

    logger: str
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class Planned:
    """A capture that was read and planned, here or by a worker; as far as that went."""

    job: Job | None = None
    index: MovieIndex | None = None
    """None where the run is finished and only to be repeated."""
    plan: RestorationPlan | None = None
    error: VirestError | None = None
    """Why it went no further."""
    seconds: float = 0.0
    """Wall-clock time that it took."""
    messages: tuple[Message, ...] = ()
    """What was said meanwhile, where another process was at work."""


def plan_capture(path: str, name: str, options: ProcessOptions) -> Planned:
    """Read a capture and plan its restoration. An error of ours comes back with what is known until then."""
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
    """The same in a worker; what it says is kept, for the capture's turn."""
    prepare_worker()
    with _Keeper(logging.DEBUG if options.verbose else logging.INFO) as messages:
        planned = plan_capture(path, name, options)
    return dataclasses.replace(planned, messages=tuple(messages))


class _Keeper(logging.Handler):
    """Keeps what one thread logs; a cluster's worker may have others at work in the same process."""

    at_work = 0
    """How many keepers there are; the first lowers the logger's level, the last puts it back."""
    level_before = logging.NOTSET
    gate = threading.Lock()

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.thread = threading.get_ident()
        self.kept: list[Message] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        if record.thread == self.thread:
            self.kept.append(Message(record.name, record.levelno, record.getMessage()))

    def __enter__(self) -> list[Message]:
        logger = logging.getLogger("virest")
        with self.gate:
            if not _Keeper.at_work:
                _Keeper.level_before = logger.level
                logger.setLevel(self.level)
            _Keeper.at_work += 1
        logger.addHandler(self)
        return self.kept

    def __exit__(self, *_: object) -> None:
        logger = logging.getLogger("virest")
        logger.removeHandler(self)
        with self.gate:
            _Keeper.at_work -= 1
            if not _Keeper.at_work:
                logger.setLevel(_Keeper.level_before)


def say(messages: Sequence[Message]) -> None:
    """Log here what was kept elsewhere."""
    for message in messages:
        logging.getLogger(message.logger).log(message.level, "%s", message.text)


def require_startable(path: str, name: str, options: ProcessOptions) -> None:
    """Raise what can be told before any reading: no capture, or a run in its place."""
    _require_capture(path)
    if options.mode == "new":
        check_run(RunFolder(options.out / name), {}, "new")


def shown(name: str) -> str:
    """A name as messages have it: not of any length."""
    return name if len(name) <= SHOWN_CHARACTERS else f"{name[:SHOWN_CHARACTERS]}…"


def _require_capture(path: str) -> None:
    """Raise CaptureError where the path names no folder."""
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
    """Read the capture and the profile, select frames, and note down the request."""
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
    """The frames that were asked for, at the times that a profile gives them."""
    frames = at_true_times(capture.frames, profile, capture.repeats)
    chosen = sorted(range(len(frames))[options.frames])
    return tuple(_admit(frames[i], keep_start_up=options.settings.keep_start_up) for i in chosen)


def _admit(frame: Frame, *, keep_start_up: bool) -> Frame:
    """The frame, without its reason to be left out where that is only the recorder's start-up and it is to be kept."""
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
    wishes = {**dataclasses.asdict(options.pictures), **dataclasses.asdict(options.finish)}
    if options.pictures != PictureWishes() or options.finish != FinishWishes():
        request["outputs"] = wishes
    return plain(request)


def _input_files(capture: Capture, config: Path | None) -> Iterator[Path]:
    """Movie or list of pictures, logs, and the profile: the capture's own, or the one given by --config."""
    yield from (file for file in capture.inputs if file.is_file())
    own = capture.folder / PROFILE_NAME
    if config is not None:
        yield config
    elif own.is_file():
        yield own


def _plan(job: Job, index: MovieIndex, settings: RestorationSettings) -> RestorationPlan:
    """Have what is unknown estimated; say what was found."""
    steps: dict[int, float] = {}

    def read_decodable(numbers: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        for number, picture in read_gray(job.capture.movie, index, numbers, steps):
            if picture is not None:
                yield number, picture

    plan = plan_restoration(job.capture, job.profile, settings, read_decodable, steps)
    for name, estimate in plan.profile.estimates.items():
        told = name == "time_offset_s" and any(note.code is NoteCode.TIME_OFFSET for note in plan.said)
        if name not in job.profile.estimates and not told:
            said = with_deviation(name, estimate.value, estimate.std)
            log.info("%s: %s %s (%s)", job.name, name, said, estimate.source)
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
    """Frames of an encoder's stalls at the times of what they show, where points tell; else they stay left out.

    Their translations were worked out for the times of their stamps, and go.
    """
    capture, found = job.capture, []
    if plan.copy_reason is not None:
        return job, plan
    for stall in capture.stalls[:MOST_STALLS]:
        pictures = read_gray(capture.movie, index, stall_window(capture, stall))
        told = fit_stall(capture, plan.profile, stall, {n: p for n, p in pictures if p is not None})
        if told is None:
            log.info("%s: points do not tell when frames %d-%d were taken", job.name, *stall)
            continue
        found.append(told)
        late_s = capture.frames[told.shows[0]].time_s - capture.frames[told.first].time_s
        text = (
            f"the encoder's stall is followed: frames {told.first} to {told.last}, up to {1e3 * late_s:.0f} ms later "
            f"than stamped, are taken at their true times (by points within {1e3 * told.rest_s[0]:+.1f} "
            f"± {1e3 * told.rest_s[1]:.1f} ms)"
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
    """Say where there is no distortion to be undone.  Raises SettingsError where it cannot be."""
    if lens is not None and lens.is_distorted:
        require_undistortable(lens)
        return
    why = "the focal length is unknown" if lens is None else "the profile's lens has no distortion"
    log.warning("%s: --undistort changes nothing: %s; virest calibrate --with distortion may find it", name, why)
