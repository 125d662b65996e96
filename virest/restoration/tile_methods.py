"""Methods that restore a picture tile by tile: linear filters, and the hyper-Laplacian by half-quadratic splitting."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np

from virest.image_formation.blur import Image
from virest.restoration import tiles
from virest.restoration.blurred import BlurredPicture, luma_of, reduced
from virest.restoration.clipped_light import measured_part
from virest.restoration.colour import with_colour
from virest.restoration.deconvolution import LEVELS_PER_UNIT, shrinkage_levels
from virest.restoration.row_chunks import RowRenderer, bands
from virest.restoration.settings import FEW_ITERATIONS, RestorationSettings
from virest.restoration.statistics.on_tiles import on_spectrum
from virest.restoration.statistics.records import PictureStatistics
from virest.restoration.tile_layout import (
    FULL_MARGIN,
    THIN_MARGIN,
    THINNEST_MARGIN,
    UNEVEN_NOISE_TO_SIGNAL,
    Surroundings,
    border_noise_to_signal,
    in_tiles,
    join_neighbours,
    luma_tiles,
    noise_to_signal,
)

REDUCTIONS = (1.5, 4 / 3)
"""Size reductions tried with few iterations; they lose nothing where noise hides all finer detail."""
FEW_SCALE = 0.6
"""Factor on the gradient unit with few iterations: they do not converge for weak gradients, and this compensates."""
FIRST_BETA, LAST_BETA, FEW_BETAS = 0.2, 12.0, (0.25, 1.0)
"""First and last penalty of the splitting, in units of the gradients' own scale, and all of those with few iterations.
"""
RESIDUAL_SHARE = 0.05
"""Fraction of the picture's power in the residual: texture too faint for the sparse prior."""
LINEAR_SHARE = 0.5
"""Weight of the linear filter for a picture whose power lies at few frequencies: the prior turns its waves to steps."""


def by_tile_filter(blurred: BlurredPicture, settings: RestorationSettings) -> RowRenderer:
    """Luma by one linear filter per tile."""
    deconvolution = luma_tiles(blurred, settings)
    projected = _projected_luma(blurred, deconvolution, settings)
    factors = _tile_factors(blurred, deconvolution, settings)
    sharp = deconvolution.blend(cv2.multiply(s, f) for s, f in zip(projected, factors, strict=True))
    return with_colour(blurred, deconvolution.restore_highlights(sharp), settings)


def _tile_factors(
    blurred: BlurredPicture, deconvolution: tiles.TileDeconvolution, settings: RestorationSettings
) -> Iterator[Image]:
    """Each tile's factor after conj(K) for the method in the settings; by default Wiener with the measured N / S."""
    statistics = blurred.statistics
    match settings.deblur:
        case "inverse":
            return deconvolution.filters(tiles.inverse_filter)
        case "wiener":
            weight = statistics.frequency
            flat = float(np.sum(statistics.noise * weight) / np.sum(statistics.signal * weight))
            ratio = np.full((deconvolution.size,) * 2, settings.strength**2 * flat, np.float32)
            ratio[0, 0] = 0.0  # keep the mean unchanged
            return deconvolution.filters(lambda power: tiles.wiener_filter(power, ratio))
    ratio = noise_to_signal(deconvolution, settings, statistics.between_rings_and_level)
    least = border_noise_to_signal(deconvolution, luma_of(blurred.light), blurred.longest_px)
    return map(tiles.wiener_filter, deconvolution.powers, in_tiles(ratio, least))


def _projected_luma(
    blurred: BlurredPicture, deconvolution: tiles.TileDeconvolution, settings: RestorationSettings
) -> Image:
    """Spectra of Kᵀ g, (tiles, size, size), neighbours included; clipped highlights are removed from the tiles."""
    luma, holes = luma_of(blurred.light), blurred.holes
    if holes is not None:
        numbers = deconvolution.touched(holes)
        kernels = blurred.field(deconvolution.grid.centres_px[numbers]).arrays(positive=True)
        deconvolution.remove_highlights(numbers, kernels, luma, measured_part(holes), float(luma.max()))
    if blurred.neighbours:
        ratio = noise_to_signal(deconvolution, settings, blurred.statistics)
        join_neighbours(blurred, deconvolution, [luma], lambda neighbour: [neighbour.light], ratio)
    return deconvolution.back_projected(luma)


def by_tile_hyper_laplacian(blurred: BlurredPicture, settings: RestorationSettings) -> RowRenderer:
    """Hyper-Laplacian for the luma, Wiener filter with the measured N / S for the colour differences."""
    times = _reduction(blurred.statistics, settings)
    if times == 1.0:
        around = THIN_MARGIN if settings.iterations <= FEW_ITERATIONS else FULL_MARGIN
        return with_colour(blurred, tile_hyper_laplacian(blurred, settings, around), settings)
    small = replace(settings, tile_px=round(settings.tile_px / times))
    return with_colour(blurred, tile_hyper_laplacian(reduced(blurred, times), small, THINNEST_MARGIN), settings)


def _reduction(statistics: PictureStatistics, settings: RestorationSettings) -> float:
    """How many times smaller to restore the luma: as much as loses no detail above the noise."""
    few = settings.iterations <= FEW_ITERATIONS
    return next((times for times in REDUCTIONS if few and statistics.finest < 0.5 / times), 1.0)


def tile_hyper_laplacian(
    blurred: BlurredPicture, settings: RestorationSettings, around: Surroundings = FULL_MARGIN
) -> Image:
    """The sharp luma, (height, width): Krishnan & Fergus 2009, each step over all tiles.

    With few iterations, texture that the prior removed as noise is not restored afterwards.  The result is blended with
    the linear filter's, which weighs each frequency by its own N / S, the more the noise hides the gradients.
    """
    deconvolution = luma_tiles(blurred, settings, around)
    statistics, few = blurred.statistics, settings.iterations <= FEW_ITERATIONS
    unit = statistics.gradient_scale * (FEW_SCALE if few else 1.0)
    least = border_noise_to_signal(deconvolution, luma_of(blurred.light), blurred.longest_px)
    trusts = [(unit / (settings.strength * noise)) ** 2 for noise in _tile_noise(blurred, least)]
    gradients = tiles.gradient_power(deconvolution.size)
    projected = _projected_luma(blurred, deconvolution, settings)
    start = statistics.between_rings_and_level if few else statistics
    ratio = noise_to_signal(deconvolution, settings, start)
    linear = sharp = deconvolution.blend(deconvolution.solutions(projected, in_tiles(ratio, least)))
    extra_noise = _extra_noise(statistics, deconvolution.size)
    before, scale = sharp, blurred.slopes(1, settings.tile_px, sharp.shape[::-1]) * np.float32(1.0 / unit)
    betas = beta_schedule(settings.iterations)
    for step, beta in enumerate(betas):
        ahead, before = _extrapolated(sharp, before, step), sharp
        pull = _gradient_targets(ahead, scale, shrinkage_levels(beta))
        pulled = deconvolution.pulled(projected, pull, [beta / trust for trust in trusts])
        priors = {trust: gradients * np.float32(beta / trust) + extra_noise for trust in set(trusts)}
        solved = deconvolution.solutions(pulled, (priors[trust] for trust in trusts))
        if step == len(betas) - 1 and not few:
            solved = _with_residual(deconvolution, projected, solved, statistics, least)
        sharp = deconvolution.blend(solved)
    share = max(LINEAR_SHARE * statistics.unevenness, statistics.below_noise if few else 0.0)
    if share:
        sharp = cv2.addWeighted(linear, share, sharp, 1 - share, 0.0)
    return deconvolution.restore_highlights(sharp)


def _extra_noise(statistics: PictureStatistics, size: int) -> Image | np.float32:
    """N / S per frequency beyond that of the rings: the gradient prior passes noise at frequencies a grating lacks."""
    if not statistics.unevenness:
        return np.float32(0)
    rings = on_spectrum(statistics, statistics.noise_to_signal, size, by_place=False)
    places = on_spectrum(statistics, statistics.noise_to_signal, size)
    least = np.float32(UNEVEN_NOISE_TO_SIGNAL * statistics.unevenness)
    extra_noise = cv2.max(cv2.subtract(np.maximum(places, least), rings), 0.0)
    extra_noise[0, 0] = 0.0
    return extra_noise


def _extrapolated(sharp: Image, before: Image, step: int) -> Image:
    """The picture extrapolated along its last step, further as the iterations converge: it saves a third of them.

    Nesterov 1983's momentum, as Beck and Teboulle 2009 (doi:10.1137/080716542) apply it to shrinkage.
    """
    momentum = step / (step + 1)
    return cv2.addWeighted(sharp, 1 + momentum, before, -momentum, 0.0) if momentum else sharp


def _tile_noise(blurred: BlurredPicture, least: Sequence[float]) -> list[float]:
    """Noise, grey levels, to assume in each tile.

    least: of :func:`border_noise_to_signal`.  Where a tile reaches beyond the picture, whose content there is a rough
    guess, a weakly regularised inverse would carry the guess's error many blur lengths inwards.
    """
    statistics = blurred.statistics
    power = np.interp(2.0 / max(blurred.longest_px, 4.0), statistics.frequency, statistics.signal)
    return [max(statistics.noise_levels, float(np.sqrt(ratio * power))) for ratio in least]


def _with_residual(
    deconvolution: tiles.TileDeconvolution,
    projected: Image,
    solved: Iterable[Image],
    statistics: PictureStatistics,
    least: Sequence[float],
) -> Iterator[Image]:
    """Each tile's spectrum with the fine texture added that the prior removed as noise.

    That is the residual g − K f, filtered as a picture of little power.  least: N / S of each tile.  A spectrum is
    valid until the next.
    """
    ratio = on_spectrum(statistics, statistics.noise_to_signal / RESIDUAL_SHARE, deconvolution.size)
    left, divisor = np.empty((2, *ratio.shape), np.float32)
    ratios = in_tiles(ratio, [lowest / RESIDUAL_SHARE for lowest in least])
    for spectrum, back, power, own in zip(solved, projected, deconvolution.powers, ratios, strict=True):
        cv2.subtract(back, cv2.multiply(power, spectrum, left), left)
        cv2.divide(left, cv2.add(power, own, divisor), left)
        yield cv2.add(spectrum, left, left)


def _gradient_targets(sharp: Image, scale: Image, factors: Image) -> Image:
    """Dᵀ w, with w the shrunk gradients; factors: w / v at |v| · LEVELS_PER_UNIT, from :func:`shrinkage_levels`.

    It works band by band, so that the data stay in the cache.
    """
    pull = np.zeros_like(sharp)
    for rows in bands(len(sharp)):
        band, steepness, pulled = (p[rows.start : rows.stop + 1] for p in (sharp, scale, pull))
        _pull_along(band[:-1], band[1:], steepness[:-1], factors, pulled[:-1], pulled[1:])
        band, steepness, pulled = (p[rows] for p in (sharp, scale, pull))
        _pull_along(band[:, :-1], band[:, 1:], steepness[:, :-1], factors, pulled[:, :-1], pulled[:, 1:])
    return pull


def _pull_along(
    behind: Image, ahead: Image, steepness: Image, factors: Image, pull_behind: Image, pull_ahead: Image
) -> None:
    """Add the shrunk gradient between adjacent pixels to the one ahead, and subtract it from the one behind."""
    if not len(behind):
        return
    gradient = cv2.subtract(ahead, behind)
    level = cv2.convertScaleAbs(cv2.multiply(gradient, steepness), alpha=LEVELS_PER_UNIT)
    gradient = cv2.multiply(gradient, cv2.LUT(level, factors))
    pull_ahead += gradient
    pull_behind -= gradient


def beta_schedule(iterations: int, first: float = FIRST_BETA) -> tuple[float, ...]:
    """Increasing penalties of the half-quadratic splitting, in units of the gradients' own scale."""
    if iterations <= FEW_ITERATIONS:
        return FEW_BETAS[-max(iterations, 1) :]
    return tuple(float(b) for b in np.geomspace(first, LAST_BETA, iterations))
