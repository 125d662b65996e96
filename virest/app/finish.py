"""The last step of a run, once all frames are written: write a video, crop all frames alike, remove the frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from virest.app.film import display_matrix, side_by_side, write_film
from virest.app.outputs import require_file, require_no_input, write_picture
from virest.app.run_folder import RunFolder, parse_lines
from virest.arrays import Picture
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.location import is_remote, read_each
from virest.capture.video import MovieIndex, read_frames
from virest.errors import OutputError
from virest.restoration.capture import RestorationPlan
from virest.restoration.shutter import warp
from virest.restoration.undistortion import undistortion_map

Json = dict[str, Any]
Crop = tuple[int, int, int, int]
LEAST_CROP_PX = 16
"""The smallest frame that a camera profile accepts."""
NAME_FIELD = "{capture}"
LENS_ESTIMATES = ("k1", "k2", "p1", "p2", "k3", "k4")
"""Profile entries that do not apply to an undistorted picture."""


@dataclass(frozen=True, slots=True)
class FinishOptions:
    """What to do with a run's frames at its end."""

    film: str | None = None
    """Path of the video; ``{capture}`` is replaced by the capture's name."""
    side_by_side: bool = False
    keep_frames: bool = True
    crop: bool = False

    @property
    def any(self) -> bool:
        """Whether anything is requested."""
        return self.film is not None or self.crop

    def film_of(self, name: str) -> Path | None:
        """The video path of a capture."""
        return None if self.film is None else Path(self.film.replace(NAME_FIELD, name))


@dataclass(frozen=True, slots=True)
class Finished:
    """What was done to the frames."""

    crop_px: Crop | None = None
    film: Path | None = None
    kept: bool = True

    def changed(self, line: Json) -> Json:
        """A line of parameters.jsonl, updated for its changed picture."""
        if self.crop_px is not None and line["output"] is not None:
            x0, y0, x1, y1 = self.crop_px
            line = {**line, "crop_px": list(self.crop_px), "valid_px": [0, 0, x1 - x0, y1 - y0]}
        return line if self.kept else {**line, "output": None}

    def profile(self, profile: CameraProfile) -> CameraProfile:
        """The camera of the output frames: cropping moves the principal point."""
        return profile if self.crop_px is None else cropped_profile(profile, self.crop_px)


def pictures_profile(plan: RestorationPlan) -> CameraProfile:
    """The camera of a run's frames before any crop: a pinhole if lens distortion is removed."""
    profile = plan.profile
    if profile.intrinsics is None or not plan.settings.undistort:
        return profile
    estimates = {name: value for name, value in profile.estimates.items() if name not in LENS_ESTIMATES}
    return dataclasses.replace(profile, intrinsics=profile.intrinsics.pinhole, estimates=estimates)


def cropped_profile(profile: CameraProfile, crop_px: Crop) -> CameraProfile:
    """The camera of frames cropped to (x0, y0, x1, y1); row times still refer to the full frame, by ``crop_px``."""
    x0, y0, x1, y1 = crop_px
    lens = profile.intrinsics
    if lens is not None:
        lens = dataclasses.replace(
            lens, width=x1 - x0, height=y1 - y0, cx_px=lens.cx_px - x0, cy_px=lens.cy_px - y0
        )  # fmt: skip
    moved = [field.moved(x0, y0) if field.covariates == ("x", "y") else field for field in profile.fields]
    return dataclasses.replace(profile, width=x1 - x0, height=y1 - y0, intrinsics=lens).with_fields(moved)


def require_finishable(
    options: FinishOptions, name: str, run: Path, inputs: Iterable[Path], *, overwrite: bool
) -> None:
    """Raise OutputError, before any work, if the request cannot be fulfilled; inputs: the files that the run reads."""
    if options.any and is_remote(run):
        raise OutputError("--video and --crop need a local --out", hint="process to a folder, then upload")
    film = options.film_of(name)
    if film is not None:
        require_no_input(film, inputs, "--video")
        require_file(film, overwrite=overwrite, option="--video")


def finish_pictures(
    run: RunFolder,
    logs: Iterable[Path],
    movie: Path,
    index: MovieIndex,
    options: FinishOptions,
    name: str,
    lens: Intrinsics | None = None,
) -> Finished:
    """Crop the frames, write the video and remove the frames, as requested; repeating it is harmless.

    lens: the lens whose distortion was removed from the run's frames; recorded frames shown in their place are
    undistorted too.
    """
    lines = [line for log in read_each(logs) for line in parse_lines(log)]
    crop_px = common_rectangle(lines) if options.crop else None
    if crop_px is not None:
        for line in lines:
            if line["output"] is not None:
                for place in (run.picture(line["frame"]), run.mask(line["frame"])):
                    _crop_file(place, crop_px)
    film = options.film_of(name) if lines else None
    if options.crop and crop_px is None and film is not None:
        raise OutputError("--crop: no frame was written that shows the video's area", hint="omit --crop")
    if film is not None:
        rotation = display_matrix(movie)
        first_ns = lines[0]["timestamp_ns"]
        frames = _film_frames(run, lines, movie, index, crop_px, rotation if options.side_by_side else None, lens)
        write_film(film, ((ns - first_ns, picture) for ns, picture in frames), _rate(lines), rotation)
    if not options.keep_frames:
        for line in lines:
            run.picture(line["frame"]).unlink(missing_ok=True)
    return Finished(crop_px, film, options.keep_frames)


def common_rectangle(lines: Iterable[Json]) -> Crop | None:
    """The rectangle with recorded data in every written frame, None without one.  Raises OutputError if it is empty."""
    inside = [line["valid_px"] for line in lines if line["output"] is not None]
    if not inside:
        return None
    x0, y0 = np.max([px[:2] for px in inside], axis=0).tolist()
    x1, y1 = np.min([px[2:] for px in inside], axis=0).tolist()
    if min(x1 - x0, y1 - y0) < LEAST_CROP_PX:
        raise OutputError("--crop: no area holds recorded data in every frame", hint="use --mask, or fewer --frames")
    return (x0, y0, x1, y1)


def _crop_file(path: Path, crop_px: Crop) -> None:
    """Crop a picture to the rectangle, unless it is cropped already."""
    x0, y0, x1, y1 = crop_px
    picture = _read_png(path)
    if picture is not None and picture.shape[:2] != (y1 - y0, x1 - x0):
        write_picture(path, np.ascontiguousarray(picture[y0:y1, x0:x1]))


def _read_png(path: Path) -> Picture | None:
    if not path.is_file():
        return None
    data = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    return data if data is None or data.ndim == 2 else np.asarray(data[..., ::-1])


def _film_frames(
    run: RunFolder,
    lines: list[Json],
    movie: Path,
    index: MovieIndex,
    crop_px: Crop | None,
    beside: Any,
    lens: Intrinsics | None,
) -> Iterator[tuple[int, Picture]]:
    """Timestamp and picture of each frame; frames without a restored picture are shown as recorded, undistorted."""
    wanted = {line["frame"]: line for line in lines}
    numbers = sorted(wanted)
    stored = all(run.picture(number).is_file() for number in numbers)
    if stored and beside is None:
        for number in numbers:
            picture = _read_png(run.picture(number))
            assert picture is not None
            yield wanted[number]["timestamp_ns"], picture
        return
    x0, y0, x1, y1 = crop_px or (0, 0, None, None)
    for number, decoded in read_frames(movie, index, numbers[0], numbers[-1]):
        if number not in wanted or decoded is None:
            continue
        recorded = decoded[y0:y1, x0:x1]
        shown = _read_png(run.picture(number))
        if shown is None:
            source = None if lens is None else undistortion_map(lens)
            shown = recorded if source is None else warp(decoded, source)[y0:y1, x0:x1]
        yield wanted[number]["timestamp_ns"], shown if beside is None else side_by_side(recorded, shown, beside)


def _rate(lines: list[Json]) -> float:
    """Frames per second by the median step of the timestamps."""
    steps = np.diff([line["timestamp_ns"] for line in lines])
    return float(np.clip(1e9 / np.median(steps), 1.0, 1000.0)) if len(steps) and np.median(steps) > 0 else 30.0
