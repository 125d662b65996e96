"""Lucas–Kanade between differently blurred pictures of one texture, compared with the blur paths' prediction."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from motion.synthetic_tracks import Setup, recorded

from virest.camera.response import ResponseCurve
from virest.image_formation.point_model import integrate_motion, seen_s
from virest.inference.blur_bias import matched_shift_px, rolling_shift_px
from virest.inference.even_blur import BlurPath, EvenMap
from virest.inference.guidance import NODES, MapBetween, applied_blur, interpolated
from virest.inference.tracking import track_pairs
from virest.motion.trajectory import turned

Array = np.ndarray
SIDE, MARGIN, PAIRS, INSTANTS = 288, 32, 30, 24
GREY = ResponseCurve("gamma", gamma=2.2)
STILL = np.zeros((2, 2))


def test_even_paths_have_no_bias() -> None:
    """A path at constant speed is symmetric about its mean, whatever its length."""
    rng = np.random.default_rng(1)
    speed, still = rng.normal(0, 3, (2, 50, 2)), np.zeros((50, 2))
    assert np.abs(matched_shift_px((speed[0], still), (speed[1], still))).max() < 1e-5


def test_the_bias_changes_its_sign_with_the_order() -> None:
    """The error is odd: exchanging the pictures reverses it."""
    rng = np.random.default_rng(2)
    speed, bend = rng.normal(0, 3, (2, 50, 2)), rng.normal(0, 0.3, (2, 50, 2))
    forth = matched_shift_px((speed[0], bend[0]), (speed[1], bend[1]))
    back = matched_shift_px((speed[1], bend[1]), (speed[0], bend[0]))
    assert np.abs(forth).max() > 0.01
    np.testing.assert_allclose(forth, -back, atol=1e-5)


@pytest.mark.parametrize("seed", [3, 4])
def test_steps_of_blurred_points_are_too_short_as_predicted(seed: int) -> None:
    """The errors proportional to the step and to the acceleration are mostly predicted."""
    rng = np.random.default_rng(seed)
    texture, error, predicted, steps, bends = _letters(rng), [], [], [], []
    for _ in range(PAIRS):
        first, second, step = _hand(rng)
        pair = track_pairs(enumerate((_blurred(texture, first), _blurred(texture, second + step))))[0]
        shift = second.mean(axis=0) - first.mean(axis=0)
        found = pair.points_second_px - pair.points_first_px - step - shift
        error.append(found)
        expected = matched_shift_px(_speed_and_bend(first), _speed_and_bend(second))
        predicted.append(np.broadcast_to(expected, found.shape))
        steps.append(np.broadcast_to(step, found.shape))
        bends.append(np.broadcast_to(shift, found.shape))
    error, predicted, steps, bends = map(np.concatenate, (error, predicted, steps, bends))
    before, after = (_slopes(left, steps, bends) for left in (error, error - predicted))
    assert before[0] < -4e-4
    assert before[1] < -0.05
    assert abs(after[0]) < 0.7 * abs(before[0])
    assert abs(after[1]) < 0.7 * abs(before[1])


@pytest.mark.parametrize("seed", [3, 4])
def test_a_guide_that_blurs_the_sharper_picture_leaves_less_bias(seed: int) -> None:
    """The errors of guided points match the prediction with the added blur and not the one without."""
    rng = np.random.default_rng(seed)
    texture, error, predicted, unguided = _letters(rng), [], [], []
    for _ in range(PAIRS):
        first, second, step = _hand(rng)
        guide = _Guide(step, np.cov(first.T), np.cov(second.T))
        pictures = enumerate((_blurred(texture, first), _blurred(texture, second + step)))
        (pair,) = track_pairs(pictures, guide=guide)
        assert pair.guided
        found = pair.points_second_px - pair.points_first_px - step - second.mean(axis=0) + first.mean(axis=0)
        paths = _speed_and_bend(first), _speed_and_bend(second)
        error.append(found)
        predicted.append(np.broadcast_to(matched_shift_px(*paths, guide.added[None]), found.shape))
        unguided.append(np.broadcast_to(matched_shift_px(*paths), found.shape))
    error, predicted, unguided = map(np.concatenate, (error, predicted, unguided))
    own, others = (_slopes(error, shift, np.zeros_like(error))[0] for shift in (predicted, unguided))
    assert abs(own - 1) < 0.45
    assert others < 0.5


@pytest.mark.parametrize("seed", [3, 4])
def test_pictures_blurred_along_each_other_s_paths_have_no_bias(seed: int) -> None:
    """The errors proportional to step and acceleration nearly vanish; without this blur both are clear."""
    rng = np.random.default_rng(seed)
    texture, shifts, steps, bends = _letters(rng), ([], []), [], []
    for _ in range(PAIRS):
        first, second, step = _hand(rng)
        bend = second.mean(axis=0) - first.mean(axis=0)
        pictures = _blurred(texture, first), _blurred(texture, second + step)
        for found, guide in zip(shifts, (_Guide(step), _EvenGuide(step + bend, first, second)), strict=True):
            (pair,) = track_pairs(enumerate(pictures), guide=guide)
            found.append(pair.points_second_px - pair.points_first_px - step - bend)
        for values, vector in ((steps, step), (bends, bend)):
            values.append(vector)
    before, after = (
        _slopes(np.concatenate(found), *(np.repeat(v, [len(f) for f in found], axis=0) for v in (steps, bends)))
        for found in shifts
    )
    assert before[1] < -0.05
    assert abs(after[0]) < 0.3 * abs(before[0])
    assert abs(after[1]) < 0.3 * abs(before[1])


class _EvenGuide:
    """A guide that knows the step between two pictures and their blur paths."""

    def __init__(self, step: Array, first: Array, second: Array) -> None:
        self.step, self.paths = step, (first, second)

    def seen_before(self, _first: int, _second: int, shape: tuple[int, int], _factor: int) -> EvenMap:
        """The map between the two pictures."""
        return EvenMap(_moved(-self.step, shape), *(_blur_path(path, shape) for path in self.paths), GREY)


def _blur_path(path: Array, shape: tuple[int, int]) -> BlurPath:
    terms = (interpolated(np.tile(vector, (NODES**2, 1)), shape) for vector in _speed_and_bend(path))
    return BlurPath(tuple(terms), float(np.linalg.norm(path[-1] - path[0])))


def _moved(step: Array, shape: tuple[int, int]) -> MapBetween:
    return MapBetween(interpolated(np.tile(step, (NODES**2, 1)), shape).coefficients, shape)


class _Guide:
    """A guide that knows the step between two pictures and the covariances of their blur."""

    def __init__(self, step: Array, first: Array = STILL, second: Array = STILL) -> None:
        self.step, self.lacks = step, (applied_blur(second - first), applied_blur(first - second))

    @property
    def added(self) -> Array:
        """Covariance of the blur added to either picture."""
        return self.lacks[0] + self.lacks[1]

    def seen_before(self, _first: int, _second: int, shape: tuple[int, int], _factor: int) -> MapBetween:
        """The map between the two pictures."""
        return replace(_moved(-self.step, shape), first_lacks=self.lacks[0], second_lacks=self.lacks[1])


def _slopes(error: Array, steps: Array, bends: Array) -> Array:
    """Parts (2,) of the step and of the shift by acceleration in the errors, from a robust fit."""
    distance = np.linalg.norm(error, axis=1)
    weight = np.repeat(1 / (1 + (distance / (2 * np.median(distance))) ** 2), 2)
    rows = np.stack([steps.ravel(), bends.ravel()], axis=-1)
    return np.linalg.lstsq(rows * weight[:, None] ** 0.5, error.ravel() * weight**0.5, rcond=None)[0]


def _hand(rng: np.random.Generator, frame_s: float = 1 / 30, exposure_s: float = 0.013) -> tuple[Array, Array, Array]:
    """Paths (INSTANTS, 2) about two instants and the step between them: 400 px/s RMS between 0.5 Hz and 12 Hz."""
    frequency = np.exp(np.linspace(np.log(0.5), np.log(12), 30))
    speed = (frequency / 2) / (1 + frequency / 2) / (1 + (frequency / 8) ** 2) * rng.uniform(0.6, 1.4, (2, 30))
    speed *= 400 / np.sqrt((speed**2).sum() / 2)
    omega, phase = 2 * np.pi * frequency, rng.uniform(0, 2 * np.pi, (2, 30))

    def place(time_s: Array) -> Array:
        return (speed / omega * np.sin(omega * time_s[:, None, None] + phase)).sum(axis=-1)

    within = ((np.arange(INSTANTS) + 0.5) / INSTANTS - 0.5) * exposure_s
    begin, end = place(np.zeros(1)), place(np.full(1, frame_s))
    return place(within) - begin, place(frame_s + within) - end, (end - begin)[0]


def _speed_and_bend(path: Array) -> tuple[Array, Array]:
    """Speed and bend, (1, 2) each, of p(u) = c + speed u + bend u², u from −1 to 1."""
    u = 2 * (np.arange(INSTANTS) + 0.5) / INSTANTS - 1
    fitted = np.polynomial.polynomial.polyfit(u, path, 2)
    return fitted[1][None], fitted[2][None]


def _letters(rng: np.random.Generator) -> Array:
    """Overlapping horizontal and vertical bars; linear light in [0, 1]."""
    picture = np.full((SIDE, SIDE), 0.6, np.float32)
    for _ in range(500):
        left, top = rng.integers(0, SIDE, 2)
        width, height = rng.permutation([rng.integers(3, 7), rng.integers(8, 26)])
        picture[top : top + height, left : left + width] = rng.uniform(0.03, 0.9)
    return cv2.GaussianBlur(picture, (0, 0), 0.6)


def _blurred(texture: Array, path: Array) -> Array:
    """Grey picture of a texture that moves along a path during the exposure."""
    spectrum = np.fft.rfft2(texture)
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None]
    down, across = (np.exp(-2j * np.pi * f.ravel()[:, None] * path[:, axis]) for f, axis in ((fy, 1), (fx, 0)))
    light = np.fft.irfft2(spectrum * (down @ across.T / len(path)), s=texture.shape)
    grey = 255 * np.clip(light, 0, 1) ** (1 / 2.2)
    return np.rint(grey).astype(np.uint8)[MARGIN:-MARGIN, MARGIN:-MARGIN].copy()


@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_rows_that_are_read_while_points_move_shift_them(direction: str) -> None:
    """The mean of a point over the time for which its rows are exposed, beside that of its middle row."""
    recording = recorded(Setup(seed=21, readout_direction=direction, frames=12, gyro_noise_rad_s=0.0))
    profile, table = recording.profile, recording.table()
    table = table.chosen(np.arange(len(table)) % 5 == 0)
    known, half_s = integrate_motion(recording.imu, profile, translation=False), 0.01
    at = table.first_stamp_s, np.full(len(table), 2 * half_s / profile.shutter.exposure_scale)
    middle_s = seen_s(profile, table.first_px, *at)
    world = turned(known.trajectory.orientation(middle_s), known.lens.rays(table.first_px, middle_s))

    def seen(time_s: Array) -> Array:
        back = np.swapaxes(known.trajectory.orientation(time_s), -1, -2)
        return known.lens.project(turned(back, world), time_s)

    since_s = half_s * np.linspace(-1.6, 1.6, 321)
    paths = [seen(middle_s + since) for since in since_s]
    late_s = [middle_s + since - seen_s(profile, px, *at) for since, px in zip(since_s, paths, strict=True)]
    exposed = np.clip((half_s - np.abs(late_s)) / np.diff(since_s)[0] + 0.5, 0.0, 1.0)
    mean_px = np.average(paths, axis=0, weights=np.broadcast_to(exposed[..., None], np.shape(paths)))
    row_s = seen_s(profile, mean_px, *at)
    at_once = np.mean([seen(row_s + half_s * share) for share in (2 * np.arange(100) + 1) / 100 - 1], axis=0)
    shift_px = mean_px - at_once
    found_px = rolling_shift_px(known, mean_px, *at)
    assert np.abs(shift_px).max() > 0.01
    assert np.sqrt(np.mean((found_px - shift_px) ** 2)) < 0.25 * np.sqrt(np.mean(shift_px**2))
