"""One picture, deblurred: linear light in, linear light out, by the method that the settings name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.camera.response import ResponseCurve
from virest.degradation.blur import Image, SpaceVariantBlur, TileGrid, tile_grid
from virest.degradation.kernels import KernelField
from virest.restoration import tiles
from virest.restoration.deconvolution import (
    difference,
    difference_adjoint,
    hyper_laplacian,
    richardson_lucy,
    shrinkage_table,
)
from virest.restoration.settings import RestorationSettings
from virest.restoration.statistics import PictureStatistics, on_spectrum

CLIP_MARGIN_LEVELS = 3.0
"""A clipped pixel comes back from the movie's codec up to about this many levels below the top."""
FieldMaker = Callable[[NDArray[np.float64]], KernelField]


@dataclass(frozen=True, slots=True)
class BlurredPicture:
    """A recorded picture and what restoring it needs to know."""

    light: list[Image]
    """Linear light of each channel, (height, width)."""
    slope: list[Image]
    """Grey levels per unit of light, smoothed over the neighbourhood, of each channel."""
    censored: list[Image | None]
    """1.0 where a channel's light could not be measured; None: nowhere."""
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
    smooth = cv2.blur(picture, (reach, reach))
    slope = list(cv2.split(cv2.LUT(smooth, curve.slope_table())))
    mask_table = curve.censored_table(CLIP_MARGIN_LEVELS).astype(np.uint8)
    mask = cv2.LUT(picture, mask_table)
    censored = [c.astype(np.float32) if c.any() else None for c in cv2.split(mask)]
    return BlurredPicture(light, slope, censored, *statistics, field, longest_px)


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


def _tile_deconvolution(blurred: BlurredPicture, side: int, overlap: int) -> tiles.TileDeconvolution:
    height, width = blurred.light[0].shape
    grid = tile_grid(height, width, side, overlap)
    field = blurred.field(grid.centres_px)
    margin = int(np.clip(blurred.longest_px, 16, 96))
    return tiles.TileDeconvolution(grid, field.arrays(), margin)


def _by_tile_filter(blurred: BlurredPicture, settings: RestorationSettings) -> list[Image]:
    deconvolution = _tile_deconvolution(blurred, settings.tile_px, settings.tile_px // 4)
    factors = [_tile_factors(deconvolution, settings, s) for s in (blurred.statistics, blurred.chroma)]
    sharp = []
    for plane, factor in zip(_to_opponents(blurred.light), (factors[0], factors[1], factors[1]), strict=True):
        spectra = deconvolution.back_projected(plane)
        sharp.append(deconvolution.blend([s * f for s, f in zip(spectra, factor, strict=True)]))
    return _kept_near_censored(_from_opponents(sharp), blurred)


def _tile_factors(
    deconvolution: tiles.TileDeconvolution, settings: RestorationSettings, statistics: PictureStatistics
) -> list[Image]:
    """What follows conj(K) in each tile: by the method that the settings name, the measured N / S one by default."""
    match settings.deblur:
        case "inverse":
            return deconvolution.filters(tiles.inverse_filter)
        case "wiener":
            weight = statistics.frequency
            flat = float(np.sum(statistics.noise * weight) / np.sum(statistics.signal * weight))
            return deconvolution.filters(lambda power: tiles.wiener_filter(power, settings.strength**2 * flat))
    ratio = on_spectrum(statistics, settings.strength**2 * statistics.noise_to_signal, deconvolution.size)
    return deconvolution.filters(lambda power: tiles.wiener_filter(power, ratio))


def _to_opponents(light: list[Image]) -> list[Image]:
    """Luma and two colour differences of linear light: noise and detail differ between them, so must the filters."""
    red, green, blue = light
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    return [luma.astype(np.float32), red - luma, blue - luma]


def _from_opponents(planes: list[Image]) -> list[Image]:
    luma, red, blue = planes
    green = luma - (0.299 / 0.587) * red - (0.114 / 0.587) * blue
    return [luma + red, green.astype(np.float32), luma + blue]


def _kept_near_censored(sharp: list[Image], blurred: BlurredPicture) -> list[Image]:
    return [
        _keep_near_censored(s, light, censored, blurred.longest_px)
        for s, light, censored in zip(sharp, blurred.light, blurred.censored, strict=True)
    ]


def _keep_near_censored(sharp: Image, light: Image, censored: Image | None, reach_px: float) -> Image:
    """A linear filter cannot leave pixels out: fade to the recorded light where clipped ones would have rung."""
    if censored is None:
        return sharp
    reach = 2 * int(np.ceil(reach_px)) + 3
    near = cv2.dilate(censored, np.ones((reach, reach), np.uint8))
    fade = cv2.blur(near, (reach, reach))
    return sharp + fade * (light - sharp)


def _by_tile_hyper_laplacian(blurred: BlurredPicture, settings: RestorationSettings) -> list[Image]:
    """Hyper-Laplacian for the luma, measured Wiener for the colour differences, which hold little detail."""
    deconvolution = _tile_deconvolution(blurred, settings.tile_px, settings.tile_px // 4)
    first = _tile_factors(deconvolution, settings, blurred.statistics)
    colour = _tile_factors(deconvolution, settings, blurred.chroma)
    luma, *differences = _to_opponents(blurred.light)
    sharp = [_tile_hyper_laplacian(deconvolution, luma, first, blurred, settings)]
    for plane in differences:
        spectra = deconvolution.back_projected(plane)
        sharp.append(deconvolution.blend([s * f for s, f in zip(spectra, colour, strict=True)]))
    return _kept_near_censored(_from_opponents(sharp), blurred)


def _tile_hyper_laplacian(
    deconvolution: tiles.TileDeconvolution,
    plane: Image,
    first: list[Image],
    blurred: BlurredPicture,
    settings: RestorationSettings,
) -> Image:
    unit = blurred.statistics.gradient_scale
    trust = (unit / (settings.strength * blurred.statistics.noise_levels)) ** 2
    gradients = tiles.gradient_power(deconvolution.size)
    projected = deconvolution.back_projected(plane)
    sharp = deconvolution.blend([s * f for s, f in zip(projected, first, strict=True)])
    scale = blurred.slope[1] * np.float32(1.0 / unit)
    for beta in _beta_schedule(settings.iterations):
        weight = np.float32(trust / beta)
        factors = deconvolution.filters(lambda power, w=weight: 1.0 / (power * w + gradients))
        pull = _gradient_targets(sharp, scale, shrinkage_table(beta))
        sharp = _tile_solve(deconvolution, projected, pull, factors, weight)
    return sharp


def _gradient_targets(sharp: Image, scale: Image, table: Image) -> Image:
    """Dᵀ w, with w the shrunk gradients."""
    pull = np.zeros_like(sharp)
    for axis in (0, 1):
        gradient = difference(sharp, axis)
        index = np.minimum(np.abs(gradient) * scale * np.float32(len(table) / 8.0), len(table) - 1).astype(np.int32)
        pull += difference_adjoint(gradient * np.take(table, index), axis)
    return pull


def _tile_solve(
    deconvolution: tiles.TileDeconvolution, projected: list[Image], pull: Image, factors: list[Image], trust: np.float32
) -> Image:
    padded = deconvolution.padded(pull, cv2.BORDER_CONSTANT)
    spectra = [
        (trust * back + cv2.dft(deconvolution.periodic(padded, top, left))) * factor
        for (top, left), back, factor in zip(deconvolution.grid.corners(), projected, factors, strict=True)
    ]
    return deconvolution.blend(spectra)


def _beta_schedule(iterations: int) -> tuple[float, ...]:
    """Rising penalties of the half-quadratic splitting, in units of the gradients' own scale."""
    return tuple(float(b) for b in np.geomspace(0.05, 8.0, max(iterations, 1)))


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
    for light, censored in zip(blurred.light, blurred.censored, strict=True):
        weight = np.ones_like(light) if censored is None else 1 - censored
        start = _extended(light, operator.border)
        result = richardson_lucy(light, operator.apply, operator.adjoint, start, weight, settings.iterations)
        sharp.append(_inner(result, operator.border))
    return sharp


def _by_global_hyper_laplacian(blurred: BlurredPicture, settings: RestorationSettings) -> list[Image]:
    operator = _whole_operator(blurred)
    statistics = blurred.statistics
    unit = statistics.gradient_scale
    first = _by_tile_filter(blurred, RestorationSettings("fast", "gradient-wiener", tile_px=settings.tile_px))
    betas = _beta_schedule(settings.iterations)
    sharp = []
    for light, slope, censored, start in zip(blurred.light, blurred.slope, blurred.censored, first, strict=True):
        weight = slope if censored is None else slope * (1 - censored)
        result = hyper_laplacian(
            light,
            operator.apply,
            operator.adjoint,
            _extended(start, operator.border),
            weight,
            _extended(slope, operator.border),
            (settings.strength * statistics.noise_levels) ** -2,
            unit,
            betas,
            settings.inner_iterations,
        )
        sharp.append(_inner(result, operator.border))
    return sharp


def _inner(picture: Image, border: int) -> Image:
    return picture[border:-border, border:-border]
