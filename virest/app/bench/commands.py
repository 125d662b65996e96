"""Run time of interactive commands: ``--help``, ``inspect``, ``calibrate`` and ``diagnose``.

$ python -m virest.app.bench --only commands --quick
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from virest.app.bench.workload import Scale, Timing, looped_capture, simulated, timed
from virest.app.console import numeric_table

HELP_TRIES, INSPECT_TRIES = 5, 2
"""Number of runs, of which the fastest counts; before ``--help`` one extra run fills the system's caches."""
INSPECTED_FRAMES = 18_000
"""10 min at 30 frames/s."""
FITTED_FRAMES, FPS = 960, 30.0
SIZE, QUICK_SIZE, PHONE_SIZE = (640, 480), (320, 240), (720, 1280)
HIDDEN = (
    "time_offset=0.012",
    "readout_time=0.0155",
    "gyro_bias=-0.035,0.021,0.035",
    "radial_distortion=0.068",
    "response_curve=1.3",
    "vignetting=0.5",
)
"""Effects hidden in the phone-size capture, which is left out with --quick since it takes about 10 min to simulate."""
HELP_S, INSPECT_S = 0.3, 5.0
"""Time limits of ``--help`` and ``inspect``; for the others the limit is the capture's duration."""
Facts = dict[str, Any]


def commands_section(work: Path, scale: Scale) -> tuple[Facts, str]:
    """Time each command as a separate process, from start to exit."""
    rows = [_help(), _inspect(work), *_fits(work, QUICK_SIZE if scale.quick else SIZE)]
    rows += [] if scale.quick else _fits(work, PHONE_SIZE, HIDDEN)
    return {"commands": rows}, commands_text(rows)


def _virest(*arguments: str) -> list[str]:
    """The command line of the installed script."""
    script = Path(sys.executable).with_name("virest")
    return [*([str(script)] if script.is_file() else [sys.executable, "-m", "virest"]), *arguments]


def _help() -> Facts:
    command = _virest("--help")
    timed(command)
    return record("help", "virest --help", [timed(command) for _ in range(HELP_TRIES)], HELP_S)


def _inspect(work: Path) -> Facts:
    """Time of inspect on 10 min of 720x1280, 0.5 GB."""
    capture = looped_capture(work, INSPECTED_FRAMES)
    tries = [timed(_virest("inspect", str(capture))) for _ in range(INSPECT_TRIES)]
    shutil.rmtree(capture)
    return record("inspect", f"inspect, {INSPECTED_FRAMES / FPS:.0f} s of 720x1280", tries, INSPECT_S)


def _fits(work: Path, size: tuple[int, int], hidden: tuple[str, ...] = ()) -> list[Facts]:
    """Calibrate and diagnose one capture that is simulated in full, not looped."""
    width, height = size
    options: dict[str, Any] = {"exposure_ms": 8.0, "rate_rad_s": 1.0, "noise_levels": 1.5, "seed": 31}
    options |= {"width": width, "height": height, "frames": FITTED_FRAMES, "effects": list(hidden)}
    capture = simulated(work, f"fits-{width}x{height}", **options)
    out, length_s = work / "fits", FITTED_FRAMES / FPS
    arguments = {
        "calibrate": ("--out", str(out / "camera.yaml"), "--overwrite", "-q"),
        "diagnose": ("--out", str(out), "--overwrite", "-q"),
    }
    out.mkdir()
    rows = []
    for name, rest in arguments.items():
        title = f"{name}, {length_s:.0f} s of {width}x{height}"
        title += f", {len(hidden)} hidden effects" if hidden else ""
        label = f"{name}-hidden" if hidden else name
        try:
            rows.append(record(label, title, [timed(_virest(name, str(capture), *rest))], length_s))
        except subprocess.CalledProcessError as failed:
            rows.append({"command": label, "title": title, "asked_s": length_s, "exit_code": failed.returncode})
    shutil.rmtree(out)
    return rows


def record(name: str, title: str, tries: list[Timing], asked_s: float) -> Facts:
    """Time of the fastest run, and its fraction of the limit."""
    best = min(tries, key=lambda timing: timing.wall_s)
    return {
        "command": name,
        "title": title,
        "asked_s": asked_s,
        "wall_s": best.wall_s,
        "cpu_s": best.cpu_s,
        "part_of_asked": best.wall_s / asked_s,
        "cpu_part_of_asked": best.cpu_s / asked_s,
        "others_cores": best.others_cores,
        "exit_code": 0,
    }


def commands_text(rows: list[Facts]) -> str:
    """One line per command."""
    lines = []
    for row in rows:
        if row["exit_code"]:
            lines.append([row["title"], f"{row['asked_s']:g}", f"exit code {row['exit_code']}", "-", "-", "-"])
            continue
        others = f"{row['others_cores']:.1f}"
        found = [f"{row['wall_s']:.2f}", f"{row['cpu_s']:.2f}", f"{row['part_of_asked']:.2f}", others]
        lines.append([row["title"], f"{row['asked_s']:g}", *found])
    header = ["command", "target s", "wall s", "CPU s", "wall / target", "others' cores"]
    return (
        "COMMANDS: from start to exit; the target of calibrate and diagnose is the capture's length\n"
        + numeric_table(header, lines)
    )
