"""Hostile names and files given to the program: one error line, the right exit code, no file written elsewhere."""

import os
from pathlib import Path

import pytest

from virest.app.cli import run
from virest.app.outputs import capture_name
from virest.errors import OutputError


def refused(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    """The exit code and the error line of a rejected call."""
    code = run(["process", *map(str, arguments)])
    output, errors = capfd.readouterr()
    lines = [line for line in errors.splitlines() if line.startswith("virest: error: ")]
    assert output == ""
    assert "Traceback" not in errors
    assert len(lines) == 1, errors
    assert len(lines[0]) < 1000
    return code, lines[0]


@pytest.mark.parametrize("name", ["a" * 4096, "a" * 255 + "/" + "b" * 255 + "x", "é" * 2000, "x/" * 2000])
def test_names_of_four_kilobytes_are_refused(capfd: pytest.CaptureFixture[str], tmp_path: Path, name: str) -> None:
    """The error line shows only the beginning of the name."""
    code, _ = refused(capfd, tmp_path / name, "--out", tmp_path / "out")
    assert code == 4
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["a\nb", "a\x1b[2Jb", "a\x7f", "a\x9bb", "a\u2028b"])
def test_control_characters_are_refused(capfd: pytest.CaptureFixture[str], tmp_path: Path, name: str) -> None:
    """They could manipulate the terminal of a user who reads the log."""
    (tmp_path / name).mkdir()
    code, line = refused(capfd, tmp_path / name, "--out", tmp_path / "out")
    assert code == 8
    assert name not in line


def test_names_with_dots_never_lead_out_of_the_output_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths are resolved first; a path without a name of its own is refused."""
    (tmp_path / "a/b").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "a")
    assert capture_name("b/../../a/b") == "b"
    assert capture_name("..") == tmp_path.name
    assert capture_name("b/..") == "a"
    for path in ("/", "/..", "s3://trips/../x"):
        with pytest.raises(Exception, match=r"name|URL"):
            capture_name(path)
    with pytest.raises(OutputError):
        capture_name("/../..")


def test_loops_of_links_are_refused(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """A capture folder or a file in it may be a loop of symbolic links."""
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert refused(capfd, tmp_path / "loop", "--out", tmp_path / "out")[0] == 4
    (tmp_path / "one").mkdir()
    (tmp_path / "one/movie.mp4").symlink_to(tmp_path / "two")
    (tmp_path / "two").symlink_to(tmp_path / "one/movie.mp4")
    assert refused(capfd, tmp_path / "one", "--out", tmp_path / "out")[0] == 4


@pytest.mark.parametrize("option", ["--config", "--settings"])
def test_a_pipe_for_a_profile_or_settings_does_not_hang(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, option: str
) -> None:
    """No process writes into the pipe."""
    os.mkfifo(tmp_path / "file.yaml")
    (tmp_path / "one").mkdir()
    assert refused(capfd, tmp_path / "one", option, tmp_path / "file.yaml", "--out", tmp_path / "out")[0] == 3


@pytest.mark.parametrize(
    "text",
    [
        "deblur: !!python/object/apply:os.system ['exit 1']",
        "deblur: &a [*a]",
        "tile_px: " + "9" * 5000,
        "tile_px: 1" + ":59" * 400,
        "strength: .inf",
        "strength: 1e999",
        "tile_px: 9223372036854775808",
        "? " * 5000,
        "{" * 5000,
        "deblur: " + "x" * 900_000,
    ],
)
def test_hostile_settings_are_refused(capfd: pytest.CaptureFixture[str], tmp_path: Path, text: str) -> None:
    """Tags, YAML bombs, huge numbers and deep nesting exit with 3."""
    (tmp_path / "one").mkdir()
    (tmp_path / "s.yaml").write_text(text + "\n")
    assert refused(capfd, tmp_path / "one", "--settings", tmp_path / "s.yaml", "--out", tmp_path / "out")[0] == 3


@pytest.mark.parametrize("name", [".run", "run.json", ".lock", ".segments", "frames"])
def test_pipes_in_the_output_folder_do_not_hang(
    capfd: pytest.CaptureFixture[str], tiny: Path, tmp_path: Path, name: str
) -> None:
    """A folder that is not a run is refused, whatever it contains."""
    (tmp_path / "out/tiny").mkdir(parents=True)
    os.mkfifo(tmp_path / "out/tiny" / name)
    os.mkfifo(tmp_path / "out/tiny/another")
    code, _ = refused(capfd, tiny, "--out", tmp_path / "out", "--overwrite", "--jobs", 1)
    assert code == 8
    assert (tmp_path / "out/tiny" / name).is_fifo()
