"""A run's folder: OUT/<capture>/frames/*.png, parameters.jsonl, run.json; locking, resuming and finishing.

The files in a run's folder define its state::

    run.json          the run is finished; with ``failure``, the reason why there is none (a new run may start)
    .run              the run is unfinished: its request; --resume continues it
    .segments/        logs of the finished segments of an unfinished run
    .lock             held (flock) by the process that uses the folder; released by the system when that dies

In object storage (``s3://…``) one request writes each file, folders are only name prefixes, and there is no lock.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from virest.app.outputs import json_line, json_text, output_error, write_whole
from virest.capture.location import is_remote, read_each, remove_files
from virest.errors import OutputError

fcntl: Any
msvcrt: Any
try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
    import msvcrt

OWN_FILES = re.compile(r"(parameters\.jsonl|run\.json|\.run|\d{6,}\.png|\d+-\d+\.jsonl)(\.[0-9a-f]{8}\.part)?")
PART = re.compile(r".*\.[0-9a-f]{8}\.part")
DIAGNOSIS, EXTENDED, FIGURES, REPORT = "diagnosis.json", "extended.yaml", "figures", "report.html"
BESIDE = (DIAGNOSIS, EXTENDED, FIGURES, REPORT)
"""Files of `diagnose` and `report` in the same folder: they do not belong to a run and do not block one."""
FIGURE = re.compile(r"(pictures|residuals|ladder|field_\d\d|\d\d_[a-z_]+)\.png")
"""Names of `diagnose`'s figures; no other file in FIGURES is read or removed."""
REQUEST_KEYS = ("version", "settings", "frames", "profile_sha256", "inputs", "outputs")

Mode = Literal["new", "resume", "overwrite"]
Found = Literal["nothing", "unfinished", "finished"]
Change = Callable[[dict[str, Any]], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The paths of one run, below OUT/<capture>."""

    path: Path

    @property
    def frames(self) -> Path:
        """Folder of the restored frames."""
        return self.path / "frames"

    @property
    def masks(self) -> Path:
        """Folder of the masks, if requested."""
        return self.path / "masks"

    @property
    def folders(self) -> tuple[Path, ...]:
        """Existing folders of this run's own files."""
        return tuple(folder for folder in (self.path, self.frames, self.masks) if folder.is_dir())

    @property
    def segments(self) -> Path:
        """Folder of the finished segments' logs."""
        return self.path / ".segments"

    @property
    def state(self) -> Path:
        """The request of an unfinished run."""
        return self.path / ".run"

    @property
    def lock(self) -> Path:
        """Lock file, held while a process uses the folder."""
        return self.path / ".lock"

    @property
    def parameters(self) -> Path:
        """parameters.jsonl: one line per frame."""
        return self.path / "parameters.jsonl"

    @property
    def run_json(self) -> Path:
        """run.json of the finished run."""
        return self.path / "run.json"

    def picture(self, frame: int) -> Path:
        """Path of a restored frame."""
        return self.frames / f"{frame:06d}.png"

    def mask(self, frame: int) -> Path:
        """Path of a frame's mask."""
        return self.masks / f"{frame:06d}.png"

    def segment_log(self, first: int, last: int) -> Path:
        """Path of a segment's log."""
        return self.segments / f"{first}-{last}.jsonl"


def check_run(run: RunFolder, request: dict[str, Any], mode: Mode) -> Found:
    """State of a run's folder; raises OutputError if it blocks the run. Changes nothing."""
    found, old = find_run(run)
    if found == "nothing":
        return found
    if mode == "new":
        raise OutputError(
            f"{run.path}: holds {'an unfinished' if found == 'unfinished' else 'a finished'} run",
            hint=(
                "--resume continues it, --overwrite replaces it"
                if found == "unfinished"
                else "--overwrite replaces it, --out chooses another folder"
            ),
        )
    if mode == "resume" and (differences := _differences(old, request)):
        raise OutputError(
            f"{run.path}: --resume: this run was started with different {'; '.join(differences)}",
            hint="repeat that command, or start over with --overwrite",
        )
    return found


def find_run(run: RunFolder) -> tuple[Found, dict[str, Any]]:
    """State of the run in this folder, and its request. Raises OutputError for foreign files or folders."""
    if run.path.exists() and not run.path.is_dir():
        raise OutputError(f"{run.path}: is a file", hint="choose another folder with --out")
    if run.frames.is_symlink() or run.segments.is_symlink():
        raise OutputError(f"{run.path}: its frames folder is a link", hint="choose another folder with --out")
    for file, found in ((run.state, "unfinished"), (run.run_json, "finished")):
        old = _read_request(file)
        if old is not None:
            return ("nothing", {}) if _records_failure(old) else (found, old)  # type: ignore[return-value]
    try:
        inside = run.path.iterdir() if run.path.is_dir() else ()
        foreign = [p.name for p in inside if p != run.lock and p.name not in BESIDE and not _is_own_part(p.name)]
    except OSError as error:
        raise output_error(run.path, error) from error
    if foreign:
        raise OutputError(
            f"{run.path}: holds {len(foreign)} entries that do not belong to a virest run ({sorted(foreign)[0]!r}, …)",
            hint="choose another folder with --out",
        )
    return "nothing", {}


def _is_own_part(name: str) -> bool:
    """Whether a file is a leftover of a run that was killed at its start."""
    return bool(PART.fullmatch(name) and OWN_FILES.fullmatch(name))


def _read_request(path: Path) -> dict[str, Any] | None:
    try:
        if not path.is_file():  # reading a pipe would block
            return None
        content = json.loads(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) and "profile_sha256" in content else None


def _records_failure(account: dict[str, Any]) -> bool:
    """Whether a run.json only records a failure, so that it may be replaced."""
    return isinstance(account.get("failure"), dict)


def _differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """The parts in which two requests differ, in words."""
    names = []
    for key in REQUEST_KEYS:
        before, now = (_without_places(request.get(key)) for request in (old, new))
        if before == now:
            continue
        if key == "settings" and isinstance(before, dict) and isinstance(now, dict):
            fields = [f for f in now if before.get(f) != now[f]] or sorted(set(before) - set(now))
            names.append("settings (" + ", ".join(f"{f} {before.get(f)}, now {now.get(f)}" for f in fields) + ")")
        elif key == "inputs":
            names.append(f"input files ({', '.join(_changed_files(before, now))})")
        else:
            words = {"profile_sha256": "camera profile", "frames": f"frames ({before}, now {now})"}
            names.append(words.get(key, f"{key} ({before}, now {now})"))
    return names


def _without_places(value: Any) -> Any:
    """Facts of files without their folders, so that a moved capture still matches."""
    if not isinstance(value, list):
        return value
    return [{k: v for k, v in facts.items() if k != "path"} if isinstance(facts, dict) else facts for facts in value]


def _changed_files(before: Any, now: Any) -> list[str]:
    def by_name(facts: Any) -> dict[str, Any]:
        return {f["file"]: f for f in facts if isinstance(f, dict) and "file" in f} if isinstance(facts, list) else {}

    old, new = by_name(before), by_name(now)
    return sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))


@contextmanager
def opened_run(run: RunFolder, request: dict[str, Any], mode: Mode) -> Iterator[Found]:
    """Lock a run's folder, check it and prepare it; yields the state found.

    If the body fails, half-written files are removed; a run without any finished segment leaves nothing.
    """
    fresh = not run.path.exists()
    try:
        run.path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(run.path, error) from error
    try:
        with nullcontext() if is_remote(run.path) else _locked(run):
            found = check_run(run, request, mode)
            try:
                if found != "finished" or mode == "overwrite":
                    _make_ready(run, request, mode)
                    if found == "nothing":
                        _remove_failure(run)
                else:
                    _clear_scaffolding(run)  # left by a run that was killed just before its end
                yield found if mode == "resume" else "nothing"
            except BaseException:
                _leave(run)
                raise
    finally:
        if fresh:
            with suppress(OSError):
                run.path.rmdir()


def _take(handle: int) -> None:
    """Lock an open file exclusively.  Raises OSError if another process holds the lock."""
    if fcntl is not None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:  # Windows
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)


@contextmanager
def _locked(run: RunFolder) -> Iterator[None]:
    while True:
        try:
            handle = os.open(run.lock, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o644)
        except OSError as error:
            raise output_error(run.path, error) from error
        try:
            _take(handle)
        except OSError:
            os.close(handle)
            raise OutputError(
                f"{run.path}: another virest process is using this folder",
                hint="wait for it to finish, or choose another folder with --out",
            ) from None
        with suppress(OSError):
            if os.stat(run.lock).st_ino == os.fstat(handle).st_ino:
                break
        os.close(handle)  # the previous holder removed the file when it finished
    try:
        yield
    finally:
        if fcntl is None:
            os.close(handle)  # Windows cannot remove an open file
        with suppress(OSError):
            run.lock.unlink()
        if fcntl is not None:
            os.close(handle)


def _make_ready(run: RunFolder, request: dict[str, Any], mode: Mode) -> None:
    """Prepare the folder for writing segments, whatever a killed run has left."""
    try:
        if mode == "overwrite":
            _remove_segments(run)
        if mode == "overwrite" or not run.state.exists():
            write_whole(run.state, json_text(request).encode())
        run.frames.mkdir(exist_ok=True)
        run.segments.mkdir(exist_ok=True)
        if mode == "overwrite":
            _remove_own(run)
        remove_parts(run)
    except OSError as error:
        raise output_error(run.path, error) from error


def _remove_own(run: RunFolder) -> None:
    """Remove the files of a run, except its state, and no others."""
    for folder in run.folders:
        own = [file for file in folder.iterdir() if OWN_FILES.fullmatch(file.name) and file != run.state]
        remove_files([file for file in own if is_remote(file) or not file.is_dir()])


def _remove_failure(run: RunFolder) -> None:
    """Remove the run.json of a failed attempt."""
    try:
        for file in (run.run_json, run.parameters):
            if file.exists():
                file.unlink(missing_ok=True)
    except OSError as error:
        raise output_error(run.path, error) from error


def _clear_scaffolding(run: RunFolder) -> None:
    """Remove the files that only an unfinished run needs."""
    try:
        _remove_segments(run)
        remove_parts(run)
    except OSError as error:
        raise output_error(run.path, error) from error


def _remove_segments(run: RunFolder) -> None:
    if is_remote(run.path):
        remove_files(list(run.segments.iterdir()))
    else:
        shutil.rmtree(run.segments, ignore_errors=True)


def remove_parts(run: RunFolder) -> None:
    """Remove half-written files of killed writers; object storage has none."""
    if is_remote(run.path):
        return
    for folder in (*run.folders, run.segments):
        for file in folder.iterdir() if folder.is_dir() else ():
            if PART.fullmatch(file.name):
                file.unlink(missing_ok=True)


def _leave(run: RunFolder) -> None:
    """Clean up after a failure: remove half-written files, and everything if no segment is finished."""
    with suppress(OSError):
        remove_parts(run)
        if run.run_json.exists() or (run.segments.is_dir() and any(run.segments.iterdir())):
            return
        if run.frames.is_dir():
            _remove_own(run)
        for folder in (run.segments, run.masks, run.frames):
            with suppress(FileNotFoundError):
                folder.rmdir()
        run.state.unlink(missing_ok=True)


def remove_stray_pictures(run: RunFolder, keep: Iterable[int]) -> None:
    """Remove the frames and masks of unfinished segments."""
    kept = {run.picture(frame).name for frame in keep}
    folders = (place for place in (run.frames, run.masks) if place.is_dir())
    names = (file for place in folders for file in place.iterdir() if OWN_FILES.fullmatch(file.name))
    remove_files([file for file in names if file.name not in kept])


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The records of a JSON-lines file."""
    return parse_lines(path.read_bytes())


def parse_lines(data: bytes) -> list[dict[str, Any]]:
    """The records of JSON lines. Raises ValueError for invalid JSON."""
    return [json.loads(line) for line in data.decode("utf-8").splitlines() if line]


def finished_segments(run: RunFolder, segments: Iterable[tuple[int, ...]]) -> set[tuple[int, ...]]:
    """The segments, each given by its frames, whose log is complete and whose pictures exist."""
    try:
        logs = {file.name for file in run.segments.iterdir()}
        pictures = {f"frames/{file.name}" for file in run.frames.iterdir()} if logs else set()
        begun = [frames for frames in segments if run.segment_log(frames[0], frames[-1]).name in logs]
        contents = read_each(run.segment_log(frames[0], frames[-1]) for frames in begun)
        return {frames for frames, data in zip(begun, contents, strict=True) if _is_finished(frames, data, pictures)}
    except OSError as error:
        raise output_error(run.path, error) from error


def _is_finished(frames: tuple[int, ...], data: bytes, pictures: set[str]) -> bool:
    try:
        lines = parse_lines(data)
        outputs = [line["output"] for line in lines if line["output"]]
        return tuple(line["frame"] for line in lines) == frames and pictures.issuperset(outputs)
    except (ValueError, KeyError, TypeError):
        return False


def finish_run(run: RunFolder, logs: Iterable[Path], account: dict[str, Any], change: Change | None = None) -> None:
    """Join the segments' lines in frame order, write run.json last, and remove the temporary files.

    change: updates a line for changes to its picture after the segments were finished.
    """
    try:
        if change is None:
            _join(run.parameters, logs)
        else:
            lines = (change(line) for log in read_each(logs) for line in parse_lines(log))
            write_whole(run.parameters, "".join(json_line(line) + "\n" for line in lines).encode())
        _write_account(run, account)
        run.state.unlink(missing_ok=True)
    except OSError as error:
        raise output_error(run.path, error) from error
    _clear_scaffolding(run)


def write_failure(run: RunFolder, account: dict[str, Any]) -> bool:
    """Write run.json for a capture that could not be processed; False, without writing, if the folder holds a run.

    run.json is written first and is sufficient.  An empty parameters.jsonl lets tools read the lines of many runs
    alike.  Raises OutputError if run.json cannot be written.
    """
    fresh = False
    try:
        fresh = not run.path.exists()
        run.path.mkdir(parents=True, exist_ok=True)
        with nullcontext() if is_remote(run.path) else _locked(run):
            if find_run(run)[0] != "nothing":
                return False
            _write_account(run, account)
            write_whole(run.parameters, b"")
            return True
    except OSError as error:
        raise output_error(run.path, error) from error
    finally:
        if fresh:
            with suppress(OSError):
                run.path.rmdir()


def _write_account(run: RunFolder, account: dict[str, Any]) -> None:
    write_whole(run.run_json, json_text(account).encode())


def _join(path: Path, logs: Iterable[Path]) -> None:
    """Concatenate the logs into one file without loading them all; remote storage receives it in one request."""
    if is_remote(path):
        write_whole(path, b"".join(read_each(logs)))
        return
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    try:
        with part.open("xb") as file:
            for log in logs:
                file.write(log.read_bytes())
        os.replace(part, path)
    finally:
        with suppress(OSError):
            part.unlink()
