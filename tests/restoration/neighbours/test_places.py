"""The position uncertainty of a neighbour's picture: the field of its tiles' shifts, and distortion near relief."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from virest.restoration.neighbours.joint import (
    _cubic_error,
    _likeliest_field,
    _shift_field,
    _trust,
    is_detailed,
)
from virest.restoration.neighbours.reduced_tiles import AROUND, TILE, WIDE, wide_spectra
from virest.restoration.neighbours.registration import TileAgreement
from virest.restoration.statistics.records import unknown_picture

SPACING_PX = 64.0
CENTRES_PX = np.stack(np.meshgrid(np.arange(12), np.arange(9)), axis=-1).reshape(-1, 2) * SPACING_PX


APART = np.linalg.norm(CENTRES_PX[:, None] - CENTRES_PX, axis=-1) / SPACING_PX


def test_independent_shift_noise_is_not_a_field_error(rng: np.random.Generator) -> None:
    """Independent noise of adjacent tiles is hardly ever attributed to the field."""
    sure = np.ones(len(CENTRES_PX))
    found = [_likeliest_field(rng.normal(0, 0.2, CENTRES_PX.shape), sure, APART)[0] for _ in range(40)]
    assert np.mean(np.square(found)) < 0.05 * 0.2**2


@pytest.mark.parametrize("noise_px", [0.03, 0.1])
@pytest.mark.parametrize("wave_px", [0.2, 5.0])
def test_a_smooth_residual_is_an_error_of_the_field(rng: np.random.Generator, wave_px: float, noise_px: float) -> None:
    """A residual that changes slowly over the picture is distinguished from noise, even if it is far larger."""
    off = wave_px * np.sin(2 * np.pi * CENTRES_PX / (9 * SPACING_PX))
    off += rng.normal(0, noise_px, off.shape)
    common_px, found_px, reach = _likeliest_field(off, np.ones(len(off)), APART)
    assert common_px > wave_px / 2
    assert reach > 1
    assert 0.7 * noise_px < found_px < 2 * noise_px


def _agreement(near_shift_px: float, rng: np.random.Generator) -> TileAgreement:
    """Two frames of one texture, three by four tiles.

    In one tile the neighbour's content is shifted by a given distance.
    """
    height, width = 3 * TILE, 4 * TILE
    spectrum = np.fft.fft2(rng.normal(size=(height + 2 * AROUND, width + 2 * AROUND)))
    fy, fx = np.meshgrid(np.fft.fftfreq(spectrum.shape[0]), np.fft.fftfreq(spectrum.shape[1]), indexing="ij")
    smooth = spectrum * np.exp(-((np.hypot(fx, fy) / 0.08) ** 2))

    def picture(shift_px: float) -> np.ndarray:
        found = np.fft.ifft2(smooth * np.exp(2j * np.pi * fx * shift_px)).real
        return (1 + 0.3 * found / found.std()).astype(np.float32)[AROUND:-AROUND, AROUND:-AROUND]

    here, moved = picture(0.0), picture(near_shift_px)
    tops_lefts = np.stack(np.meshgrid(np.arange(3), np.arange(4), indexing="ij"), axis=-1).reshape(-1, 2) * TILE
    spectra = wide_spectra(here, tops_lefts)
    shift = np.zeros((len(tops_lefts), 2))
    relief = 5
    shift[relief, 0] = near_shift_px
    there = np.stack([
        (moved if k == relief else here)[top : top + TILE, left : left + TILE]
        for k, (top, left) in enumerate(tops_lefts)
    ])  # fmt: skip
    there += rng.normal(0, 1e-3, there.shape).astype(np.float32)
    return TileAgreement(
        tops_lefts,
        tops_lefts[:, ::-1] + (TILE - 1) / 2,
        shift,
        np.ones(len(shift)),
        spectra,
        there,
        1.0,
        1.0,
        np.ones((height, width), bool),
        np.zeros((height, width), bool),
        4,
        np.ones((WIDE, WIDE // 2 + 1)),
        1,
    )


def _field_of(shift_px: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The shift field at the centres of tiles, and its standard deviation, from the measured shifts of tiles."""
    some = replace(_agreement(0.0, rng), centres_px=CENTRES_PX, shift_px=shift_px, precision=np.ones(len(shift_px)))
    field, _, std_px = _shift_field(some, np.ones(len(shift_px), bool))
    return field.at(CENTRES_PX), std_px


@pytest.mark.parametrize("size_px", [0.0, 0.1, 0.4])
def test_the_field_follows_a_smooth_residual(rng: np.random.Generator, size_px: float) -> None:
    """With a residual the error stays below the noise of tiles, and without one it stays far below."""
    true = size_px * np.sin(2 * np.pi * CENTRES_PX / (9 * SPACING_PX)) + 0.001 * CENTRES_PX
    errors, deviations = [], []
    for _ in range(30):
        found, std_px = _field_of(true + rng.normal(0, 0.1, true.shape), rng)
        errors.append(found - true)
        deviations.append(std_px)
    error_px, std_px = (float(np.sqrt(np.mean(np.square(all_)))) for all_ in (errors, deviations))
    assert error_px < (0.09 if size_px else 0.04)
    assert 0.5 < error_px / std_px < 1.6, "the standard deviation does not match the error of the field"


def test_one_outlier_tile_does_not_distort_the_field(rng: np.random.Generator) -> None:
    """A tile 3 px off moves the field beside it by less than 0.1 px."""
    measured = rng.normal(0, 0.05, CENTRES_PX.shape)
    moved = measured.copy()
    moved[50] += 3.0
    assert np.abs(_field_of(moved, rng)[0] - _field_of(measured, rng)[0]).max() < 0.1


def test_displaced_relief_weighs_little(rng: np.random.Generator) -> None:
    """A tile that fits only with its own shift distorts the picture: it weighs little, the others as before."""
    agreement = _agreement(1.0, rng)
    trust, _ = _trust(agreement, np.zeros_like(agreement.shift_px), 0.02, 1e-4)
    near = trust[TILE + 16 : 2 * TILE - 16, TILE + 16 : 2 * TILE - 16]
    far = trust[:, 3 * TILE + 16 : -16]
    assert far.mean() > 0.9
    assert near.mean() < 0.5 * far.mean()


def test_a_shift_that_noise_explains_costs_no_weight(rng: np.random.Generator) -> None:
    """If shifts scatter as much anyway, a tile's own shift is no sign of relief."""
    agreement = _agreement(0.05, rng)
    field = np.zeros_like(agreement.shift_px)
    uncertain, certain = (_trust(agreement, field, noise_px, 1e-4)[0] for noise_px in (0.1, 0.0))
    near = np.s_[TILE + 16 : 2 * TILE - 16, TILE + 16 : 2 * TILE - 16]
    assert uncertain[near].mean() > certain[near].mean()
    assert uncertain[near].mean() > 0.9


@pytest.mark.parametrize("frequency", [0.1, 0.3, 0.4])
def test_the_error_of_cubic_interpolation_is_known(frequency: float) -> None:
    """Waves read by OpenCV at 16 shifts differ from true ones by the expected power, and less with eight points."""
    x = np.arange(400, dtype=np.float32)[None]
    wave, error = np.cos(2 * np.pi * frequency * x).astype(np.float32), {}
    for reading in (cv2.INTER_CUBIC, cv2.INTER_LANCZOS4):
        left = [
            (cv2.remap(wave, x + shift, np.zeros_like(x), reading) - np.cos(2 * np.pi * frequency * (x + shift)))[
                :, 8:-8
            ]
            for shift in (np.arange(16, dtype=np.float32) + 0.5) / 16
        ]
        error[reading] = 2 * float(np.mean(np.square(left)))
    assert error[cv2.INTER_CUBIC] == pytest.approx(np.interp(frequency, *_cubic_error()), rel=0.05, abs=2e-4)
    assert error[cv2.INTER_LANCZOS4] < error[cv2.INTER_CUBIC]


def test_only_detail_above_the_noise_needs_better_interpolation() -> None:
    """A picture with steep power or much noise is read equally well with four points."""
    blank = unknown_picture()
    edges = replace(blank, signal=1e-1 * blank.frequency**-2.0, noise=np.full_like(blank.noise, 0.05))
    assert is_detailed(edges)
    assert not is_detailed(replace(edges, noise=100 * edges.noise))
    assert not is_detailed(replace(edges, passed=np.exp(-((blank.frequency / 0.1) ** 2))))
