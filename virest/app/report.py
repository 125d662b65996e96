"""``virest report RUN_DIR``: runs and diagnoses with frames before and after, as one self-contained page.

RUN_DIR is the folder of one capture (run.json, diagnosis.json, or both), or a folder of several of them.  Recorded
frames are decoded from the capture's movie at its path in run.json, if its size and sha256 match.
"""

from __future__ import annotations

import logging
import os
import shlex
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from virest import __version__
from virest.app.account import STATUSES
from virest.app.outputs import file_facts, require_file, write_whole
from virest.app.report_files import (
    Account,
    DiagnosisFile,
    Input,
    Tile,
    read_bytes,
    read_frame_lines,
    read_model,
    read_tiles,
)
from virest.app.run_folder import DIAGNOSIS, EXTENDED, FIGURE, FIGURES, REPORT, RunFolder
from virest.arrays import Picture
from virest.capture.pictures import MOVIE_SUFFIXES
from virest.capture.video import MovieIndex, probe_movie, read_frames
from virest.errors import PARTLY_FAILED, CaptureError, VirestError
from virest.report.html import (
    CaptureRecord,
    DiagnosisRecord,
    Embedded,
    FrameFacts,
    RunRecord,
    ShownFrame,
    choose_frames,
    count_words,
    embed_figure,
    report_page,
    show_frame,
)

log = logging.getLogger(__name__)

RUN = "run.json"
FRAMES_SHOWN, MOST_FRAMES = 6, 24
"""Default numbers of frames shown: of one capture, and of all captures of a page together."""
PICTURE_BYTES = 4_200_000
"""All frames of a page together, base64 encoded; with the figures, a page stays below about 6 MB."""
MAX_PROFILE_BYTES, MAX_PICTURE_BYTES = 1 << 20, 256 << 20
"""Far larger than any file that virest writes; the files are not trusted."""
ONLY_AFTER = "recorded frames are not shown"

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """The options of one ``virest report``."""

    out: Path | None = None
    """None: RUN_DIR/report.html."""
    frames: int | None = None
    """Number of frames to show per capture."""
    capture: Path | None = None
    """The capture's folder, or the folder of the captures, if moved since the run."""
    overwrite: bool = False


@dataclass(frozen=True, slots=True)
class ReportOutcome:
    """The result."""

    facts: Json
    text: str
    exit_code: int


@dataclass(frozen=True, slots=True)
class _Movie:
    """The movie of a run, ready for decoding."""

    path: Path
    index: MovieIndex


# ── the command ──────────────────────────────────────────────────────────────────────────────────────────────────


def write_report(run_dir: Path, options: ReportOptions) -> ReportOutcome:
    """Read the results in RUN_DIR and write the page.

    Raises CaptureError if there is nothing to report, OutputError if the page exists or cannot be written.  Of several
    captures, unreadable ones are reported and skipped, and the exit code is 9.
    """
    target = options.out or run_dir / REPORT
    _require_dir(run_dir)
    require_file(target, overwrite=options.overwrite)
    folders = find_folders(run_dir)
    records, failures = [], []
    for folder in folders:
        try:
            records.append(read_folder(folder, options, len(folders)))
        except CaptureError as error:
            if len(folders) == 1:
                raise
            failures.append({"folder": str(folder), "error": str(error)})
            log.error("%s", error)
    if not records:
        raise CaptureError(f"{run_dir}: none of its {len(folders)} runs can be read", hint="see the lines above")
    page = report_page(records, __version__).encode("utf-8", "backslashreplace")
    write_whole(target, page)
    facts = _facts(target, len(page), records, failures)
    return ReportOutcome(facts, _describe(facts), PARTLY_FAILED if failures else 0)


def _require_dir(run_dir: Path) -> None:
    try:
        found = run_dir.is_dir()
    except OSError as error:
        raise CaptureError(f"{run_dir}: {error.strerror}", hint="pass OUT/<capture> of a run, or OUT itself") from None
    if not found:
        what = "is not a folder" if run_dir.exists() else "no such folder"
        raise CaptureError(f"{run_dir}: {what}", hint="pass OUT/<capture> of a run, or OUT itself")


def find_folders(run_dir: Path) -> list[Path]:
    """The folder itself if it holds a run or a diagnosis, else its subfolders that do."""
    try:
        inside = sorted(path for path in run_dir.iterdir() if path.is_dir())
    except OSError as error:
        raise CaptureError(f"{run_dir}: {error.strerror}", hint="check its permissions") from None
    if _holds_results(run_dir):
        return [run_dir]
    found = [path for path in inside if _holds_results(path)]
    if found:
        return found
    if any((path / ".run").exists() for path in (run_dir, *inside)):
        raise CaptureError(f"{run_dir}: its run is not finished", hint="finish it with virest process --resume")
    raise CaptureError(
        f"{run_dir}: holds neither {RUN} nor {DIAGNOSIS}, nor do its subfolders",
        hint="pass OUT/<capture> of a run, or OUT itself",
    )


def _holds_results(folder: Path) -> bool:
    return any((folder / name).exists() for name in (RUN, DIAGNOSIS))


def read_folder(folder: Path, options: ReportOptions, among: int) -> CaptureRecord:
    """The results in the folder of one capture; ``among``: number of captures that share the page's bytes."""
    run = _read_run(folder, options, among) if (folder / RUN).exists() else None
    diagnosis = _read_diagnosis(folder) if (folder / DIAGNOSIS).exists() else None
    name = str(run.account["capture"]) if run else folder.resolve().name
    return CaptureRecord(name, run, diagnosis)


# ── a run ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _read_run(folder: Path, options: ReportOptions, among: int) -> RunRecord:
    account = read_model(folder / RUN, Account, "run record")
    by_line, notes = read_frame_lines(folder, sum(account.counts.get(status, 0) for status in STATUSES))
    frames = list(by_line.values())
    chosen = choose_frames(frames, options.frames or max(1, min(FRAMES_SHOWN, MOST_FRAMES // among)))
    numbers = {facts.frame for facts in chosen}
    tiles = read_tiles(folder, {n for n, facts in by_line.items() if facts.frame in numbers})
    movie, complaint = (None, "") if account.failure else find_movie(account, folder, options.capture)
    notes += [complaint] if complaint else []
    bytes_each = PICTURE_BYTES // among // len(chosen) if chosen else 0
    shown = [_show(folder, facts, tiles[facts.frame], movie, bytes_each, account.crop_px) for facts in chosen]
    return RunRecord(account.model_dump(), frames, shown, tuple(notes))


def _show(
    folder: Path,
    facts: FrameFacts,
    tiles: Sequence[Tile],
    movie: _Movie | None,
    max_bytes: int,
    crop_px: tuple[int, int, int, int] | None = None,
) -> ShownFrame:
    """A frame with its pictures before and after, cropped alike; a copied frame has no picture after."""
    x0, y0, x1, y1 = crop_px or (0, 0, None, None)
    before = None if movie is None else _recorded(movie, facts.frame)
    before = None if before is None else before[y0:y1, x0:x1]
    after = None
    if facts.state == "restored" or (facts.state == "copied" and before is None):
        after = read_picture(RunFolder(folder).picture(facts.frame))
    picture = after if after is not None else before
    size = (1, 1) if picture is None else (picture.shape[1], picture.shape[0])
    centres = [(tile.centre_px[0] - x0, tile.centre_px[1] - y0) for tile in tiles]
    columns = [(*centre, tile.angle_rad, tile.length_px) for centre, tile in zip(centres, tiles, strict=True)]
    return show_frame(facts, before, after, columns, size, max_bytes)


def _recorded(movie: _Movie, frame: int) -> Picture | None:
    """A frame of the movie; None if it cannot be decoded."""
    try:
        found = read_frames(movie.path, movie.index, frame, frame)
        return next((picture for number, picture in found if number == frame), None)
    except VirestError as error:
        log.warning("%s: frame %d: %s", movie.path, frame, error.message)
        return None


def read_picture(path: Path) -> Picture | None:
    """An 8-bit RGB picture; None, and a warning, if it cannot be read."""
    try:
        data = np.frombuffer(read_bytes(path, MAX_PICTURE_BYTES), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if data.size else None
    except (CaptureError, cv2.error) as error:
        log.warning("%s", str(error).strip().splitlines()[-1])
        return None
    if picture is None:
        log.warning("%s: cannot be read as a picture", path)
    return None if picture is None else np.asarray(picture, np.uint8)


# ── where the movie is ───────────────────────────────────────────────────────────────────────────────────────────


def find_movie(account: Account, folder: Path, hint: Path | None) -> tuple[_Movie | None, str]:
    """The movie (or list or folder of images) of the run, or None and a note why it is missing.

    A file is accepted only if its size and sha256 match run.json.
    """
    names = _movie_names(account)
    if not names:
        return None, f"run.json names no movie; {ONLY_AFTER}."
    other = None
    for path in dict.fromkeys(root / name for root in _possible_folders(account, folder, hint) for name in names):
        with suppress(OSError, ValueError, VirestError):
            if path.is_dir() or any(_is_same(path, item) for item in account.inputs):
                return _Movie(path, probe_movie(path)), ""
            other = other or (path if path.exists() else None)
    if other is not None:
        return None, f"{other} is not the movie of this run; {ONLY_AFTER}."
    return None, f"The capture's movie was not found (give its folder with --capture); {ONLY_AFTER}."


def _is_same(path: Path, known: Input) -> bool:
    if Path(known.file).name != path.name or not path.is_file() or path.stat().st_size != known.bytes:
        return False
    return bool(file_facts(path)["sha256"] == known.sha256)


def _movie_names(account: Account) -> list[str]:
    """Possible names of the movie in the capture's folder: as run.json states, else each input with a movie suffix."""
    if account.folder and account.movie:
        return [os.path.relpath(account.movie, account.folder)]
    return [item.file for item in account.inputs if Path(item.file).suffix.lower() in MOVIE_SUFFIXES]


def _possible_folders(account: Account, folder: Path, hint: Path | None) -> Iterator[Path]:
    """Possible folders of the capture, most likely first."""
    if hint is not None:
        yield from (hint, hint / folder.resolve().name)
        return
    if account.folder:
        yield Path(account.folder)
    source = Path(account.profile_source)
    if source.is_absolute():
        yield source.parent
    with suppress(ValueError):
        for word in shlex.split(account.command)[2:]:
            path = Path(word)
            if path.name == account.capture or word == ".":
                yield from (path, folder.resolve().parent / path, folder.resolve().parent.parent / path)


# ── a diagnosis ──────────────────────────────────────────────────────────────────────────────────────────────────


def _read_diagnosis(folder: Path) -> DiagnosisRecord:
    checked = read_model(folder / DIAGNOSIS, DiagnosisFile, "diagnosis")
    profile = ""
    with suppress(CaptureError):
        profile = read_bytes(folder / EXTENDED, MAX_PROFILE_BYTES).decode("utf-8", "replace")
    return DiagnosisRecord(checked.model_dump(), list(_figures(folder / FIGURES)), profile)


def _figures(folder: Path) -> Iterator[tuple[str, Embedded]]:
    """The diagnosis's figures: first the effect of the causes on pictures and residuals, then the ladder."""
    order = ("residuals.png", "pictures.png")
    names = [path.name for path in _inside(folder) if FIGURE.fullmatch(path.name)]
    for name in sorted(names, key=lambda n: (order.index(n) if n in order else len(order), n)):
        picture = read_picture(folder / name)
        if picture is not None:
            yield name.removesuffix(".png"), embed_figure(picture)


def _inside(folder: Path) -> Iterable[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return ()


# ── results ──────────────────────────────────────────────────────────────────────────────────────────────────────


def _facts(target: Path, size: int, records: Sequence[CaptureRecord], failures: list[Json]) -> Json:
    captures = [_capture_facts(record) for record in records]
    counted: dict[str, int] = {}
    for capture in captures:
        for state, count in (capture["counts"] or {}).items():
            counted[state] = counted.get(state, 0) + count
    verdicts = list(dict.fromkeys(capture["verdict"] for capture in captures if capture["verdict"] is not None))
    return {
        "path": str(target),
        "bytes": size,
        "verdict": verdicts[0] if len(verdicts) == 1 else verdicts or None,
        "counts": counted or None,
        "captures": captures,
        "failed": failures,
    }


def _capture_facts(record: CaptureRecord) -> Json:
    run, diagnosis = record.run, record.diagnosis
    return {
        "capture": record.name,
        "verdict": run.account["verdict"] if run else None,
        "counts": run.account["counts"] if run else None,
        "frames_shown": [frame.facts.frame for frame in run.shown] if run else [],
        "recorded_shown": bool(run and any(frame.before for frame in run.shown)),
        "diagnosis": diagnosis.facts["verdict"] if diagnosis else None,
        "causes": [cause["name"] for cause in diagnosis.facts["causes"]] if diagnosis else [],
        "notes": list(run.notes) if run else [],
    }


def _describe(facts: Json) -> str:
    lines = []
    for capture in facts["captures"]:
        parts = []
        if capture["counts"] is not None:
            parts.append(f"{capture['verdict']} ({count_words(capture['counts']) or 'no frames'})")
        if capture["diagnosis"] is not None:
            named = ", ".join(capture["causes"])
            parts.append(f"diagnosis {capture['diagnosis']}{f' ({named})' if named else ''}")
        lines.append(f"{capture['capture']}: {'; '.join(parts)}")
        lines += [f"{capture['capture']}: {note}" for note in capture["notes"]]
    lines.append(f"wrote {facts['path']}, {facts['bytes'] / 1e6:.1f} MB")
    return "\n".join(" ".join(line.split()) for line in lines)
