"""Peak memory of the program and its workers together, for short and long movies: it must not grow."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

from virest.app.bench.tables import table
from virest.app.bench.workload import Scale, looped_capture, process_command

FRAMES = (100, 600)
QUICK_FRAMES = (20, 60)
FULL_FRAMES = (100, 3000)
SAMPLE_S = 0.05
PRESET = "fast"


def memory_section(work: Path, scale: Scale) -> tuple[dict[str, Any], str]:
    """Sum of the resident sizes of all processes, sampled twenty times a second; shared pages count once for each."""
    counts = QUICK_FRAMES if scale.quick else FULL_FRAMES if scale.full else FRAMES
    results = []
    for frames in counts:
        capture = looped_capture(work, frames)
        out = work / "memory"
        peak_bytes, wall_s = peak_of(process_command(capture, out, "--preset", PRESET, "--jobs", "2"))
        results.append({"frames": frames, "peak_mb": peak_bytes / 1e6, "wall_s": wall_s})
        shutil.rmtree(out)
        shutil.rmtree(capture)
    rows = [[str(r["frames"]), f"{r['peak_mb']:.0f}", f"{r['wall_s']:.1f}"] for r in results]
    title = f"MEMORY: peak of all processes together, 720x1280, --preset {PRESET} --jobs 2\n"
    return {"preset": PRESET, "runs": results}, title + table(["frames", "peak MB", "seconds"], rows)


def peak_of(command: list[str]) -> tuple[int, float]:
    """Run a command; largest sum seen of the resident bytes of it and its descendants, and its wall-clock time."""
    began = time.perf_counter()
    peak = 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peak = max(peak, sum(map(resident_bytes, process_tree(process.pid))))
            time.sleep(SAMPLE_S)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return peak, time.perf_counter() - began


def process_tree(root: int) -> list[int]:
    """Find a process and all its descendants, by the parents that /proc names."""
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


def _parent(pid: int) -> int | None:
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    except (OSError, IndexError):
        return None
