"""Exposures of frames other than the logged ones: those of other rows of the table, or ones that follow the brightness.

A frame whose exposure time changes unlogged is brighter or darker than its logged exposure × ISO says.  Its light over
that product, up to a common factor, is then the factor on its exposure time:

    light / (exposure · ISO)  ∝  own exposure / logged exposure
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.capture.records import Frame
from virest.inference.tracking import TrackPair

ROWS_LATE = (1, -1, 2, -2)
"""Rows by which a table of exposures may lag (+) or lead (−) the movie."""
LEAST_GAIN_STD = 0.05
"""Relative deviation of exposures from the logged ones that matters: half a pixel of a path of 10 px."""


@dataclass(frozen=True, slots=True)
class OwnExposures:
    """The frames' own exposures: those of other rows of the table, or the logged ones times a factor each."""

    rows_late: int = 0
    gain: tuple[float, ...] = ()
    """(frames,) factors on the exposure times by movie index; empty: none."""
    p_value: float | None = None
    """Of the points' better agreement with exposures that follow the brightness; None: the delay of frames that they
    replace has one."""

    def __bool__(self) -> bool:
        return bool(self.rows_late or self.gain)

    @classmethod
    def stated_by(cls, profile: CameraProfile) -> OwnExposures:
        """Those of a profile."""
        return cls(profile.extensions.exposures_late_frames, profile.extensions.exposure_gain)

    def on(self, profile: CameraProfile) -> CameraProfile:
        """A profile that gives the frames these exposures, in addition to its own changes."""
        ext = profile.extensions
        rows, gain = ext.exposures_late_frames + self.rows_late, ext.exposure_gain
        if self.gain:
            gain = tuple((ext.exposure_gain_of(range(len(self.gain))) * np.array(self.gain)).tolist())
        return profile.with_extensions(exposures_late_frames=rows, exposure_gain=gain)

    def of(self, frames: Sequence[Frame]) -> tuple[Frame, ...]:
        """All frames of a movie, with these exposure times, and the ISO values of the rows that they are taken from.

        Frames before the first or after the last row get the nearest one.
        """
        if not self:
            return tuple(frames)
        sources = np.clip(np.arange(len(frames)) + self.rows_late, 0, len(frames) - 1)
        gains = (*self.gain, *[1.0] * len(frames))
        own = ((frames[int(k)], gain) for k, gain in zip(sources, gains, strict=False))
        return tuple(
            replace(frame, exposure_s=source.exposure_s and source.exposure_s * gain, iso=source.iso)
            for frame, (source, gain) in zip(frames, own, strict=True)
        )


AS_LOGGED = OwnExposures()
"""No other exposures."""


def unlogged_log_light(
    frames: Sequence[Frame], pairs: Sequence[TrackPair], curve: ResponseCurve, known: Array | None = None
) -> Array:
    """Log light (frames,) over the logged exposure × ISO, by movie index, from the brightness of tracked frames.

    frames: all of the movie.  pairs: of consecutive frames, in order.  known: values measured otherwise, which those of
    frames with NaN are chained to.  None: each run of pairs has a median of 0.  NaN: frames that no pair connects to a
    known one, and frames without an exposure.
    """
    logged = np.log([(frame.exposure_s or np.nan) * (frame.iso or 1.0) for frame in frames])
    steps = [
        (pair.first, pair.second, pair.levels.log_light(curve) - (logged[pair.second] - logged[pair.first]))
        for pair in pairs
    ]
    if known is not None:
        return _chained(known, steps)
    begins = sorted({first for first, _, _ in steps} - {second for _, second, _ in steps})
    log_light = np.full(len(frames), np.nan)
    log_light[begins] = 0.0
    log_light = _chained(log_light, steps)
    for begin, end in pairwise([*begins, len(frames)]):
        run = slice(begin, end)
        if not np.isnan(log_light[run]).all():
            log_light[run] -= np.nanmedian(log_light[run])
    return log_light


def by_brightness(frames: Sequence[Frame], pairs: Sequence[TrackPair], curve: ResponseCurve) -> OwnExposures:
    """Exposures that follow the brightness of tracked frames, with a mean factor of 1; those of other frames stay."""
    gain = np.exp(np.nan_to_num(unlogged_log_light(frames, pairs, curve)))
    return OwnExposures(gain=tuple((gain / gain.mean()).tolist()))


def _chained(log_light: Array, steps: Sequence[tuple[int, int, float]]) -> Array:
    """Log light with the unknown values of frames next to known ones, forwards and then backwards."""
    chained = log_light.copy()
    for start, end, step in [*steps, *((second, first, -step) for first, second, step in reversed(steps))]:
        if np.isnan(chained[end]):
            chained[end] = chained[start] + step
    return chained
