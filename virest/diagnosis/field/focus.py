"""A focus that moves, from the spectra of the same patches in two frames.

Two frames with Gaussian blurs of variance u and v, px², differ in the log of their power by 4π² f² (v − u) beside what
their motion predicts.  A scene of soft edges is the same in both frames and cancels.  Frames a tenth of a second apart
are compared with near and far ones, so that their differences determine the variance over time up to a constant, which
is that of the sharpest frames.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from virest.arrays import Array, Mask
from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.capture.join import median_period_s
from virest.capture.records import Capture
from virest.diagnosis.field.blur import MIN_GAIN, MIN_SIZE_PX, blur_field, blur_finding
from virest.diagnosis.field.forms import TIME
from virest.diagnosis.field.screening import MAX_P
from virest.diagnosis.findings import BLUR, FieldFinding, HeldOutGain
from virest.diagnosis.local_blur import (
    LENS_SIGMA_PX,
    LENS_STD_PX,
    BlurObservations,
    Reader,
    added_variance,
    pictures_of,
    predicted_blur,
)
from virest.diagnosis.local_blur_model import fitted_width
from virest.diagnosis.local_blur_spectra import (
    SECTORS,
    SeenFrame,
    SpectrumRatios,
    bin_count,
    join_ratios,
    observe_pair,
    ring_of_bin,
)
from virest.diagnosis.photometry_patches import predicted_points
from virest.image_formation.turning_camera import turning_camera
from virest.inference.chance import chi2_tail, ratio_tail
from virest.inference.robust import robust_std
from virest.motion.trajectory import Trajectory

log = logging.getLogger(__name__)

CODING_PX2 = 2 * LENS_SIGMA_PX * LENS_STD_PX
"""Standard deviation, px², of a frame's blur by coding alone."""
LEAST_TILES, LEAST_BINS, LEAST_IN_BIN = 5, 4, 3
"""Fewest tiles of a pair, bins of a tile, and tiles in which a bin of a pair is measured."""
STEP_S, MOST_TIMES = 0.1, 100
"""Spacing of the compared frames: a focus motor takes 0.1 to 0.5 s for a move; and their largest number."""
APART = 1, 3, 9
"""Distances of compared frames, in steps: near pairs follow the motion, far ones keep errors from adding up."""
LEAST_AS_DEFOCUS = 0.55
"""Part of the changes that must look like a defocus.  Five simulated phones whose focus moves have 0.71 to 0.87, three
with unlogged exposures or a temporal denoiser 0.18 to 0.43."""
NARROWEST = 0.2
"""Part of the edges that may be narrower than the blur of the sharpest frames, by noise."""


@dataclass(frozen=True, slots=True)
class FocusOverTime:
    """What the spectra of a whole capture show of a moving focus."""

    finding: FieldFinding | None
    """None: it rests."""


@dataclass(frozen=True, slots=True)
class _Pairs:
    """Differences of the frames' blur in pairs of frames."""

    times_s: Array
    """(n, 2) timestamps, camera clock."""
    change_px2: Array
    """(n,) variance of the second frame's blur less that of the first."""
    std_px2: Array
    """(n,) its standard deviation."""


@dataclass(frozen=True, slots=True)
class _Tiles:
    """The same in each tile of the picture."""

    times_s: Array
    x_px: Array
    change_px2: Array
    bins_px2: Array
    """(n, b) in each ring and sector; NaN: not measured."""

    def pairs(self, use: Mask | slice = slice(None)) -> _Pairs:
        """Medians over the tiles of each pair of frames."""
        times_s, pair = np.unique(self.times_s[use], axis=0, return_inverse=True)
        change = self.change_px2[use]
        parts = [change[pair.ravel() == k] for k in range(len(times_s))]
        enough = np.array([len(part) >= LEAST_TILES for part in parts], bool)
        parts = [part for part, yes in zip(parts, enough, strict=True) if yes]
        scatter = np.median([robust_std(part) for part in parts]) if parts else 0.0
        std = np.hypot(scatter / np.sqrt([len(part) for part in parts]), np.sqrt(2) * CODING_PX2)
        return _Pairs(times_s[enough], np.array([np.median(part) for part in parts]), np.asarray(std, float))


@dataclass(frozen=True, slots=True)
class _OverTime:
    """Variances of the frames' blur, fitted to pairs."""

    times_s: Array
    variance_px2: Array
    """(k,) up to a constant."""
    std_px2: Array
    p_value: float
    """Probability of such differences without any change."""

    def changes(self, pairs: _Pairs) -> Array:
        """Change (n,) in each pair."""
        at = np.interp(pairs.times_s, self.times_s, self.variance_px2)
        return np.asarray(at[:, 1] - at[:, 0])


def blur_fields(
    seen: BlurObservations,
    profile: CameraProfile,
    trajectory: Trajectory,
    capture: Capture,
    by_spectra: FocusOverTime | None = None,
) -> tuple[list[FieldFinding], CameraProfile]:
    """All blur fields that edges and spectra support, and the profile with them.

    by_spectra: that of :func:`moving_focus`.  It takes precedence over a blur of the edges over time, which coding of
    long blurs and denoising cause too, and a logged focus distance over both.
    """
    by_edges = blur_field(seen, profile, trajectory, capture)
    covariates = () if by_edges is None else by_edges[0].covariates
    if by_edges is None or (covariates == (TIME,) and by_spectra is not None):
        found, own = [], profile
    else:
        found, own = [by_edges[0]], by_edges[1]
    moving = None if by_spectra is None else by_spectra.finding
    if moving is None or covariates == ("focus",):
        return found, own
    (field,) = moving.fields
    own = own.with_extensions(defocus_sigma_px=_even_px(seen, profile, trajectory, field))
    return [*found, moving], own.with_fields([*own.fields, field])


def _even_px(seen: BlurObservations, profile: CameraProfile, trajectory: Trajectory, field: Field) -> float:
    """Defocus of the sharpest frames: that of the narrowest edges, since soft content is wider.

    The profile's if it is 0, or if there are too few edges.
    """
    edges, stated_px = seen.edges, profile.extensions.defocus_sigma_px
    if not stated_px or not seen.edges_determined:
        return stated_px
    motion_px = predicted_blur(seen, profile, trajectory).motion_px
    moved_px = field.at_time(edges.stamp_s)[:, 0]
    left = edges.width_px**2 - fitted_width(motion_px, moved_px, LENS_SIGMA_PX) ** 2
    even_px = float(np.sqrt(max(np.quantile(left, NARROWEST), 0.0)))
    return even_px if even_px > MIN_SIZE_PX and seen.allow(even_px) else 0.0


def moving_focus(
    gray: Reader, seen: BlurObservations, profile: CameraProfile, trajectory: Trajectory, capture: Capture
) -> FocusOverTime | None:
    """The blur over time that spectra of frames support; None where they were not compared, or the capture is too long.

    Further frames are read only if the pairs that were measured for the exposure differ, or widths of edges change.
    """
    first = _tiles(seen, profile, trajectory).pairs()
    squares = float(np.sum((first.change_px2 / first.std_px2) ** 2))
    differ = len(first.change_px2) > 0 and chi2_tail(squares, len(first.change_px2)) <= MAX_P
    wanted = _frames(capture)
    if profile.over_time("blur") or len(wanted) > MOST_TIMES:
        return None
    if not differ:
        by_edges = blur_field(seen, profile, trajectory, capture)
        if by_edges is None or by_edges[0].covariates != (TIME,):
            return None
    ratios = _compared(gray, wanted, capture, profile, trajectory)
    tiles = _tiles(replace(seen, ratios=ratios), profile, trajectory)
    found = _fitted(tiles.pairs())
    return None if found is None else FocusOverTime(_finding(tiles, found, seen, capture))


def _finding(tiles: _Tiles, found: _OverTime, seen: BlurObservations, capture: Capture) -> FieldFinding | None:
    """The finding, if the changes are significant, look like a defocus, and hold in the other half of the picture."""
    if found.p_value > MAX_P:
        return None
    lowest = np.argmin(found.variance_px2)
    alike = found.variance_px2 - found.variance_px2[lowest] < 2 * np.hypot(found.std_px2, found.std_px2[lowest])
    variance = np.maximum(found.variance_px2 - found.variance_px2[alike].mean(), 0.0)
    sigma = np.sqrt(np.where(variance < MIN_SIZE_PX**2, 0.0, variance))
    as_defocus = _part_as_defocus(tiles)
    log.debug(
        "focus over time: p %.2g, blur up to %.2f px, %.2f of it as a defocus", found.p_value, sigma.max(), as_defocus
    )
    if as_defocus < LEAST_AS_DEFOCUS:
        return None
    held_out = _held_out(tiles)
    if not sigma.any() or held_out is None or held_out.after > (1 - MIN_GAIN) * held_out.before:
        return None
    by_coding = 0.5 * seen.damping_std * sigma  # what survives coding scales all differences
    std = np.hypot(found.std_px2 / (2 * np.maximum(sigma, MIN_SIZE_PX)), by_coding)
    values, deviations = (tuple((float(value),) for value in column) for column in (sigma, std))
    field = Field("blur", ("time",), (tuple(found.times_s.tolist()),), values, deviations, capture.stamp_0_ns)
    return blur_finding(field, held_out, found.p_value, (), "frames")


def _frames(capture: Capture) -> list[int]:
    """Movie indices of the frames to compare."""
    usable = [f for f in capture.frames if f.exposure_s and (f.skip_reason is None or f.only_startup)]
    period_s = median_period_s(np.array([frame.time_s for frame in usable]))
    return [frame.index for frame in usable][:: max(round(STEP_S / period_s), 1) if period_s > 0 else 1]


def _compared(
    gray: Reader, wanted: Sequence[int], capture: Capture, profile: CameraProfile, trajectory: Trajectory
) -> SpectrumRatios:
    """Spectrum ratios of frames with those before them."""
    camera = turning_camera(trajectory, profile)

    def expected(first: SeenFrame, second: SeenFrame) -> Callable[[Array], Array]:
        return lambda points_px: predicted_points(points_px, first.recent[0], second.recent[0], camera)

    kept: deque[SeenFrame] = deque(maxlen=APART[-1])
    pairs = []
    for frame in pictures_of(gray, wanted, capture.frames):
        others = [kept[-apart] for apart in APART if apart <= len(kept)]
        pairs += [observe_pair(other, frame, profile.curve, expected(other, frame)) for other in others]
        kept.append(frame)
    return join_ratios(pairs)


def _tiles(seen: BlurObservations, profile: CameraProfile, trajectory: Trajectory) -> _Tiles:
    """The change of the blur in each tile with enough bins."""
    change = added_variance(seen, profile, trajectory)
    enough = np.isfinite(change).sum(axis=1) >= LEAST_BINS
    change, ratios = change[enough], seen.ratios
    medians = np.nanmedian(change, axis=1)
    return _Tiles(ratios.stamp_s[enough, :, 0], ratios.points_px[enough, 0, 0], medians, change)


def _part_as_defocus(tiles: _Tiles) -> float:
    """Part of the changes that all directions and frequencies share: near 1 for a defocus, less for other changes.

    In log power a defocus grows as f², the same in all directions.  Motion changes one direction, as a tensor
    u + v cos 2θ + w sin 2θ over the direction θ of the frequency, with least value u − √(v² + w²).  Two pictures in
    one, as a temporal denoiser leaves of things that move, lose as much in the lower ring as in the upper one.
    """
    sector, ring = np.arange(bin_count()) % SECTORS, ring_of_bin()
    angle = (sector + 0.5) * (2 * np.pi / SECTORS)
    terms = np.column_stack([ring == 0, ring == 1, np.cos(angle), np.sin(angle)]).astype(float)
    times_s, pair = np.unique(tiles.times_s, axis=0, return_inverse=True)
    shared, whole = 0.0, 0.0
    for k in range(len(times_s)):
        bins = tiles.bins_px2[pair.ravel() == k]
        count = np.isfinite(bins).sum(axis=0)
        shown = count >= LEAST_IN_BIN
        if len(bins) < LEAST_TILES or np.linalg.matrix_rank(terms[shown]) < terms.shape[1]:
            continue
        weight = np.sqrt(count[shown])
        found = np.linalg.lstsq(terms[shown] * weight[:, None], np.nanmedian(bins[:, shown], axis=0) * weight)[0]
        mean = found[:2].mean()
        least = np.min(np.sign(mean) * found[:2]) - np.hypot(*found[2:])
        shared, whole = shared + max(least, 0.0) * abs(mean), whole + mean**2
    return float(shared / whole) if whole else 0.0


def _fitted(pairs: _Pairs) -> _OverTime | None:
    """Variances of all compared frames by least squares; errors beyond the stated ones count as noise in an F test."""
    times_s, which = np.unique(pairs.times_s, return_inverse=True)
    which = which.reshape(-1, 2)
    numbers, freedom = len(times_s) - 1, len(which) - len(times_s) + 1
    if numbers < 1 or freedom < 1:
        return None
    unit = np.eye(len(times_s))
    rows, target = (unit[which[:, 1]] - unit[which[:, 0]]) / pairs.std_px2[:, None], pairs.change_px2 / pairs.std_px2
    # the mean is open, and frames that nothing connects stay near it
    inverse = np.linalg.inv(rows.T @ rows + unit / (MIN_SIZE_PX**2 * len(times_s)) ** 2)
    variance = inverse @ (rows.T @ target)
    left = target - rows @ variance
    excess = max(float(left @ left) / freedom, 1.0)
    ratio = max(float(target @ target - left @ left), 0.0) / numbers / excess
    centred = np.eye(len(times_s)) - 1 / len(times_s)
    std = np.sqrt(excess * np.diag(centred @ inverse @ centred))
    return _OverTime(times_s, np.asarray(variance), std, ratio_tail(ratio, numbers, freedom))


def _held_out(tiles: _Tiles) -> HeldOutGain | None:
    """Rms over pairs, px at a blur of 1 px, of what one half of the picture shows beside a fit to the other half."""
    right = tiles.x_px > np.median(tiles.x_px)
    halves = [tiles.pairs(side) for side in (right, ~right)]
    folds = []
    for pairs, judged in (halves, halves[::-1]):
        found = _fitted(pairs)
        if found is None or not len(judged.change_px2):
            return None
        left = judged.change_px2 - found.changes(judged)
        before, after = (float(np.sqrt(np.mean(one**2))) / 2 for one in (judged.change_px2, left))
        folds.append((before, after, 0.0))
    return replace(HeldOutGain.of_folds(BLUR, folds), noise=None)
