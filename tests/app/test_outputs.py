"""Files of a run are written completely or not at all, and a run's folder shows its own state."""

import errno
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from virest.app import outputs, run_folder
from virest.app.calibrate import CalibrationOutput
from virest.app.diagnose import DiagnosisOptions, run_diagnosis
from virest.app.evaluate_shutter import ShutterOptions, run_shutter
from virest.app.evaluate_slam import SlamOptions, run_slam
from virest.app.outputs import capture_name, json_line, plain, require_file, write_picture, write_whole
from virest.app.run_folder import RunFolder, check_run, opened_run, write_failure
from virest.errors import OutputError

REQUEST = {
    "version": "0.1.0",
    "settings": {"deblur": "wiener", "shutter": "none"},
    "frames": "0:8:1",
    "profile_sha256": "ab",
    "inputs": [{"file": "movie.mp4", "bytes": 3, "sha256": "cd"}],
}


def names(folder: Path) -> set[str]:
    """Everything below a folder."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def fail_with(run: RunFolder, segments: tuple[int, ...]) -> None:
    """Fail while frame 1 is being written, after the given segments are finished."""
    (run.frames / "000000.png").write_bytes(b"done")
    (run.frames / "000001.png.0123abcd.part").write_bytes(b"half")
    for frame in segments:
        write_whole(run.segment_log(frame, frame), b"{}\n")
    raise RuntimeError


def finish(run: RunFolder) -> None:
    """Leave the folder as a finished run of one frame does."""
    with opened_run(run, REQUEST, "new"):
        (run.frames / "000000.png").write_bytes(b"png")
        log = run.segment_log(0, 0)
        write_whole(log, b'{"frame": 0}\n')
        run_folder.finish_run(run, [log], REQUEST)


def test_a_picture_reads_back_unchanged(tmp_path: Path, rng: np.random.Generator) -> None:
    """PNG is lossless, and the colour order is kept."""
    picture = rng.integers(0, 256, (7, 11, 3), np.uint8)
    write_picture(tmp_path / "000000.png", picture)
    assert np.array_equal(cv2.imread(str(tmp_path / "000000.png"))[..., ::-1], picture)
    assert names(tmp_path) == {"000000.png"}


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_a_failed_write_leaves_nothing_and_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """A full or read-only disk is an OutputError with a hint; no partial file stays."""

    def half(path: Path, data: bytes) -> None:
        path.write_bytes(data[:2])
        raise OSError(number, os.strerror(number))

    (tmp_path / "run.json").write_bytes(b"old")
    monkeypatch.setattr(outputs, "_write_bytes", half)
    with pytest.raises(OutputError, match=os.strerror(number)) as caught:
        write_whole(tmp_path / "run.json", b"fresh")
    assert caught.value.hint
    assert names(tmp_path) == {"run.json"}
    assert (tmp_path / "run.json").read_bytes() == b"old"


def test_an_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C during a write removes the partial file."""

    def interrupted(path: Path, data: bytes) -> None:
        path.write_bytes(data[:2])
        raise KeyboardInterrupt

    monkeypatch.setattr(outputs, "_write_bytes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "a", b"fresh")
    assert names(tmp_path) == set()


def test_json_has_no_nan_and_no_infinity() -> None:
    """NaN becomes null, infinity the text "inf", and arrays become lists."""
    value = {"a": math.nan, "b": [math.inf, -np.inf], "c": np.float32(0.5), "d": np.arange(2), "e": (True, None, 7)}
    assert json.loads(json_line(value)) == {
        "a": None, "b": ["inf", "-inf"], "c": 0.5, "d": [0, 1], "e": [True, None, 7]
    }  # fmt: skip


def test_timestamps_keep_all_their_digits() -> None:
    """Nanoseconds are integers and are not rounded; other numbers lose only meaningless digits."""
    assert plain(90274601234567891) == 90274601234567891
    assert plain(0.1 + 0.2) == 0.3


def test_a_captures_name_is_the_last_part_of_its_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``.`` and ``..`` resolve to their folders' names, and a trailing slash does not matter."""
    (tmp_path / "trip" / "in").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "trip" / "in")
    assert [capture_name(path) for path in (".", "..", "../in/", "x/../y")] == ["in", "trip", "in", "y"]


@pytest.mark.parametrize("path", ["/", "a\nb", "a\x1b[2J", "x/\x7f"])
def test_a_name_that_is_not_a_folder_name_is_refused(path: str) -> None:
    """Names from data never leave the output folder and never reach the terminal unescaped."""
    with pytest.raises(OutputError) as caught:
        capture_name(path)
    assert "\n" not in str(caught.value)
    assert "\x1b" not in str(caught.value)


def test_a_finished_run_is_refused_without_overwrite(tmp_path: Path) -> None:
    """The hint names the option; no file changes."""
    run = RunFolder(tmp_path / "out" / "trip")
    finish(run)
    before = names(run.path)
    assert before == {"frames", "frames/000000.png", "parameters.jsonl", "run.json"}
    with pytest.raises(OutputError, match="finished run") as caught, opened_run(run, REQUEST, "new"):
        pass
    assert "--overwrite" in caught.value.hint
    assert names(run.path) == before
    assert check_run(run, REQUEST, "resume") == "finished"


@pytest.mark.parametrize("mode", ["new", "resume", "overwrite"])
def test_a_run_killed_at_its_very_start_does_not_block_a_new_one(tmp_path: Path, mode: str) -> None:
    """A partial request is not a foreign file and is removed."""
    run = RunFolder(tmp_path / "trip")
    run.path.mkdir()
    (run.path / ".run.0123abcd.part").write_bytes(b"half")
    with opened_run(run, REQUEST, mode):  # type: ignore[arg-type]
        assert names(run.path) - {".lock"} == {".run", ".segments", "frames"}
    (run.path / "mine.0123abcd.part").write_bytes(b"mine")
    run.state.unlink()
    with pytest.raises(OutputError, match="do not belong to a virest run"):
        check_run(run, REQUEST, "overwrite")


def test_resume_cleans_up_a_run_killed_at_its_very_end(tmp_path: Path) -> None:
    """The run is finished, but its temporary files still exist."""
    run = RunFolder(tmp_path / "trip")
    finish(run)
    run.segments.mkdir()
    write_whole(run.segment_log(0, 0), b'{"frame": 0}\n')
    (run.path / "run.json.0123abcd.part").write_bytes(b"half")
    with opened_run(run, REQUEST, "resume") as found:
        assert found == "finished"
    assert names(run.path) == {"frames", "frames/000000.png", "parameters.jsonl", "run.json"}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"settings": {"deblur": "inverse", "shutter": "none"}}, "deblur wiener, now inverse"),
        ({"frames": "0:9:1"}, "0:8:1, now 0:9:1"),
        ({"profile_sha256": "xy"}, "camera profile"),
        ({"inputs": [{"file": "movie.mp4", "bytes": 4, "sha256": "ef"}]}, "movie.mp4"),
        ({"version": "9"}, "version"),
    ],
)
def test_resume_with_another_request_is_refused_with_the_difference(tmp_path: Path, change: dict, says: str) -> None:
    """A run can be resumed only with the request that started it."""
    run = RunFolder(tmp_path / "trip")
    finish(run)
    with pytest.raises(OutputError, match="--resume") as caught:
        check_run(run, {**REQUEST, **change}, "resume")
    assert says in str(caught.value)


FAILURE = {"virest_run": 1, "profile_sha256": None, "failure": {"error": "ImuError", "reason": "empty", "hint": ""}}


@pytest.mark.parametrize("mode", ["new", "resume", "overwrite"])
def test_a_failure_record_does_not_block_a_run(tmp_path: Path, mode: str) -> None:
    """It states the reason, is replaced by that of a later failure, and is removed when a run begins."""
    run = RunFolder(tmp_path / "out/trip")
    for reason in ("empty", "of another session"):
        assert write_failure(run, {**FAILURE, "failure": {"reason": reason}})
        assert names(run.path) == {"run.json", "parameters.jsonl"}
        assert json.loads(run.run_json.read_bytes())["failure"]["reason"] == reason
    with opened_run(run, REQUEST, mode) as found:  # type: ignore[arg-type]
        assert found == "nothing"
        assert names(run.path) == {".run", ".lock", "frames", ".segments"}
    with pytest.raises(RuntimeError), opened_run(run, REQUEST, "overwrite"):
        raise RuntimeError
    assert not run.path.exists() or not names(run.path)


def test_a_failure_record_overwrites_no_existing_file(tmp_path: Path) -> None:
    """It replaces neither a run nor foreign files; a folder that cannot be created is an OutputError."""
    run = RunFolder(tmp_path / "trip")
    finish(run)
    before = {name: (run.path / name).read_bytes() for name in names(run.path) if (run.path / name).is_file()}
    assert not write_failure(run, FAILURE)
    (run.path / ".run").write_bytes((run.path / "run.json").read_bytes())
    (run.path / "run.json").unlink()
    assert not write_failure(run, FAILURE)
    assert not run.run_json.exists()
    assert run.parameters.read_bytes() == before["parameters.jsonl"]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    for place in ("mine", "mine/notes.txt", "mine/notes.txt/deeper"):
        with pytest.raises(OutputError):
            write_failure(RunFolder(tmp_path / place), FAILURE)
    assert names(tmp_path / "mine") == {"notes.txt"}


def test_a_moved_capture_can_be_resumed(tmp_path: Path) -> None:
    """The inputs' paths are recorded, but only their contents are compared."""
    run = RunFolder(tmp_path / "trip")
    moved = {**REQUEST, "inputs": [{**REQUEST["inputs"][0], "path": "/old/movie.mp4"}]}  # type: ignore[dict-item]
    with opened_run(run, REQUEST, "new"):
        run_folder.finish_run(run, [], moved)
    assert check_run(run, REQUEST, "resume") == "finished"


def test_overwrite_removes_only_files_of_the_run(tmp_path: Path) -> None:
    """Foreign files in the folder of a run stay."""
    run = RunFolder(tmp_path / "trip")
    finish(run)
    (run.path / "notes.txt").write_text("mine")
    (run.frames / "best.png").write_text("mine")
    with opened_run(run, REQUEST, "overwrite"):
        assert names(run.path) - {".lock"} == {".run", ".segments", "frames", "frames/best.png", "notes.txt"}


@pytest.mark.parametrize("mode", ["new", "resume", "overwrite"])
def test_a_foreign_folder_is_never_touched(tmp_path: Path, mode: str) -> None:
    """A folder without a run is refused in every mode, even with a foreign run.json in it."""
    folder = tmp_path / "trip"
    (folder / "frames").mkdir(parents=True)
    (folder / "frames" / "000000.png").write_bytes(b"holiday")
    (folder / "run.json").write_text('{"other": "tool"}')
    with pytest.raises(OutputError, match="do not belong to a virest"), opened_run(RunFolder(folder), REQUEST, mode):  # type: ignore[arg-type]
        pass
    assert names(folder) == {"frames", "frames/000000.png", "run.json"}


def test_a_frames_folder_that_is_a_link_is_refused(tmp_path: Path) -> None:
    """``--overwrite`` must not follow a link out of the run's folder."""
    run = RunFolder(tmp_path / "trip")
    finish(run)
    run.frames.rename(tmp_path / "album")
    run.frames.symlink_to(tmp_path / "album")
    with pytest.raises(OutputError, match="link"), opened_run(run, REQUEST, "overwrite"):
        pass
    assert names(tmp_path / "album") == {"000000.png"}


def test_a_failure_before_the_first_segment_leaves_nothing(tmp_path: Path) -> None:
    """Not even an empty folder stays."""
    run = RunFolder(tmp_path / "out" / "trip")
    with pytest.raises(RuntimeError), opened_run(run, REQUEST, "new"):
        fail_with(run, segments=())
    assert not run.path.exists()


def test_a_failure_after_a_segment_leaves_a_resumable_run(tmp_path: Path) -> None:
    """Complete files stay and partial files are removed."""
    run = RunFolder(tmp_path / "trip")
    with pytest.raises(RuntimeError), opened_run(run, REQUEST, "new"):
        fail_with(run, segments=(0,))
    assert names(run.path) == {".run", ".segments", ".segments/0-0.jsonl", "frames", "frames/000000.png"}
    with opened_run(run, REQUEST, "resume") as found:
        assert found == "unfinished"


def test_two_processes_cannot_work_in_one_folder(tmp_path: Path) -> None:
    """The second is refused; the lock is released with its holder, even after SIGKILL."""
    run = RunFolder(tmp_path / "trip")
    program = (
        "import sys, time, pathlib; from virest.app.run_folder import *\n"
        "with opened_run(RunFolder(pathlib.Path(sys.argv[1])), {'profile_sha256': 'ab'}, 'new'):\n"
        "    print('ready', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(run.path)], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "ready\n"
        with pytest.raises(OutputError, match="another virest process"), opened_run(run, REQUEST, "overwrite"):
            pass
        other.kill()
        other.wait()
    with opened_run(run, REQUEST, "overwrite"):
        pass


@pytest.mark.parametrize("taken", ["out", "out/trip"])
def test_an_output_path_that_is_a_file_is_refused(tmp_path: Path, taken: str) -> None:
    """The existing file stays."""
    (tmp_path / taken).parent.mkdir(exist_ok=True)
    (tmp_path / taken).write_text("mine")
    with pytest.raises(OutputError), opened_run(RunFolder(tmp_path / "out" / "trip"), REQUEST, "overwrite"):
        pass
    assert (tmp_path / taken).read_text() == "mine"


# ── before the work ──────────────────────────────────────────────────────────────────────────────────────────────────


def _start(command: str, out: Path) -> None:
    """Begin a command whose capture does not exist, so that only checks of its output can come first."""
    match command:
        case "calibrate":
            CalibrationOutput(out / "camera.yaml").require()
        case "diagnose":
            run_diagnosis("walk", DiagnosisOptions(out))
        case "file":
            require_file(out / "picture.png", overwrite=False)
        case "shutter":
            run_shutter(ShutterOptions(("walk",), out=out))
        case "slam":
            run_slam([Path("walk")], SlamOptions(command="true {sequence} {trajectory}", out=out))


COMMANDS = ["calibrate", "diagnose", "file", "shutter", "slam"]


@pytest.mark.parametrize("command", COMMANDS)
def test_an_output_that_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """A fit of minutes was lost, or ended in a traceback, where the folder takes no files."""
    out = tmp_path if command in ("calibrate", "file") else tmp_path / "new" / "deep"
    monkeypatch.setattr(os, "access", lambda *_arguments: False)
    with pytest.raises(OutputError, match=f"no permission to write in {tmp_path}, or the disk is read-only"):
        _start(command, out)


@pytest.mark.parametrize("command", ["diagnose", "shutter", "slam"])
def test_an_output_below_a_file_is_refused_before_the_work(tmp_path: Path, command: str) -> None:
    """The file is named."""
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(OutputError, match="notes is a file"):
        _start(command, tmp_path / "notes" / "out" / "deep")
