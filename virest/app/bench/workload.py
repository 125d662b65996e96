"""Benchmark inputs: simulated captures with truth, looped captures of any length, and runs of the program on them."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np

from virest.app.evaluation_captures import read_picture
from virest.app.simulate import simulate_command
from virest.arrays import Picture
from virest.capture.join import TICKS_PER_S
from virest.capture.video import probe_movie, read_frames
from virest.simulation.phone_isp import PhoneIsp
from virest.simulation.recording import RecordingOptions, write_movie

PRESETS = ("fast", "balanced", "best")
LOOP_FRAMES = 15
"""0.5 s at 30 frames/s, so that the loop's length is a whole number of microseconds."""
GROUP_FRAMES = 30
"""Frames between key frames, as written by phones and the simulator."""


@dataclass(frozen=True, slots=True)
class Scale:
    """The extent of the measurement."""

    quick: bool = False
    full: bool = False
    presets: tuple[str, ...] = PRESETS
    """Presets that ``honesty`` measures."""
    kinds: tuple[str, ...] = ()
    """Kinds of capture that ``quality`` measures; empty: all."""
    seeds: int = 100
    """Number of captures in the section ``calibration``."""
    figures: Path | None = None
    """Folder for figures."""

    @property
    def name(self) -> str:
        """The scale's name, for the report."""
        return "quick" if self.quick else "full" if self.full else "usual"


@dataclass(frozen=True, slots=True)
class Workload:
    """A simulated capture of the quality or honesty table."""

    name: str
    kind: str
    """``ordinary``, ``photographs``, ``fine``, ``long``, ``bright``, ``shaken``, ``phone`` or ``defocused``."""
    blur_range_px: tuple[float, float]
    """Frames with a blur at the centre in this range count in the means; all count in the minimum."""
    options: dict[str, Any] = field(default_factory=dict)
    true_profile: bool = False
    """Process with truth/camera.yaml, so that the camera model has no error."""

    def arguments(self, capture: Path) -> tuple[str, ...]:
        """Arguments of ``virest process`` in addition to the preset."""
        return ("--config", str(capture / "truth" / "camera.yaml")) if self.true_profile else ()


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
"""Bits per pixel of captures with little coding loss; the recorder's own rate is 0.25."""
ORDINARY_PX, LONG_PX = (5.0, 20.0), (15.0, 45.0)
"""Range of the blur's length over the frames that a capture is drawn for."""
WORKLOADS = (
    _workload("leaves", "ordinary", ORDINARY_PX, "leaves", 16.0, 1.4, 1.5),
    _workload("text", "ordinary", ORDINARY_PX, "text", 16.0, 1.4, 2.0),
    _workload("board", "ordinary", ORDINARY_PX, "board", 16.0, 1.4, 2.5),
    _workload("leaves-p", "ordinary", ORDINARY_PX, "leaves", 10.0, 1.2, 2.5),
    _workload("text-p", "ordinary", ORDINARY_PX, "text", 10.0, 1.2, 1.5),
    _workload("board-p", "ordinary", ORDINARY_PX, "board", 10.0, 1.2, 2.0),
    _workload("photographs", "photographs", ORDINARY_PX, "photographs", 16.0, 1.4, 1.5),
    _workload("photographs-p", "photographs", ORDINARY_PX, "photographs", 10.0, 1.2, 2.0),
    _workload("leaves-fine", "fine", ORDINARY_PX, "leaves", 16.0, 1.4, 1.5),
    _workload("text-fine-p", "fine", ORDINARY_PX, "text", 10.0, 1.2, 2.0),
    _workload("long", "long", LONG_PX, "leaves", 25.0, 2.2, 4.0),
    _workload("long-p", "long", LONG_PX, "text", 20.0, 1.6, 4.0),
    _workload("bright", "bright", ORDINARY_PX, "bright", 16.0, 1.4, 2.0),
    _workload("bright-p", "bright", ORDINARY_PX, "bright", 10.0, 1.2, 2.0),
)
COLOURFUL = (_workload("colours", "ordinary", ORDINARY_PX, "colours", 16.0, 1.4, 1.5),)
"""Saturated colours, where half of the error by blur is in the colour differences."""
QUICK = ("leaves", "photographs", "long", "bright")


def _phone(
    name: str, scene: str, exposure_ms: float, rate: float, noise: float, blur_range_px: tuple[float, float], **isp: Any
) -> Workload:
    """A phone's capture, 640x480; the strengths are set here, independent of the defaults of ``--isp phone``."""
    plain = _workload(f"phone-{name}", "phone", blur_range_px, scene, exposure_ms, rate, noise)
    own = {"readout_ms": PHONE_READOUT_MS, "isp": PhoneIsp(**{**PHONE, **isp})}
    return dataclasses.replace(plain, options={**plain.options, **own})


PHONE_READOUT_MS = 12.0
"""Readout of phone captures: at 20 ms an unmodelled stabiliser's straightening error would dominate the PSNR."""
PHONE: dict[str, Any] = {
    "tone": 0.4,
    "highlights": 0.25,
    "local_tone": 0.1,
    "denoise": 1.5,
    "temporal_denoise": 0.4,
    "sharpen": 0.5,
    "sharpen_radius_px": 1.0,
    "bits_per_px": 0.3,
    "gyro_noise": 0.001,
    "gyro_jitter_s": 0.0002,
    "gyro_lowpass_hz": 60.0,
}
"""Common to all phones: gyroscope noise of 0.01 rad/s at 200 Hz, before its 60 Hz low-pass filter."""
PHONES = (
    _phone("calm", "text", 12.0, 0.6, 1.5, (1.0, 10.0), offset_s=0.002),
    _phone("fast", "photographs", 16.0, 1.6, 2.0, ORDINARY_PX, offset_s=-0.002),
    _phone("stabilised", "leaves", 20.0, 0.9, 1.5, ORDINARY_PX, stabiliser_rest=0.2),
    _phone("dim", "text", 30.0, 0.9, 5.0, ORDINARY_PX, offset_s=0.002, denoise=2.0, temporal_denoise=0.6,
           bits_per_px=0.15),
)  # fmt: skip


def _shaken(name: str, scene: str, exposure_ms: float, rate: float, noise: float, **more: Any) -> Workload:
    plain = _workload(f"shaken-{name}", "shaken", (0.0, np.inf), scene, exposure_ms, rate, noise)
    return dataclasses.replace(plain, options={**plain.options, **more})


SHAKEN = (
    _shaken("short", "photographs", 10.0, 1.4, 1.5),
    _shaken("middle", "leaves", 18.0, 1.8, 2.0),
    _shaken("far", "photographs", 28.0, 2.2, 2.0),
    _shaken("plane", "leaves", 16.0, 0.9, 1.5, depth_m=1.6, sway_m=0.03),
    _shaken("noise", "photographs", 14.0, 1.6, 8.0),
    _shaken("highlights", "bright", 14.0, 1.4, 2.0, seed=1220),
)
"""Blur of 5 to 45 px, a near plane, strong noise, clipped highlights; restored from the gyroscope and neighbours."""


def quality_workloads(scale: Scale) -> list[Workload]:
    """Captures of the quality table; with --quick a few with four frames each."""
    every = [w for w in (*WORKLOADS, *SHAKEN, *PHONES) if w.kind in scale.kinds or not scale.kinds]
    if scale.kinds or not scale.quick:
        return [_shortened(w, 4) for w in every] if scale.quick else every
    return [_shortened(w, 4) for w in (*WORKLOADS, *PHONES) if w.name in QUICK or w in PHONES]


def _defocused(name: str, scene: str, exposure_ms: float, rate: float, sigma_px: float) -> Workload:
    plain = _workload(name, "defocused", (0.0, 20.0), scene, exposure_ms, rate, 1.5)
    return dataclasses.replace(
        plain, options={**plain.options, "effects": [f"defocus={sigma_px:g}"]}, true_profile=True
    )


DEFOCUSED = (
    _defocused("defocused-calm", "leaves", 4.0, 0.6, 1.8),
    _defocused("defocused-fast", "photographs", 12.0, 1.4, 1.8),
    _defocused("defocused-more", "text", 8.0, 1.0, 2.8),
)
"""Processed with their true profiles: a correct model must not degrade the frames."""
SHORT = (
    _workload("short", "ordinary", (0.0, 6.0), "photographs", 8.0, 0.8, 1.5),
    _workload("short-leaves", "ordinary", (0.0, 6.0), "leaves", 9.0, 0.9, 2.0),
    _phone("short", "photographs", 9.0, 0.8, 1.5, (0.0, 6.0)),
    _phone("short-sharp", "leaves", 8.0, 0.9, 1.5, (0.0, 6.0), sharpen=0.8, offset_s=0.002),
)
"""Blur of 1 to 5 px, where the achievable gain is small and easily overestimated."""
ODD = (
    _phone("colours", "colours", 14.0, 1.0, 2.0, ORDINARY_PX, offset_s=-0.002),
    _phone("board", "board", 14.0, 1.0, 2.5, ORDINARY_PX, tone=0.6, offset_s=0.002),
    _phone("steep", "photographs", 14.0, 0.8, 2.0, ORDINARY_PX, tone=0.8, denoise=1.0),
    _phone("flat", "leaves", 14.0, 1.0, 2.0, ORDINARY_PX, tone=0.1, sharpen=0.0, stabiliser_rest=0.4),
)
"""Phones whose scene, tone curve or stabiliser differs from the others': half of all captures are then phones'."""
HONEST_QUICK = ("leaves", "phone-fast", "phone-stabilised", "defocused-calm")


def honesty_workloads(scale: Scale) -> list[Workload]:
    """Captures of the honesty table: landscape, defocused, phone and short blur; with --quick four, six frames each."""
    every = [*(w for w in WORKLOADS if not w.name.endswith("-p")), *COLOURFUL, *DEFOCUSED, *PHONES, *SHORT, *ODD]
    return [_shortened(w, 6) for w in every if w.name in HONEST_QUICK] if scale.quick else every


def _shortened(workload: Workload, frames: int) -> Workload:
    return dataclasses.replace(workload, options={**workload.options, "frames": frames})


def simulated(work: Path, name: str, **options: Any) -> Path:
    """Simulate a capture under ``work``; an existing one of that name with the same options is reused."""
    folder = work / "captures" / name
    made_of = folder.with_name(f".{name}.options")
    if not (folder.is_dir() and made_of.is_file() and made_of.read_text(encoding="utf-8") == repr(options)):
        simulate_command(folder, overwrite=folder.is_dir(), **options)
        made_of.write_text(repr(options), encoding="utf-8")
    return folder


def real_captures() -> Path | None:
    """The folder of real captures that VIREST_REALDATA names; None: it names no folder."""
    named = os.environ.get("VIREST_REALDATA")
    return Path(named) if named and Path(named).is_dir() else None


# ── the program ──────────────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class Timing:
    """Time of a command."""

    wall_s: float
    """Wall-clock time from the program's start to its end."""
    cpu_s: float
    """CPU time (user and system) of all its processes."""
    others_cores: float
    """Cores kept busy by other processes; above about 0.1 the wall-clock time is unreliable."""


def timed(command: list[str]) -> Timing:
    """Run and time a command, discarding its standard output.  Raises CalledProcessError if it fails."""
    began, before_s = time.perf_counter(), _busy_s()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)  # includes all descendants that it has waited for
        process.returncode = os.waitstatus_to_exitcode(status)
    wall_s, cpu_s = time.perf_counter() - began, usage.ru_utime + usage.ru_stime
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return Timing(wall_s, cpu_s, max(_busy_s() - before_s - cpu_s, 0.0) / wall_s)


def _busy_s() -> float:
    """Busy seconds of all cores since boot, including time stolen by a virtual machine's host."""
    user, nice, system, _, _, irq, softirq, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Run:
    """One finished ``virest process``."""

    folder: Path
    """OUT/<capture>."""
    lines: list[dict[str, Any]]
    """The lines of parameters.jsonl."""
    timing: Timing

    @property
    def wall_s(self) -> float:
        """Wall-clock time from the program's start to its end."""
        return self.timing.wall_s

    def picture(self, line: dict[str, Any]) -> Picture:
        """Read the restored frame of a line, RGB."""
        return read_picture(self.folder / line["output"])


def process_command(capture: Path, out: Path, *arguments: str) -> list[str]:
    """Command line of one quiet run on a capture."""
    command = [sys.executable, "-m", "virest", "process", str(capture), "--out", str(out), "--overwrite", "-q"]
    return [*command, *arguments]


def run_process(capture: Path, out: Path, *arguments: str) -> Run:
    """Run ``virest process`` as a separate process and read its log."""
    timing = timed(process_command(capture, out, *arguments))
    folder = out / capture.name
    lines = [json.loads(line) for line in (folder / "parameters.jsonl").read_text(encoding="utf-8").splitlines()]
    return Run(folder, lines, timing)


def recorded_frames(capture: Path) -> Iterator[tuple[int, Picture]]:
    """Decode the frames of a capture's movie one by one, RGB."""
    movie = capture / "movie.mp4"
    index = probe_movie(movie)
    for number, picture in read_frames(movie, index, 0, len(index) - 1):
        if picture is not None:
            yield number, picture


# ── long captures ────────────────────────────────────────────────────────────────────────────────────────────────


def looped_capture(work: Path, frames: int, width: int = 720, height: int = 1280) -> Path:
    """Make a capture of any length by repeating 0.5 s of frames and gyroscope samples of a simulated one."""
    size = f"{width}x{height}"
    folder = work / "captures" / f"loop{frames}-{size}"
    if folder.is_dir():
        return folder
    options = {"width": width, "height": height, "frames": LOOP_FRAMES, "exposure_ms": 10.0, "rate_rad_s": 1.2}
    source = simulated(work, f"loop-source-{size}", **options, seed=21)
    folder.mkdir(parents=True)
    (folder / "camera.yaml").write_bytes((source / "camera.yaml").read_bytes())
    (folder / "edge_epochs.txt").write_bytes((source / "edge_epochs.txt").read_bytes())
    _loop_table(source, folder, "frame_timestamps.txt", frames)
    _loop_table(source, folder, "movie_metadata.csv", frames)
    _loop_gyro(source, folder, frames)
    _loop_movie(source, folder, frames)
    return folder


def _loop_movie(source: Path, folder: Path, frames: int) -> None:
    """Encode one group of frames and repeat its packets, so that long movies need no encoding."""
    pictures = [picture for _, picture in recorded_frames(source)]
    count = min(frames, GROUP_FRAMES)
    group = folder / "group.mp4"
    shown = (pictures[k % len(pictures)] for k in range(count))
    write_movie(group, shown, np.arange(count, dtype=np.int64) * (TICKS_PER_S // 30), 30.0, RecordingOptions())
    with av.open(str(group)) as reader, av.open(str(folder / "movie.mp4"), "w", format="mp4") as writer:
        coded = reader.streams.video[0]
        stream = writer.add_stream_from_template(coded)
        packets = [packet for packet in reader.demux(coded) if packet.size]
        time_base = coded.time_base or Fraction(1, TICKS_PER_S)
        step = round(1 / (30 * time_base))
        for k in range(frames):
            packet = packets[k % count]
            packet.stream, packet.time_base = stream, time_base
            packet.pts = packet.dts = k * step
            writer.mux(packet)
    group.unlink()


def _loop_table(source: Path, folder: Path, name: str, frames: int) -> None:
    """Repeat a table of one row per frame with continued timestamps, without its last (Unix time) column."""
    head, *rows = [line.split(",")[:-1] for line in (source / name).read_text(encoding="ascii").splitlines()]
    start_ns = int(rows[0][0])
    lines = [",".join(head)]
    for k in range(frames):
        stamp_ns = start_ns + (k * 1_000_000 // 30) * 1000
        lines.append(",".join([str(stamp_ns), *rows[k % len(rows)][1:]]))
    (folder / name).write_text("\n".join(lines) + "\n", encoding="ascii")


def _loop_gyro(source: Path, folder: Path, frames: int) -> None:
    """Repeat the inertial samples of the loop's 0.5 s, from 0.5 s before the movie to 1 s after it."""
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
