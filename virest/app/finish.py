"""What is done to a run's pictures once all are written: a film, a crop that all share, and no frames at all."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.app.film import display_turn, side_by_side, write_film
from virest.app.outputs import write_picture
from virest.app.run_folder import RunFolder, parse_lines
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.location import is_remote, read_each
from virest.capture.video import MovieIndex, read_frames
from virest.errors import OutputError
from virest.restoration.capture import RestorationPlan
from virest.restoration.shutter import warp
from virest.restoration.undistortion import undistortion_map

Json = dict[str, Any]
Picture = NDArray[np.uint8]
Crop = tuple[int, int, int, int]
LEAST_CROP_PX = 16
NAME_FIELD = "{capture}"
LENS_ESTIMATES = ("k1", "k2", "p1", "p2", "k3", "k4")
"""Of a profile: they say nothing of a picture without distortion."""


@dataclass(frozen=True, slots=True)
class FinishWishes:
    """What a run does with its pictures in the end."""

    film: str | None = None
    """Path of the film; ``{capture}`` stands for the capture's name."""
    side_by_side: bool = False
    keep_frames: bool = True
    crop: bool = False

    @property
    def any(self) -> bool:
        """Whether there is something to do."""
        return self.film is not None or self.crop

    def film_of(self, name: str) -> Path | None:
        """The film of a capture."""
        return None if self.film is None else Path(self.film.replace(NAME_FIELD, name))


@dataclass(frozen=True, slots=True)
class Finished:
    """What was done to the pictures."""

    crop_px: Crop | None = None
    film: Path | None = None
    kept: bool = True

    def changed(self, line: Json) -> Json:
        """A line of parameters.jsonl, as its picture now is."""
        if self.crop_px is not None and line["output"] is not None:
            x0, y0, x1, y1 = self.crop_px
            line = {**line, "crop_px": list(self.crop_px), "valid_px": [0, 0, x1 - x0, y1 - y0]}
        return line if self.kept else {**line, "output": None}

    def profile(self, profile: CameraProfile) -> CameraProfile:
        """The camera of the pictures: cropping moves the principal point."""
        return profile if self.crop_px is None else cropped_profile(profile, self.crop_px)


def pictures_profile(plan: RestorationPlan) -> CameraProfile:
    """The camera of a run's pictures before any crop: a pinhole where the lens's distortion is undone."""
    profile = plan.profile
    if profile.intrinsics is None or not plan.settings.undistort:
        return profile
    estimates = {name: value for name, value in profile.estimates.items() if name not in LENS_ESTIMATES}
    return dataclasses.replace(profile, intrinsics=profile.intrinsics.pinhole, estimates=estimates)


def cropped_profile(profile: CameraProfile, crop_px: Crop) -> CameraProfile:
    """The camera whose pictures are the rectangle (x0, y0, x1, y1) of this one's; row times stay with ``crop_px``."""
    x0, y0, x1, y1 = crop_px
    lens = profile.intrinsics
    if lens is not None:
        lens = dataclasses.replace(
            lens, width=x1 - x0, height=y1 - y0, cx_px=lens.cx_px - x0, cy_px=lens.cy_px - y0
        )  # fmt: skip
    moved = [field.moved(x0, y0) if field.covariates == ("x", "y") else field for field in profile.fields]
    return dataclasses.replace(profile, width=x1 - x0, height=y1 - y0, intrinsics=lens).with_fields(moved)


def require_finishable(wishes: FinishWishes, name: str, run: Path, *, overwrite: bool) -> None:
    """Raise OutputError, before any work, where the wishes cannot be met."""
    if wishes.any and is_remote(run):
        raise OutputError("--video and --crop need --out in a file system", hint="process into a folder, then upload")
    film = wishes.film_of(name)
    if film is None:
        return
    if film.is_dir() or not film.absolute().parent.is_dir():
        raise OutputError(
            f"{film}: is a folder, or its folder does not exist", hint="name a file in a folder that exists"
        )
    if film.exists() and not overwrite:
        raise OutputError(f"{film}: exists already", hint="name another by --video, or pass --overwrite")


def finish_pictures(
    run: RunFolder,
    logs: Iterable[Path],
    movie: Path,
    index: MovieIndex,
    wishes: FinishWishes,
    name: str,
    lens: Intrinsics | None = None,
) -> Finished:
    """Crop the frames, write the film, and take the frames away, as wished.  Doing it again does no harm.

    lens: whose distortion the run's pictures are without; recorded ones that stand in for them lose it too.
    """
    lines = [line for log in read_each(logs) for line in parse_lines(log)]
    crop_px = common_rectangle(lines) if wishes.crop else None
    if crop_px is not None:
        for line in lines:
            if line["output"] is not None:
                for place in (run.picture(line["frame"]), run.mask(line["frame"])):
                    _crop_file(place, crop_px)
    film = wishes.film_of(name)
    if film is not None and lines:
        turn = display_turn(movie)
        first_ns = lines[0]["timestamp_ns"]
        frames = _film_frames(run, lines, movie, index, crop_px, turn if wishes.side_by_side else None, lens)
        write_film(film, ((ns - first_ns, picture) for ns, picture in frames), _rate(lines), turn)
    if not wishes.keep_frames:
        for line in lines:
            run.picture(line["frame"]).unlink(missing_ok=True)
    return Finished(crop_px, film, wishes.keep_frames)


def common_rectangle(lines: Iterable[Json]) -> Crop:
    """The rectangle that holds recorded data in every frame that has a picture.  Raises OutputError for none."""
    inside = [line["valid_px"] for line in lines if line["output"] is not None]
    if not inside:
        raise OutputError("--crop: no frame has a picture", hint="leave --crop out")
    x0, y0 = np.max([px[:2] for px in inside], axis=0).tolist()
    x1, y1 = np.min([px[2:] for px in inside], axis=0).tolist()
    if min(x1 - x0, y1 - y0) < LEAST_CROP_PX:
        raise OutputError("--crop: no area holds recorded data in every frame", hint="use --mask, or fewer --frames")
    return (x0, y0, x1, y1)


def _crop_file(path: Path, crop_px: Crop) -> None:
    """Cut a picture to the rectangle, unless that was done before."""
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
    """Stamp and picture of each frame; one without a restored picture is shown as recorded, but for the distortion."""
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
    """Frames a second by the stamps' median step."""
    steps = np.diff([line["timestamp_ns"] for line in lines])
    return float(np.clip(1e9 / np.median(steps), 1.0, 1000.0)) if len(steps) and np.median(steps) > 0 else 30.0
