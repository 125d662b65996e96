"""Generate the sample captures of ``make sample``: small, upright as from a phone, with truth for a few frames."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from virest.app.console import emit
from virest.app.simulate import simulate_command

KEPT_TRUTH = (0, 5, 10)
"""Frames whose truth images are kept, to limit the size."""
SAMPLES: dict[str, dict[str, Any]] = {
    "leaves": {
        "scene": "leaves",
        "frames": 16,
        "exposure_ms": 10.0,
        "rate_rad_s": 1.0,
        "response": "five_segment",
        "seed": 3,
    },
    "text": {"scene": "text", "frames": 12, "exposure_ms": (8.0, 14.0), "rate_rad_s": 0.9, "seed": 4},
}


def write_samples(folder: Path) -> list[Path]:
    """Write each sample capture below ``folder``, replacing an existing one."""
    written = []
    for name, options in SAMPLES.items():
        out = folder / name
        if (out / "truth").is_dir():
            shutil.rmtree(out)
        simulate_command(out, width=720, height=1280, readout_ms=20.733, **options)
        for truth in sorted((out / "truth" / "frames").glob("*.png")):
            if int(truth.stem) not in KEPT_TRUTH:
                truth.unlink()
        written.append(out)
    return written


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m virest.app.sample FOLDER``."""
    parser = argparse.ArgumentParser(prog="python -m virest.app.sample", description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("sample_data"))
    options = parser.parse_args(arguments)
    for out in write_samples(options.folder):
        size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
        emit(f"{out}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
