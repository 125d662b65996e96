"""Soak test: 200 captures in one run, 1 of 10 with one of ten defects.  All good ones must be restored without growth.

Memory and open files of the program and its workers are sampled throughout.  The last quarter of the run is compared
with the second, since the first fills caches.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from virest.app.bench.memory import resident_bytes, run_sampled
from virest.app.bench.workload import Scale, simulated
from virest.app.console import numeric_table
from virest.errors import PARTLY_FAILED

CAPTURES, QUICK_CAPTURES = 200, 20
"""Small captures, many of them: what leaks per capture accumulates."""
BROKEN_EVERY = 10
"""One capture in ten is damaged, each defect in turn."""
FRAMES = 8
"""Enough for one segment; the section tests the handling of captures, not of frames."""
SAMPLE_S = 0.25
"""Many samples of the memory per run, at a negligible load."""
HEAD_LINES = 1
"""Lines before the first row of the gyroscope's log."""
SHIFT_NS = 10**15
"""11.6 days: no sample covers a frame any more."""


def soak_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Write the captures, process them in one run, and check each result."""
    count = QUICK_CAPTURES if scale.quick else CAPTURES
    source = simulated(work, "soak-source", width=240, height=180, frames=FRAMES, seed=3)
    broken = dict(_write_captures(work / "soak", source, count))
    folders = sorted((work / "soak").iterdir())
    out = work / "soak-out"
    command = [sys.executable, "-m", "virest", "process", *map(str, folders), "--out", str(out)]
    code, errors, samples = _monitored([*command, "--preset", "fast", "--jobs", "2"], work / "soak.log")
    facts = {"captures": count, "exit_code": code, **_judge(folders, broken, out, errors), **_growth(samples)}
    for folder in (work / "soak", out):
        shutil.rmtree(folder)
    return facts, _text(facts)


# ── captures ─────────────────────────────────────────────────────────────────────────────────────────────────────


def _write_captures(folder: Path, source: Path, count: int) -> Iterator[tuple[str, str]]:
    """Copy one capture ``count`` times and damage every tenth copy; yields (name, defect) of those."""
    folder.mkdir()
    for number in range(count):
        copy = folder / f"capture-{number:04d}"
        shutil.copytree(source, copy, ignore=shutil.ignore_patterns("truth*"))
        if number % BROKEN_EVERY == BROKEN_EVERY - 1:
            defect = list(DEFECTS)[number // BROKEN_EVERY % len(DEFECTS)]
            DEFECTS[defect](copy)
            yield copy.name, defect


def _cut_movie(folder: Path) -> None:
    movie = folder / "movie.mp4"
    movie.write_bytes(movie.read_bytes()[: movie.stat().st_size // 2])


def _spoil_movie(folder: Path) -> None:
    """Overwrite the last third of the media data; the index is unchanged."""
    movie = folder / "movie.mp4"
    data = bytearray(movie.read_bytes())
    start = data.find(b"mdat")
    size = int.from_bytes(data[start - 4 : start], "big")
    data[start + 2 * size // 3 : start + size - 4] = np.random.default_rng(1).bytes(size - 4 - 2 * size // 3)
    movie.write_bytes(data)


def _empty_movie(folder: Path) -> None:
    (folder / "movie.mp4").write_bytes(b"")


def _empty_gyro(folder: Path) -> None:
    (folder / "gyro_accel.csv").write_bytes(b"")


def _other_session(folder: Path) -> None:
    """Shift the gyroscope's timestamps by SHIFT_NS, about 11.6 days."""
    path = folder / "gyro_accel.csv"
    lines = path.read_text().splitlines()
    rows = (line.partition(",") for line in lines[HEAD_LINES:])
    moved = [f"{int(time_ns) + SHIFT_NS},{rest}" for time_ns, _, rest in rows]
    path.write_text("\n".join([*lines[:HEAD_LINES], *moved]) + "\n")


def _no_gyro(folder: Path) -> None:
    path = folder / "gyro_accel.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:HEAD_LINES], *(re.sub(r",.*", ",null" * 6, row) for row in lines[1:])]) + "\n")


def _swap(folder: Path) -> None:
    one, other = folder / "gyro_accel.csv", folder / "frame_timestamps.txt"
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)


def _pipe(folder: Path) -> None:
    (folder / "gyro_accel.csv").unlink()
    os.mkfifo(folder / "gyro_accel.csv")


def _wrong_profile(folder: Path) -> None:
    (folder / "camera.yaml").write_text("virest_profile: 1\nimage: {width: 240, hight: 180}\n")


def _remove_all(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.mkdir()


DEFECTS: dict[str, Callable[[Path], None]] = {
    "movie cut": _cut_movie,
    "movie spoilt": _spoil_movie,
    "movie empty": _empty_movie,
    "gyroscope empty": _empty_gyro,
    "gyroscope null": _no_gyro,
    "gyroscope of another session": _other_session,
    "files swapped": _swap,
    "pipe for a file": _pipe,
    "wrong profile": _wrong_profile,
    "nothing there": _remove_all,
}


# ── monitoring ───────────────────────────────────────────────────────────────────────────────────────────────────


def _monitored(command: list[str], log: Path) -> tuple[int, str, list[tuple[float, int]]]:
    """Exit code, standard error, and (bytes, open files) of the whole process tree, sampled 4 times per second."""
    samples: list[tuple[float, int]] = []

    def sample(tree: list[int]) -> None:
        samples.append((float(sum(map(resident_bytes, tree))), sum(map(_open_files, tree))))

    with log.open("w") as file:
        code = run_sampled(command, sample, SAMPLE_S, file).returncode
    return code, log.read_text(errors="replace"), samples


def _open_files(pid: int) -> int:
    with suppress(OSError):
        return len(os.listdir(f"/proc/{pid}/fd"))
    return 0


def _growth(samples: list[tuple[float, int]]) -> dict[str, Any]:
    """Median memory and open files in the second and the last quarter of the run."""
    values = np.array(samples)
    quarter = len(values) // 4
    early, late = np.median(values[quarter : 2 * quarter], axis=0), np.median(values[3 * quarter :], axis=0)
    return {
        "memory_mb": [early[0] / 1e6, late[0] / 1e6],
        "open_files": [int(early[1]), int(late[1])],
        "seconds": len(values) * SAMPLE_S,
    }


def _judge(folders: list[Path], broken: dict[str, str], out: Path, errors: str) -> dict[str, Any]:
    """Count the good captures restored, and the broken ones explained by their run.json."""
    accounts = {file.parent.name: json.loads(file.read_bytes()) for file in out.glob("*/run.json")}
    done = {name for name, account in accounts.items() if account["status"] == "done" and account["exit_code"] == 0}
    explained = {name: _explanation(accounts.get(name)) for name in broken}
    return {
        "good": len(folders) - len(broken),
        "good_done": sum(folder.name in done for folder in folders if folder.name not in broken),
        "broken": len(broken),
        "broken_explained": sum(bool(lines) for lines in explained.values()),
        "explanations": {broken[name]: lines[0] if lines else "" for name, lines in explained.items()},
        "tracebacks": errors.count("Traceback"),
        "left_over": sorted(p.name for p in out.rglob("*") if p.name.endswith((".part", ".lock")) or p.name == ".run"),
    }


def _explanation(account: dict[str, Any] | None) -> list[str]:
    """Reasons why a capture was not processed, or warnings about it; empty if its run.json gives none."""
    if account is None:
        return []
    failed = [f"{account['counts']['failed']} frames failed"] if account["counts"]["failed"] else []
    reason = [account["failure"]["reason"]] if account["failure"] else []
    return [*reason, *failed, *account["warnings"]]


def _text(facts: dict[str, Any]) -> str:
    rows = [
        ["exit code", str(facts["exit_code"]), str(PARTLY_FAILED)],
        ["good captures done", str(facts["good_done"]), str(facts["good"])],
        ["broken ones explained", str(facts["broken_explained"]), str(facts["broken"])],
        ["tracebacks, files left over", f"{facts['tracebacks']}, {len(facts['left_over'])}", "0, 0"],
        ["memory, MB", "{:.0f} -> {:.0f}".format(*facts["memory_mb"]), "level"],
        ["open files", "{} -> {}".format(*facts["open_files"]), "level"],
    ]
    title = f"SOAK: {facts['captures']} captures in one run, {facts['seconds']:.0f} s; second quarter -> last quarter\n"
    explanations = "\n".join(f"  {defect}: {line[:150]}" for defect, line in facts["explanations"].items())
    return title + numeric_table(["what", "found", "expected"], rows) + "\n" + explanations
