"""Local blur as measured in the frames and as the profile predicts it (forward_model, section 9 (c)).

Two complementary measurements:

- *spectra* of the same patch in two frames: their ratio depends on motion alone, so it gives the exposure time;
- *edges* along which the image hardly moved: their width depends on lens and defocus alone.

A decoded movie differs from what the sensor recorded.  H.264 predicts a frame from the one before and codes only part
of the difference, so a frame also shows some of the blur of its predecessors (MEMORY, fitted freely); quantisation
damps the ratios (DAMPING, known to DAMPING_STD).  Both were measured on movies of known blur.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np
from numpy.typing import NDArray

from virest.arrays import Array, Index, Mask
from virest.camera.profile import CameraProfile
from virest.camera.response import ResponseCurve
from virest.capture.records import Capture, Frame
from virest.diagnosis.isolated_steps import IsolatedSteps, isolated_steps, join_steps
from virest.diagnosis.local_blur_edges import EdgeWidths, evenly_isolated, isolated_edges, join_edges, observe_picture
from virest.diagnosis.local_blur_model import across, fitted_width, path_tensors, predicted_ratios, transfers
from virest.diagnosis.local_blur_spectra import (
    BANDS_PER_PX,
    MEMORY,
    SeenFrame,
    SpectrumRatios,
    join_ratios,
    observe_pair,
    ring_of_bin,
)
from virest.image_formation.light import defocus_px
from virest.inference.edges import EdgeSettings, find_edges
from virest.inference.parallel import ParallelMap, one_by_one
from virest.inference.robust import CAUCHY, cauchy_weight, robust_std
from virest.inference.spectral_limit import allow, widest_gaussian_px
from virest.inference.time_blocks import even_blocks
from virest.motion.trajectory import Trajectory

Stream = Iterable[tuple[int, NDArray[np.uint8] | None]]
Reader = Callable[[Sequence[int]], Stream]

LENS_SIGMA_PX = 0.70
"""Width of a sharp edge in a decoded frame, from lens, pixel and coding; defocus is the excess."""
LENS_STD_PX = 0.13
"""Its standard deviation: coding at 0.15 bit per pixel alone widens edges from 0.70 to 0.85 px."""
DAMPING = (0.92, 0.84)
"""Fraction of a log ratio that survives coding, per frequency ring."""
DAMPING_STD = 0.13
"""Its standard deviation: more is lost under defocus, less at 1 bit per pixel and for strong edges."""
STARVED_BITS, STARVED_STD = 0.1, 0.35
"""Bits per pixel at which half of the remaining log ratio is lost too, and standard deviation of this between scenes
(natural logarithm).  At 0.1 to 0.15 bit per pixel, 0.5 to 0.9 of what survives at higher rates was left; at 0.2 bit,
0.9."""
STILL_PX = 0.4
"""Measure edges across which the path's standard deviation is below this."""
MIN_TRANSFER = 0.25
"""Bins with a predicted |K|² below this are noise."""
PARTS = 4
"""Number of parts in which the frames may be measured in parallel."""
PAIR_FRAMES = 4
"""Frames from the first to the second of a pair: the camera has rotated, but the patch is still in view."""
MIN_EDGES = 40
"""Fewest isolated edges from which a defocus is estimated."""
MIN_ACCEPTED = 0.004
"""Minimum fraction of the strong gradients that are isolated steps; a smooth scene has almost none."""
MIN_RATIOS = 400
"""Fewest measured bins from which an exposure is estimated."""
MIN_CONTRAST = 0.06
"""Minimum rms of the predicted log ratios: frames with equal motion do not determine the exposure."""
BLOCKS = 8
"""Number of time blocks; measurements within a block share errors."""


@dataclass(frozen=True, slots=True)
class BlurObservations:
    """Local blur measured in the frames; residuals are ordered edges first, then the bins of the ratios."""

    edges: EdgeWidths
    ratios: SpectrumRatios
    isolated: int
    """Number of the edges' candidates that are isolated steps, whether or not the image moved across them."""
    bits_per_px: float = inf
    """Bit rate of the movie."""
    steps: IsolatedSteps | None = None
    """Isolated steps of the same frames, in grey levels; None: not measured."""
    widest_px: tuple[float, ...] = ()
    """Widest Gaussian blur that the spectrum of each frame allows, px."""

    def __len__(self) -> int:
        return len(self.edges) + int(self.valid.sum())

    @property
    def valid(self) -> Mask:
        """(n, b) mask of the measured bins of each tile."""
        return np.isfinite(self.ratios.log_ratio)

    @property
    def time_s(self) -> Array:
        """Timestamp of each residual's frame, camera clock; for ratios, of the pair's first frame."""
        tile, _ = np.nonzero(self.valid)
        return np.concatenate([self.edges.stamp_s, self.ratios.stamp_s[tile, 0, 0]])

    @property
    def is_edge(self) -> Mask:
        """Mask of the residuals that are edges."""
        return np.arange(len(self)) < len(self.edges)

    @property
    def surviving(self) -> float:
        """Fraction of DAMPING that survives at this bit rate."""
        return 1.0 / (1.0 + (STARVED_BITS / self.bits_per_px) ** 3)

    @property
    def damping_std(self) -> float:
        """Relative standard deviation of what survives coding."""
        return float(np.hypot(DAMPING_STD, 3.0 * (1.0 - self.surviving) * STARVED_STD))

    def allow(self, gaussian_px: float) -> bool:
        """Whether frames show no finer detail than a Gaussian blur of all of them leaves."""
        return allow(self.widest_px, self.bits_per_px, gaussian_px)

    @property
    def edges_determined(self) -> bool:
        """Whether the scene has enough isolated steps to distinguish a defocused image from smooth content."""
        return len(self.edges) >= MIN_EDGES and self.isolated >= MIN_ACCEPTED * self.edges.candidates


def frames_to_read(capture: Capture, pairs: int = 22) -> list[int]:
    """Movie indices for :func:`look_for_blur`: pairs of frames, evenly spaced over the capture."""
    known = {f.index for f in capture.frames if f.exposure_s and (f.skip_reason is None or f.only_startup)}
    starts = [k for k in sorted(known) if k + PAIR_FRAMES in known]
    picked = np.linspace(0, len(starts) - 1, min(pairs, len(starts))).round().astype(int)
    return sorted({starts[i] + step for i in picked for step in (0, PAIR_FRAMES)})


def look_for_blur(
    gray: Reader,
    capture: Capture,
    profile: CameraProfile,
    trajectory: Trajectory,
    each: ParallelMap = one_by_one,
) -> BlurObservations:
    """Measure the frames of :func:`frames_to_read` part by part; the result is that of one stream.

    Profile and trajectory only select the edges with little motion and the frequencies that motion leaves above the
    noise.
    """
    wanted, curve = frames_to_read(capture), profile.curve
    parts = _parts(wanted)
    early = [[k for k in wanted if part[0] - PAIR_FRAMES <= k < part[0]] if part else [] for part in parts]
    calls = [(gray, [*lead, *part], len(lead), capture.frames, curve) for lead, part in zip(early, parts, strict=True)]
    seen = each(_measured, calls)
    edges: list[EdgeWidths] = [one for part in seen for one in part[0]]
    pairs: list[SpectrumRatios] = [one for part in seen for one in part[1]]
    steps: list[IsolatedSteps] = [one for part in seen for one in part[2]]
    widest_px = tuple(one for part in seen for one in part[3])
    found = _chosen(join_edges(edges), join_ratios(pairs), profile, trajectory, capture.bits_per_px)
    return replace(found, steps=join_steps(steps), widest_px=widest_px)


def look_for_steps(gray: Reader, capture: Capture, each: ParallelMap = one_by_one) -> IsolatedSteps:
    """The isolated steps in the frames of :func:`frames_to_read`, as :func:`look_for_blur` finds them."""
    parts = _parts(frames_to_read(capture))
    seen = each(_steps_of_part, [(gray, part, capture.frames) for part in parts])
    return join_steps([one for part in seen for one in part])


def _parts(wanted: Sequence[int]) -> list[list[int]]:
    return [part.tolist() for part in np.array_split(np.array(wanted, np.intp), PARTS)]


def _steps_of_part(gray: Reader, wanted: list[int], frames: Sequence[Frame]) -> list[IsolatedSteps]:
    return [
        isolated_steps(picture, frames[index], *find_edges(picture, EdgeSettings()))
        for index, picture in gray(wanted)
        if picture is not None and frames[index].exposure_s
    ]


def _measured(
    gray: Reader, wanted: list[int], lead: int, frames: Sequence[Frame], curve: ResponseCurve
) -> tuple[list[EdgeWidths], list[SpectrumRatios], list[IsolatedSteps], list[float]]:
    """Edges, spectrum ratios, steps and widest blurs of frames in ascending order.

    The first ``lead`` frames only serve as first of a pair.  At most PAIR_FRAMES + 1 frames are in memory.
    """
    only_paired = frozenset(wanted[:lead])
    edges: list[EdgeWidths] = []
    steps: list[IsolatedSteps] = []
    pairs: list[SpectrumRatios] = []
    widest_px: list[float] = []
    kept: dict[int, SeenFrame] = {}
    for seen in pictures_of(gray, wanted, frames):
        picture, frame = seen.picture, seen.recent[0]
        index = frame.index
        if index not in only_paired:
            found = find_edges(picture, EdgeSettings())
            edges.append(observe_picture(picture, frame, curve, *found))
            steps.append(isolated_steps(picture, frame, *found))
            widest_px.append(widest_gaussian_px(picture, curve))
        kept[index] = seen
        if index - PAIR_FRAMES in kept and index not in only_paired:
            pairs.append(observe_pair(kept[index - PAIR_FRAMES], kept[index], curve))
        kept = {k: seen for k, seen in kept.items() if k > index - PAIR_FRAMES}
    return edges, pairs, steps, widest_px


def pictures_of(gray: Reader, wanted: Sequence[int], frames: Sequence[Frame]) -> Iterator[SeenFrame]:
    """The pictures of frames with a known exposure, in order."""
    for index, picture in gray(wanted):
        if picture is not None and frames[index].exposure_s:
            yield SeenFrame(picture, _recent(frames, index))


def _recent(frames: Sequence[Frame], index: int) -> tuple[Frame, ...]:
    """A frame and the MEMORY − 1 before it, newest first; a frame without known times is replaced by the next one."""
    recent = [frames[index]]
    for k in range(index - 1, index - MEMORY, -1):
        known = k >= 0 and frames[k].exposure_s is not None and frames[k].skip_reason is None
        recent.append(frames[k] if known else recent[-1])
    return tuple(recent)


def _chosen(
    edges: EdgeWidths, ratios: SpectrumRatios, profile: CameraProfile, trajectory: Trajectory, bits_per_px: float
) -> BlurObservations:
    still = evenly_isolated(edges.select(_motion_px(edges, profile, trajectory) < STILL_PX), MIN_EDGES)
    through = transfers(ratios, profile, trajectory)[:, :, 0].min(axis=1)
    ratio = np.where(through > MIN_TRANSFER, ratios.log_ratio, np.nan)
    isolated = len(isolated_edges(edges))
    return BlurObservations(still, replace(ratios, log_ratio=ratio), isolated, bits_per_px)


@dataclass(frozen=True, slots=True)
class PredictedBlur:
    """Blur that the paths of a profile predict; defocus, lens and damping are not included."""

    motion_px: Array
    """(edges,) standard deviation of the path across each edge."""
    log_ratios: Array
    """(valid bins, MEMORY) log ratios of the spectra, of the frames themselves and of those before them."""


def predicted_blur(observations: BlurObservations, profile: CameraProfile, trajectory: Trajectory) -> PredictedBlur:
    """Predict blur from the paths of a profile."""
    return PredictedBlur(
        _motion_px(observations.edges, profile, trajectory),
        predicted_ratios(observations.ratios, profile, trajectory)[observations.valid],
    )


def residuals(
    observations: BlurObservations,
    profile: CameraProfile,
    trajectory: Trajectory,
    lens_sigma_px: float = LENS_SIGMA_PX,
    damping: float = 1.0,
    predicted: PredictedBlur | None = None,
) -> Array:
    """Measured − predicted blur, px (n,): edge widths, then spectra converted to motion widths.

    A log ratio changes by 2 (2π f)² τ δτ with the path's standard deviation τ; it is converted to δτ at τ = 1 px.
    All effects come from the profile; lens_sigma_px and damping are nuisances of the measurement.  predicted: the blur
    of its paths, if already computed.
    """
    predicted = predicted or predicted_blur(observations, profile, trajectory)
    widths = fitted_width(predicted.motion_px, defocus_px(profile, observations.edges.points_px), lens_sigma_px)
    off = _ratio_residuals(observations, predicted.log_ratios, damping)
    return np.concatenate([observations.edges.width_px - widths, off])


def added_variance(observations: BlurObservations, profile: CameraProfile, trajectory: Trajectory) -> Array:
    """Variance (n, b), px², of the second frame's blur less the first's, beside the path's, in each bin of each tile.

    A log ratio changes by (2π f)² per px², and a residual in px by half of that at τ = 1 px.  NaN: not measured.
    """
    predicted = predicted_ratios(observations.ratios, profile, trajectory)[observations.valid]
    share = observations.surviving * np.array(DAMPING)[ring_of_bin()]
    change = np.full(observations.valid.shape, np.nan)
    change[observations.valid] = 2 * _ratio_residuals(observations, predicted, 1.0)
    return change / share


def _ratio_residuals(observations: BlurObservations, log_ratios: Array, damping: float) -> Array:
    valid = observations.valid
    ring = np.broadcast_to(ring_of_bin(), valid.shape)[valid]
    share = damping * observations.surviving * np.array(DAMPING)[ring]
    own, *earlier = (log_ratios * share[:, None]).T
    off = observations.ratios.log_ratio[valid] - own
    scale = 1.0 / (2.0 * (2 * np.pi * (np.array(BANDS_PER_PX[:-1]) + np.array(BANDS_PER_PX[1:])) / 2) ** 2)
    return (off - _remembered(off, np.stack(earlier, -1) - own[:, None])) * scale[ring]


def _remembered(off: Array, columns: Array) -> Array:
    """Contribution of earlier frames' blur to the log ratios: robust least squares for the share of each."""
    weight = np.ones(len(off))
    fitted = np.zeros(len(off))
    for _ in range(4 if len(off) > 3 * columns.shape[1] else 0):
        root = np.sqrt(weight)
        shares = np.linalg.lstsq(columns * root[:, None], off * root, rcond=None)[0]
        fitted = columns @ np.clip(shares, 0.0, 0.5)
        weight = cauchy_weight((off - fitted) ** 2, CAUCHY * max(robust_std(off - fitted), 1e-9))
    return fitted


def _motion_px(edges: EdgeWidths, profile: CameraProfile, trajectory: Trajectory) -> Array:
    tensors = path_tensors(edges.stamp_s, edges.exposure_s, edges.points_px, profile, trajectory)
    return np.sqrt(across(tensors, edges.normal))


def time_blocks(time_s: Array, count: int = BLOCKS) -> Index:
    """Block (n,) of each residual; each block has the same number of distinct timestamps."""
    stamps = np.unique(time_s)
    return even_blocks(np.searchsorted(stamps, time_s), len(stamps), count)
