"""Statistics of a blurred picture: known noise and signal are recovered."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from laws import texture
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.image_formation.blur import tile_grid
from virest.image_formation.kernels import KernelField
from virest.restoration.statistics import ring_fit, tile_power
from virest.restoration.statistics.measure import measure_picture
from virest.restoration.statistics.of_picture import SAMPLE_TILE_PX, detailed
from virest.restoration.statistics.on_tiles import on_spectrum
from virest.restoration.statistics.place_fit import unevenness
from virest.restoration.statistics.records import PictureStatistics, coder_noise
from virest.restoration.statistics.rings import SIDE, ring_index

HEIGHT, WIDTH = 420, 560
STRAIGHT = ResponseCurve("linear")


def _field(length_px: float = 15.0, angle_rad: float = 0.4) -> KernelField:
    """A curved blur path that is the same everywhere, on a grid of centres."""
    part = (np.arange(40) + 0.5) / 40
    path = np.stack([length_px * part, 0.12 * length_px * part**2], -1) @ np.array(
        [[np.cos(angle_rad), np.sin(angle_rad)], [-np.sin(angle_rad), np.cos(angle_rad)]]
    )
    x, y = np.meshgrid(np.arange(64, WIDTH, 128), np.arange(64, HEIGHT, 128))
    centres = np.stack([x, y], -1).reshape(-1, 2).astype(float)
    return KernelField(centres, np.repeat(path[None], len(centres), 0), 0.0)


def _blurred(field: KernelField, noise_levels: float) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Blur a grey texture with the kernel and add white noise; return it and the sharp texture, grey levels."""
    sharp = 255 * (0.2 + 0.6 * texture(HEIGHT, WIDTH, seed=5))
    blurred = cv2.filter2D(sharp, -1, field.arrays()[0].astype(float))
    noisy = blurred + np.random.default_rng(8).normal(0, noise_levels, sharp.shape)
    return np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, -1), sharp


@pytest.mark.parametrize("noise_levels", [0.8, 2.0, 4.0])
def test_the_response_curve_at_blurred_edges_is_not_noise(noise_levels: float) -> None:
    """Black and white patches are blurred in linear light and pass through a response curve.

    The measured noise is the noise added after the curve. With a linear curve the measurement is over 1.3 times larger.
    """
    field, curve = _field(13.0), ResponseCurve("srgb")
    light = 0.02 + 0.9 * (texture(HEIGHT, WIDTH, seed=5) > 0.5)
    grey = 255 * curve.encode(cv2.filter2D(light, -1, field.arrays()[0].astype(float)))
    noisy = grey + np.random.default_rng(8).normal(0, noise_levels, grey.shape)
    picture = np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, -1)
    measured, taken_for_light = (measure_picture(picture, field, c)[0].noise_levels for c in (curve, STRAIGHT))
    assert measured == pytest.approx(noise_levels, rel=0.25)
    assert taken_for_light > 1.3 * measured


@pytest.mark.parametrize("length_px", [3.5, 5.0, 15.0])
def test_the_noise_of_a_coder_is_bounded_by_its_step(length_px: float) -> None:
    """Upright bars have more detail across than along, which passes for noise under a short blur path.

    The coding step bounds the noise and never raises it.
    """
    field, step = _field(length_px, np.pi / 2), 12.0
    bars = np.random.default_rng(3).normal(0, 25, WIDTH)
    sharp = 127 + 60 * (texture(HEIGHT, WIDTH, seed=5) - 0.5) + cv2.GaussianBlur(bars[None], (0, 0), 0.7)
    blurred = cv2.filter2D(sharp, -1, field.arrays()[0].astype(float))
    picture = np.clip(np.rint(_coded(blurred, step)), 0, 255).astype(np.uint8)
    known, unknown = (
        measure_picture(np.repeat(picture[..., None], 3, -1), field, STRAIGHT, coding_step=given)[0]
        for given in (step, None)
    )
    true_power = np.mean((picture - blurred) ** 2)
    assert known.noise_levels < 2 * np.sqrt(true_power)
    assert np.all(known.noise <= unknown.noise * 1.001)


def test_chroma_has_no_more_noise_than_coding_leaves() -> None:
    """Chroma is coded in steps of 12 with one sample per 2 × 2 pixels; a step of 1/2 more than halves the noise.

    An uncertain kernel lifts the bound for luma only.
    """
    field = _field(9.0, np.pi / 2)
    sharp = 80 * (texture(HEIGHT // 2, WIDTH // 2, seed=6) - 0.5)
    coded = _coded(cv2.filter2D(sharp, -1, field.scaled(0.5).arrays()[0].astype(float)), 12.0)
    red = np.clip(np.rint(128 + cv2.resize(coded, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)), 0, 255)
    grey = red[:, ::-1]
    planes = np.clip(np.stack([grey, red, np.full_like(red, 128)], -1), 0, 255).astype(np.uint8)
    picture = cv2.cvtColor(planes, cv2.COLOR_YCrCb2RGB)
    found, known, doubted = (
        measure_picture(picture, field, STRAIGHT, coding_step=step, bounds_luma=bounds)
        for step, bounds in ((None, True), (0.5, True), (0.5, False))
    )
    low = slice(2, 8)
    assert known[1].noise[low].mean() < 0.5 * found[1].noise[low].mean()
    np.testing.assert_array_equal(doubted[1].noise, known[1].noise)
    np.testing.assert_array_equal(doubted[0].noise, found[0].noise)


@pytest.mark.parametrize("noise_levels", [1.5, 4.0, 8.0])
@pytest.mark.parametrize("angle_rad", [0.4, 1.9])
def test_white_noise_is_measured(noise_levels: float, angle_rad: float) -> None:
    """Known white noise is measured within 15 % under a known blur."""
    field = _field(angle_rad=angle_rad)
    luma, _ = measure_picture(_blurred(field, noise_levels)[0], field, STRAIGHT)
    assert luma.noise_levels == pytest.approx(noise_levels, rel=0.15)


def test_noise_to_signal_is_of_the_right_order() -> None:
    """N / S of each ring is within a factor of 2.5 of the truth where noise and signal are comparable, and rises."""
    field = _field()
    picture, sharp = _blurred(field, 4.0)
    luma, _ = measure_picture(picture, field, STRAIGHT)
    fy, fx = np.fft.fftfreq(HEIGHT)[:, None], np.fft.fftfreq(WIDTH)[None]
    power = np.abs(np.fft.fft2(sharp)) ** 2 / (HEIGHT * WIDTH)
    radius = np.hypot(fx, fy)
    truth = np.array([4.0**2 / np.mean(power[np.abs(radius - f) < 0.011]) for f in luma.frequency])
    middle = (luma.frequency > 0.04) & (luma.frequency < 0.4)
    ratio = luma.noise_to_signal[middle] / truth[middle]
    assert ratio.min() > 1 / 2.5
    assert ratio.max() < 2.5
    assert luma.noise_to_signal[12] > 5 * luma.noise_to_signal[2]


@pytest.mark.parametrize("length_px", [3.0, 15.0])
def test_the_loss_by_blur_is_measured(length_px: float) -> None:
    """The mean square of the change by blur, without noise, follows from the blurred picture alone."""
    field = _field(length_px)
    picture, sharp = _blurred(field, 2.0)
    lost = np.mean((sharp - cv2.filter2D(sharp, -1, field.arrays()[0].astype(float))) ** 2)
    assert measure_picture(picture, field, STRAIGHT)[0].blur_error == pytest.approx(lost, rel=0.12)


def test_more_noise_lowers_the_expected_gain() -> None:
    """The expected gain is above 1.5 dB with little noise and shrinks as noise grows."""
    field = _field()
    gains = [measure_picture(_blurred(field, n)[0], field, STRAIGHT)[0].expected_gain_db for n in (1.0, 4.0, 12.0)]
    assert gains[0] > gains[1] > gains[2] >= 0
    assert gains[0] > 1.5


def test_a_blur_absent_from_the_picture_counts_as_noise() -> None:
    """A sharp picture with a predicted blur gets more than twice the noise of a picture with that blur."""
    field = _field()
    picture, sharp = _blurred(field, 1.5)
    unblurred = np.repeat(np.rint(sharp).astype(np.uint8)[..., None], 3, -1)
    seen, missed = (measure_picture(p, field, STRAIGHT)[0].noise_levels for p in (picture, unblurred))
    assert missed > 2 * seen


def test_a_grey_picture_has_hardly_any_chroma_signal() -> None:
    """Chroma has separate statistics: in a grey picture little but rounding remains."""
    field = _field()
    luma, chroma = measure_picture(_blurred(field, 4.0)[0], field, STRAIGHT)
    assert np.all(chroma.signal < 0.05 * luma.signal)


@pytest.mark.parametrize(
    "picture",
    [
        pytest.param(np.full((60, 80, 3), 90, np.uint8), id="too small"),
        pytest.param(np.zeros((HEIGHT, WIDTH, 3), np.uint8), id="black"),
        pytest.param(np.full((HEIGHT, WIDTH, 3), 255, np.uint8), id="white"),
        pytest.param(np.full((HEIGHT, WIDTH, 3), (200, 40, 90), np.uint8), id="one colour"),
    ],
)
def test_pictures_without_detail_give_finite_statistics(picture: NDArray[np.uint8]) -> None:
    """All figures are finite, and signal and noise are positive."""
    for statistics in measure_picture(picture, _field(), STRAIGHT):
        for values in (statistics.signal, statistics.noise, statistics.noise_to_signal):
            assert np.isfinite(values).all()
            assert (values > 0).all()
        assert np.isfinite([statistics.noise_levels, statistics.gradient_scale, statistics.expected_gain_db]).all()


def test_rings_are_spread_over_a_packed_spectrum() -> None:
    """Ring values are placed at their frequencies; at the mean, which needs no regularisation, the value is 0."""
    frequency = (np.arange(24) + 0.5) / 48
    statistics = PictureStatistics(frequency, np.ones(24), np.ones(24), np.ones(24), 1.0)
    spread = on_spectrum(statistics, 1 + frequency, 96)
    assert spread[0, 0] == 0
    assert spread[0, 2 * 30] == pytest.approx(1 + 30 / 96, rel=1e-3)
    assert spread[2 * 20, 0] == pytest.approx(1 + 20 / 96, rel=1e-3)


def test_scaled_statistics_are_those_of_the_scaled_picture() -> None:
    """In a picture reduced to 3/4, white noise falls to 3/4 and the rings are at frequencies 4/3 times higher."""
    frequency = (np.arange(24) + 0.5) / 48
    statistics = PictureStatistics(frequency, 1 + frequency, np.full(24, 4.0), np.ones(24), 2.0)
    small = statistics.scaled(0.75)
    assert small.noise_levels == pytest.approx(1.5)
    np.testing.assert_allclose(small.noise, 1.5**2)
    ratio = statistics.noise_to_signal
    np.testing.assert_allclose(on_spectrum(small, ratio, 96), on_spectrum(statistics, ratio, 96, 4 / 3), rtol=1e-6)


def test_gradients_per_pixel_grow_in_a_smaller_picture() -> None:
    """With f⁻³ power, which has gradients at all scales, the gradient scale grows by less than the reduction."""
    frequency = (np.arange(24) + 0.5) / 48
    statistics = PictureStatistics(frequency, frequency**-3.0, np.ones(24), np.ones(24), 1.0)
    assert 1.0 < statistics.scaled(0.5).gradient_scale / statistics.gradient_scale < 2.0


def test_the_finest_frequency_is_the_last_above_the_noise() -> None:
    """It is the highest ring whose power after the blur exceeds the noise, or the lowest ring if none does."""
    frequency = (np.arange(24) + 0.5) / 48
    signal = np.where(frequency < 0.3, 8.0, 1.0)
    statistics = PictureStatistics(frequency, signal, np.full(24, 2.0), np.full(24, 0.5), 1.0)
    assert statistics.finest == frequency[frequency < 0.3][-1]
    assert PictureStatistics(frequency, signal, np.full(24, 9.0), np.ones(24), 3.0).finest == frequency[0]


def test_few_tiles_suffice_for_white_noise() -> None:
    """With a third of the tiles known white noise is still measured within 15 %."""
    field = _field()
    luma, _ = measure_picture(_blurred(field, 4.0)[0], field, STRAIGHT, None, 4)
    assert luma.noise_levels == pytest.approx(4.0, rel=0.15)


def test_clipped_highlights_are_not_noise() -> None:
    """With the mask of clipped streaks the noise is right within 15 %; without it, it is three times too large."""
    field = _field()
    sharp = 255 * (0.2 + 0.6 * texture(HEIGHT, WIDTH, seed=5))
    rng = np.random.default_rng(9)
    for y, x in np.stack([rng.integers(5, HEIGHT - 9, 40), rng.integers(5, WIDTH - 9, 40)], -1):
        sharp[y : y + 4, x : x + 3] = 6000.0
    seen = cv2.filter2D(sharp, -1, field.arrays()[0].astype(float)) + rng.normal(0, 2.0, sharp.shape)
    picture = np.repeat(np.clip(np.rint(seen), 0, 255).astype(np.uint8)[..., None], 3, -1)
    clipped = (picture[..., 0] >= 254).astype(np.uint8)
    assert 0.01 < clipped.mean() < 0.02
    known, _ = measure_picture(picture, field, STRAIGHT, clipped)
    assert known.noise_levels == pytest.approx(2.0, rel=0.15)
    taken, _ = measure_picture(picture, field, STRAIGHT)
    assert taken.noise_levels > 6.0


def test_a_picture_clipped_all_over_gives_finite_statistics() -> None:
    """A picture that is white everywhere causes no division by zero."""
    white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    luma, chroma = measure_picture(white, _field(), STRAIGHT, np.ones((HEIGHT, WIDTH), np.uint8))
    for found in (luma, chroma):
        assert np.isfinite(found.noise_levels)
        assert np.isfinite(found.expected_gain_db)


def test_detail_removed_by_coding_is_extrapolated() -> None:
    """Where the noise is close to the recorded power, the sharp picture continues the fall of its last clear ring.

    Clear rings are unchanged.
    """
    frequency = (np.arange(24) + 0.5) / 48
    signal, noise, passed = 40.0 * frequency**-3, np.full(24, 900.0), np.linspace(0.9, 0.1, 24)
    cut = np.where(frequency > 0.3, 1e-3 * signal, signal)
    found = ring_fit._extrapolated_detail(frequency, cut, passed, noise)
    np.testing.assert_allclose(found, signal, rtol=1e-9)
    clear = ring_fit._extrapolated_detail(frequency, signal, passed, np.full(24, 1e-3))
    np.testing.assert_array_equal(clear, signal)


def test_detail_removed_by_coding_is_not_taken_for_a_grating(rng: np.random.Generator) -> None:
    """Detail below the law of natural pictures leaves no unevenness, since the rings still fit the recorded power."""
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.arange(1, SIDE // 2)[None, :] / SIDE
    frequency = np.hypot(fx, fy)
    passed = np.stack([np.sinc(3 * (fx * np.cos(a) + fy * np.sin(a))) ** 2 for a in np.linspace(0.4, 0.65, 6)])
    recorded = passed * 200 * frequency**-3.6 * np.exp(-4 * (frequency / 0.12) ** 2) + 0.5
    seen = (recorded * rng.exponential(1.0, passed.shape)).astype(np.float32)
    passed = passed.astype(np.float32)
    found = ring_fit.fit_rings((seen, ring_fit.RingCells(passed), 0.5, None))[0]
    law = found.noise[:, None] + found.signal[:, None] * ring_fit.RingCells(passed).passed
    assert law[12].max() > 3 * seen.mean(axis=0)[ring_index(SIDE) == 12].mean()
    assert unevenness(found, seen, passed) == 0.0


@pytest.mark.parametrize("height", [41, 45])
def test_white_noise_is_the_median_second_difference(height: int, rng: np.random.Generator) -> None:
    """The histogram gives the median of the second difference in both directions at every fourth pixel."""
    plane = rng.integers(0, 256, (height, 58)).astype(np.uint8)
    mask = np.outer([1, -2, 1], [1, -2, 1]).astype(float)
    differences = cv2.filter2D(plane.astype(float), -1, mask)[2 : height - 2 : 4, 2:-2:4]
    expected = np.median(np.abs(differences)) / 0.6745 / 6.0
    assert tile_power.white_noise(plane) == pytest.approx(expected, rel=1e-9)


def _coded(picture: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Quantise the cosine transforms of blocks, as a video encoder does."""
    coded = picture.copy()
    height, width = picture.shape
    for top in range(0, height - 3, 4):
        for left in range(0, width - 3, 4):
            block = np.s_[top : top + 4, left : left + 4]
            coded[block] = cv2.idct(np.rint(cv2.dct(picture[block]) / step) * step)
    return coded


def test_coding_noise_is_level_where_the_picture_exceeds_it() -> None:
    """A short blur shows noise at high frequencies only, where it falls with the picture; at lower ones it is level."""
    field = _field(3.0)
    blurred = cv2.filter2D(255 * (0.2 + 0.6 * texture(HEIGHT, WIDTH, seed=5)), -1, field.arrays()[0].astype(float))
    coded = _coded(blurred, 20.0)
    picture = np.repeat(np.clip(np.rint(coded), 0, 255).astype(np.uint8)[..., None], 3, -1)
    luma, _ = measure_picture(picture, field, STRAIGHT)
    low = luma.frequency < 0.15
    lost = (coded - blurred).astype(np.float32)
    tiles = [lost[y : y + 128, x : x + 128] for y in (10, 150, 280) for x in (20, 200, 400)]
    error = np.mean([tile_power.windowed_power(tile) for tile in tiles], 0)
    rings = ring_index(128)
    truth = np.array([error[rings == number].mean() for number in np.flatnonzero(low)[1:]])
    assert (luma.noise[low][1:] < 2 * truth).all()


@pytest.mark.parametrize("turned_deg", [10, 145])
@pytest.mark.parametrize("length_px", [2.0, 3.5])
def test_stripes_under_a_short_path_are_not_noise(length_px: float, turned_deg: int) -> None:
    """A path of a few pixels cancels little, so detail that is strongest along it must not count as noise."""
    field, rng = _field(length_px, angle_rad=0.0), np.random.default_rng(3)
    stripes = cv2.blur(cv2.GaussianBlur(rng.standard_normal((900, 900)), (0, 0), 0.7), (1, 25))
    stripes = cv2.warpAffine(stripes, cv2.getRotationMatrix2D((450, 450), turned_deg, 1.0), (900, 900))
    stripes = stripes[200 : 200 + HEIGHT, 150 : 150 + WIDTH]
    sharp = 85 + 77 * texture(HEIGHT, WIDTH, seed=5) + 30 * stripes / stripes.std()
    blurred = cv2.filter2D(sharp, -1, field.arrays()[0].astype(float)) + rng.standard_normal(sharp.shape)
    noisy = np.clip(np.rint(blurred), 0, 255).astype(np.uint8)
    luma, _ = measure_picture(np.repeat(noisy[..., None], 3, -1), field, STRAIGHT)
    assert luma.noise_levels < 3


@pytest.mark.parametrize("std_px", [0.1, 0.6, 2.0])
def test_errors_of_a_misplaced_picture_follow_from_its_spectrum(std_px: float) -> None:
    """Errors of the restored and the recorded picture, averaged over many shifts, equal the predicted ones."""
    frequency = (np.arange(24) + 0.5) / 48
    signal, passed, noise = 100 * (0.02 / frequency) ** 2.5, np.exp(-((6 * frequency) ** 2)), np.full(24, 0.01)
    found = PictureStatistics(frequency, signal, noise, passed, 1.0)
    rng, area = np.random.default_rng(4), 2 * np.pi * frequency / 48
    distance_px = np.hypot(*rng.normal(0, std_px, (2, 20000, 1))) * np.cos(rng.uniform(0, 2 * np.pi, (20000, 1)))
    phase = 2 * np.pi * frequency * distance_px
    filtered = passed * signal / (passed * signal + noise)

    def missing(kept: NDArray[np.float64], moved: NDArray[np.float64]) -> float:
        return float(np.mean((np.abs(1 - kept * np.exp(1j * moved)) ** 2 * signal) @ area))

    recorded, restored, recorded_off, restored_off = (
        missing(kept, moved) for moved in (0 * phase[:1], phase) for kept in (np.sqrt(passed), filtered)
    )
    misplaced = found.misplaced(std_px, np.zeros(24))
    assert misplaced.removed == pytest.approx(recorded - restored)
    assert misplaced.weight @ misplaced.restored == pytest.approx(restored_off - restored, rel=0.03)
    assert misplaced.weight @ misplaced.blurred == pytest.approx(recorded_off - recorded, rel=0.03)


def test_a_frame_has_at_least_the_noise_of_its_coder() -> None:
    """Missed noise is added and raises the noise level; noise that was measured stays."""
    frequency = (np.arange(24) + 0.5) / 48
    signal, passed = 100 * (0.02 / frequency) ** 2.5, np.exp(-((6 * frequency) ** 2))
    missed, found = (PictureStatistics(frequency, signal, np.full(24, n), passed, np.sqrt(n)) for n in (0.2, 400.0))
    least = missed.with_coder_noise(30.0)
    recorded = passed * signal + missed.noise
    assert np.all(least.noise >= missed.noise)
    assert np.all(least.noise <= np.maximum(recorded, missed.noise) + 1e-9)
    assert least.noise[0] == pytest.approx(coder_noise(recorded, 30.0)[0])
    assert least.noise_levels > 2 * missed.noise_levels
    assert found.with_coder_noise(30.0).noise_levels == pytest.approx(found.noise_levels)


def test_chroma_is_measured_where_the_picture_has_colour() -> None:
    """Grey stripes beside the colours, over part of the tiles, hardly change the spectrum of chroma."""
    field = _field()
    grey, sharp = _blurred(field, 1.0)
    other = cv2.filter2D(255 * (0.3 + 0.4 * texture(HEIGHT, WIDTH, seed=9)), -1, field.arrays()[0].astype(float))
    coloured = grey.copy()
    coloured[..., 0] = np.clip(np.rint(other + np.random.default_rng(2).normal(0, 1, sharp.shape)), 0, 255)
    striped = coloured.copy()
    for left in (0, 256):  # of the first and of the third column of tiles
        striped[:, left : left + 128] = grey[:, left : left + 128]
    everywhere, here_and_there = (measure_picture(p, field, STRAIGHT)[1] for p in (coloured, striped))
    np.testing.assert_allclose(here_and_there.signal[1:8], everywhere.signal[1:8], rtol=0.7)
    assert here_and_there.noise_to_signal[2] < 3 * everywhere.noise_to_signal[2]


@pytest.mark.parametrize(
    ("flat_noise", "step", "flat_counts"),
    [(0.0, 20.0, False), (0.6, 20.0, False), (0.0, None, False), (3.0, None, True), (3.0, 2.0, True)],
)
def test_blank_tiles_tell_nothing_about_noise(
    flat_noise: float, step: float | None, flat_counts: bool, rng: np.random.Generator
) -> None:
    """Beside print, a bare page counts only if it shows more than the coder drops, such as the sensor's noise."""
    page = np.full((512, 512), 230.0) - np.linspace(0, 40 if step else 0, 512)  # lit from one side
    page[:, :256] -= 180 * (cv2.GaussianBlur(rng.random((512, 256)), (0, 0), 2.0) > 0.52)
    picture = np.clip(np.rint(page + flat_noise * rng.standard_normal(page.shape)), 0, 255).astype(np.uint8)
    centres_px = tile_grid(512, 512, SAMPLE_TILE_PX, 0).centres_px
    kept = detailed(picture, centres_px, step)
    assert {tuple(c) for c in kept} >= {tuple(c) for c in centres_px if c[0] < 256}
    assert (len(kept) == len(centres_px)) == flat_counts


def test_a_blank_picture_is_measured_as_a_whole() -> None:
    """Where no tile shows anything, all count."""
    centres_px = tile_grid(512, 512, SAMPLE_TILE_PX, 0).centres_px
    np.testing.assert_array_equal(detailed(np.full((512, 512, 3), 200, np.uint8), centres_px, 10.0), centres_px)
