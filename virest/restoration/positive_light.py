"""Restored light without negative values, made to agree with what was recorded.

A linear filter rings around edges, and the tone curve's steep slope at dark levels shows it as stripes beside a bright
thing.  Cutting negative light off makes its surroundings too bright.  Each of Richardson–Lucy's steps (Richardson 1972,
Lucy 1974) multiplies the light by what should be recorded over what it would record, spread back along the paths, and
leaves alone what agrees.  Light is counted from the curve's darkest, which may be below 0.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from virest.image_formation.blur import Image
from virest.restoration.blurred import BlurredPicture, block_means, luma_of
from virest.restoration.tile_layout import sampled_kernels

LIGHT_STEPS = 2
"""Number of steps.

The first gains 0.2 to 0.3 dB in saturated scenes, the second 0.05 to 0.1, two more as much again (three simulated
captures, 42 frames); where there is little colour, all gain 0.01 to 0.02.  With few iterations one is made."""
LEAST_LIGHT = 1e-6
"""Keeps divisors above 0; the darkest grey level is 3e-4."""


@dataclass(frozen=True, slots=True)
class PathBlur:
    """The blur along the paths of pictures (height, width[, 3]) of reduced size, and its transpose."""

    scale: int
    """How many times smaller than the recorded picture they are."""
    blur: Callable[[Image], Image]
    unblur: Callable[[Image], Image]


def without_negative_light(blurred: BlurredPicture, luma: Image, along: PathBlur, steps: int) -> Image:
    """Restored luma, perhaps at reduced size, without negative light, and as bright around it as before.

    The luma would still be recorded as with its negative light: where there is none, nothing changes.  Ringing beside a
    bright thing on dark ground shrinks to the ground's own light.  The steps work at the scale of ``along``.
    """
    light = luma - _darkest(blurred)
    positive = cv2.max(light, 0.0)
    least = _light_of_noise(blurred, blurred.statistics.noise_levels)
    small, seen = shrunk(positive, blurred, along.scale), along.blur(shrunk(light, blurred, along.scale))
    factor = _consistency_factor(small, cv2.max(seen, 0.0), along, least, steps)
    factor = cv2.resize(factor, luma.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return cv2.multiply(positive, factor) + _darkest(blurred)


def consistent_light(
    blurred: BlurredPicture,
    luma: Image,
    recorded: list[Image],
    restored: list[Image],
    along: PathBlur,
    scale: int,
    steps: int,
) -> list[Image]:
    """Restored light of the channels, (height, width) each, non-negative and consistent with what was recorded.

    A channel that is nearly dark, as red is on a green leaf, would be too bright, and striped.  The noise of the
    recorded light is added to both sides of the ratio; light that was not measured corrects nothing.  The luma,
    restored with a better prior, stays as it is.  All are ``scale`` times smaller than the picture; the steps work at
    the scale of ``along``, which may be coarser.
    """
    darkest, times = _darkest(blurred), along.scale // scale
    light = [cv2.max(channel - darkest, 0.0) for channel in restored]
    coarse, seen = (cv2.merge([block_means(channel, times) for channel in channels]) for channels in (light, recorded))
    noise = float(np.hypot(blurred.statistics.noise_levels, blurred.chroma.colour_noise_levels))
    measured = _measured(blurred, along.scale)
    factor = _consistency_factor(coarse, seen - darkest, along, _light_of_noise(blurred, noise), steps, measured)
    if times > 1:
        height, width = (times * length for length in factor.shape[:2])
        factor = cv2.resize(factor, (width, height), interpolation=cv2.INTER_LINEAR)[: len(luma), : luma.shape[1]]
    channels = [cv2.multiply(*planes) for planes in zip(light, cv2.split(factor), strict=True)]
    brighter = cv2.divide(cv2.max(luma - darkest, 0.0), cv2.max(luma_of(channels), LEAST_LIGHT))
    return [cv2.multiply(channel, brighter) + darkest for channel in channels]


def _consistency_factor(
    light: Image, seen: Image, along: PathBlur, least: float, steps: int, measured: Image | None = None
) -> Image:
    """What ``light`` is multiplied by so that it would be recorded as ``seen``: Richardson–Lucy steps.

    least: added to both sides of the ratio, in whose place nothing is known.  measured: 0 where nothing was recorded.
    """
    factor = np.ones_like(light)
    for _ in range(steps):
        ratio = cv2.divide(seen + least, along.blur(cv2.multiply(light, factor)) + least)
        if measured is not None:
            ratio = 1 + measured * (ratio - 1)
        factor = cv2.multiply(factor, along.unblur(ratio))
    return factor


def shrunk(luma: Image, blurred: BlurredPicture, scale: int) -> Image:
    """A luma of the recorded or of a reduced size at ``scale`` times fewer pixels than the recorded one."""
    height, width = blurred.light[0].shape
    if luma.shape == (height, width):
        return block_means(luma, scale)
    return cv2.resize(luma, (-(-width // scale), -(-height // scale)), interpolation=cv2.INTER_LINEAR)


def _darkest(blurred: BlurredPicture) -> np.float32:
    """The least light that the curve holds, at most 0."""
    return np.float32(min(blurred.curve.light_range[0], 0.0))


def _light_of_noise(blurred: BlurredPicture, noise_levels: float) -> float:
    """Light of the grey level that is as high as the noise."""
    table = blurred.curve.linear_table()
    return float(table[int(np.clip(np.rint(noise_levels), 1, 255))] - table[0])


def blur_along_paths(blurred: BlurredPicture, scale: int) -> PathBlur:
    """The blur of pictures (height, width[, 3]) ``scale`` times smaller than the recorded one, and its transpose.

    Instants are a pixel apart along the path; paths vary smoothly over the picture.
    """
    height, width = (-(-length // scale) for length in blurred.light[0].shape)
    _, _, recorded_px, recorded_sigma_px = sampled_kernels(blurred)
    paths_px, sigma_px = (recorded_px / scale).astype(np.float32), float(recorded_sigma_px.mean()) / scale
    count = int(np.clip(np.ceil(blurred.longest_px / scale), 2, paths_px.shape[2]))
    instants = ((np.arange(count) + 0.5) / count * paths_px.shape[2]).astype(int).tolist()
    own = np.stack(np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)), -1)
    moved = [cv2.resize(paths_px[:, :, k], (width, height), interpolation=cv2.INTER_LINEAR) for k in instants]
    ahead, behind = ([cv2.scaleAdd(shift, sign, own) for shift in moved] for sign in (1.0, -1.0))

    def gathered(picture: Image, sources: list[Image]) -> Image:
        whole = np.zeros_like(picture)
        for source in sources:
            cv2.accumulate(cv2.remap(picture, source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), whole)
        whole *= np.float32(1 / count)
        return cv2.GaussianBlur(whole, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE) if sigma_px else whole

    return PathBlur(scale, lambda picture: gathered(picture, ahead), lambda picture: gathered(picture, behind))


def _measured(blurred: BlurredPicture, scale: int) -> Image | None:
    """1.0 where all of a small pixel's light was measured, else 0.0, (height, width, 3); None: everywhere."""
    if all(mask is None for mask in (*blurred.clipped, *blurred.dark)):
        return None
    shape = block_means(blurred.light[0], scale).shape
    known = []
    for masks in zip(blurred.clipped, blurred.dark, strict=True):
        unknown = [block_means(mask, scale) for mask in masks if mask is not None]
        known.append(np.float32(functools.reduce(cv2.add, unknown, np.zeros(shape, np.float32)) == 0))
    return cv2.merge(known)
