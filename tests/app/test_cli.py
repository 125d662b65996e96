"""The program as users see it: exit codes, one line for an error, and results only on standard output."""

import errno
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from run_content import content, differences

from virest.app import outputs
from virest.app.cli import run

Virest = Callable[..., "subprocess.CompletedProcess[str]"]
Edit = Callable[[Callable[[list[str]], list[str]]], None]
FAST = ("--preset", "fast", "--jobs", "1")


def below(folder: Path) -> set[str]:
    """Names of everything below a folder."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")} if folder.exists() else set()


def assert_refused(result: "subprocess.CompletedProcess[str]", code: int, *says: str) -> None:
    """One error line, the right exit code, nothing on standard output, and no traceback."""
    errors = [line for line in result.stderr.splitlines() if line.startswith("virest: error: ")]
    assert result.returncode == code, result.stderr
    assert len(errors) == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""
    for text in says:
        assert text in errors[0]


def wait_for(condition: Callable[[], bool], process: "subprocess.Popen[str]", seconds: float = 60) -> None:
    """Wait until a condition holds while a process runs."""
    end = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.fixture
def start(tmp_path: Path) -> Callable[..., "subprocess.Popen[str]"]:
    """Start the program in its own process group, as a terminal does.

    A shell's background jobs ignore Ctrl-C, and so would programs that a test starts from such a job.
    """

    def popen(*arguments: object) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "virest", *map(str, arguments)]
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip

    return popen


# ── calling it ───────────────────────────────────────────────────────────────────────────────────────────────────


def test_help_imports_nothing_heavy() -> None:
    """``virest --help`` answers at once: it loads no numpy, OpenCV or PyAV."""
    program = (
        "import sys; from virest.app.cli import run; code = run(['--help']);"
        "print(code, sorted({'numpy', 'cv2', 'av', 'scipy', 'pandas', 'pydantic', 'rich'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "0 []"
    assert "process" in result.stdout


@pytest.mark.parametrize(
    ("words", "usage"),
    [
        ("process", "[OPTIONS] CAPTURE..."),
        ("evaluate shutter", "[OPTIONS] [CAPTURE]..."),
        ("profile new", "[OPTIONS] [CAPTURE]"),
        ("import", "[OPTIONS] BAG OUT"),
    ],
)
def test_help_names_arguments_as_manual_pages_do(words: str, usage: str, capsys: pytest.CaptureFixture[str]) -> None:
    """NAME is required, [NAME] is optional, NAME... may be repeated, and no Python types appear."""
    assert run([*words.split(), "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"Usage: virest {words} {usage}\n" in shown
    assert "<" not in shown.split("Arguments:")[1].split("Options:")[0]


def test_help_of_a_group_truncates_no_description(capsys: pytest.CaptureFixture[str]) -> None:
    """Each command's line fits a terminal of 80 columns."""
    for group in ([], ["evaluate"], ["profile"]):
        run([*group, "--help"])
        assert "..." not in capsys.readouterr().out.split("Commands:")[1]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["process"], "CAPTURE"),
        (["proces", "x"], "process"),
        (["process", "x", "--pre", "fast"], "--pre"),
        (["process", "x", "--preset", "quick"], "quick"),
        (["process", "x", "--deblur", "sharp"], "richardson-lucy"),
        (["process", "x", "--frames", "5,6"], "slice"),
        (["process", "x", "--frames", "1:2:0"], "step"),
        (["process", "x", "--frames", "a:b"], "slice"),
        (["process", "x", "--jobs", "0"], "--jobs"),
        (["process", "x", "--resume", "--overwrite"], "--resume"),
        (["inspect", "--deep", "x"], "--deep"),
        (["preview", "x", "--out", "p.jpg"], "end in .png"),
        (["profile", "new", "x", "--size", "64x48"], "CAPTURE and --size"),
        (["profile", "new", "--size", "64x48", "--focal-px", "50", "--fov-deg", "60"], "--focal-px and --fov-deg"),
    ],
)
def test_a_usage_error_prints_one_line_and_exits_with_2(virest: Virest, arguments: list[str], says: str) -> None:
    """The line names the error and points to the help."""
    result = virest(*arguments)
    assert_refused(result, 2, says, "--help")
    assert len(result.stderr.splitlines()) == 1


def test_a_scheduler_needs_its_extra(virest: Virest) -> None:
    """Without Dask, ``--scheduler`` names the extra to install."""
    program = (
        "import sys; sys.modules['distributed'] = None; from virest.app.cli import run; sys.exit(run(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", program, "process", "x", "--scheduler", "tcp://localhost:8786"]
    assert_refused(subprocess.run(command, capture_output=True, text=True, check=False), 2, "virest[cluster]")


def test_version_goes_to_standard_output(virest: Virest) -> None:
    """``--version`` works for the program and for each command."""
    for arguments in (["--version"], ["process", "--version"], ["inspect", "--version"]):
        result = virest(*arguments)
        assert (result.returncode, result.stderr) == (0, "")
        assert re.fullmatch(r"virest \d+\.\d+\S*\n", result.stdout)


def test_a_closed_pipe_ends_the_program_quietly() -> None:
    """``virest --help | head -0`` prints no error."""
    read, write = os.pipe()
    os.close(read)
    result = subprocess.run(
        [sys.executable, "-m", "virest", "--help"], stdout=write, stderr=subprocess.PIPE, check=False
    )
    os.close(write)
    assert (result.returncode, result.stderr) == (141, b"")


def test_a_full_standard_output_is_an_output_error(virest: Virest) -> None:
    """A result that cannot be written gives exit code 8."""
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full here")
    with open("/dev/full", "wb") as full:
        command = [sys.executable, "-m", "virest", "--version"]
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert result.returncode == 8
    assert "No space left" in result.stderr


# ── a good run ───────────────────────────────────────────────────────────────────────────────────────────────────


def test_process_writes_frames_parameters_and_run(virest: Virest, tiny: Path, tmp_path: Path) -> None:
    """The command writes exactly the documented files and prints a table on standard output."""
    result = virest("process", tiny, "--out", "out", *FAST, "--frames", "2:5", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    pictures = {f"frames/{i:06d}.png" for i in (2, 3, 4)}
    assert below(tmp_path / "out") == {"tiny", *(f"tiny/{n}" for n in pictures), "tiny/frames", "tiny/run.json",
                                       "tiny/parameters.jsonl"}  # fmt: skip
    account = json.loads((tmp_path / "out/tiny/run.json").read_text())
    assert account["version"]
    assert account["command"].startswith("virest process ")
    assert account["settings"]["preset"] == "fast"
    assert account["profile"]["virest_profile"] == 1
    counts = account["counts"]
    assert sum(counts[s] for s in ("restored", "copied", "skipped", "failed")) == account["totals"]["frames"] == 3
    assert {f["file"] for f in account["inputs"]} >= {"movie.mp4", "gyro_accel.csv", "camera.yaml"}
    assert all(len(f["sha256"]) == 64 and f["bytes"] > 0 for f in account["inputs"])
    assert result.stdout.splitlines()[1].split()[0] == "tiny"


def test_json_lines_are_the_parameters_and_nothing_else(virest: Virest, tiny: Path, tmp_path: Path) -> None:
    """Names come from standard input; the lines come in frame order, ready for the next program in a pipe."""
    result = virest("process", "-", "--out", "out", "--json", "--preset", "fast", "--jobs", 2, cwd=tmp_path,
                    stdin=f"{tiny}\n\n")  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert result.stdout == (tmp_path / "out/tiny/parameters.jsonl").read_text()
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert [line["frame"] for line in lines] == list(range(24))
    assert all(line["blur"]["length_px"] >= 0 for line in lines if line["status"] != "skipped")


def test_quiet_prints_nothing_on_standard_error(virest: Virest, tiny: Path, tmp_path: Path) -> None:
    """With ``-q`` a successful run prints nothing on standard error."""
    result = virest("process", tiny, "-q", *FAST, "--frames", ":1", cwd=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")


def test_a_dot_is_named_after_its_folder(virest: Virest, tiny: Path, tmp_path: Path) -> None:
    """``cd capture; virest process .`` writes OUT/<capture>."""
    result = virest("process", ".", "--out", tmp_path / "out", *FAST, "--frames", "0:1", cwd=tiny)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "out/tiny/run.json").is_file()


@pytest.mark.parametrize(
    ("frames", "chosen"),
    [("-2:", [22, 23]), ("20:900:3", [20, 23]), ("1:0:-1", [1]), ("::23", [0, 23]), ("30:", [])],
)
def test_frames_is_a_python_slice(virest: Virest, tiny: Path, tmp_path: Path, frames: str, chosen: list[int]) -> None:
    """Ends are clipped and negative indices count from the end; an empty selection gives a warning."""
    result = virest("process", tiny, "--json", "--deblur", "none", "--frames", frames, "--jobs", 1, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert [json.loads(line)["frame"] for line in result.stdout.splitlines()] == chosen
    assert ("selects no frame" in result.stderr) == (not chosen)


# ── bad input ────────────────────────────────────────────────────────────────────────────────────────────────────


def refuse(virest: Virest, tiny: Path, code: int, *says: str) -> None:
    """Process a damaged capture: one error line, which run.json repeats, and no other output."""
    result = virest("process", tiny, "--out", tiny.parent / "out", *FAST)
    assert_refused(result, code, *says)
    assert below(tiny.parent / "out") == {"tiny", "tiny/run.json", "tiny/parameters.jsonl"}
    account = json.loads((tiny.parent / "out/tiny/run.json").read_text())
    assert (account["status"], account["exit_code"], sum(account["counts"].values())) == ("failed", code, 0)
    for text in says:
        assert text in "; ".join(account["failure"].values())
    assert account["source"]["resolved"] == os.path.realpath(tiny)


def test_a_path_that_does_not_exist(virest: Virest, tmp_path: Path) -> None:
    """Exit 4, and the path is named; a single mistyped path writes nothing."""
    result = virest("process", tmp_path / "tiny", "--out", tmp_path / "out", *FAST)
    assert_refused(result, 4, "no such folder")
    assert not (tmp_path / "out").exists()


def test_an_empty_folder(virest: Virest, tmp_path: Path) -> None:
    """Exit 4."""
    (tmp_path / "tiny").mkdir()
    refuse(virest, tmp_path / "tiny", 4, "tiny")


def test_no_movie(virest: Virest, tiny: Path) -> None:
    """Exit 4."""
    (tiny / "movie.mp4").unlink()
    refuse(virest, tiny, 4, "movie.mp4")


def test_a_movie_without_moov(virest: Virest, tiny: Path) -> None:
    """A recording that was cut off has no index."""
    movie = tiny / "movie.mp4"
    data = movie.read_bytes()
    movie.write_bytes(data[: data.index(b"moov") - 4])
    refuse(virest, tiny, 4, "movie.mp4")


def test_an_imu_that_does_not_cover_the_frames(virest: Virest, tiny: Path, edit_gyro: Edit) -> None:
    """No frame can be processed: exit 4."""
    edit_gyro(lambda rows: rows[:40])
    refuse(virest, tiny, 4, "gyro_accel.csv")


def test_an_imu_that_covers_some_frames(virest: Virest, tiny: Path, edit_gyro: Edit) -> None:
    """Frames outside the IMU samples are skipped with a reason and the others are processed: exit 0."""
    edit_gyro(lambda rows: rows[130:])
    result = virest("process", tiny, "--json", *FAST, cwd=tiny.parent)
    assert result.returncode == 0, result.stderr
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    skipped = [line for line in lines if line["status"] == "skipped"]
    assert [line["frame"] for line in skipped] == list(range(len(skipped)))
    assert 0 < len(skipped) < 24
    assert all(line["output"] is None and line["warnings"] for line in skipped)


@pytest.mark.parametrize("damage", ["gap", "nan"])
def test_a_hole_in_the_imu_skips_the_frames_inside(virest: Virest, tiny: Path, edit_gyro: Edit, damage: str) -> None:
    """For a gap or NaN samples, the frames inside are skipped: exit 0."""

    def hole(rows: list[str]) -> list[str]:
        inside = range(150, 190)
        if damage == "gap":
            return [row for i, row in enumerate(rows) if i not in inside]
        return [re.sub(r",[^,]*,", ",NaN,", row, count=1) if i in inside else row for i, row in enumerate(rows)]

    edit_gyro(hole)
    result = virest("process", tiny, "--json", *FAST, cwd=tiny.parent)
    assert result.returncode == 0, result.stderr
    statuses = [json.loads(line)["status"] for line in result.stdout.splitlines()]
    assert 4 <= statuses.count("skipped") <= 12
    assert statuses[0] != "skipped" != statuses[-1]


def test_swapped_files(virest: Virest, tiny: Path) -> None:
    """The files' headers reveal the swap."""
    (tiny / "gyro_accel.csv").rename(tiny / "x")
    (tiny / "movie_metadata.csv").rename(tiny / "gyro_accel.csv")
    (tiny / "x").rename(tiny / "movie_metadata.csv")
    refuse(virest, tiny, 4, "swapped")


def test_an_unknown_key_in_the_profile(virest: Virest, tiny: Path) -> None:
    """Exit 3, and the error suggests the nearest known key."""
    profile = tiny / "camera.yaml"
    profile.write_text(profile.read_text().replace("readout_time_s", "readout_s"))
    refuse(virest, tiny, 3, "readout_s", "readout_time_s")


def test_a_profile_of_another_size(virest: Virest, tiny: Path) -> None:
    """Exit 3, and the error names both sizes."""
    profile = tiny / "camera.yaml"
    profile.write_text(profile.read_text().replace("160", "320"))
    refuse(virest, tiny, 3, "320", "160")


def test_invalid_settings(virest: Virest, tiny: Path) -> None:
    """Exit 3, before any work."""
    (tiny.parent / "s.yaml").write_text("strenght: 2\n")
    result = virest("process", tiny, "--out", tiny.parent / "out", "--settings", tiny.parent / "s.yaml")
    assert_refused(result, 3, "s.yaml", "strength")
    assert not (tiny.parent / "out").exists()


def test_a_profile_file_that_does_not_exist(virest: Virest, tiny: Path) -> None:
    """Exit 3, before any work."""
    assert_refused(virest("process", tiny, "--config", "none.yaml", cwd=tiny.parent), 3, "none.yaml")


# ── output ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_an_existing_run_is_protected_resumed_or_replaced(virest: Virest, tiny: Path) -> None:
    """Without ``--overwrite`` nothing changes; ``--resume`` accepts a finished run; ``--overwrite`` starts anew."""
    arguments = ("process", tiny, "--out", tiny.parent / "out", *FAST, "--deblur", "none", "--frames")
    run = tiny.parent / "out/tiny"
    assert virest(*arguments, "0:3").returncode == 0
    before = content(run)
    assert_refused(virest(*arguments, "0:2"), 8, "--overwrite")
    assert_refused(virest(*arguments, "0:2", "--resume"), 8, "frames")
    assert virest(*arguments, "0:3", "--resume").returncode == 0
    assert differences(run, before) == []
    assert virest(*arguments, "0:2", "--overwrite").returncode == 0
    assert {name for name in below(run) if name.endswith(".png")} == {"frames/000000.png", "frames/000001.png"}


def test_other_captures_in_the_output_folder_do_not_matter(virest: Virest, tiny: Path) -> None:
    """A run occupies only OUT/<capture>."""
    (tiny.parent / "out/other/frames").mkdir(parents=True)
    assert virest("process", tiny, "--out", tiny.parent / "out", *FAST, "--frames", "0:1").returncode == 0


def test_an_output_below_a_file_is_refused(virest: Virest, tiny: Path) -> None:
    """OUT may neither be a file nor lie below one."""
    (tiny.parent / "file").write_text("mine")
    for out in ("file", "file/deeper"):
        result = virest("process", tiny, "--out", tiny.parent / out, *FAST, "--frames", "0:1")
        assert_refused(result, 8, "file")
    assert (tiny.parent / "file").read_text() == "mine"


@pytest.fixture(scope="session")
def undisturbed(virest: Virest, _tiny_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Contents of an uninterrupted run of ``tiny`` without deblurring."""
    folder = tmp_path_factory.mktemp("undisturbed")
    capture = shutil.copytree(_tiny_capture, folder / "tiny")
    options = ("--out", folder / "out", "--jobs", "1", "--deblur", "none")
    assert virest("process", capture, *options).returncode == 0
    return content(folder / "out/tiny")


@pytest.mark.parametrize(("code", "after"), [("ENOSPC", 0), ("ENOSPC", 3), ("EDQUOT", 13), ("EROFS", 0)])
def test_a_disk_that_rejects_writes(
    virest_here: Virest, tiny: Path, undisturbed: dict[str, Any], code: str, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Full, over quota or read-only.

    Exit 8, one line, no half-written file, and ``--resume`` completes the run afterwards.
    """
    arguments = ["process", str(tiny), "--out", str(tiny.parent / "out"), "--jobs", "1", "--deblur", "none"]
    number, honest, written = getattr(errno, code), outputs._write_bytes, itertools.count(1)

    def injected(path: Path, data: bytes) -> None:
        if next(written) > after:
            path.write_bytes(data[: len(data) // 2])
            raise OSError(number, os.strerror(number))
        honest(path, data)

    with monkeypatch.context() as broken:
        broken.setattr(outputs, "_write_bytes", injected)
        assert_refused(virest_here(*arguments), 8, os.strerror(number))
    assert not [name for name in below(tiny.parent / "out") if name.endswith((".part", ".lock", "run.json"))]
    if after < 10:
        assert not (tiny.parent / "out/tiny").exists()
    assert virest_here(*arguments, "--resume").returncode == 0
    assert differences(tiny.parent / "out/tiny", undisturbed) == []


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["process", "{tiny}", "--out", "{long}"], 8),
        (["process", "{tiny}", "--config", "{long}"], 3),
        (["simulate", "{long}"], 8),
        (["calibrate", "{tiny}", "--out", "{long}"], 8),
        (["diagnose", "{tiny}", "--out", "{long}"], 8),
        (["export", "{tiny}", "--out", "{long}"], 8),
        (["report", "{long}"], 4),
    ],
)
def test_a_name_too_long_for_the_disk_is_a_user_error(
    virest: Virest, tiny: Path, arguments: list[str], code: int
) -> None:
    """One line and the exit code of the input concerned, not a traceback."""
    filled = [part.format(tiny=tiny, long=tiny.parent / ("a" * 300)) for part in arguments]
    assert_refused(virest(*filled), code, os.strerror(errno.ENAMETOOLONG))


# ── batches ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_capture_given_twice_is_refused_before_any_work(virest: Virest, tiny: Path) -> None:
    """Exit 8, and nothing is written. Different folders with one name are told apart by their paths (test_finish)."""
    result = virest("process", tiny, tiny.parent / "tiny/../tiny", cwd=tiny.parent)
    assert_refused(result, 8, "'tiny'")
    assert not (tiny.parent / "virest-out").exists()


def accounts(out: Path) -> dict[str, dict[str, Any]]:
    """Every run.json of an output folder, by capture."""
    return {path.parent.name: json.loads(path.read_text()) for path in out.glob("*/run.json")}


def test_a_batch_with_failures_processes_the_rest_and_exits_with_9(virest: Virest, tiny: Path) -> None:
    """A failed capture has an error line and a run.json, the other capture a row; ``--resume`` retries what failed."""
    arguments = ("process", "./tiny", "none", "odd", *FAST, "--frames", "0:1")
    shutil.copytree(tiny, tiny.parent / "odd")
    (tiny.parent / "odd/gyro_accel.csv").write_bytes(b"")
    result = virest(*arguments, cwd=tiny.parent)
    assert result.returncode == 9
    assert len([line for line in result.stderr.splitlines() if line.startswith("virest: error: ")]) == 2
    assert [line.split()[0] for line in result.stdout.splitlines()] == ["capture", "tiny", "wrote", "next:"]
    found = accounts(tiny.parent / "virest-out")
    assert {name: (a["status"], a["exit_code"]) for name, a in found.items()} == {
        "tiny": ("done", 0), "none": ("failed", 4), "odd": ("failed", 4)
    }  # fmt: skip
    assert found["tiny"]["source"] == {"given": "./tiny", "resolved": os.path.realpath(tiny)}
    assert {f["path"] for f in found["tiny"]["inputs"]} >= {os.path.realpath(tiny / "movie.mp4")}
    assert {f["file"]: f["bytes"] for f in found["odd"]["inputs"]}["gyro_accel.csv"] == 0
    for source in ("gyro_accel.csv", "camera.yaml"):
        shutil.copy(tiny / source, tiny.parent / "odd")
    again = virest(*arguments, "--resume", cwd=tiny.parent)
    assert again.returncode == 9, again.stderr
    assert {n: a["status"] for n, a in accounts(tiny.parent / "virest-out").items()} == {
        "tiny": "done", "none": "failed", "odd": "done"
    }  # fmt: skip
    assert not [name for name in below(tiny.parent / "virest-out") if ".run" in name.split("/") or ".part" in name]


@pytest.mark.scenario
def test_a_batch_prints_and_writes_the_same_for_any_number_of_jobs(virest: Virest, tiny: Path) -> None:
    """Workers plan several captures at once; lines keep the order of the captures and files do not change."""
    names = ["tiny", "b", "c", "d"]
    for name in names[1:]:
        shutil.copytree(tiny, tiny.parent / name)
    (tiny.parent / "b/movie.mp4").write_bytes(b"")
    (tiny.parent / "d/movie_metadata.csv").unlink()
    said = {}
    for jobs in (1, 2):
        result = virest("process", *names, "--out", f"out{jobs}", *FAST[:2], "--jobs", jobs, cwd=tiny.parent)
        assert result.returncode == 9, result.stderr
        said[jobs] = result.stderr
    assert said[1] == said[2]
    for name in names:
        assert differences(tiny.parent / "out1" / name, content(tiny.parent / "out2" / name)) == []


def test_an_undecodable_frame_fails_only_its_group(virest: Virest, tiny: Path) -> None:
    """Exit 9; the frames of the damaged group fail with a reason, and the rest is processed."""
    data = bytearray((tiny / "movie.mp4").read_bytes())
    begin = data.index(b"mdat") + 4
    middle = begin + (data.index(b"moov") - begin if data.index(b"moov") > begin else len(data) - begin) // 2
    data[middle : middle + 1500] = bytes(1500)
    (tiny / "movie.mp4").write_bytes(data)
    result = virest("process", tiny, "--json", "--jobs", 1, "--deblur", "none", cwd=tiny.parent)
    statuses = [json.loads(line)["status"] for line in result.stdout.splitlines()]
    assert result.returncode == 9, result.stderr
    assert len(statuses) == 24
    assert 0 < statuses.count("failed") < 20
    assert "decoded" in next(json.loads(x)["warnings"][0] for x in result.stdout.splitlines() if '"failed"' in x)


def test_no_name_on_standard_input_is_a_warning(virest: Virest) -> None:
    """If ``find … | virest process -`` finds nothing, there is nothing to process."""
    result = virest("process", "-", stdin="\n")
    assert (result.returncode, result.stdout) == (0, "")
    assert "standard input" in result.stderr


@pytest.mark.parametrize("as_json", [False, True])
def test_inspect_prints_what_it_can(virest: Virest, tiny: Path, *, as_json: bool) -> None:
    """An intact capture exits 0.

    Without its movie the exit code is 4, with the remaining facts on standard output and one error line.
    """
    options = ["--json"] if as_json else []
    good = virest("inspect", tiny, *options)
    assert (good.returncode, good.stderr) == (0, "")
    (tiny / "movie.mp4").unlink()
    bad = virest("inspect", tiny, *options)
    assert bad.returncode == 4
    assert "tiny" in bad.stdout
    assert len(bad.stderr.splitlines()) == 1
    if as_json:
        assert json.loads(good.stdout)
        assert json.loads(bad.stdout)


# ── being stopped ────────────────────────────────────────────────────────────────────────────────────────────────

ITERATIONS = 40
"""About 0.1 s per frame of ``swing``, so that a run is still working when it is stopped."""


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, ...]:
    """Arguments that make a run slow."""
    file = tmp_path_factory.mktemp("slow") / "slow.yaml"
    file.write_text(f"virest_settings: 1\niterations: {ITERATIONS}\nneighbours: 0\n")
    return ("--settings", file)


@pytest.fixture(scope="module")
def undisturbed_swing(
    virest: Virest, swing: Path, slow: tuple[object, ...], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    """Contents of an uninterrupted run of ``swing`` with one process."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    assert virest("process", swing, *slow, "--jobs", 1, "--out", out).returncode == 0
    return content(out / "swing")


@pytest.mark.scenario
@pytest.mark.parametrize(("number", "jobs"), [(signal.SIGINT, 2), (signal.SIGTERM, 1)])
def test_ctrl_c_leaves_only_complete_files_and_resume_continues(
    virest: Virest,
    start: Callable[..., Any],
    swing: Path,
    slow: tuple[object, ...],
    undisturbed_swing: dict[str, Any],
    tmp_path: Path,
    jobs: int,
    number: signal.Signals,
) -> None:
    """Exit 130 (143 for SIGTERM), no partial files, no lock; ``--resume`` yields the files of an uninterrupted run."""
    arguments = ("process", swing, *slow, "--out", tmp_path / "out", "--jobs")
    with start(*arguments, jobs) as process:
        wait_for(lambda: len(below(tmp_path / "out/swing/frames")) > 2, process)
        os.killpg(process.pid, number)
        output, errors = process.communicate(timeout=300)
    assert process.returncode == (130 if number == signal.SIGINT else 143), errors
    assert output == ""
    assert "Traceback" not in errors
    assert not [name for name in below(tmp_path / "out") if name.endswith((".part", ".lock", "run.json"))]
    assert virest(*arguments, 1, "--resume").returncode == 0
    assert differences(tmp_path / "out/swing", undisturbed_swing) == []


@pytest.mark.scenario
def test_resume_after_a_kill_gives_the_same_run(
    virest: Virest, start: Callable[..., Any], long_swing: Path, slow: tuple[object, ...], tmp_path: Path
) -> None:
    """After SIGKILL no worker outlives its parent, and finished segments are not processed again."""
    arguments = ("process", long_swing, *slow, "--jobs", 2, "--out")
    alone = ("process", long_swing, *slow, "--jobs", 1, "--out")
    run = tmp_path / "out/swing"
    with start(*arguments, tmp_path / "out") as process:
        wait_for(lambda: any(name.startswith(".segments/") for name in below(run)), process)
        process.kill()
        process.communicate(timeout=300)  # returns when the last worker has closed the pipes
    log = next((run / ".segments").glob("*.jsonl"))
    first = json.loads(log.read_text().splitlines()[0])["output"]
    written_ns = (run / first).stat().st_mtime_ns
    (run / "frames/000023.png.0123abcd.part").write_bytes(b"half")
    assert_refused(virest(*arguments, tmp_path / "out"), 8, "unfinished", "--resume")
    assert virest(*alone, tmp_path / "out", "--resume").returncode == 0
    assert (run / first).stat().st_mtime_ns == written_ns
    assert virest(*alone, tmp_path / "undisturbed").returncode == 0
    assert differences(run, content(tmp_path / "undisturbed/swing")) == []


@pytest.mark.scenario
def test_the_files_do_not_depend_on_the_number_of_jobs(virest: Virest, long_swing: Path, tmp_path: Path) -> None:
    """One process and two write the same files."""
    for jobs in (1, 2):
        options = ("--preset", "best", "--frames", "0:14", "--jobs", jobs)
        result = virest("process", long_swing, "--out", tmp_path / str(jobs), *options)
        assert result.returncode == 0, result.stderr
    assert differences(tmp_path / "1/swing", content(tmp_path / "2/swing")) == []


@pytest.mark.scenario
def test_a_closed_reader_ends_the_run_quietly(start: Callable[..., Any], tiny: Path, tmp_path: Path) -> None:
    """``virest process … --json | head -1`` gives no traceback and no half-written file."""
    with start("process", tiny, "--jobs", 1, "--json", "-q", "--out", tmp_path / "out") as process:
        assert json.loads(process.stdout.readline())["frame"] == 0
        process.stdout.close()
        errors = process.stderr.read()
        process.wait(timeout=300)
    assert (process.returncode, errors) == (141, "")
    assert not [name for name in below(tmp_path / "out") if name.endswith((".part", ".lock"))]
