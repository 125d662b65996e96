"""What a capture's neighbouring frames show of the prediction, asked once at planning on a few runs of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from virest.image_formation.blur import Image
from virest.image_formation.kernels import blur_chords
from virest.image_formation.neighbour import neighbour_view
from virest.image_formation.row_motion import RowMotion
from virest.motion.optics import MovingLens
from virest.motion.trajectory import Trajectory
from virest.restoration.neighbours.confirmation import ConfirmedGain, confirmed_gain
from virest.restoration.neighbours.refinement import MissingTurn, RefinedMotion, missing_turn
from virest.restoration.neighbours.registration import judged_change
from virest.restoration.neighbours.sights import FrameNeighbours, Sight

RUN_FRAMES = 4
"""Three pairs: what linear interpolation leaves of the middle one shows."""
MOST_RUNS = 4
TELLING_PX = 3.0
"""Paths of this length cancel a third of a cycle per pixel, and frames are compared up to a quarter.  On eleven
simulated captures 36 of 38 shares of frames with longer paths were positive, of those with 1 to 2.5 px 12 of 40."""
Picture = NDArray[np.uint8]


def survey_runs(numbers: Iterable[int], path_px: Mapping[int, float]) -> list[tuple[int, ...]]:
    """Runs of consecutive frames among those at hand: the most blurred of each unbroken stretch, evenly over these.

    path_px: about how long the blur path of each frame is.
    """
    ordered = np.array(sorted(numbers), np.intp)
    if not len(ordered):
        return []
    runs = []
    for stretch in np.split(ordered, np.flatnonzero(np.diff(ordered) != 1) + 1):
        pieces = np.array_split(stretch, max(1, min(len(stretch) // RUN_FRAMES, MOST_RUNS)))
        for piece in pieces if len(stretch) <= MOST_RUNS * RUN_FRAMES else [stretch]:
            starts = range(max(len(piece) - RUN_FRAMES + 1, 1))
            blur = [sum(path_px.get(int(n), 0.0) for n in piece[k : k + RUN_FRAMES]) for k in starts]
            best = int(np.argmax(blur))
            runs.append(tuple(int(n) for n in piece[best : best + RUN_FRAMES]))
    chosen = np.unique(np.linspace(0, len(runs) - 1, min(len(runs), MOST_RUNS)).round().astype(int))
    return [runs[k] for k in chosen if len(runs[k]) > 1]


def kept_lumas(
    pictures: Iterable[tuple[int, Picture]], wanted: Iterable[int], into: dict[int, Picture]
) -> Iterator[tuple[int, Picture]]:
    """Pass lumas on by their index, and keep those that are wanted."""
    chosen = set(wanted)
    for index, luma in pictures:
        if index in chosen:
            into[index] = luma
        yield index, luma


def survey_turns(
    runs: Sequence[Sequence[int]], sights: Mapping[int, Sight], neighbours: FrameNeighbours, trajectory: Trajectory
) -> MissingTurn | None:
    """What the predicted turns lack by these runs of frames; None: nothing of significance, or it cannot be told."""
    motions: list[RowMotion] = [s.motion for s in sights.values() if s.usable and s.motion is not None]
    turns = [
        [neighbours.turn(sights[a], sights[b]) if a in sights and b in sights else None for a, b in pairwise(run)]
        for run in runs
    ]
    return missing_turn(turns, motions, trajectory)


def survey_gain(
    runs: Sequence[Sequence[int]],
    sights: Mapping[int, Sight],
    neighbours: FrameNeighbours,
    trajectory: Trajectory,
    lens: MovingLens,
    tried: Callable[[Sight, RowMotion, RefinedMotion | None], tuple[Image, Image] | None],
) -> ConfirmedGain | None:
    """What deblurring gains by the neighbours' account.

    tried: luma of a frame's light, as recorded and as restored, at the middle of its exposures and reduced; None: it is
    left alone.  One blurred frame of each run is restored, and one more where runs are few.  Each is compared with both
    its neighbours; if neither can judge it, the next frame takes its place.
    """
    found: list[tuple[float, float, float, float]] = []
    path_px = {n: path_length_px(s.motion) for n, s in sights.items() if s.usable and s.motion is not None}
    asked, most = 0, min(len(runs) + 1, MOST_RUNS)
    for number in lively_frames(runs, path_px)[: 2 * most]:
        if asked == most:
            break
        before, here, after = (sights[number + step] for step in (-1, 0, 1))
        assert here.motion is not None
        refined = neighbours.refined((before,), here, (after,))
        motion = here.motion if refined is None else refined.motion
        pictures = tried(here, motion, refined)
        if pictures is None:
            continue
        before_this = len(found)
        for other in (before, after):
            assert other.motion is not None
            further = None if refined is None else refined.further
            view = neighbour_view(motion, other.motion, trajectory, lens, further=further)
            judged = judged_change(view, *pictures, neighbours.light(other))
            if judged is not None:
                found.append(judged)
        asked += len(found) > before_this
    return confirmed_gain(found)


def lively_frames(runs: Sequence[Sequence[int]], path_px: Mapping[int, float]) -> list[int]:
    """Numbers of frames that lie between two others: the first telling one of each run, then the others.

    A frame that was hardly blurred tells little: what restoring it changes is finer than the compared pictures show.
    Those that tell come in the movie's order, then the most blurred.  path_px: length of each usable frame's blur path.
    """
    inner = [n for n in sorted(path_px) if n - 1 in path_px and n + 1 in path_px]
    ranked = sorted(inner, key=lambda n: -min(path_px[n], TELLING_PX))
    first = [next((n for n in ranked if n in run), None) for run in runs]
    chosen = [n for n in dict.fromkeys(first) if n is not None]
    return chosen + [n for n in ranked if n not in chosen]


def path_length_px(motion: RowMotion) -> float:
    """Length of the blur path in the picture's middle."""
    middle_px = 0.5 * np.array([[motion.profile.width, motion.profile.height]])
    return float(np.linalg.norm(blur_chords(motion, middle_px)[0]))
