"""What is measured: simulated captures with truth, looped captures of any length, and the program run over them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.app.simulate import simulate_command
from virest.capture.video import probe_movie, read_frames
from virest.simulation.recording import RecordingOptions, write_movie

Picture = NDArray[np.uint8]
PRESETS = ("fast", "balanced", "best")
TICKS_PER_S = 90_000
LOOP_FRAMES = 15
"""Half a second at 30 frames a second: the stamps of a loop are whole microseconds."""


@dataclass(frozen=True, slots=True)
class Scale:
    """How much is measured."""

    quick: bool = False
    full: bool = False

    @property
    def name(self) -> str:
        """For the report."""
        return "quick" if self.quick else "full" if self.full else "usual"


@dataclass(frozen=True, slots=True)
class Workload:
    """One simulated capture of the quality table."""

    name: str
    kind: str
    """``ordinary``, ``fine``, ``long`` or ``bright``."""
    blur_range_px: tuple[float, float]
    """Frames whose blur at the centre lies in here count in the means; all count in the minimum."""
    options: dict[str, Any] = field(default_factory=dict)


def _workload(
    name: str, kind: str, blur_range_px: tuple[float, float], scene: str, exposure_ms: float, rate: float, noise: float
) -> Workload:
    portrait = name.endswith("-p")
    size = {"width": 720, "height": 1280, "frames": 4} if portrait else {"width": 640, "height": 480, "frames": 8}
    seed = sum(name.encode())
    motion = {"exposure_ms": exposure_ms, "rate_rad_s": rate, "noise_levels": noise, "seed": seed}
    coder = {"bitrate_bits_per_px": FINE_BITS} if kind == "fine" else {}
    return Workload(name, kind, blur_range_px, {"scene": scene, **size, **motion, **coder})


FINE_BITS = 1.0
"""Bits per pixel of the captures whose coder is to take little away; the recorder's own rate is 0.25."""
ORDINARY_PX, LONG_PX = (5.0, 20.0), (15.0, 45.0)
WORKLOADS = (
    _workload("leaves", "ordinary", ORDINARY_PX, "leaves", 16.0, 1.4, 1.5),
    _workload("text", "ordinary", ORDINARY_PX, "text", 16.0, 1.4, 2.0),
    _workload("board", "ordinary", ORDINARY_PX, "board", 16.0, 1.4, 2.5),
    _workload("leaves-p", "ordinary", ORDINARY_PX, "leaves", 10.0, 1.2, 2.5),
    _workload("text-p", "ordinary", ORDINARY_PX, "text", 10.0, 1.2, 1.5),
    _workload("board-p", "ordinary", ORDINARY_PX, "board", 10.0, 1.2, 2.0),
    _workload("leaves-fine", "fine", ORDINARY_PX, "leaves", 16.0, 1.4, 1.5),
    _workload("text-fine-p", "fine", ORDINARY_PX, "text", 10.0, 1.2, 2.0),
    _workload("long", "long", LONG_PX, "leaves", 25.0, 2.2, 4.0),
    _workload("long-p", "long", LONG_PX, "text", 20.0, 1.6, 4.0),
    _workload("bright", "bright", ORDINARY_PX, "bright", 16.0, 1.4, 2.0),
    _workload("bright-p", "bright", ORDINARY_PX, "bright", 10.0, 1.2, 2.0),
)
QUICK = ("leaves", "long", "bright")


def quality_workloads(scale: Scale) -> list[Workload]:
    """Choose the captures of the quality table; with --quick a few small ones of four frames."""
    if not scale.quick:
        return list(WORKLOADS)
    return [Workload(w.name, w.kind, w.blur_range_px, {**w.options, "frames": 4}) for w in WORKLOADS if w.name in QUICK]


def simulated(work: Path, name: str, **options: Any) -> Path:
    """Simulate a capture below ``work``; one of that name is used again."""
    folder = work / "captures" / name
    if not folder.is_dir():
        simulate_command(folder, **options)
    return folder


# ── the program ──────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class Run:
    """One finished ``virest process``."""

    folder: Path
    """OUT/<capture>."""
    lines: list[dict[str, Any]]
    """Of parameters.jsonl."""
    wall_s: float
    """From the program's start to its end."""

    def picture(self, line: dict[str, Any]) -> Picture:
        """Read the frame that a line names, RGB."""
        return read_png(self.folder / line["output"])


def process_command(capture: Path, out: Path, *arguments: str) -> list[str]:
    """Give the command line of one run over a capture, errors only on standard error."""
    command = [sys.executable, "-m", "virest", "process", str(capture), "--out", str(out), "--overwrite", "-q"]
    return [*command, *arguments]


def run_process(capture: Path, out: Path, *arguments: str) -> Run:
    """Run ``virest process`` as a process of its own and read what it wrote."""
    began = time.perf_counter()
    subprocess.run(process_command(capture, out, *arguments), check=True, stdout=subprocess.DEVNULL)
    wall_s = time.perf_counter() - began
    folder = out / capture.name
    lines = [json.loads(line) for line in (folder / "parameters.jsonl").read_text(encoding="utf-8").splitlines()]
    return Run(folder, lines, wall_s)


def recorded_frames(capture: Path) -> Iterator[tuple[int, Picture]]:
    """Stream the decoded frames of a capture's movie, RGB."""
    movie = capture / "movie.mp4"
    index = probe_movie(movie)
    for number, picture in read_frames(movie, index, 0, len(index) - 1):
        if picture is not None:
            yield number, picture


def truth_frame(capture: Path, number: int, folder: str = "frames") -> Picture:
    """Read the sharp global-shutter picture of a frame, RGB."""
    return read_png(capture / "truth" / folder / f"{number:06d}.png")


def read_png(path: Path) -> Picture:
    """Read an RGB picture."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise FileNotFoundError(path)
    return picture[..., ::-1].astype(np.uint8)


# ── long captures ────────────────────────────────────────────────────────────────────────────────────────────────


def looped_capture(work: Path, frames: int) -> Path:
    """Make a 720x1280 capture of any length: half a second of a simulated one, pictures and gyroscope repeated."""
    folder = work / "captures" / f"loop{frames}"
    if folder.is_dir():
        return folder
    source = simulated(work, "loop-source", frames=LOOP_FRAMES, exposure_ms=10.0, rate_rad_s=1.2, seed=21)
    folder.mkdir(parents=True)
    (folder / "camera.yaml").write_bytes((source / "camera.yaml").read_bytes())
    (folder / "edge_epochs.txt").write_bytes((source / "edge_epochs.txt").read_bytes())
    _loop_table(source, folder, "frame_timestamps.txt", frames)
    _loop_table(source, folder, "movie_metadata.csv", frames)
    _loop_gyro(source, folder, frames)
    pictures = [picture for _, picture in recorded_frames(source)]
    ticks = np.arange(frames, dtype=np.int64) * (TICKS_PER_S // 30)
    shown = (pictures[k % len(pictures)] for k in range(frames))
    write_movie(folder / "movie.mp4", shown, ticks, 30.0, RecordingOptions())
    return folder


def _loop_table(source: Path, folder: Path, name: str, frames: int) -> None:
    """Repeat a table of one row a frame, the stamps going on, without its last (Unix) column."""
    head, *rows = [line.split(",")[:-1] for line in (source / name).read_text(encoding="ascii").splitlines()]
    start_ns = int(rows[0][0])
    lines = [",".join(head)]
    for k in range(frames):
        stamp_ns = start_ns + (k * 1_000_000 // 30) * 1000
        lines.append(",".join([str(stamp_ns), *rows[k % len(rows)][1:]]))
    (folder / name).write_text("\n".join(lines) + "\n", encoding="ascii")


def _loop_gyro(source: Path, folder: Path, frames: int) -> None:
    """Repeat the inertial samples of the loop's half second, from half a second before the movie to one after it."""
    stamp_0 = int((source / "frame_timestamps.txt").read_text(encoding="ascii").splitlines()[1].split(",")[0])
    head, *rows = [
        line.split(",")[:-1] for line in (source / "gyro_accel.csv").read_text(encoding="ascii").splitlines()
    ]
    period_ns = LOOP_FRAMES * 1_000_000_000 // 30
    times = np.array([int(row[0]) for row in rows]) - stamp_0
    first = int(np.searchsorted(times, 0))
    step_ns = int(np.median(np.diff(times)))
    count = period_ns // step_ns
    own = list(islice(rows, first, first + count))
    lines = [",".join(head)]
    for k in range(-count, (frames // LOOP_FRAMES + 3) * count):
        stamp_ns = stamp_0 + int(times[first]) + k * step_ns
        lines.append(",".join([str(stamp_ns), *own[k % count][1:]]))
    (folder / "gyro_accel.csv").write_text("\n".join(lines) + "\n", encoding="ascii")
