"""Ambiguous causes: resolve them with a second kind of evidence, or report them as rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from virest.arrays import Array
from virest.camera.profile import CameraProfile
from virest.camera.shutter import STAMP_FRACTION
from virest.diagnosis import picture_ladder
from virest.diagnosis.candidates import varies
from virest.diagnosis.findings import Finding, ParameterChange, Rival
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.diagnosis.tracking_stage import with_flicker_of

OFFSETS = frozenset({"time_offset", "timestamp_reference"})
"""Causes that shift all rows of the frames by one time, as the delay of a gyroscope's filter does."""
COINCIDENCE_SIGMA, COINCIDENCE_PART = 3.5, 0.25
"""An offset is attributed to another timestamp reference if it agrees within this many standard deviations and within
this part of the reference's own shift: a deviation that an unmodelled effect has widened agrees with everything."""


def offset_as_timestamp(geometric: GeometricVerdict, findings: list[Finding], exposure_s: Array) -> list[Finding]:
    """At constant exposure, report an offset of exactly half or one exposure as a different timestamp reference.

    Where exposures are unknown, points are timed at the start of the exposure, so an offset may be half of it.
    """
    if float(np.median(exposure_s)) <= 0:
        return [_or_exposure(finding) for finding in findings]
    if varies(exposure_s):
        return findings
    nominal = geometric.nominal.profile
    exposure = nominal.shutter.true_exposure_s(float(np.median(exposure_s)))
    result = []
    for finding in findings:
        if finding.name == "timestamp_reference":
            known = tuple(rival for rival in finding.rivals if rival.name != "time_offset")
            result.append(replace(finding, rivals=(Rival("time_offset", finding.held_out.after), *known)))
            continue
        if finding.name != "time_offset":
            result.append(finding)
            continue
        change = finding.parameters["time_offset_s"]
        shift, std = change.estimate - (change.nominal or 0.0), float(change.std)
        others = [rival for rival in finding.rivals if rival.name != "timestamp_reference"]
        meaning = _meaning(nominal.shutter.timestamp, shift, exposure, std)
        if meaning is None:
            result.append(finding)
            continue
        result.append(
            replace(
                finding,
                name="timestamp_reference",
                parameters={"timestamp": ParameterChange(nominal.shutter.timestamp, meaning, None)},
                rivals=(Rival("time_offset", finding.held_out.after), *others),
                sentence=f"a frame's stamp means its {meaning}; or the clocks differ by {shift:.4g} s",
            )
        )
        profile = replace(geometric.model.profile.with_shutter(timestamp=meaning), time_offset_s=nominal.time_offset_s)
        geometric.model = replace(geometric.model, profile=profile)
    return result


def offset_beside_averaging(findings: Sequence[Finding]) -> list[Finding]:
    """An offset of the clocks beside a gyroscope that averages, with the gyroscope's filter as its rival.

    Filters of one delay and one averaging time differ in the skewness of their responses.  The model has none beyond
    that of a second-order filter, and shares the delay between filter and clock accordingly: only the sum is certain.
    """
    names = {finding.name for finding in findings}
    if "gyro_averaging" not in names:
        return list(findings)
    return [
        replace(finding, rivals=(*finding.rivals, Rival("gyro_lowpass", finding.held_out.after)))
        if finding.name in OFFSETS and "gyro_lowpass" not in {rival.name for rival in finding.rivals}
        else finding
        for finding in findings
    ]


def _or_exposure(finding: Finding) -> Finding:
    """A time offset, with the unknown exposure as its rival."""
    if finding.name != "time_offset":
        return finding
    return replace(finding, rivals=(Rival("exposure_time", finding.held_out.after), *finding.rivals))


def _meaning(now: str, shift_s: float, exposure_s: float, std_s: float) -> str | None:
    """The timestamp reference equivalent to an offset: its first row starts later by (now − meaning) exposures."""
    for meaning, fraction in STAMP_FRACTION.items():
        expected = (STAMP_FRACTION[now] - fraction) * exposure_s
        near = min(COINCIDENCE_SIGMA * std_s, COINCIDENCE_PART * abs(expected))
        if meaning != now and abs(shift_s - expected) < near:
            return meaning
    return None


def exposure_hypothesis(findings: Sequence[Finding], exposure_s: Array, given: CameraProfile) -> ParameterChange | None:
    """The exposure scale that shifts the mid-exposure by the time offset found, instead of the given scale.

    None without such an offset, and where timestamps mark the middle of the exposure, which no scale shifts.
    """
    exposure = float(np.median(exposure_s))
    shifted_by = exposure * (STAMP_FRACTION["exposure_middle"] - STAMP_FRACTION[given.shutter.timestamp])
    if varies(exposure_s) or not shifted_by:
        return None
    for finding in findings:
        if finding.name == "time_offset":
            change, scale = finding.parameters["time_offset_s"], given.shutter.exposure_scale
            shift_s = change.estimate - (change.nominal or 0.0)
            return ParameterChange(scale, scale + shift_s / shifted_by, float(change.std) / abs(shifted_by))
    return None


def as_exposure(findings: Sequence[Finding], change: ParameterChange) -> Finding:
    """Attribute an offset to the exposure time, with its more precise value from the points."""
    finding = next(f for f in findings if f.name == "time_offset")
    return replace(
        finding,
        name="exposure_time",
        parameters={"exposure_scale": change},
        rivals=(Rival("time_offset", finding.held_out.after),),
        sentence=picture_ladder.SENTENCES["exposure_time"].format(exposure_scale=f"{change.estimate:.3g}"),
    )


def merged(moved: CameraProfile, lit: CameraProfile, blurred: CameraProfile, is_exposure: bool) -> CameraProfile:
    """Combine all causes in one profile: geometry from ``moved``, photometry from ``lit``, blur from ``blurred``."""
    light = lit.extensions
    found = with_flicker_of(replace(moved, response=lit.response), lit).with_extensions(
        vignetting_corner_loss=light.vignetting_corner_loss,
        gain=light.gain,
        defocus_sigma_px=blurred.extensions.defocus_sigma_px,
    )
    return found if is_exposure else found.with_shutter(exposure_scale=blurred.shutter.exposure_scale)
