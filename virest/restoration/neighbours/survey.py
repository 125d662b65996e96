"""Measure missing rotation and confirmed gain on a few runs of consecutive frames, once per capture at planning."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from virest.arrays import Picture
from virest.image_formation.blur import Image
from virest.image_formation.kernels import blur_chords
from virest.image_formation.neighbour import neighbour_view
from virest.image_formation.row_motion import RowMotion
from virest.motion.optics import MovingLens
from virest.motion.trajectory import Trajectory
from virest.restoration.neighbours.confirmation import ConfirmedGain, confirmed_gain
from virest.restoration.neighbours.refinement import MissingTurn, RefinedMotion, missing_turn, undetected_rad_s
from virest.restoration.neighbours.registration import judged_change
from virest.restoration.neighbours.sights import FrameNeighbours, Sight

RUN_FRAMES = 4
"""Length of a run: three pairs, so that the middle one tests linear interpolation between the outer ones."""
MOST_RUNS = 4
"""Runs of a survey: one frame of each, compared with both neighbours, gives eight shares.  A run of 320 × 240 px takes
0.2 s."""
TELLING_PX = 3.0
"""Blur paths of this length cancel ⅓ cycle per pixel; frames are compared up to ¼.  On eleven simulated captures 36 of
38 shares of frames with longer paths were positive, against 12 of 40 for paths of 1 to 2.5 px."""


def survey_runs(numbers: Iterable[int], path_px: Mapping[int, float]) -> list[tuple[int, ...]]:
    """At most MOST_RUNS runs of consecutive frames, the most blurred of each part of the capture, evenly spaced.

    numbers: frames to choose from.  path_px: approximate blur path length by frame index.
    """
    ordered = np.array(sorted(numbers), np.intp)
    if not len(ordered):
        return []
    runs = []
    for stretch in np.split(ordered, np.flatnonzero(np.diff(ordered) != 1) + 1):
        pieces = np.array_split(stretch, max(1, min(len(stretch) // RUN_FRAMES, MOST_RUNS)))
        for piece in pieces:
            starts = range(max(len(piece) - RUN_FRAMES + 1, 1))
            blur = [sum(path_px.get(int(n), 0.0) for n in piece[k : k + RUN_FRAMES]) for k in starts]
            best = int(np.argmax(blur))
            runs.append(tuple(int(n) for n in piece[best : best + RUN_FRAMES]))
    chosen = np.unique(np.linspace(0, len(runs) - 1, min(len(runs), MOST_RUNS)).round().astype(int))
    return [runs[k] for k in chosen if len(runs[k]) > 1]


def store_lumas(
    pictures: Iterable[tuple[int, Picture]], wanted: Iterable[int], into: dict[int, Picture]
) -> Iterator[tuple[int, Picture]]:
    """Pass (index, luma) pairs through, and store the wanted ones in ``into``."""
    chosen = set(wanted)
    for index, luma in pictures:
        if index in chosen:
            into[index] = luma
        yield index, luma


def survey_turns(
    runs: Sequence[Sequence[int]], sights: Mapping[int, Sight], neighbours: FrameNeighbours, trajectory: Trajectory
) -> tuple[MissingTurn | None, float | None]:
    """The rotation that the prediction lacks, from runs of frames; None: not significant, or not measurable.

    And the standard deviation, rad/s, of the rate that it may lack without that; None: not measurable.
    """
    motions: list[RowMotion] = [s.motion for s in sights.values() if s.usable and s.motion is not None]
    turns = [
        [neighbours.turn(sights[a], sights[b]) if a in sights and b in sights else None for a, b in pairwise(run)]
        for run in runs
    ]
    return missing_turn(turns, motions, trajectory), undetected_rad_s(turns)


def survey_gain(
    runs: Sequence[Sequence[int]],
    sights: Mapping[int, Sight],
    neighbours: FrameNeighbours,
    trajectory: Trajectory,
    lens: MovingLens,
    restore: Callable[[Sight, RowMotion, RefinedMotion | None], tuple[Image, Image] | None],
) -> ConfirmedGain | None:
    """The gain of deblurring that neighbours confirm; None: not measurable.

    restore: returns a frame's luma of light as recorded and as restored, at mid-exposure and reduced, or None if it is
    not deblurred.  One blurred frame per run is restored, and one more if there are fewer than MOST_RUNS runs.  Each is
    compared with both neighbours; if neither can judge it, the next candidate takes its place.
    """
    found: list[tuple[float, float, float, float]] = []
    path_px = {n: path_length_px(s.motion) for n, s in sights.items() if s.usable and s.motion is not None}
    asked, most = 0, min(len(runs) + 1, MOST_RUNS)
    for number in gain_test_candidates(runs, path_px)[: 2 * most]:
        if asked == most:
            break
        before, here, after = (sights[number + step] for step in (-1, 0, 1))
        assert here.motion is not None
        refined = neighbours.refined((before,), here, (after,))
        motion = here.motion if refined is None else refined.motion
        pictures = restore(here, motion, refined)
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


def gain_test_candidates(runs: Sequence[Sequence[int]], path_px: Mapping[int, float]) -> list[int]:
    """Candidates for testing the gain, each between two usable frames: the best of each run, then the others.

    A frame with a short path is of little use: restoring it changes detail finer than the compared pictures resolve.
    Frames with paths of TELLING_PX and more come first, in movie order, then the others, most blurred first.  path_px:
    blur path length of each usable frame.
    """
    inner = [n for n in sorted(path_px) if n - 1 in path_px and n + 1 in path_px]
    ranked = sorted(inner, key=lambda n: -min(path_px[n], TELLING_PX))
    first = [next((n for n in ranked if n in run), None) for run in runs]
    chosen = [n for n in dict.fromkeys(first) if n is not None]
    return chosen + [n for n in ranked if n not in chosen]


def path_length_px(motion: RowMotion) -> float:
    """Length of the blur path in the picture's centre."""
    middle_px = 0.5 * np.array([[motion.profile.width, motion.profile.height]])
    return float(np.linalg.norm(blur_chords(motion, middle_px)[0]))
