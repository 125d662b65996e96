"""Write the sample captures of ``make sample`` anew: small, upright like the phone's, with a few frames of truth."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from virest.app.console import emit
from virest.app.simulate import simulate_command

KEPT_TRUTH = (0, 5, 10)
"""Frames whose truth is kept; all of them would be large."""
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
    """Write each sample capture below ``folder``, replacing the one that is there."""
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


def write_before_after(capture: Path, frame: int, corner_px: tuple[int, int], side_px: int, out: Path) -> None:
    """Cut a square out of a frame as recorded, as restored by preset ``best``, and as it truly was, side by side."""
    from virest.capture.folder import read_capture, resolve_profile
    from virest.capture.video import probe_movie, read_frames
    from virest.restoration.capture import RestorationPlan, restore_frames
    from virest.restoration.settings import PRESETS

    recorded = read_capture(capture)
    plan = RestorationPlan(resolve_profile(recorded)[0], PRESETS["best"])
    frames = read_frames(recorded.movie, probe_movie(recorded.movie), frame, frame)
    index, picture = next(frames)
    restored = next(restore_frames([(recorded.frames[index], picture)], recorded.imu, plan)).picture
    truth = cv2.imread(str(capture / "truth" / "frames" / f"{frame:06d}.png"))
    x, y = corner_px
    pictures = (picture, restored, None if truth is None else truth[..., ::-1])
    cuts = [p[y : y + side_px, x : x + side_px] for p in pictures if p is not None]
    out.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(out), np.hstack(cuts)[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m virest.app.sample FOLDER``."""
    parser = argparse.ArgumentParser(prog="python -m virest.app.sample", description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("sample_data"))
    parser.add_argument("--picture", type=Path, help="write the README's before/after picture here")
    options = parser.parse_args(arguments)
    for out in write_samples(options.folder):
        size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
        emit(f"{out}: {size / 1e6:.1f} MB")
    if options.picture:
        write_before_after(options.folder / "text", 5, (200, 420), 300, options.picture)


if __name__ == "__main__":
    main()
