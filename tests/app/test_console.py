"""Terminal output while work is in progress."""

import io
import sys

import pytest

from virest.app import console


class Terminal(io.StringIO):
    """A standard error that is a terminal."""

    def isatty(self) -> bool:
        """Always true."""
        return True


def looked_at(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """A terminal in place of standard error.

    Set inside the test because pytest replaces standard error before each test.
    """
    shown = Terminal()
    monkeypatch.setattr(sys, "stderr", shown)
    return shown


def test_work_without_steps_shows_its_name_below_log_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading and planning a capture takes seconds: the terminal shows neither a bar of 0 of 1 nor nothing."""
    terminal = looked_at(monkeypatch)
    with console.progress_bar(None, "trip: reading and planning", quiet=False):
        console.CONSOLE.line("camera profile from camera.yaml")
    lines = terminal.getvalue().replace("\n", "\r").split("\r")
    assert lines.count("trip: reading and planning …") == 2  # before the line and below it
    assert "virest: camera profile from camera.yaml" in lines
    assert "%" not in terminal.getvalue()


def test_frames_of_an_earlier_run_do_not_count_towards_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    """With 8 of 10 frames done, the bar begins at 80 % and shows the speed that the table below it shows."""
    terminal = looked_at(monkeypatch)
    with console.progress_bar(10, "trip", quiet=False, done=8) as bar:
        assert bar is not None
        bar.update(1)
        facts = bar.format_dict  # type: ignore[attr-defined]
    assert " 80%" in terminal.getvalue()
    assert (facts["n"], facts["initial"]) == (9, 8)
    assert facts["rate"] is None  # no moving average: frames per second, as in the table


def test_no_bar_with_quiet_or_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither ``--quiet`` nor a redirected standard error shows a bar."""
    terminal = looked_at(monkeypatch)
    with console.progress_bar(10, "trip", quiet=True) as bar:
        assert bar is None
    monkeypatch.setattr(terminal, "isatty", lambda: False)
    with console.progress_bar(10, "trip", quiet=False) as bar:
        assert bar is None
    assert terminal.getvalue() == ""
