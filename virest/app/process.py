"""``virest process``: read captures, have their frames restored, and write down what came out."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from virest import __version__
from virest.app import console
from virest.app.cluster import is_lost
from virest.app.jobs import Segment, Workers, cut_frames, make_segment, run_segments
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
)
from virest.camera.profile import CameraProfile, profile_mapping
from virest.capture.folder import (
    Capture,
    Frame,
    read_capture,
    resolve_profile,
)
from virest.capture.location import locate, read_each
from virest.capture.profile_source import PROFILE_NAME
from virest.capture.video import MovieIndex, probe_movie, read_gray
from virest.errors import CaptureError, OutputError, SettingsError
from virest.restoration.capture import RestorationPlan, at_true_times, plan_restoration
from virest.restoration.settings import RestorationSettings

log = logging.getLogger(__name__)

PARTLY_FAILED = 9
STATUSES = ("restored", "copied", "skipped", "failed")
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
    run: RunFolder
    capture: Capture
    profile: CameraProfile
    profile_source: str
    selected: tuple[Frame, ...]
    request: dict[str, Any]
    """What must be equal for a run to be continued, and what run.json repeats."""


def process_captures(paths: list[str], options: ProcessOptions) -> int:
    """Process captures one after the other. Returns the exit code: a capture's own, or 9 where some of many failed."""
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
        for path, name in zip(paths, names, strict=True):
            try:
                outcomes.append(process_capture(path, name, options, workers))
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
    """Process one capture into OUT/<name>."""
    began = time.perf_counter()
    _require_capture(path)
    run = RunFolder(options.out / name)
    if options.mode == "new":
        check_run(run, {}, "new")
    job = _read_job(path, name, run, options)
    if check_run(run, job.request, options.mode) == "finished" and options.mode == "resume":
        with opened_run(run, job.request, "resume"):
            return _repeat_finished(job, options)
    index = probe_movie(job.capture.movie)
    plan = _plan(job, index, options.settings)
    with opened_run(run, job.request, options.mode):
        try:
            workers.start(job.capture.movie, run.path)
            return _run(job, index, plan, options, workers, began)
        except BaseException:
            workers.kill()
            raise


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
    return _Job(name, run, capture, profile, str(source), selected, _request(capture, profile, options, chosen))


def _admit(frame: Frame, *, keep_start_up: bool) -> Frame:
    """The frame, without its reason to be left out where that is only the recorder's start-up and it is to be kept."""
    if keep_start_up and frame.only_startup:
        return dataclasses.replace(frame, skip_reason=None, skip_codes=())
    return frame


def _request(capture: Capture, profile: CameraProfile, options: ProcessOptions, chosen: list[int]) -> dict[str, Any]:
    mapping = json.dumps(plain(profile_mapping(profile)), sort_keys=True, allow_nan=False)
    step = chosen[1] - chosen[0] if len(chosen) > 1 else 1
    request = {
        "version": __version__,
        "command": options.command,
        "settings": dataclasses.asdict(options.settings),
        "frames": f"{chosen[0]}:{chosen[-1] + 1}:{step}" if chosen else "none",
        "profile_sha256": hashlib.sha256(mapping.encode()).hexdigest(),
        "inputs": [file_facts(file) for file in _input_files(capture, options.config)],
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
    job: _Job, index: MovieIndex, plan: RestorationPlan, options: ProcessOptions, workers: Workers, began: float
) -> CaptureOutcome:
    """Run the segments that are not done yet, then finish the run's folder."""
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
    _work(todo, workers, give, len(job.selected), sum(map(len, done)), job.name, options.quiet)
    logs = [job.run.segment_log(n[0], n[-1]) for n in numbers]
    totals = _totals(logs)
    wall_s = time.perf_counter() - began
    account = _account(job, plan, totals, wall_s)
    finish_run(job.run, logs, account)
    _warn_about(job.name, account["counts"], len(job.selected))
    return CaptureOutcome(job.name, job.run.path, account["counts"], account["verdict"], wall_s)


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
    frames = len(job.selected)
    notes = [note.text for note in job.capture.notes if note.severity != "info"]
    seconds = {stage: round(totals["seconds"].get(stage, 0.0), 3) for stage in STAGES}
    return {
        "virest_run": 1,
        "version": __version__,
        "capture": job.name,
        "folder": str(job.capture.folder.absolute()),
        "movie": str(job.capture.movie.absolute()),
        "command": job.request["command"],
        "profile": profile_mapping(plan.profile),
        "profile_source": job.profile_source,
        "profile_sha256": job.request["profile_sha256"],
        "settings": dataclasses.asdict(plan.settings),
        "frames": job.request["frames"],
        "inputs": job.request["inputs"],
        "counts": totals["counts"],
        "totals": {
            "frames": frames,
            "seconds": {**seconds, "wall": round(wall_s, 3)},
            "frames_per_s": round(frames / wall_s, 3) if wall_s > 0 else None,
        },
        "verdict": verdict(totals["counts"], plan.copy_reason),
        "warnings": [*notes, *plan.warnings, *([plan.copy_reason] if plan.copy_reason else [])],
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
