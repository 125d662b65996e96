"""``virest process``: read captures, have their frames restored, and write down what came out."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest import __version__
from virest.app import console
from virest.app.cluster import is_lost
from virest.app.jobs import Ahead, Segment, Workers, cut_frames, make_segment, prepare_worker, run_segments
from virest.app.outputs import (
    Mode,
    RunFolder,
    capture_name,
    check_run,
    file_facts,
    finish_run,
    finished_segments,
    opened_run,
    output_error,
    parse_lines,
    plain,
    remove_parts,
    remove_stray_pictures,
    resolved,
    write_failure,
)
from virest.camera.profile import CameraProfile, profile_mapping
from virest.capture.folder import (
    Capture,
    Frame,
    read_capture,
    resolve_profile,
)
from virest.capture.location import is_remote, locate, read_each
from virest.capture.profile_source import PROFILE_NAME
from virest.capture.video import MovieIndex, probe_movie, read_gray
from virest.errors import CaptureError, OutputError, SettingsError, VirestError
from virest.restoration.capture import RestorationPlan, at_true_times, plan_restoration
from virest.restoration.settings import RestorationSettings

log = logging.getLogger(__name__)

PARTLY_FAILED = 9
STATUSES = ("restored", "copied", "skipped", "failed")
MOST_FILES, MOST_BYTES = 32, 1 << 30
"""Of a capture that cannot be read: what is looked at for run.json."""
SHOWN_CHARACTERS = 200
"""Of a name that is longer, in messages."""
STAGES = ("decode", "estimate", "deblur", "shutter", "write")


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
    json_lines: bool = False
    """Give each frame's line on standard output, in frame order, as they are done."""
    quiet: bool = False
    verbose: bool = False


@dataclass(frozen=True, slots=True)
class CaptureOutcome:
    """What became of one capture."""

    name: str
    folder: Path
    counts: dict[str, int]
    """Frames by status."""
    verdict: str
    seconds: float
    """Wall-clock time."""

    @property
    def exit_code(self) -> int:
        """9 where a frame failed."""
        return PARTLY_FAILED if self.counts.get("failed") else 0


@dataclass(frozen=True, slots=True)
class _Job:
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
class _Message:
    """One line for the log."""

    logger: str
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class _Planned:
    """A capture that was read and planned, here or by a worker; as far as that went."""

    job: _Job | None = None
    index: MovieIndex | None = None
    """None where the run is finished and only to be repeated."""
    plan: RestorationPlan | None = None
    error: VirestError | None = None
    """Why it went no further."""
    seconds: float = 0.0
    """Wall-clock time that it took."""
    messages: tuple[_Message, ...] = ()
    """What was said meanwhile, where another process was at work."""


@dataclass(frozen=True, slots=True)
class _Turn:
    """One of the captures of a call."""

    path: str
    """As it was given."""
    name: str
    number: int = 0
    among: int = 1
    """How many captures there are."""
    ahead: Ahead[_Planned] | None = None
    """The workers that plan; None: it is done here."""

    def begin_next(self) -> None:
        """Give the captures that follow to the workers, behind what they still have of this one."""
        if self.ahead:
            self.ahead.begin(self.number + 1)

    def plan(self, options: ProcessOptions) -> _Planned:
        """The capture, read and planned."""
        if self.ahead:
            return self.ahead.result(self.number, self.name)
        return _plan_capture(self.path, self.name, options)


def process_captures(paths: list[str], options: ProcessOptions) -> int:
    """Process captures one after the other. Returns the exit code: a capture's own, or 9 where some of many failed.

    With several workers the captures are read and planned by them, some ahead of their turn.
    """
    names = _require_distinct_names(paths)
    _require_out(options.out)
    if options.config is not None and not options.config.is_file():
        raise SettingsError(f"{options.config}: no such file", hint="--config takes a camera profile")
    outcomes: list[CaptureOutcome] = []
    codes: list[int] = []
    workers = Workers(options.jobs, options.scheduler, verbose=options.verbose)
    try:
        if options.scheduler is not None:
            workers.start()  # before any reading, so that a wrong address costs nothing
        ahead = _planned_ahead(paths, names, options, workers)
        for number, (path, name) in enumerate(zip(paths, names, strict=True)):
            try:
                turn = _Turn(path, name, number, len(paths), ahead)
                outcomes.append(_process(turn, options, workers))
                codes.append(outcomes[-1].exit_code)
            except (BrokenPipeError, SettingsError, MemoryError) as error:
                if isinstance(error, BrokenPipeError) or len(paths) == 1:
                    raise
                codes.append(console.report_error(error, _shown(name)))
            except Exception as error:  # a failed capture is a normal, explained outcome of a batch
                if is_lost(error):
                    raise
                codes.append(console.report_error(error, _shown(name)))
    finally:
        workers.kill()
    if outcomes and not options.json_lines:
        console.emit(_summary(outcomes))
    failures = [code for code in codes if code]
    return 0 if not failures else failures[0] if len(codes) == 1 else PARTLY_FAILED


def _require_distinct_names(paths: list[str]) -> list[str]:
    names = [capture_name(path) for path in paths]
    for name, times in Counter(names).items():
        if times > 1:
            both = ", ".join(path for path, n in zip(paths, names, strict=True) if n == name)
            raise OutputError(
                f"{times} captures are named {name!r} ({both}) and would share one output folder",
                hint="process them with different --out, or rename one",
            )
    return names


def _require_out(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file", hint="--out takes a folder")


def process_capture(path: str, name: str, options: ProcessOptions, workers: Workers) -> CaptureOutcome:
    """Process one capture into OUT/<name>. One that cannot be processed leaves its account there all the same."""
    return _process(_Turn(path, name), options, workers)


def _process(turn: _Turn, options: ProcessOptions, workers: Workers) -> CaptureOutcome:
    """Process the capture whose turn it is, and account for it if that cannot be."""
    began = time.perf_counter()
    planned = _Planned()
    try:
        _require_startable(turn.path, turn.name, options)
        planned = turn.plan(options)
        seconds = planned.seconds if turn.ahead else time.perf_counter() - began
        _say(planned.messages)
        if planned.error is not None:
            if turn.ahead and isinstance(planned.error, CaptureError):
                workers.start(locate(turn.path))  # a worker that does not see the capture is another error
            raise planned.error
        return _process_planned(turn, planned, options, workers, seconds)
    except Exception as error:
        if not (isinstance(error, OutputError | BrokenPipeError) or is_lost(error)):
            lost_s = time.perf_counter() - began + (planned.seconds if turn.ahead else 0.0)
            _leave_account(turn, options, planned, error, lost_s)
        raise


def _process_planned(
    turn: _Turn, planned: _Planned, options: ProcessOptions, workers: Workers, seconds: float
) -> CaptureOutcome:
    """Have a planned capture's segments done; ``seconds`` went into its plan."""
    began = time.perf_counter() - seconds
    assert planned.job is not None
    run = RunFolder(options.out / turn.name)
    job = dataclasses.replace(planned.job, run=run, path=turn.path)
    found = check_run(run, job.request, options.mode)
    if planned.index is None or planned.plan is None or (found == "finished" and options.mode == "resume"):
        with opened_run(run, job.request, "resume"):
            return _repeat_finished(job, options)
    with opened_run(run, job.request, options.mode):
        try:
            workers.start(job.capture.movie, run.path)
            return _run(job, planned.index, planned.plan, options, workers, began, turn.begin_next)
        except BaseException:
            workers.kill()
            raise


# ── planning ─────────────────────────────────────────────────────────────────────────────────────────────────────


def _planned_ahead(
    paths: list[str], names: list[str], options: ProcessOptions, workers: Workers
) -> Ahead[_Planned] | None:
    """The captures' plans, made by the workers; None where they are better made here, each at its turn.

    A cluster's workers need not see the file of --config.
    """
    if len(paths) == 1 or workers.here or (options.scheduler is not None and options.config is not None):
        return None
    if options.scheduler is None:
        return Ahead(_plan_elsewhere, [(path, name, options) for path, name in zip(paths, names, strict=True)], workers)
    apart = dataclasses.replace(options, out=options.out.absolute())  # a worker may stand in another folder
    places = [str(locate(path).absolute()) for path in paths]
    return Ahead(_plan_elsewhere, [(place, name, apart) for place, name in zip(places, names, strict=True)], workers)


def _plan_capture(path: str, name: str, options: ProcessOptions) -> _Planned:
    """Read a capture and plan its restoration. An error of ours comes back with what is known until then."""
    began = time.perf_counter()
    planned = _Planned()
    try:
        _require_startable(path, name, options)
        job = _read_job(path, name, RunFolder(options.out / name), options)
        planned = _Planned(job)
        if check_run(job.run, job.request, options.mode) != "finished" or options.mode != "resume":
            index = probe_movie(job.capture.movie)
            planned = _Planned(job, index, _plan(job, index, options.settings))
    except VirestError as error:
        planned = dataclasses.replace(planned, error=error)
    return dataclasses.replace(planned, seconds=time.perf_counter() - began)


def _plan_elsewhere(path: str, name: str, options: ProcessOptions) -> _Planned:
    """The same in a worker; what it says is kept, for the capture's turn."""
    prepare_worker()
    with _Keeper(logging.DEBUG if options.verbose else logging.INFO) as messages:
        planned = _plan_capture(path, name, options)
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
        self.kept: list[_Message] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        if record.thread == self.thread:
            self.kept.append(_Message(record.name, record.levelno, record.getMessage()))

    def __enter__(self) -> list[_Message]:
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


def _say(messages: Sequence[_Message]) -> None:
    for message in messages:
        logging.getLogger(message.logger).log(message.level, "%s", message.text)


def _require_startable(path: str, name: str, options: ProcessOptions) -> None:
    """Raise what can be told before any reading: no capture, or a run in its place."""
    _require_capture(path)
    if options.mode == "new":
        check_run(RunFolder(options.out / name), {}, "new")


def _shown(name: str) -> str:
    return name if len(name) <= SHOWN_CHARACTERS else f"{name[:SHOWN_CHARACTERS]}…"


def _require_capture(path: str) -> None:
    """Raise CaptureError where the path names no folder."""
    place = locate(path)
    try:
        if place.is_dir():
            return
        what = "is no folder" if place.exists() else "no such folder"
    except (OSError, ValueError) as fault:  # a name too long, an address that does not answer
        what = getattr(fault, "strerror", None) or str(fault)
    raise CaptureError(f"{_shown(path)}: {what}", hint="pass the folder that holds movie.mp4 and the sensor logs")


def _read_job(path: str, name: str, run: RunFolder, options: ProcessOptions) -> _Job:
    """Read the capture and the profile, select frames, and note down the request."""
    capture = read_capture(locate(path))
    for note in capture.notes:
        log.log(logging.INFO if note.severity == "info" else logging.WARNING, "%s: %s", name, note.text)
    profile, source = resolve_profile(capture, options.config)
    log.info("%s: camera profile from %s", name, source)
    chosen = sorted(range(len(capture.frames))[options.frames])
    frames = at_true_times(capture.frames, profile, capture.repeats)
    selected = tuple(_admit(frames[i], keep_start_up=options.settings.keep_start_up) for i in chosen)
    inputs = tuple(_input_files(capture, options.config))
    request = _request(profile, options, chosen, inputs)
    return _Job(name, path, run, capture, profile, str(source), selected, request, inputs)


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
    return plain(request)


def _input_files(capture: Capture, config: Path | None) -> Iterator[Path]:
    """Movie or list of pictures, logs, and the profile: the capture's own, or the one given by --config."""
    yield from (file for file in capture.inputs if file.is_file())
    own = capture.folder / PROFILE_NAME
    if config is not None:
        yield config
    elif own.is_file():
        yield own


def _plan(job: _Job, index: MovieIndex, settings: RestorationSettings) -> RestorationPlan:
    """Have what is unknown estimated; say what was found."""

    def read_decodable(numbers: Sequence[int]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        for number, picture in read_gray(job.capture.movie, index, numbers):
            if picture is not None:
                yield number, picture

    plan = plan_restoration(job.capture, job.profile, settings, read_decodable)
    for name, estimate in plan.profile.estimates.items():
        if name not in job.profile.estimates:
            spread = "" if estimate.std is None else f" ± {estimate.std}"
            log.info("%s: %s = %s%s (%s)", job.name, name, estimate.value, spread, estimate.source)
    for note in plan.notes:
        log.info("%s: %s", job.name, note)
    for warning in plan.warnings:
        log.warning("%s: %s", job.name, warning)
    if plan.copy_reason:
        log.warning("%s: all frames are copied: %s", job.name, plan.copy_reason)
    return plan


def _run(
    job: _Job,
    index: MovieIndex,
    plan: RestorationPlan,
    options: ProcessOptions,
    workers: Workers,
    began: float,
    given_out: Callable[[], None],
) -> CaptureOutcome:
    """Run the segments that are not done yet, then finish the run's folder; tells when all are given out."""
    parts = cut_frames(job.selected, job.capture.keyframes or index.keyframes)
    numbers = [tuple(frame.index for frame in part) for part in parts]
    done = finished_segments(job.run, numbers)
    _clean(job.run, [frame for n in done for frame in n])
    if done:
        log.info("%s: %d of %d segments were done before", job.name, len(done), len(parts))
    todo = (
        make_segment(part, job.capture, job.name, index, plan, job.run)
        for part, n in zip(parts, numbers, strict=True)
        if n not in done
    )
    give = _in_order(job.run, numbers, done) if options.json_lines else None
    _work(_then(todo, given_out), workers, give, len(job.selected), sum(map(len, done)), job.name, options.quiet)
    logs = [job.run.segment_log(n[0], n[-1]) for n in numbers]
    totals = _totals(logs)
    wall_s = time.perf_counter() - began
    account = _account(job, plan, totals, wall_s)
    finish_run(job.run, logs, account)
    _warn_about(job.name, account["counts"], len(job.selected))
    return CaptureOutcome(job.name, job.run.path, account["counts"], account["verdict"], wall_s)


def _then(todo: Iterator[Segment], given_out: Callable[[], None]) -> Iterator[Segment]:
    yield from todo
    given_out()


def _clean(run: RunFolder, keep: list[int]) -> None:
    try:
        remove_stray_pictures(run, keep)
        remove_parts(run)
    except OSError as error:
        raise output_error(run.path, error) from error


def _work(
    todo: Iterator[Segment],
    workers: Workers,
    give: Callable[[tuple[int, ...] | None], None] | None,
    total: int,
    before: int,
    name: str,
    quiet: bool,
) -> None:
    with console.progress_bar(total, name, quiet=quiet) as bar:
        if bar:
            bar.update(before)
        if give:
            give(None)
        for segment, counts in run_segments(todo, workers):
            if bar:
                bar.update(sum(counts.values()))
            if give:
                give(tuple(frame.index for frame in segment.frames))


def _in_order(
    run: RunFolder, numbers: list[tuple[int, ...]], done: set[tuple[int, ...]]
) -> Callable[[tuple[int, ...] | None], None]:
    """A function to be told of finished segments, that gives out their lines as soon as all before are given."""
    waiting = list(reversed(numbers))
    finished = set(done)

    def give(number: tuple[int, ...] | None) -> None:
        if number is not None:
            finished.add(number)
        while waiting and waiting[-1] in finished:
            ready = waiting.pop()
            for line in run.segment_log(ready[0], ready[-1]).read_text("utf-8").splitlines():
                console.emit(line)

    return give


def _totals(logs: list[Path]) -> dict[str, Any]:
    """Counts by status, warnings by text, and seconds by stage, over all lines."""
    counts: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    for content in read_each(logs):
        for line in parse_lines(content):
            counts[line["status"]] += 1
            seconds.update({stage: line["seconds"].get(stage, 0.0) for stage in STAGES})
    return {"counts": {status: counts[status] for status in STATUSES}, "seconds": dict(seconds)}


def _account(job: _Job, plan: RestorationPlan, totals: dict[str, Any], wall_s: float) -> dict[str, Any]:
    """The content of run.json."""
    notes = [note.text for note in job.capture.notes if note.severity != "info"]
    counts = totals["counts"]
    return {
        "virest_run": 1,
        "version": __version__,
        "capture": job.name,
        "status": "done",
        "exit_code": PARTLY_FAILED if counts["failed"] else 0,
        "failure": None,
        "source": _source(job.path),
        "folder": str(job.capture.folder.absolute()),
        "movie": str(job.capture.movie.absolute()),
        "command": job.request["command"],
        "profile": profile_mapping(plan.profile),
        "profile_source": job.profile_source,
        "profile_sha256": job.request["profile_sha256"],
        "settings": dataclasses.asdict(plan.settings),
        "frames": job.request["frames"],
        "inputs": _inputs(job),
        "counts": counts,
        "totals": _sums(len(job.selected), totals["seconds"], wall_s),
        "verdict": verdict(counts, plan.copy_reason),
        "warnings": [*notes, *plan.warnings, *([plan.copy_reason] if plan.copy_reason else [])],
    }


def _source(path: str) -> dict[str, str]:
    """Where the capture is: as it was given, and where that lies, links followed."""
    return {"given": path, "resolved": resolved(path)}


def _facts_of_folder(folder: Path) -> list[dict[str, Any]]:
    """Facts of plain files in the folder of a capture that could not be read, in bounded time; none at an address."""
    facts: list[dict[str, Any]] = []
    left = 0 if is_remote(folder) else MOST_BYTES
    with suppress(OSError):
        for file in sorted(folder.iterdir())[:MOST_FILES] if left else ():
            with suppress(OSError):
                if file.is_file() and (size := file.stat().st_size) <= left:
                    left -= size
                    facts.append({**file_facts(file), "path": resolved(file)})
    return facts


def _inputs(job: _Job) -> list[dict[str, Any]]:
    """Facts of the input files with their places."""
    known = zip(job.request["inputs"], job.inputs, strict=True)
    return [{**facts, "path": resolved(file)} for facts, file in known]


def _sums(frames: int, seconds: Mapping[str, float], wall_s: float) -> dict[str, Any]:
    return {
        "frames": frames,
        "seconds": {**{stage: round(seconds.get(stage, 0.0), 3) for stage in STAGES}, "wall": round(wall_s, 3)},
        "frames_per_s": round(frames / wall_s, 3) if wall_s > 0 else None,
    }


def _leave_account(turn: _Turn, options: ProcessOptions, planned: _Planned, error: Exception, wall_s: float) -> None:
    """Write down why a capture could not be processed, where no run stands in its folder.

    A single path that leads nowhere is a slip of the pen: it leaves nothing.
    """
    try:
        if turn.among == 1 and not locate(turn.path).is_dir():
            return
        account = _failure_account(turn, options, planned.job, error, wall_s)
        write_failure(RunFolder(options.out / turn.name), account)
    except (VirestError, OSError, ValueError) as fault:
        log.warning("%s: this failure leaves no account: %s", _shown(turn.name), _shown(str(fault)))


def _failure_account(
    turn: _Turn, options: ProcessOptions, job: _Job | None, error: Exception, wall_s: float
) -> dict[str, Any]:
    """The content of run.json for a capture that could not be processed; what was not found out is empty."""
    kind = type(error).__name__
    known = error if isinstance(error, VirestError) else VirestError(f"{kind}: {error}", hint=console.OUR_FAULT)
    return {
        "virest_run": 1,
        "version": __version__,
        "capture": turn.name,
        "status": "failed",
        "exit_code": known.exit_code,
        "failure": {"error": kind, "reason": known.message, "hint": known.hint},
        "source": _source(turn.path),
        "folder": str(locate(turn.path).absolute()),
        "movie": str(job.capture.movie.absolute()) if job else None,
        "command": options.command,
        "profile": profile_mapping(job.profile) if job else {},
        "profile_source": job.profile_source if job else "",
        "profile_sha256": job.request["profile_sha256"] if job else None,
        "settings": dataclasses.asdict(options.settings),
        "frames": job.request["frames"] if job else None,
        "inputs": _inputs(job) if job else _facts_of_folder(locate(turn.path)),
        "counts": dict.fromkeys(STATUSES, 0),
        "totals": _sums(0, {}, wall_s),
        "verdict": f"not processed: {known.message}",
        "warnings": [text for text in (known.message, known.hint) if text],
    }


def verdict(counts: dict[str, int], copy_reason: str | None) -> str:
    """One word or sentence for the whole run."""
    if counts.get("failed"):
        return "some frames failed"
    if copy_reason:
        return f"copied: {copy_reason}"
    if counts.get("restored"):
        return "restored"
    return (
        "nothing to restore" if counts.get("copied") else "all frames skipped" if counts.get("skipped") else "no frames"
    )


def _warn_about(name: str, counts: dict[str, int], selected: int) -> None:
    if not selected:
        log.warning("%s: --frames selects no frame of this movie", name)
    elif counts["failed"]:
        log.warning(
            "%s: %d of %d frames failed; their lines in parameters.jsonl say why", name, counts["failed"], selected
        )
    elif not counts["restored"]:
        log.warning(
            "%s: no frame was restored: %d copied, %d skipped; parameters.jsonl says why",
            name,
            counts["copied"],
            counts["skipped"],
        )


def _repeat_finished(job: _Job, options: ProcessOptions) -> CaptureOutcome:
    """The outcome of a run that was finished before."""
    log.info("%s: was finished before; nothing to do", job.name)
    account = json.loads(job.run.run_json.read_bytes())
    if options.json_lines:
        for line in job.run.parameters.read_text("utf-8").splitlines():
            console.emit(line)
    return CaptureOutcome(job.name, job.run.path, account["counts"], account["verdict"], 0.0)


def _summary(outcomes: list[CaptureOutcome]) -> str:
    header = ["capture", *STATUSES, "frames/s", "verdict", "output"]
    rows = []
    for outcome in outcomes:
        counts = [str(outcome.counts.get(status, 0)) for status in STATUSES]
        rate = sum(outcome.counts.values()) / outcome.seconds if outcome.seconds else 0.0
        rows.append([outcome.name, *counts, f"{rate:.1f}" if rate else "-", outcome.verdict, str(outcome.folder)])
    return console.table(header, rows)
