"""Generate the documentation's pictures from simulated captures: ``python -m virest.app.pictures docs/images``.

``make figures`` calls it, and virest.app.gallery for the gallery of effects.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from virest.app import api
from virest.app.console import emit
from virest.app.evaluation_captures import truth_frame
from virest.app.outputs import write_whole
from virest.app.simulate import simulate_command
from virest.arrays import Picture
from virest.camera.profile import CameraProfile
from virest.capture.folder import Capture
from virest.image_formation.blur import tile_grid
from virest.image_formation.kernels import blur_chords, kernel_field
from virest.image_formation.row_clock import ROW_MIDDLE, row_time_s
from virest.image_formation.row_motion import row_motion
from virest.motion.integration import integrate_gyro
from virest.report.concepts import axes_figure, blur_figure, rows_figure, strip_figure

COLOURS = 192
"""Colours of a palette picture, a third of the size; photographs keep full colour."""
PHOTOGRAPHS = ("before_after", "joint", "blur_paths")
CONTENTS: dict[str, dict[str, Any]] = {
    "photographs": {"frames": 8, "exposure_ms": 12.0, "readout_ms": 25.0, "rate_rad_s": 1.3, "noise_levels": 1.2,
                    "seed": 52},
    "board": {"frames": 8, "exposure_ms": 5.0, "readout_ms": 30.0, "rate_rad_s": 2.2, "bitrate_bits_per_px": 1.0,
              "seed": 41},
    "text": {"frames": 9, "exposure_ms": 18.0, "readout_ms": 25.0, "rate_rad_s": 1.2, "noise_levels": 2.0, "seed": 55},
}  # fmt: skip
"""What `simulate` films, by scene."""
ARROW_STEP_PX = 80
"""144 arrows in a frame of 1280 × 720."""


@dataclass(frozen=True, slots=True)
class _Shot:
    """One frame as recorded, as restored, and as the sharp truth."""

    capture: Capture
    profile: CameraProfile
    frame: int
    recorded: Picture
    restored: Picture
    single: Picture
    """Restored without neighbouring frames."""
    truth: Picture


def write_pictures(folder: Path) -> None:
    """Write all pictures below ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as work:
        photographs, board, page = (_shot(Path(work), scene) for scene in CONTENTS)
        files = {
            "before_after": _before_after(photographs),
            "joint": _joint(page),
            "rolling_shutter": _rolling_shutter(board),
            "blur_paths": _blur_paths(photographs),
            "rows": _rows(photographs),
            "axes": axes_figure(),
        }
    for name, data in files.items():
        file = data if name in PHOTOGRAPHS else compact(data)
        write_whole(folder / f"{name}.png", file)
        emit(f"{name}.png: {len(file) / 1000:.0f} KB")


def compact(png: bytes) -> bytes:
    """The picture reduced to a palette."""
    from PIL import Image

    out = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(
        out, "png", optimize=True
    )
    return out.getvalue()


def _shot(work: Path, scene: str) -> _Shot:
    folder, frame = work / scene, 4
    simulate_command(folder, scene=scene, width=960, height=720, **CONTENTS[scene])
    capture = api.open(folder)
    restored, single = (capture.restore(frame, "best", **alone).picture for alone in ({}, {"neighbours": 0}))
    if restored is None or single is None:
        raise RuntimeError(f"{folder}: frame {frame} was not restored")
    recorded, truth = capture.read_frame(frame), truth_frame(folder, frame)
    return _Shot(capture.record, capture.profile, frame, recorded, restored, single, truth)


def _before_after(shot: _Shot, side: int = 330, corner: tuple[int, int] = (600, 352)) -> bytes:
    x, y = corner
    pictures = (("as recorded", shot.recorded), ("restored", shot.restored), ("truth", shot.truth))
    return strip_figure([(name, picture[y : y + side, x : x + side]) for name, picture in pictures])


def _joint(shot: _Shot, side: int = 250, corner: tuple[int, int] = (340, 200)) -> bytes:
    """A detail of a frame restored without and with its neighbours."""
    (x, y), names = corner, ("as recorded", "this frame alone", "with its neighbours", "truth")
    pictures = (shot.recorded, shot.single, shot.restored, shot.truth)
    return strip_figure([(n, p[y : y + side, x : x + side]) for n, p in zip(names, pictures, strict=True)])


def _rolling_shutter(shot: _Shot) -> bytes:
    names = ("as recorded", "restored", "truth")
    pictures = (shot.recorded, shot.restored, shot.truth)
    half = [cv2.resize(p, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA) for p in pictures]
    return strip_figure([(name, np.asarray(picture)) for name, picture in zip(names, half, strict=True)])


def _blur_paths(shot: _Shot) -> bytes:
    """The frame's own forward model: chords and kernels as the restoration uses them."""
    frame = shot.capture.frames[shot.frame]
    trajectory = integrate_gyro(shot.capture.imu, shot.profile)
    motion = row_motion(trajectory, shot.profile, frame.time_s, frame.exposure_s, "exposure-start")
    height, width = shot.recorded.shape[:2]
    centres = tile_grid(height, width, ARROW_STEP_PX, 0).centres_px
    kernels = kernel_field(motion, centres).arrays(positive=True)
    columns = len(np.unique(centres[:, 0]))
    last = len(centres) - 1
    shown = (0, columns - 1, last // 2, last - columns // 2, last - columns + 1, last)
    return blur_figure(shot.recorded, centres, blur_chords(motion, centres), kernels, shown)


def _rows(shot: _Shot) -> bytes:
    shutter, height = shot.profile.shutter, shot.profile.height
    exposure_s = shot.capture.frames[shot.frame].exposure_s or 0.0
    row_start_s = row_time_s(0.0, shutter.readout_time_s, np.arange(height) / height)
    middle_s = row_time_s(0.0, shutter.readout_time_s, 0.5, exposure_s, ROW_MIDDLE)
    return rows_figure(row_start_s, exposure_s, middle_s)


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m virest.app.pictures FOLDER``."""
    parser = argparse.ArgumentParser(prog="python -m virest.app.pictures", description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("docs/images"))
    write_pictures(parser.parse_args(arguments).folder)


if __name__ == "__main__":
    main()
