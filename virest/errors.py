"""The error tree.

    VirestError                    exit  1   an internal error, unless a subclass says otherwise
    ├── SettingsError              exit  3   settings or camera profile
    ├── CaptureError               exit  4   the capture cannot be used
    │   ├── VideoError             exit  4   the movie
    │   ├── ImuError               exit  4   gyroscope or accelerometer
    │   └── ClockError             exit  4   inconsistent times
    ├── CalibrationError           exit  6   the data do not determine the requested values
    ├── RestorationError           exit  7   the restoration of a frame failed
    └── OutputError                exit  8   exists, locked, disk full, not writable

Exit codes are a stable interface; 0 done, 2 usage, 9 part of a batch failed, 10 ``diagnose --check``, 130 interrupted.
The message of every error says what, where and how much; its hint says what to do next.
"""

from __future__ import annotations

from typing import Any

PARTLY_FAILED = 9
"""Exit code of a batch of which a part failed, and of a capture some of whose frames failed."""


def printable(text: str) -> str:
    """A name or a value for a message: characters that cannot be printed are shown as ``?``."""
    return "".join(c if c.isprintable() else "?" for c in text)


def one_line(text: object, most: int = 200) -> str:
    """A text, or what an error of another library says, in one line of at most this many characters."""
    return " ".join(str(text).split())[:most]


class VirestError(Exception):
    """What went wrong (message), what to do next (hint), and the numbers behind it (facts)."""

    exit_code = 1

    def __init__(self, message: str, *, hint: str = "", **facts: Any) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint
        self.facts = facts

    def __str__(self) -> str:
        return f"{self.message}; {self.hint}" if self.hint else self.message

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep hint and facts when the error is sent between processes."""
        return _rebuild, (type(self), self.message, self.hint, self.facts)


def _rebuild(kind: type[VirestError], message: str, hint: str, facts: dict[str, Any]) -> VirestError:
    return kind(message, hint=hint, **facts)


class SettingsError(VirestError):
    """A setting, a settings file or a camera profile cannot be used."""

    exit_code = 3


class CaptureError(VirestError):
    """A capture cannot be used."""

    exit_code = 4


class VideoError(CaptureError):
    """The movie is missing, truncated, not decodable, or not the one that the timestamps belong to."""


class ImuError(CaptureError):
    """Gyroscope or accelerometer data are missing, damaged, or do not cover the frames."""


class ClockError(CaptureError):
    """Times that decrease, repeat, lost their precision, or come from different clocks."""


class CalibrationError(VirestError):
    """The data do not determine the requested values."""

    exit_code = 6


class RestorationError(VirestError):
    """A frame could not be restored."""

    exit_code = 7


class OutputError(VirestError):
    """A result cannot be written: it exists, the folder is locked or read-only, or the disk is full."""

    exit_code = 8
