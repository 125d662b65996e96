"""``virest process``: read captures, restore their frames, and write the results."""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from virest.app import console
from virest.app.account import failure_account, run_account, run_totals
from virest.app.cluster import is_lost
from virest.app.finish import Finished, finish_pictures, require_finishable
from virest.app.jobs import PrefetchedCalls, Workers, run_segments
from virest.app.names import shard_of
from virest.app.outcome import CaptureOutcome, summary
from virest.app.outputs import output_error, require_writable
from virest.app.planning import (
    Job,
    Planned,
    ProcessOptions,
    log_messages,
    plan_capture,
    plan_elsewhere,
    require_startable,
    shown,
)
from virest.app.run_folder import (
    RunFolder,
    check_run,
    finish_run,
    finished_segments,
    opened_run,
    remove_parts,
    remove_stray_pictures,
    write_failure,
)
from virest.app.segments import Segment, cut_frames, make_segment
from virest.calibration.calibrated_values import SOURCE as CALIBRATED
from virest.capture.location import locate
from virest.capture.video import MovieIndex
from virest.errors import CaptureError, OutputError, SettingsError, VirestError
from virest.restoration.capture import RestorationPlan
from virest.restoration.plan_notes import NoteCode

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CaptureSlot:
    """One of the captures of a call."""

    path: str
    """The path as given."""
    name: str
    number: int = 0
    among: int = 1
    """Number of captures."""
    ahead: PrefetchedCalls[Planned] | None = None
    """Plans prefetched by the workers; None: planned here."""

    def begin_next(self) -> None:
        """Submit the next captures to the workers, queued behind the rest of this one."""
        if self.ahead:
            self.ahead.begin(self.number + 1)

    def plan(self, options: ProcessOptions) -> Planned:
        """The capture, read and planned."""
        if self.ahead:
            return self.ahead.result(self.number, self.name)
        return plan_capture(self.path, self.name, options)


def process_captures(paths: list[str], options: ProcessOptions, shard: tuple[int, int] = (1, 1)) -> int:
    """Process captures one by one. Returns the exit code: the capture's own for one, 9 if some of several failed.

    Several workers also read and plan the captures, some ahead of their turn.  shard: (i, N), only the i-th of N parts
    of the captures; names are those in the whole batch.
    """
    paths, names = shard_of(paths, shard)
    _require_out(options.out)
    if options.config is not None:
        _require_config(options.config)
    outcomes: list[CaptureOutcome] = []
    codes: list[int] = []
    workers = Workers(options.jobs, options.scheduler, verbose=options.verbose)
    try:
        if options.scheduler is not None:
            workers.start()  # before any reading, so that a wrong address fails at once
        ahead = _planned_ahead(paths, names, options, workers)
        for number, (path, name) in enumerate(zip(paths, names, strict=True)):
            try:
                slot = CaptureSlot(path, name, number, len(paths), ahead)
                outcomes.append(_process(slot, options, workers))
                codes.append(outcomes[-1].exit_code)
            except (BrokenPipeError, SettingsError, MemoryError) as error:
                if isinstance(error, BrokenPipeError) or len(paths) == 1:
                    raise
                codes.append(console.report_error(error, shown(name)))
            except Exception as error:  # a failed capture must not stop the batch; run.json explains it
                if is_lost(error):
                    raise
                codes.append(console.report_error(error, shown(name)))
    finally:
        workers.kill()
    if outcomes and not options.json_lines and not options.quiet:
        console.emit(summary(outcomes))
    return console.batch_code(codes)


def _require_config(config: Path) -> None:
    try:
        found = config.is_file()
    except OSError as error:
        raise SettingsError(f"{config}: {error.strerror}", hint="--config takes a camera profile") from None
    if not found:
        what = "is not a regular file" if config.exists() else "no such file"
        raise SettingsError(f"{config}: {what}", hint="--config takes a camera profile")


def _require_out(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file", hint="--out takes a folder")


def process_capture(path: str, name: str, options: ProcessOptions, workers: Workers) -> CaptureOutcome:
    """Process one capture into OUT/<name>; a failure is recorded in run.json there."""
    return _process(CaptureSlot(path, name), options, workers)


def _process(slot: CaptureSlot, options: ProcessOptions, workers: Workers) -> CaptureOutcome:
    """Process the current capture; record the failure if it cannot be processed."""
    began = time.perf_counter()
    planned = Planned()
    try:
        require_startable(slot.path, slot.name, options)
        require_writable(options.out / slot.name)
        with console.progress_bar(None, f"{shown(slot.name)}: reading and planning", quiet=options.quiet):
            planned = slot.plan(options)
        seconds = planned.seconds if slot.ahead else time.perf_counter() - began
        log_messages(planned.messages)
        if planned.error is not None:
            if slot.ahead and isinstance(planned.error, CaptureError):
                workers.start(locate(slot.path))  # a worker that cannot read the capture is a different error
            raise planned.error
        return _process_planned(slot, planned, options, workers, seconds)
    except Exception as error:
        if not (isinstance(error, OutputError | BrokenPipeError) or is_lost(error)):
            lost_s = time.perf_counter() - began + (planned.seconds if slot.ahead else 0.0)
            _record_failure(slot, options, planned, error, lost_s)
        raise


def _process_planned(
    slot: CaptureSlot, planned: Planned, options: ProcessOptions, workers: Workers, seconds: float
) -> CaptureOutcome:
    """Run a planned capture's segments; planning took ``seconds``."""
    began = time.perf_counter() - seconds
    assert planned.job is not None
    run = RunFolder(options.out / slot.name)
    job = dataclasses.replace(planned.job, run=run, path=slot.path)
    found = check_run(run, job.request, options.mode)
    if planned.index is None or planned.plan is None or (found == "finished" and options.mode == "resume"):
        with opened_run(run, job.request, "resume"):
            return _repeat_finished(job, options)
    require_finishable(options.finish, slot.name, run.path, job.inputs, overwrite=options.mode != "new")
    with opened_run(run, job.request, options.mode):
        try:
            if options.pictures.masks:
                run.masks.mkdir(exist_ok=True)
            workers.start(job.capture.movie, run.path)
            return _run(job, planned.index, planned.plan, options, workers, began, slot.begin_next)
        except BaseException:
            workers.kill()
            raise


# ── planning ─────────────────────────────────────────────────────────────────────────────────────────────────────


def _planned_ahead(
    paths: list[str], names: list[str], options: ProcessOptions, workers: Workers
) -> PrefetchedCalls[Planned] | None:
    """The captures' plans, computed by the workers; None if planning here, in turn, is better.

    A cluster's workers may not be able to read the file of --config.
    """
    if len(paths) == 1 or workers.here or (options.scheduler is not None and options.config is not None):
        return None
    if options.scheduler is None:
        return PrefetchedCalls(
            plan_elsewhere, [(path, name, options) for path, name in zip(paths, names, strict=True)], workers
        )
    apart = dataclasses.replace(options, out=options.out.absolute())  # a worker's current folder may differ
    absolute = [str(locate(path).absolute()) for path in paths]
    return PrefetchedCalls(
        plan_elsewhere, [(path, name, apart) for path, name in zip(absolute, names, strict=True)], workers
    )


def _run(
    job: Job,
    index: MovieIndex,
    plan: RestorationPlan,
    options: ProcessOptions,
    workers: Workers,
    began: float,
    given_out: Callable[[], None],
) -> CaptureOutcome:
    """Run the remaining segments, then finish the run's folder; ``given_out`` is called when all are submitted."""
    parts = cut_frames(job.selected, job.capture.keyframes or index.keyframes)
    numbers = [tuple(frame.index for frame in part) for part in parts]
    restoring = time.perf_counter()
    done = finished_segments(job.run, numbers)
    _clean(job.run, [frame for n in done for frame in n])
    if done:
        log.info("%s: %d of %d segments are already done", job.name, len(done), len(parts))
    todo = (
        make_segment(part, job.capture, job.name, index, plan, job.run, options.pictures)
        for part, n in zip(parts, numbers, strict=True)
        if n not in done
    )
    at_once = options.json_lines and not options.finish.any
    give = _in_order(job.run, numbers, done) if at_once else None
    _work(_then(todo, given_out), workers, give, len(job.selected), sum(map(len, done)), job.name, options.quiet)
    logs = [job.run.segment_log(n[0], n[-1]) for n in numbers]
    totals = run_totals(logs)
    wall_s, restoring_s = time.perf_counter() - began, time.perf_counter() - restoring
    finished = Finished()
    if options.finish.any:
        lens = plan.profile.intrinsics if plan.settings.undistort else None
        finished = finish_pictures(job.run, logs, job.capture.movie, index, options.finish, job.name, lens)
    account = run_account(job, plan, totals, wall_s, finished)
    finish_run(job.run, logs, account, finished.changed if options.finish.any else None)
    if options.json_lines and not at_once:
        _emit_lines(job.run)
    _warn_about(job.name, account["counts"], len(job.selected), plan.copy_reason)
    return CaptureOutcome(
        job.name,
        job.path,
        job.run.path,
        account["counts"],
        account["verdict"],
        restoring_s,
        _advice(plan),
        finished.film,
    )


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
    with console.progress_bar(total, name, quiet=quiet, done=before) as bar:
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
    """A callback for finished segments that prints their lines as soon as all earlier ones are printed."""
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


def _record_failure(
    slot: CaptureSlot, options: ProcessOptions, planned: Planned, error: Exception, wall_s: float
) -> None:
    """Record in run.json why a capture could not be processed, unless its folder holds a run.

    A single mistyped path writes no run.json.
    """
    try:
        if slot.among == 1 and not locate(slot.path).is_dir():
            return
        account = failure_account(slot.path, slot.name, options, planned.job, error, wall_s)
        write_failure(RunFolder(options.out / slot.name), account)
    except (VirestError, OSError, ValueError) as fault:
        log.warning("%s: this failure could not be recorded in run.json: %s", shown(slot.name), shown(str(fault)))


def _warn_about(name: str, counts: dict[str, int], selected: int, copy_reason: str | None) -> None:
    """Warn about frames that were not restored, unless planning has explained it (``copy_reason``)."""
    if not selected:
        log.warning("%s: --frames selects no frame of this movie", name)
    elif counts["failed"]:
        log.warning(
            "%s: %d of %d frames failed; their lines in parameters.jsonl say why", name, counts["failed"], selected
        )
    elif not counts["restored"] and copy_reason is None:
        log.warning(
            "%s: no frame was restored: %d copied, %d skipped; parameters.jsonl says why",
            name,
            counts["copied"],
            counts["skipped"],
        )


def _repeat_finished(job: Job, options: ProcessOptions) -> CaptureOutcome:
    """The outcome of a run that is already finished."""
    log.info("%s: already finished; nothing to do", job.name)
    account = json.loads(job.run.run_json.read_bytes())
    if options.json_lines:
        _emit_lines(job.run)
    return CaptureOutcome(job.name, job.path, job.run.path, account["counts"], account["verdict"], 0.0)


def _advice(plan: RestorationPlan) -> str:
    """The command that would improve the result, if the profile is incomplete or contradicted by the frames."""
    if plan.refuses(NoteCode.NOT_FOLLOWING):
        return "record again with electronic stabilisation off; virest inspect CAPTURE lists what this recording holds"
    if plan.refuses(NoteCode.OTHER_AXES):
        return "run virest calibrate CAPTURE, which finds the axes, then process --config camera.yaml"
    if plan.contradicted is not None:
        return "the frames contradict the profile: run virest diagnose CAPTURE, then process --config extended.yaml"
    unknown = [
        name
        for name, known in (
            ("focal length", plan.profile.intrinsics is not None),
            ("readout time", plan.profile.readout_known),
            ("time offset", plan.profile.time_offset_s is not None),
        )
        if not known
    ]
    names = " and ".join(unknown)
    if unknown and any(estimate.source == CALIBRATED for estimate in plan.profile.estimates.values()):
        them = "them" if len(unknown) > 1 else "it"
        return (
            f"{names} unknown, and virest calibrate could not determine {them} from this capture: "
            f"state {them} in camera.yaml, or record again while rotating the phone about all three axes"
        )
    if unknown:
        focal = " --with focal" if plan.profile.intrinsics is None else ""
        return f"{names} unknown: run virest calibrate CAPTURE{focal}, then process --config camera.yaml"
    return ""


def _emit_lines(run: RunFolder) -> None:
    for line in run.parameters.read_text("utf-8").splitlines():
        console.emit(line)
