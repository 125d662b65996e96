"""Errors have stable exit codes and one line of text, and cross a process border completely."""

from __future__ import annotations

import pickle

import pytest

from virest import errors
from virest.errors import VirestError

EXIT_CODES = {
    "VirestError": 1,
    "SettingsError": 3,
    "CaptureError": 4,
    "VideoError": 4,
    "ImuError": 4,
    "ClockError": 4,
    "CalibrationError": 6,
    "RestorationError": 7,
    "OutputError": 8,
}
"""Section 6 of the contract."""


def _descendants(kind: type[VirestError]) -> list[type[VirestError]]:
    return [kind, *(d for child in kind.__subclasses__() for d in _descendants(child))]


def _tree() -> list[type[VirestError]]:
    return [kind for kind in _descendants(VirestError) if kind.__module__ == errors.__name__]


def test_exit_codes_are_those_of_the_contract() -> None:
    """Each kind of error has the exit code of the contract, and no kind is missing."""
    assert {kind.__name__: kind.exit_code for kind in _tree()} == EXIT_CODES


def test_the_drawn_tree_shows_every_error() -> None:
    """The tree at the head of the file names every error with its exit code."""
    lines = (errors.__doc__ or "").splitlines()
    for name, code in EXIT_CODES.items():
        assert any(f" {name} " in f"{line} " and f"exit  {code}" in line for line in lines), name


def test_video_imu_and_clock_errors_are_capture_errors() -> None:
    """Catching a capture's error catches those of its parts."""
    assert all(
        issubclass(kind, errors.CaptureError) for kind in (errors.VideoError, errors.ImuError, errors.ClockError)
    )


@pytest.mark.parametrize("kind", _tree())
def test_an_error_survives_pickling(kind: type[VirestError]) -> None:
    """Pickling keeps kind, message, hint and facts."""
    error = kind("12 of 40 rows fall", hint="cut the file", rows=12, where=("a.csv", 3))
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is kind
    assert (copy.message, copy.hint, copy.facts) == (error.message, error.hint, {"rows": 12, "where": ("a.csv", 3)})
    assert str(copy) == str(error)
    assert copy.exit_code == error.exit_code


@pytest.mark.parametrize("kind", _tree())
def test_the_text_is_one_line_of_message_and_hint(kind: type[VirestError]) -> None:
    """An error reads as one line: the problem, then the next step."""
    assert str(kind("the file is cut", hint="copy it again")) == "the file is cut; copy it again"
    assert str(kind("the file is cut")) == "the file is cut"
    assert len(str(kind("a", hint="b", n=1)).splitlines()) == 1
