"""Compare neighbouring frames once per capture, to correct the prediction and confirm the gain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.capture.folder import Capture
from virest.capture.frame_coding import FrameCoding
from virest.capture.join import outside_reason
from virest.image_formation.blur import Image
from virest.image_formation.row_motion import RowMotion
from virest.inference.unsharp_mask import MOST_FRAMES, RESIDUAL_AMOUNT, UnsharpMask, overshoot, without_mask
from virest.motion.integration import integrate_gyro
from virest.motion.optics import moving_lens
from virest.restoration.capture import RestorationPlan, at_true_times, moved_over_frame
from virest.restoration.neighbours.refinement import RefinedMotion, unmeasured_turn
from virest.restoration.neighbours.sights import FrameNeighbours, Sight
from virest.restoration.neighbours.survey import path_length_px, survey_gain, survey_turns
from virest.restoration.settings import PRESETS, RestorationSettings
from virest.restoration.trial import blur_error, try_restoration

MOST_COST, OF_FRAMES = 0.05, 0.75
"""Undoing an unsharp mask that no phone applied may cost this fraction of the blur's squared error, in this fraction of
the frames.  A frame is deblurred for a gain of 0.5 dB or more, which removes 11 % of that error.

In 18 of 19 simulated captures the expected mask costs 0.1 to 2 %.  In the other, of gravel with paths of 1.6 to 4 px
that no phone sharpened, it costs 50 %: undone in full, it takes 11 of 30 frames below straightening alone.  Of eight
captures drawn later, all sharpened, four have less of it undone: with ``balanced`` one gains 0.5 dB more, one 0.4 less.
"""


def with_neighbour_survey(
    plan: RestorationPlan,
    capture: Capture,
    runs: Sequence[Sequence[int]],
    lumas: Mapping[int, NDArray[np.uint8]],
    coding: Mapping[int, FrameCoding],
) -> RestorationPlan:
    """The plan with the phone's sharpening, the missing rotation and the confirmed gain, from neighbouring frames.

    lumas: of the runs' frames, by index.  coding: how frames were coded, by index; missing: unknown.
    """
    profile = plan.profile
    if not lumas or profile.intrinsics is None:
        return plan
    trajectory = integrate_gyro(capture.imu, profile)
    lens, known = moving_lens(trajectory, profile), plan.translations or {}
    frames = at_true_times(capture.frames, profile, capture.repeats)
    sights = {}
    for number, luma in lumas.items():
        motion = moved_over_frame(trajectory, lens, frames[number], plan.settings.reference, known.get(number), profile)
        outside = outside_reason(motion.start_s, motion.end_s, capture.imu.time_s, capture.imu_gaps_s)
        why = outside[1] if outside else ""
        sights[number] = Sight(frames[number], luma, motion, why, coding=coding.get(number))
    plan, sights = _without_sharpening(plan, sights)
    neighbours = FrameNeighbours(trajectory, lens, None)
    missing, undetected_rad_s = survey_turns(runs, sights, neighbours, trajectory)
    if undetected_rad_s is None and plan.points_off_rad_s is not None:
        missing = unmeasured_turn(plan.points_off_rad_s)
    elif missing is not None:
        note = (
            f"neighbouring frames rotate by {missing.rate_rad_s:.3f} rad/s rms more or less than predicted: "
            "each frame's motion is corrected by its neighbours"
        )
        plan = replace(plan, notes=(*plan.notes, note))
    plan = replace(plan, missing_turn=missing, undetected_rad_s=undetected_rad_s)
    if plan.settings.deblur == "none":
        return plan
    quick = replace(PRESETS["fast"], min_blur_px=plan.settings.min_blur_px)

    def restore_quickly(here: Sight, motion: RowMotion, refined: RefinedMotion | None) -> tuple[Image, Image] | None:
        return try_restoration(here.picture, motion, quick, refined, here.coding_step)

    return replace(
        plan,
        confirmed=survey_gain(runs, sights, neighbours.with_missing_turn(missing), trajectory, lens, restore_quickly),
    )


def _without_sharpening(plan: RestorationPlan, sights: Mapping[int, Sight]) -> tuple[RestorationPlan, dict[int, Sight]]:
    """The plan with the phone's sharpening as far as edges tell, and the frames with it undone."""
    if plan.settings.deblur == "none":
        return plan, dict(sights)
    usable = [(one.picture, one.motion) for one in sights.values() if one.usable and one.motion is not None]
    edges = overshoot(sorted(usable, key=lambda one: path_length_px(one[1]))[:MOST_FRAMES])
    if edges is None or (mask := edges.expected_mask()).amount <= RESIDUAL_AMOUNT:
        return plan, dict(sights)
    mask = _without_great_cost(mask, sights, plan.settings)
    if mask.amount <= RESIDUAL_AMOUNT:
        return plan, dict(sights)
    seen = "edges overshoot as after" if edges.overshoots else "edges do not exclude"
    note = (
        f"{seen} a phone's sharpening: before deblurring, process undoes the expected unsharp mask, "
        f"of {mask.amount:.2g} with a radius of {mask.radius_px:.2g} px"
    )
    plan = replace(plan, mask=mask, notes=(*plan.notes, note))
    return plan, {n: replace(one, picture=without_mask(one.picture, mask)) for n, one in sights.items()}


def _without_great_cost(mask: UnsharpMask, sights: Mapping[int, Sight], settings: RestorationSettings) -> UnsharpMask:
    """The mask with as much of its amount as costs little compared with the blur, if the phone sharpened nothing.

    The change by undoing it is proportional to its amount.  Only frames that are deblurred count.
    """
    cost = []
    for one in [*sights.values()][::2]:  # they come in runs of similar frames
        if one.usable and one.motion is not None:
            undone = without_mask(one.picture, mask)
            lost = blur_error(undone, one.motion, settings, one.coding_step)
            if lost is not None:
                cost.append(cv2.norm(undone, one.picture, cv2.NORM_L2SQR) / undone.size / max(lost, 1e-6))
    part = np.sqrt(MOST_COST / max(float(np.quantile(cost, OF_FRAMES)), MOST_COST)) if cost else 0.0
    return replace(mask, amount=mask.amount * float(part))
