"""What a terminal shows while work is under way."""

import io
import sys

import pytest

from virest.app import console


class Terminal(io.StringIO):
    """A standard error that a person looks at."""

    def isatty(self) -> bool:
        """A terminal."""
        return True


def looked_at(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """A terminal in place of standard error; within the test, since pytest puts its own there before each."""
    shown = Terminal()
    monkeypatch.setattr(sys, "stderr", shown)
    return shown


def test_work_without_steps_says_what_it_is_and_log_lines_stand_above(monkeypatch: pytest.MonkeyPatch) -> None:
    """A capture is read and planned for seconds: no bar of 0 of 1, and no silence."""
    terminal = looked_at(monkeypatch)
    with console.progress_bar(None, "trip: reading and planning", quiet=False):
        console.CONSOLE.line("camera profile from camera.yaml")
    lines = terminal.getvalue().replace("\n", "\r").split("\r")
    assert lines.count("trip: reading and planning …") == 2  # before the line and below it
    assert "virest: camera profile from camera.yaml" in lines
    assert "%" not in terminal.getvalue()


def test_what_an_earlier_run_did_is_no_part_of_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight of ten frames were there: the bar begins at 80 %, and its speed is that of the table below it."""
    terminal = looked_at(monkeypatch)
    with console.progress_bar(10, "trip", quiet=False, done=8) as bar:
        assert bar is not None
        bar.update(1)
        facts = bar.format_dict  # type: ignore[attr-defined]
    assert " 80%" in terminal.getvalue()
    assert (facts["n"], facts["initial"]) == (9, 8)
    assert facts["rate"] is None  # no moving mean: frames over seconds, as the table counts them


def test_no_bar_where_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither with --quiet nor in a file."""
    terminal = looked_at(monkeypatch)
    with console.progress_bar(10, "trip", quiet=True) as bar:
        assert bar is None
    monkeypatch.setattr(terminal, "isatty", lambda: False)
    with console.progress_bar(10, "trip", quiet=False) as bar:
        assert bar is None
    assert terminal.getvalue() == ""
