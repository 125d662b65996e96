"""One picture, deblurred: linear light in, linear light out, by the method that the settings name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.degradation.blur import Image, SpaceVariantBlur, TileGrid, tile_grid
from virest.degradation.kernels import KernelField
from virest.restoration import tiles
from virest.restoration.deconvolution import (
    LEVELS_PER_UNIT,
    hyper_laplacian,
    richardson_lucy,
    shrinkage_levels,
)
from virest.restoration.settings import RestorationSettings
from virest.restoration.statistics import PictureStatistics, on_spectrum

CLIPPED_LEVELS = 2.0
"""A pixel this close to the top was clipped."""
PULLED_DOWN_LEVELS = 8.0
"""Next to a clipped pixel, the movie's codec returns clipped ones up to about this far below the top."""
COLOUR_SCALE = 2.0
BORDER_NOISE_TO_SIGNAL = 0.003
"""Least N / S of tiles that see beyond the picture."""
RESIDUAL_SHARE = 0.1
"""Part of the picture's power that a residual holds: texture too faint for the sparse prior."""
SlopeMaker = Callable[[int], Image]
FieldMaker = Callable[[NDArray[np.float64]], KernelField]


@dataclass(frozen=True, slots=True)
class BlurredPicture:
    """A recorded picture and what restoring it needs to know."""

    light: list[Image]
    """Linear light of each channel, (height, width)."""
    slopes: SlopeMaker
    """Grey levels per unit of light of a channel, by its number, smoothed over the neighbourhood, (height, width)."""
    dark: list[Image | None]
    """1.0 where a channel's light was too little to be measured; None: nowhere."""
    clipped: list[Image | None]
    """1.0 where a channel's light was too much to be measured; None: nowhere."""
    statistics: PictureStatistics
    """Of the luma."""
    chroma: PictureStatistics
    field: FieldMaker
    """Kernels at given tile centres."""
    longest_px: float
    """Longest blur path in the picture."""


def blurred_picture(
    picture: NDArray[np.uint8],
    curve: ResponseCurve,
    statistics: tuple[PictureStatistics, PictureStatistics],
    field: FieldMaker,
    longest_px: float,
) -> BlurredPicture:
    """Take a picture (height, width, 3) through the inverse of the exposure curve."""
    light = list(cv2.split(cv2.LUT(picture, curve.linear_table())))
    reach = 2 * int(np.ceil(longest_px / 2)) + 3
    channels = cv2.split(picture)
    dark = [_dark(channel, curve) for channel in channels]
    clipped = [_clipped(channel, curve) for channel in channels]

    def slopes(channel: int) -> Image:
        return cv2.LUT(cv2.blur(channels[channel], (reach, reach)), curve.slope_table())

    return BlurredPicture(light, slopes, dark, clipped, *statistics, field, longest_px)


def _dark(channel: NDArray[np.uint8], curve: ResponseCurve) -> Image | None:
    """1.0 where the channel is below the curve's A."""
    dark = cv2.LUT(channel, (curve.censored_table() & ~curve.clipped_table()).astype(np.uint8))
    return dark.astype(np.float32) if dark.any() else None


def _clipped(channel: NDArray[np.uint8], curve: ResponseCurve) -> Image | None:
    """1.0 where the channel is clipped, and where its neighbours are and the codec has pulled it down a little."""
    clipped = cv2.LUT(channel, curve.clipped_table(CLIPPED_LEVELS).astype(np.uint8))
    if not clipped.any():
        return None
    near = cv2.dilate(clipped, np.ones((5, 5), np.uint8))
    return (near & cv2.LUT(channel, curve.clipped_table(PULLED_DOWN_LEVELS).astype(np.uint8))).astype(np.float32)


def deblur(blurred: BlurredPicture, settings: RestorationSettings) -> list[Image]:
    """The sharp picture's light, channel by channel, at the kernels' anchor."""
    match settings.deblur:
        case "inverse" | "wiener" | "gradient-wiener":
            return _by_tile_filter(blurred, settings)
        case "hyper-laplacian":
            return _by_tile_hyper_laplacian(blurred, settings)
        case "richardson-lucy":
            return _by_richardson_lucy(blurred, settings)
        case "hyper-laplacian-global":
            return _by_global_hyper_laplacian(blurred, settings)
    raise ValueError(f"no deblurring method '{settings.deblur}'")


# ── tile by tile ─────────────────────────────────────────────────────────────────────────────────────────────────


def _tile_deconvolution(blurred: BlurredPicture, side: int, scale: float = 1.0) -> tiles.TileDeconvolution:
    """Tiles over the picture, or over one that is ``scale`` times smaller, with kernels to its measure."""
    height, width = (int(np.ceil(length / scale)) for length in blurred.light[0].shape)
    grid = tile_grid(height, width, int(side / scale), int(side / scale) // 4)
    field = blurred.field((grid.centres_px + 0.5) * scale - 0.5)
    kernels = replace(field, paths_px=field.paths_px / scale).arrays()
    return tiles.TileDeconvolution(grid, kernels, int(np.clip(blurred.longest_px / scale, 16 / scale, 96)))


def _by_tile_filter(blurred: BlurredPicture, settings: RestorationSettings) -> list[Image]:
    streaks = _streaks(blurred)
    luma, *differences = _to_opponents(_without_streaks(blurred.light, streaks))
    deconvolution = _tile_deconvolution(blurred, settings.tile_px)
    sharp = _filtered(deconvolution, luma, _tile_factors(deconvolution, settings, blurred.statistics))
    colour = _filtered_colour(blurred, differences, settings)
    return _with_streaks(_from_opponents([sharp, *colour]), blurred.light, streaks)


def _filtered(deconvolution: tiles.TileDeconvolution, plane: Image, factors: list[Image]) -> Image:
    spectra = deconvolution.back_projected(plane)
    return deconvolution.blend([np.multiply(s, f, out=s) for s, f in zip(spectra, factors, strict=True)])


def _filtered_colour(blurred: BlurredPicture, differences: list[Image], settings: RestorationSettings) -> list[Image]:
    """The colour differences, filtered at half size: a movie stores no more of them."""
    height, width = differences[0].shape
    deconvolution = _tile_deconvolution(blurred, settings.tile_px, COLOUR_SCALE)
    factors = _tile_factors(deconvolution, settings, blurred.chroma, COLOUR_SCALE)
    size = (deconvolution.grid.width, deconvolution.grid.height)
    small = [cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in differences]
    return [
        cv2.resize(_filtered(deconvolution, plane, factors), (width, height), interpolation=cv2.INTER_LINEAR)
        for plane in small
    ]


def _tile_factors(
    deconvolution: tiles.TileDeconvolution,
    settings: RestorationSettings,
    statistics: PictureStatistics,
    scale: float = 1.0,
) -> list[Image]:
    """What follows conj(K) in each tile: by the method that the settings name, the measured N / S one by default."""
    match settings.deblur:
        case "inverse":
            return deconvolution.filters(tiles.inverse_filter)
        case "wiener":
            weight = statistics.frequency
            flat = float(np.sum(statistics.noise * weight) / np.sum(statistics.signal * weight))
            ratio = np.full((deconvolution.size,) * 2, settings.strength**2 * flat, np.float32)
            ratio[0, 0] = 0.0  # the mean is no noise
            return deconvolution.filters(lambda power: tiles.wiener_filter(power, ratio))
    noise_to_signal = settings.strength**2 * statistics.noise_to_signal
    ratio = on_spectrum(statistics, noise_to_signal, deconvolution.size, scale)
    guarded = np.maximum(ratio, BORDER_NOISE_TO_SIGNAL)
    guarded[0, 0] = ratio[0, 0]
    return deconvolution.filters(
        lambda power: tiles.wiener_filter(power, ratio), lambda power: tiles.wiener_filter(power, guarded)
    )


def _to_opponents(light: list[Image]) -> list[Image]:
    """Luma and two colour differences of linear light: noise and detail differ between them, so must the filters."""
    red, green, blue = light
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    return [luma.astype(np.float32), red - luma, blue - luma]


def _from_opponents(planes: list[Image]) -> list[Image]:
    luma, red, blue = planes
    green = luma - (0.299 / 0.587) * red - (0.114 / 0.587) * blue
    return [luma + red, green.astype(np.float32), luma + blue]


def _streaks(blurred: BlurredPicture) -> Image | None:
    """1 where a clipped pixel's light may have gone or come from along the blur path, falling to 0 around it."""
    masks = [c for c in blurred.clipped if c is not None]
    if not masks:
        return None
    return cv2.GaussianBlur(cv2.dilate(np.maximum.reduce(masks), _path_reach(blurred)), (0, 0), 1.5)


def _path_reach(blurred: BlurredPicture) -> NDArray[np.uint8]:
    """The blur path at the picture's middle, to both sides, as a structuring element."""
    height, width = blurred.light[0].shape
    path = blurred.field(np.array([[(width - 1) / 2, (height - 1) / 2]])).arrays(positive=True)[0]
    return (path + path[::-1, ::-1] > 2e-3).astype(np.uint8)


def _without_streaks(light: list[Image], streaks: Image | None) -> list[Image]:
    """Clipped light is no linear blur, and a filter cannot leave pixels out: fill the streaks in from around them."""
    if streaks is None:
        return light
    known = 1 - np.minimum(streaks * 4, 1)
    return [_filled_in(plane, known) for plane in light]


def _filled_in(plane: Image, known: Image) -> Image:
    """Weighted means of what is known, over wider and wider neighbourhoods, at half the size."""
    height, width = plane.shape
    size = ((width + 1) // 2, (height + 1) // 2)
    weight = cv2.resize(known, size, interpolation=cv2.INTER_AREA)
    filled = cv2.resize(plane * known, size, interpolation=cv2.INTER_AREA)
    for side in (3, 9, 27, 81):
        near = cv2.blur(weight, (side, side))
        reached = near > 1e-2
        mean = np.where(reached, cv2.blur(filled, (side, side)) / np.maximum(near, 1e-2), 0)
        filled = filled + (1 - weight) * mean
        weight = np.where(reached, np.float32(1), weight)
    smooth = cv2.resize(filled.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return plane * known + (1 - known) * smooth


def _with_streaks(sharp: list[Image], light: list[Image], streaks: Image | None) -> list[Image]:
    """Put the recorded light back where the streaks were."""
    return sharp if streaks is None else [s + streaks * (p - s) for s, p in zip(sharp, light, strict=True)]


def _by_tile_hyper_laplacian(blurred: BlurredPicture, settings: RestorationSettings) -> list[Image]:
    """Hyper-Laplacian for the luma, measured Wiener for the colour differences, which hold little detail."""
    streaks = _streaks(blurred)
    luma, *differences = _to_opponents(_without_streaks(blurred.light, streaks))
    sharp = _tile_hyper_laplacian(blurred, luma, settings)
    colour = _filtered_colour(blurred, differences, settings)
    return _with_streaks(_from_opponents([sharp, *colour]), blurred.light, streaks)


def _tile_hyper_laplacian(blurred: BlurredPicture, plane: Image, settings: RestorationSettings) -> Image:
    deconvolution = _tile_deconvolution(blurred, settings.tile_px)
    first = _tile_factors(deconvolution, settings, blurred.statistics)
    statistics = blurred.statistics
    unit = statistics.gradient_scale
    noise = settings.strength * np.array([statistics.noise_levels, _border_noise(blurred)])
    trust, guarded = ((unit / noise) ** 2).astype(np.float32)
    gradients = tiles.gradient_power(deconvolution.size)
    projected = deconvolution.back_projected(plane)
    sharp = deconvolution.blend([s * f for s, f in zip(projected, first, strict=True)])
    scale = blurred.slopes(1) * np.float32(1.0 / unit)
    for beta in _beta_schedule(settings.iterations):
        weights = [(guarded if border else trust) / np.float32(beta) for border in deconvolution.at_border]
        factors = [1.0 / (p * w + gradients) for p, w in zip(deconvolution.powers, weights, strict=True)]
        pull = _gradient_targets(sharp, scale, shrinkage_levels(beta))
        sharp = _tile_solve(deconvolution, projected, pull, factors, weights)
    if settings.iterations > 2:
        sharp += _returned_residual(deconvolution, projected, sharp, statistics)
    return sharp


def _border_noise(blurred: BlurredPicture) -> float:
    """Noise to assume where tiles see beyond the picture, grey levels: what is guessed there is a rough guess.

    A weakly regularised inverse would carry the guess's error many blur lengths inwards.
    """
    statistics = blurred.statistics
    power = np.interp(2.0 / max(blurred.longest_px, 4.0), statistics.frequency, statistics.signal)
    return max(statistics.noise_levels, float(np.sqrt(BORDER_NOISE_TO_SIGNAL * power)))


def _returned_residual(
    deconvolution: tiles.TileDeconvolution, projected: list[Image], sharp: Image, statistics: PictureStatistics
) -> Image:
    """Fine texture that the prior took for noise: the residual g − K f, filtered as a picture of a tenth the power."""
    ratio = on_spectrum(statistics, statistics.noise_to_signal / RESIDUAL_SHARE, deconvolution.size)
    guarded = np.maximum(ratio, BORDER_NOISE_TO_SIGNAL / RESIDUAL_SHARE)
    factors = deconvolution.filters(lambda power: 1.0 / (power + ratio), lambda power: 1.0 / (power + guarded))
    padded = deconvolution.padded(sharp)
    spectra = [
        (back - power * cv2.dft(deconvolution.periodic(padded, top, left))) * factor
        for (top, left), back, power, factor in zip(
            deconvolution.grid.corners(), projected, deconvolution.powers, factors, strict=True
        )
    ]
    return deconvolution.blend(spectra)


def _gradient_targets(sharp: Image, scale: Image, factors: Image) -> Image:
    """Dᵀ w, with w the shrunk gradients; factors: w / v over |v| · 32, as :func:`shrinkage_levels` tabulates it."""
    pull = np.zeros_like(sharp)
    for ahead, behind in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        gradient = cv2.subtract(sharp[ahead], sharp[behind])
        level = cv2.convertScaleAbs(cv2.multiply(gradient, scale[behind]), alpha=LEVELS_PER_UNIT)
        gradient = cv2.multiply(gradient, cv2.LUT(level, factors))
        pull[ahead] += gradient
        pull[behind] -= gradient
    return pull


def _tile_solve(
    deconvolution: tiles.TileDeconvolution,
    projected: list[Image],
    pull: Image,
    factors: list[Image],
    weights: list[np.float32],
) -> Image:
    padded = deconvolution.padded(pull, cv2.BORDER_CONSTANT)
    spectra = []
    for (top, left), back, factor, weight in zip(
        deconvolution.grid.corners(), projected, factors, weights, strict=True
    ):
        spectrum = cv2.dft(deconvolution.periodic(padded, top, left))
        spectra.append(cv2.multiply(cv2.scaleAdd(back, float(weight), spectrum), factor))
    return deconvolution.blend(spectra)


def _beta_schedule(iterations: int) -> tuple[float, ...]:
    """Rising penalties of the half-quadratic splitting, in units of the gradients' own scale."""
    if iterations <= 2:
        return (0.2, 2.0)[-max(iterations, 1) :]
    return tuple(float(b) for b in np.geomspace(0.05, 12.0, iterations))


# ── over the whole picture ───────────────────────────────────────────────────────────────────────────────────────


def _whole_operator(blurred: BlurredPicture, positive: bool = False) -> SpaceVariantBlur:
    height, width = blurred.light[0].shape
    grid: TileGrid = tile_grid(height, width, 96, 32)
    return SpaceVariantBlur(grid, blurred.field(grid.centres_px).arrays(positive=positive))


def _extended(channel: Image, border: int) -> Image:
    return cv2.copyMakeBorder(channel, border, border, border, border, cv2.BORDER_REPLICATE)


def _by_richardson_lucy(blurred: BlurredPicture, settings: RestorationSettings) -> list[Image]:
    operator = _whole_operator(blurred, positive=True)
    sharp = []
    for light, dark, clipped in zip(blurred.light, blurred.dark, blurred.clipped, strict=True):
        weight = np.ones_like(light) - sum(mask for mask in (dark, clipped) if mask is not None)
        start = _extended(light, operator.border)
        result = richardson_lucy(light, operator.apply, operator.adjoint, start, weight, settings.iterations)
        sharp.append(_inner(result, operator.border))
    return sharp


def _by_global_hyper_laplacian(blurred: BlurredPicture, settings: RestorationSettings) -> list[Image]:
    """Hyper-Laplacian over the whole operator; censored pixels have no weight, but where all is clipped, as a bound."""
    operator = _whole_operator(blurred)
    statistics = blurred.statistics
    first = _by_tile_hyper_laplacian(blurred, replace(settings, iterations=4))
    reach = _path_reach(blurred) if any(c is not None for c in blurred.clipped) else None
    sharp = []
    for channel, (light, start) in enumerate(zip(blurred.light, first, strict=True)):
        slope = blurred.slopes(channel)
        weight, bound = _data_weight(slope, blurred.dark[channel], blurred.clipped[channel], reach)
        result = hyper_laplacian(
            light,
            operator.apply,
            operator.adjoint,
            _extended(start, operator.border),
            weight,
            _extended(slope, operator.border),
            (settings.strength * statistics.noise_levels) ** -2,
            statistics.gradient_scale,
            _beta_schedule(settings.iterations),
            settings.inner_iterations,
            bound,
        )
        inner = _inner(result, operator.border)
        sharp.append(inner if bound is None else np.where(bound > 0, np.maximum(inner, light), inner))
    return sharp


def _data_weight(
    slope: Image, dark: Image | None, clipped: Image | None, reach: NDArray[np.uint8] | None
) -> tuple[Image, Image | None]:
    """Weight of each pixel's light, and where it is only a lower bound: all along the blur path is clipped there."""
    weight = slope if dark is None else slope * (1 - dark)
    if clipped is None or reach is None:
        return weight, None
    bound = cv2.erode(clipped, reach)
    unseen = cv2.dilate(clipped, np.ones((3, 3), np.uint8)) - bound
    return weight * (1 - unseen), bound


def _inner(picture: Image, border: int) -> Image:
    return picture[border:-border, border:-border]
