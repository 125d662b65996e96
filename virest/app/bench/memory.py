"""Peak memory of the program and of its largest worker for short and long movies, which must not grow."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from virest.app.bench.workload import Scale, looped_capture, process_command
from virest.app.console import numeric_table

FRAMES = (100, 600)
QUICK_FRAMES = (20, 60)
FULL_FRAMES = (100, 3000)
"""Few and many frames: peaks that differ show memory that grows with the length of the movie."""
SAMPLE_S = 0.05
"""Shorter than the work on one frame, so that its peak is seen."""
PRESET = "fast"


@dataclass(frozen=True, slots=True)
class Peaks:
    """Peak memory of a command."""

    together_bytes: int
    """Largest sum of the resident memory of all processes; shared pages count once per process."""
    main_bytes: int
    """Peak of the main process."""
    worker_bytes: int
    """Largest peak of a child process."""
    wall_s: float


def memory_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Measure the memory of runs over few and many frames."""
    counts = QUICK_FRAMES if scale.quick else FULL_FRAMES if scale.full else FRAMES
    results = []
    for frames in counts:
        capture = looped_capture(work, frames)
        out = work / "memory"
        peaks = peaks_of(process_command(capture, out, "--preset", PRESET, "--jobs", "2"))
        results.append(
            {
                "frames": frames,
                "peak_mb": peaks.together_bytes / 1e6,
                "main_mb": peaks.main_bytes / 1e6,
                "worker_mb": peaks.worker_bytes / 1e6,
                "wall_s": peaks.wall_s,
            }
        )
        shutil.rmtree(out)
        shutil.rmtree(capture)
    facts = {"preset": PRESET, "runs": results, "grown": grown(results)}
    return facts, memory_text(facts)


def grown(runs: list[dict[str, Any]]) -> dict[str, float]:
    """Ratio of the peaks of the longest to the shortest movie."""
    first, last = runs[0], runs[-1]
    return {key: last[f"{key}_mb"] / first[f"{key}_mb"] for key in ("peak", "worker")}


def memory_text(facts: dict[str, Any]) -> str:
    """One line per movie."""
    rows = [
        [str(r["frames"]), *(f"{r[f'{key}_mb']:.0f}" for key in ("worker", "main", "peak")), f"{r['wall_s']:.1f}"]
        for r in facts["runs"]
    ]
    header = ["frames", "largest worker MB", "main process MB", "all together MB", "seconds"]
    return (
        f"MEMORY: peaks of resident memory, 720x1280, --preset {facts['preset']} --jobs 2\n"
        + numeric_table(header, rows)
        + "\nlongest movie over shortest: worker {worker:.3f}, all together {peak:.3f}".format(**facts["grown"])
    )


def peaks_of(command: list[str]) -> Peaks:
    """Run a command and sample its memory and its descendants' 20 times per second.

    The peak of a process is the kernel's VmHWM, so peaks between samples are included.  The last sample of each process
    counts, since before exec a new process still reports its parent's peak.
    """
    began = time.perf_counter()
    together: list[int] = []
    own: dict[int, int] = {}

    def sample(tree: list[int]) -> None:
        together.append(sum(map(resident_bytes, tree)))
        own.update({pid: peak for pid in tree if (peak := peak_bytes(pid))})

    finished = run_sampled(command, sample, SAMPLE_S)
    if finished.returncode:
        raise subprocess.CalledProcessError(finished.returncode, command)
    main = own.pop(finished.pid, 0)
    return Peaks(max(together, default=0), main, max(own.values(), default=0), time.perf_counter() - began)


def run_sampled(
    command: list[str], sample: Callable[[list[int]], None], step_s: float, errors: IO[str] | None = None
) -> subprocess.Popen[bytes]:
    """Run a command without its standard output and call ``sample`` with its process tree every ``step_s`` seconds.

    errors: file for its standard error.  Returns the finished process.
    """
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors) as process:
        while process.poll() is None:
            sample(process_tree(process.pid))
            time.sleep(step_s)
    return process


def process_tree(root: int) -> list[int]:
    """A process and all its descendants, by the parents in /proc."""
    children: dict[int, list[int]] = {}
    for entry in os.listdir("/proc"):
        if entry.isdigit() and (parent := _parent(int(entry))) is not None:
            children.setdefault(parent, []).append(int(entry))
    found, waiting = [], [root]
    while waiting:
        found.append(waiting.pop())
        waiting += children.get(found[-1], [])
    return found


def resident_bytes(pid: int) -> int:
    """Resident memory of a process; 0 once it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0


def peak_bytes(pid: int) -> int:
    """Peak resident memory of a process; 0 once it has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), 0)


def _parent(pid: int) -> int | None:
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except (OSError, IndexError):
        return None
