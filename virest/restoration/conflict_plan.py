"""Revise a plan whose profile contradicts the tracked points: replace values, and note it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from virest.camera.profile import CameraProfile
from virest.capture.records import Capture
from virest.inference.camera_travel import VisualInertialAlignment
from virest.inference.coarse_alignment import MIN_PAIRS, SKEWS, align_coarsely
from virest.inference.observed_tracks import ObservedTracks, guessed_lens, observe_tracks
from virest.inference.tracking import TrackPair
from virest.restoration.capture import RestorationPlan
from virest.restoration.plan_notes import NoteCode
from virest.restoration.profile_conflict import CONTRADICTED, Settled, settle_conflict

POINTS_SOURCE = "tracked points against the gyroscope"
MAX_OFFSET_STD_S = 0.003
"""Largest usable deviation of an estimated offset, s: beyond it, at a hand's 30 rad/s², the rates, and so the blur
paths, would be off by 0.1 rad/s."""
MAX_FOCAL_SPREAD = 0.05
"""Largest usable relative deviation of an estimated focal length: all paths would be off by it."""
FOLLOWED = 0.95
"""Least explained fraction of the points' motion for a residual to come from the scene, not from the clocks."""
LEAST_EXPLAINED = 0.3
"""Least explained fraction of the rotation for an offset to be used as a starting point; the points judge the result.
"""


def explains_points(alignment: VisualInertialAlignment) -> bool:
    """Whether rotation and translation, with the profile, explain all tracked points."""
    scales = [stretch.fit.scale for stretch in alignment.stretches]
    return bool(scales) and max(scales) < CONTRADICTED


def settle(
    plan: RestorationPlan,
    given: CameraProfile,
    capture: Capture,
    pairs: Sequence[TrackPair],
    *,
    explained: bool = False,
) -> tuple[RestorationPlan, bool]:
    """The plan with contradicted values replaced by those from tracked points, and a note for each.

    explained: the points are explained already, by a fit that takes the stated readout time for right, so only that is
    tested.  The second: whether the points clearly follow the gyroscope, even if the rotations of whole frames do not.
    """
    offset_known, focal_known = given.time_offset_s is not None, plan.profile.intrinsics is not None
    profile = plan.profile if focal_known else replace(plan.profile, intrinsics=guessed_lens(plan.profile))
    observed = observe_tracks(capture, pairs, profile)
    found = settle_conflict(
        observed, capture.imu, profile, offset_known=offset_known, focal_known=focal_known, only_readout=explained
    )
    if explained and not found.taken:
        return plan, False
    if found.contradicted and not found.taken and not offset_known:
        begun = _at_coarse_offset(observed, capture, profile)
        if begun is not None:
            again = settle_conflict(observed, capture.imu, begun, offset_known=False, focal_known=focal_known)
            found = again if again.after_px < found.after_px else found
    followed = found.explained > FOLLOWED
    plan = replace(plan, points_off_rad_s=_rate_off_rad_s(found, observed))
    if offset_known and not found.taken:
        return (plan.noted(NoteCode.PROFILE_CONFLICT, _unexplained(found)) if found.contradicted else plan), followed
    if offset_known:
        plan = replace(_at_given_offset(plan, given, found.profile), refusal=None)
        return plan.noted(NoteCode.PROFILE_CONFLICT, *found.taken, *_remaining_note(found)), followed
    open_yet = plan.refuses(NoteCode.TIME_OFFSET, NoteCode.NOT_FOLLOWING, NoteCode.FOCAL_LENGTH)
    if not found.taken and not (followed and (open_yet or found.contradicted)):
        return (plan.noted(NoteCode.PROFILE_CONFLICT, _unexplained(found)) if found.contradicted else plan), followed
    return _with_open_values(plan, found), followed


def _at_given_offset(plan: RestorationPlan, given: CameraProfile, found: CameraProfile) -> RestorationPlan:
    """The plan with the profile found; with another readout, at the given offset, which is tested anew then."""
    if found.shutter != plan.profile.shutter:
        estimates = {name: value for name, value in found.estimates.items() if name != "time_offset_s"}
        found = replace(found, time_offset_s=given.time_offset_s, estimates=estimates)
        plan = plan.without(NoteCode.OTHER_OFFSET)
    return replace(plan, profile=found)


def _with_open_values(plan: RestorationPlan, found: Settled) -> RestorationPlan:
    """Adopt the estimated offset, and focal length if the profile has none, in addition to the replaced values."""
    assert found.offset is not None
    offset_s, std_s = found.offset
    profile = found.profile
    if found.focal is not None:
        if found.focal[1] > MAX_FOCAL_SPREAD * found.focal[0]:
            return plan
        lens = profile.intrinsics
        assert lens is not None
        lens = lens.scaled_focal(found.focal[0] / lens.fx_px)
        profile = profile.with_estimate("fx_px", *found.focal, POINTS_SOURCE, intrinsics=lens)
    profile = profile.with_estimate("time_offset_s", offset_s, std_s, POINTS_SOURCE, time_offset_s=offset_s)
    plan = replace(plan.without(NoteCode.TIME_OFFSET), profile=profile, refusal=None)
    if std_s > MAX_OFFSET_STD_S:
        plan = plan.refused(NoteCode.TIME_OFFSET, f"time offset only known to ± {std_s * 1e3:.1f} ms")
    plan = plan.noted(NoteCode.PROFILE_CONFLICT, *found.taken, *_remaining_note(found))
    return plan.noted(NoteCode.TIME_OFFSET, estimated_offset(offset_s, std_s))


def estimated_offset(offset_s: float, std_s: float) -> str:
    """Message about an estimated offset."""
    return f"time offset estimated: {offset_s * 1e3:+.2f} ± {std_s * 1e3:.2f} ms"


def _unexplained(found: Settled) -> str:
    return (
        f"tracked points lie {found.before_px:.2f} px from the profile's prediction (tracking noise "
        f"{found.noise_px:.2f} px), and no focal length, distortion, readout, gyroscope scale, clock skew or "
        "stabiliser explains it: virest diagnose"
    )


def _rate_off_rad_s(found: Settled, observed: ObservedTracks) -> float | None:
    """The rotation rate, per axis, that would move points as far as they still lie off beyond the tracking noise.

    None where they do not, or where there are too few.
    """
    lens = found.profile.intrinsics
    if found.after_px <= CONTRADICTED * found.noise_px or lens is None or not observed.pairs:
        return None
    period_s = float(np.median([observed.stamp_s[p.second] - observed.stamp_s[p.first] for p in observed.pairs]))
    return float(np.sqrt(found.after_px**2 - found.noise_px**2) / (lens.fx_px * period_s))


def _remaining_note(found: Settled) -> tuple[str, ...]:
    if found.after_px < CONTRADICTED * found.noise_px:
        return ()
    left = f"{found.after_px:.2f} px off (tracking noise {found.noise_px:.2f} px)"
    return (f"tracked points still lie {left}: virest diagnose may find why",)


def _at_coarse_offset(observed: ObservedTracks, capture: Capture, profile: CameraProfile) -> CameraProfile | None:
    """The profile at the offset where the rotations of frames and gyroscope agree best, at any focal length.

    Several clock skews are tried; the offset is that at the middle of the pairs.  None if rotations agree nowhere, or
    only at the end of the search range.
    """
    observed = observed.covered(capture.imu, profile)
    if len(observed.pairs) < MIN_PAIRS:
        return None
    turns, unset = observed.turns(profile), replace(profile, time_offset_s=None)
    least, begun = 1 - LEAST_EXPLAINED, None
    for skew in (0.0, *SKEWS):
        skewed = replace(unset, clock_skew=profile.clock_skew + skew)
        found = align_coarsely(turns, capture.imu, skewed, own_axes=True, free_focal=True)
        if found is not None and 1 - found.explained < least and not found.at_end:
            least = 1 - found.explained
            begun = found.time_offset_s + skew * float(turns.middle_s.mean())
    return None if begun is None else replace(profile, time_offset_s=begun)
