"""Print the tables and write bench-out/bench.json, or compare two of those.

$ python -m virest.app.bench --only quality --quick
$ python -m virest.app.bench --only quality --kind shaken
$ python -m virest.app.bench --only honesty --quick --preset balanced --keep captures
$ python -m virest.app.bench --only fits --keep captures
$ python -m virest.app.bench --only calibration --seeds 100
$ python -m virest.app.bench --compare OLD.json NEW.json
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from virest import __version__
from virest.app.bench.broken import broken_section
from virest.app.bench.calibration import calibration_section
from virest.app.bench.coding import coding_section
from virest.app.bench.commands import commands_section
from virest.app.bench.compare import NOISE, compare_text, read_report
from virest.app.bench.cost import cost_section
from virest.app.bench.curves import curves_section
from virest.app.bench.diagnosis import diagnosis_section
from virest.app.bench.edges import edges_section
from virest.app.bench.fields import fields_section
from virest.app.bench.fits import fits_section
from virest.app.bench.growth import growth_section
from virest.app.bench.honesty import honesty_section
from virest.app.bench.memory import memory_section
from virest.app.bench.quality import KIND_TITLES, quality_section
from virest.app.bench.real import real_section
from virest.app.bench.shutter import shutter_section
from virest.app.bench.soak import soak_section
from virest.app.bench.speed import speed_section
from virest.app.bench.summary import summary_text
from virest.app.bench.workload import PRESETS, Scale
from virest.app.console import emit
from virest.app.machine import cores, installed_version, processor
from virest.app.outputs import write_whole

Section = Callable[[Path, Scale], tuple[dict[str, Any], str]]
SECTIONS: dict[str, Section] = {
    "quality": quality_section,
    "honesty": honesty_section,
    "fits": fits_section,
    "edges": edges_section,
    "shutter": shutter_section,
    "speed": speed_section,
    "growth": growth_section,
    "memory": memory_section,
    "commands": commands_section,
    "cost": cost_section,
    "curves": curves_section,
    "diagnosis": diagnosis_section,
    "field": fields_section,
    "calibration": calibration_section,
    "coding": coding_section,
    "soak": soak_section,
    "broken": broken_section,
    "real": real_section,
}
LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "av", "scikit-image", "deepinv", "torch")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the chosen sections; write the figures of each as soon as it is finished."""
    options = _parse(arguments)
    if options.compare:
        old, new = map(read_report, options.compare)
        emit(compare_text(old, new, options.noise))
        return
    presets = tuple(options.preset or PRESETS)
    scale = Scale(options.quick, options.full, presets, tuple(options.kind or ()), options.seeds, options.out)
    options.out.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {"virest_bench": 1, "versions": _versions(), "scale": scale.name}
    work = options.keep or Path(tempfile.mkdtemp(prefix="work-", dir=options.out))
    try:
        for number, name in enumerate(options.only or SECTIONS):
            report[name], text = SECTIONS[name](work, scale)
            emit("\n" * bool(number) + text)
            write_whole(options.out / "bench.json", (json.dumps(report, indent=1) + "\n").encode())
        if closing := summary_text(report):
            emit("\n" + closing)
    finally:
        if work != options.keep:
            shutil.rmtree(work, ignore_errors=True)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m virest.app.bench", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--only", action="append", choices=tuple(SECTIONS), help="run only this section; may be repeated"
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="a few frames only: a quick check, not a measurement")
    size.add_argument("--full", action="store_true", help="measure memory up to 3000 frames")
    parser.add_argument(
        "--preset", action="append", choices=PRESETS, help="preset for the section honesty; may be repeated [all]"
    )
    parser.add_argument(
        "--kind",
        action="append",
        choices=tuple(KIND_TITLES),
        help="kind of capture for the section quality; may be repeated [all]",
    )
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep captures and runs here, and reuse captures")
    parser.add_argument("--seeds", type=int, default=100, help="number of captures for --only calibration [100]")
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="folder for bench.json [bench-out]")
    parser.add_argument(
        "--compare", nargs=2, type=Path, metavar=("OLD", "NEW"), help="compare these reports instead of measuring"
    )
    parser.add_argument(
        "--noise", type=float, default=NOISE, help=f"relative change that counts as noise, for --compare [{NOISE}]"
    )
    return parser.parse_args(arguments)


def _versions() -> dict[str, Any]:
    libraries = {name: installed_version(name) for name in LIBRARIES}
    machine = {"machine": platform.machine(), "processor": processor(), "cores": cores()}
    program = {"virest": __version__, "commit": _commit(), "python": platform.python_version()}
    return {**program, **libraries, **machine, "load": os.getloadavg()[0]}


def _commit() -> str | None:
    """Checked-out commit of the program, marked if files differ from it; None outside a git checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


if __name__ == "__main__":
    main()
