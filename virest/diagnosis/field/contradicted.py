"""Intervals of the inertial log that only the points contradict, and the climb beside bridges over doubtful intervals.

A log can be wrong for a moment without a trace in itself: a program fills a gap with a smooth curve, a sensor clips
before its filter, a case is knocked.  The pairs of frames that see such an interval then have far larger residuals than
all others, and a rate that is free inside it removes them from points that took no part in its estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.capture.records import Capture
from virest.diagnosis.field.bridging import (
    LEAST_PAIRS_LEFT,
    Bridges,
    Doubtful,
    doubtful_pairs,
    pair_medians,
    removes_excess,
    with_bridges,
)
from virest.diagnosis.field.records import Distrusted
from virest.diagnosis.field.search import with_fields
from virest.diagnosis.geometric_evidence import Evidence, Model, make_evidence
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.inference.chance import chi2_below, normal_deviate, normal_tail
from virest.inference.doubtful_log import CONTRADICTED, Stretch, in_order
from virest.inference.observed_tracks import ObservedTracks
from virest.inference.robust import robust_std

FALSE_ALARM = 1e-3
"""False-alarm probability, per capture, of a pair that stands out; also that of a knot of a trial bridge."""
AT_LIMIT, LEAST_AT_LIMIT = 0.02, 3
"""Readings within this part of an axis's largest are at its limit; least number of intervals that reach it.  Those of
six shaken cameras lie there in 0.2 to 1 % of the time on each axis: an interval of 65 ms reaches one by chance in 7 to
10 % of all places, three intervals in 1 of 1000."""

Climb = Callable[[Evidence, Callable[[Model], Model] | None], GeometricVerdict]


def climb_with_bridges(
    observed: ObservedTracks, capture: Capture, start: CameraProfile, climb: Climb, known: Sequence[Stretch] = ()
) -> GeometricVerdict:
    """Climb without the pairs in doubtful intervals of the log, and bridge the intervals from their points.

    climb: the ladder, from evidence and the estimate of the bridges beside a model (None: there are none).  If the
    points contradict the log in further intervals, the ladder is climbed again without these.  known: intervals of
    which another climb found it.
    """
    doubtful = doubtful_pairs(observed, capture, start)
    if known:
        doubtful = Doubtful.over(in_order(*doubtful.stretches, *known), observed, start)
    found = _climbed(observed, capture, start, climb, doubtful)
    further = contradicted_stretches(found, capture, start)
    if not further:
        return found
    together = Doubtful.over(in_order(*doubtful.stretches, *further), observed, start)
    bridged = _climbed(observed, capture, start, climb, together)
    bridged.undoubted = found
    return bridged


def with_fields_or_bridges(found: GeometricVerdict, capture: Capture, start: CameraProfile) -> GeometricVerdict:
    """A verdict with the fields that its residuals support, without bridges that these make superfluous.

    A clock that is set, or a lens that is switched, moves points within a few pairs more than in all others, as a log
    does that is wrong for a moment.  The log is right if fields without bridges leave no interval that stands out, and
    remove most of what fields beside bridges do.
    """
    assert found.evidence is not None
    told, without = with_fields(found, found.evidence, capture), found.undoubted
    if without is None or without.evidence is None:
        return told
    plain = with_fields(without, without.evidence, capture)
    if not removes_excess(without.final_rms_px, plain.final_rms_px, told.final_rms_px):
        return told
    return told if contradicted_stretches(plain, capture, start) else plain


def known_stretches(found: GeometricVerdict) -> tuple[Stretch, ...]:
    """The intervals of the log that only a verdict's points contradict, and that it bridges."""
    told = [stretch for entry in found.fields if isinstance(entry, Distrusted) for stretch in entry.stretches]
    return tuple(stretch for stretch in told if stretch.kind == CONTRADICTED)


def _climbed(
    observed: ObservedTracks, capture: Capture, start: CameraProfile, climb: Climb, doubtful: Doubtful
) -> GeometricVerdict:
    evidence = make_evidence(capture.imu, doubtful.for_ladder(observed), start)
    bridges = Bridges.over(doubtful, observed, capture, start) if doubtful.stretches else None
    found = climb(evidence, None if bridges is None else bridges.refitted)
    found.evidence = evidence
    if bridges is not None:
        with_bridges(found, bridges, capture)
    return found


def contradicted_stretches(found: GeometricVerdict, capture: Capture, start: CameraProfile) -> list[Stretch]:
    """Intervals whose pairs stand out after a ladder, and where a free rate explains points that it was not fitted to.

    Each reaches from the last knot of a trial bridge that agrees with the log to the next that does.  Frames of a
    recorder's start-up, which are late, are no evidence against the log.
    """
    evidence, model = found.evidence, found.model
    assert evidence is not None
    observed = evidence.observed
    distance = evidence.distances(found.fit, found.table, found.fit.depth_spread_per_m)
    medians = pair_medians(distance, found.table, len(observed.pairs))
    late = {frame.index for frame in capture.frames if frame.only_startup}
    medians[[bool({pair.first, pair.second} & late) for pair in observed.pairs]] = np.nan
    spans = spans_of_outliers(observed, model, medians)
    if not spans:
        return []
    whole = Bridges.over(Doubtful.over(spans, observed, start), observed, capture, start)
    if (~whole.doubtful.hit).sum() < LEAST_PAIRS_LEFT:
        return []
    trimmed = whole.trimmed(model, chi2_below(1 - FALSE_ALARM, 3))
    if not trimmed:
        return []
    bridges = Bridges.over(Doubtful.over(trimmed, observed, start), observed, capture, start)
    convicted = bridges.held_out(found).convicted
    kept = [stretch for stretch, wrong in zip(trimmed, convicted, strict=True) if wrong]
    return [replace(stretch, limit_rad_s=_common_limit(capture.imu, kept)) for stretch in kept]


def _common_limit(imu: ImuSamples, stretches: list[Stretch]) -> float | None:
    """Smallest of the axes' largest readings that the intervals reach; None if an interval reaches none of them.

    A sensor that clips reads its limit in every one of them, blurred by its noise.
    """
    size = np.abs(imu.gyro_rad_s)
    largest = size.max(axis=0)
    reached = []
    for stretch in stretches:
        inside = (imu.time_s >= stretch.from_s) & (imu.time_s <= stretch.to_s)
        reached.append(size[inside].max(axis=0, initial=0.0) >= (1 - AT_LIMIT) * largest)
    if len(stretches) < LEAST_AT_LIMIT or not np.all(np.any(reached, axis=1)):
        return None
    return float(largest[np.any(reached, axis=0)].min())


def spans_of_outliers(observed: ObservedTracks, model: Model, medians: Array) -> list[Stretch]:
    """Intervals, IMU clock, seen by runs of pairs whose median residuals (pairs,) are outliers among all pairs'.

    The logarithm of a pair's median is taken for normally distributed; nan: the pair does not count.
    """
    if not np.isfinite(medians).any():
        return []
    level = np.log(np.maximum(medians, np.finfo(float).tiny))
    level -= np.nanmedian(level)
    deviation = level / max(robust_std(level[np.isfinite(level)]), np.finfo(float).tiny)
    stamp_s = observed.stamp_s + (np.array(model.lag) if model.lag else 0.0)
    begin_s, end_s = replace(observed, stamp_s=stamp_s).spans_s(model.profile)
    spans: list[Stretch] = []
    for pair in np.flatnonzero(deviation > normal_deviate(FALSE_ALARM / max(len(medians), 1))):
        by_chance = min(len(medians) * normal_tail(deviation[pair]), 1.0)
        own = Stretch(CONTRADICTED, float(begin_s[pair]), float(end_s[pair]), (0, 1, 2), p_value=by_chance)
        if spans and own.from_s <= spans[-1].to_s:
            last = spans.pop()
            assert last.p_value is not None
            own = replace(own, from_s=last.from_s, p_value=min(by_chance, last.p_value))
        spans.append(own)
    return spans
