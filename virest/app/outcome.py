"""The results of a call as a table of at most 80 columns, and the command to run next."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from virest.app import console
from virest.app.account import STATUSES
from virest.app.run_folder import EXTENDED
from virest.errors import PARTLY_FAILED

NUMBERS = (*STATUSES, "frames/s")
WIDTH, MOST_VERDICT = 80, 21
"""Columns of a terminal, and of the verdict in a table of several captures."""


@dataclass(frozen=True, slots=True)
class CaptureOutcome:
    """The result of one capture."""

    name: str
    path: str
    """The path as given."""
    folder: Path
    counts: dict[str, int]
    """Frames by status."""
    verdict: str
    seconds: float
    """Wall-clock time of restoration alone, as in the progress bar; without reading and planning."""
    advice: str = ""
    """The command that would improve this capture's result; empty: none known."""
    film: Path | None = None

    @property
    def exit_code(self) -> int:
        """9 if a frame failed, else 0."""
        return PARTLY_FAILED if self.counts.get("failed") else 0


def summary(outcomes: list[CaptureOutcome]) -> str:
    """A table of the captures, the paths of the results, and what to do next."""
    verdicts = [o.verdict if len(outcomes) == 1 else _cut(o.verdict, MOST_VERDICT) for o in outcomes]
    verdicts = [verdict.partition(":")[0] for verdict in verdicts]
    longest = min(max(map(len, verdicts), default=0), MOST_VERDICT)
    most_name = WIDTH - sum(len(head) + 2 for head in NUMBERS) - 2 - longest
    rows = []
    for outcome, verdict in zip(outcomes, verdicts, strict=True):
        counts = [str(outcome.counts.get(status, 0)) for status in STATUSES]
        rate = sum(map(int, counts)) / outcome.seconds if outcome.seconds else 0.0
        rows.append([_cut(outcome.name, most_name), *counts, f"{rate:.1f}" if rate else "-", verdict])
    lines = [console.table(["capture", *NUMBERS, "verdict"], rows, words=1)]
    lines += [f"wrote {outcome.folder}" for outcome in outcomes]
    lines += [f"wrote {outcome.film}" for outcome in outcomes if outcome.film is not None]
    return "\n".join([*lines, *next_steps(outcomes)])


def next_steps(outcomes: list[CaptureOutcome]) -> list[str]:
    """One line per call: the most useful next command."""
    if len(outcomes) > 1:
        return [f"next: virest report {shlex.quote(str(outcomes[0].folder.parent))} shows them all"]
    only = outcomes[0]
    path, folder = shlex.quote(only.path), shlex.quote(str(only.folder))
    extended = only.folder / EXTENDED
    if only.advice:
        return [f"next: {only.advice.replace('CAPTURE', path)}"]
    if extended.is_file():
        return [f"next: virest report {folder} shows it; its diagnosis suggests --config {shlex.quote(str(extended))}"]
    return [f"next: virest report {folder} shows it; virest diagnose {path} tests the camera model"]


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
