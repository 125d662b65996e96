"""Exposure times that the log has in other rows, or not at all."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from diagnosis.test_photometry import FRAMES, NOMINAL, hidden, made_observations
from motion.synthetic_tracks import Recording, Setup
from numpy.typing import NDArray

from virest.camera.field import Field
from virest.camera.profile import CameraProfile
from virest.camera.shutter import Shutter
from virest.capture.records import Frame
from virest.diagnosis.findings import (
    CONSISTENT,
    EXPLAINED,
    GEOMETRY,
    UNEXPLAINED,
    Diagnosis,
    FieldFinding,
    Finding,
    HeldOutGain,
    Nominal,
    Remaining,
)
from virest.diagnosis.geometric_evidence import Model, make_evidence
from virest.diagnosis.geometric_verdict import GeometricVerdict
from virest.diagnosis.own_exposures import (
    exposures_of_points,
    measured_log_light,
    rows_late,
    with_late_exposures,
    with_own_exposures_told,
)
from virest.diagnosis.picture_ladder import PictureVerdict
from virest.inference.even_light import LevelChange
from virest.inference.frame_exposures import OwnExposures

Array = NDArray[np.float64]
ALTERNATING = Setup(seed=71, frames=45, points=40, exposure_s=0.01, exposure_swing=0.4, rate_rad_s=0.8)
"""Exposures that change by 40 %, and their log has one value."""


@pytest.mark.parametrize(
    ("rows", "size", "timestamp", "named"),
    [
        (2, 1.0, "exposure_start", "2 frames late"),
        (-1, 1.0, "exposure_start", "1 frame early"),
        (1, 1.0, "exposure_end", "1 frame late"),
        (1, 1.0, "exposure_middle", None),
        (2, 2.0, "exposure_start", None),
    ],
)
def test_delays_of_the_mid_exposures_have_the_exposure_table_as_rival(
    rows: int, size: float, timestamp: str, named: str | None, rng: np.random.Generator
) -> None:
    """Half of the difference of the exposures, and neither twice that nor anything where stamps mark the middle."""
    exposure_s = 0.01 + 0.005 * rng.random(60)
    frames = [Frame(k, 0, k / 30, float(e)) for k, e in enumerate(exposure_s)]
    shutter = Shutter(0.02, timestamp=timestamp)
    start_s = np.array([shutter.first_row_start_s(frame.time_s, frame.exposure_s) for frame in frames])
    other_s = exposure_s[np.clip(np.arange(60) + rows, 0, 59)] - exposure_s
    late_s = size * (-0.5 if timestamp == "exposure_end" else 0.5) * other_s + rng.normal(0, 1e-5, 60)
    late = Field("delay", ("time",), (tuple(start_s.tolist()),), tuple((float(v),) for v in late_s), (), 0)
    gain = HeldOutGain(GEOMETRY, 1.0, 0.1, 0.1)
    found = FieldFinding(("time",), "delay", "jitter", "late", 0.002, "s", None, gain, 1e-9, (), 1.0, "", "", (late,))
    told = with_late_exposures(found, rows_late(found, frames, CameraProfile(640, 480, shutter=shutter)))
    assert told.confounded == (() if named is None else (f"exposure times logged {named}",))
    assert (told == found) is (named is None)


def _judged(
    left_px: float, noise_px: float, *, unexplained: bool = False, fields: tuple[FieldFinding, ...] = ()
) -> Diagnosis:
    nominal = Nominal(left_px, noise_px, None, None, 500, 90)
    left = Remaining(1e-9 if unexplained else 0.5, "time", 0.5, 0.3, GEOMETRY, unexplained)
    verdict = UNEXPLAINED if unexplained else EXPLAINED if fields else CONSISTENT
    profile = CameraProfile(640, 480)
    residuals = {"before": {"x_px": left_px}, "after": {"x_px": left_px}}
    return Diagnosis(verdict, nominal, (), left, profile, profile, fields=fields, residuals=residuals)


@pytest.mark.parametrize(
    ("left_px", "noise_px", "unexplained", "better"),
    [(0.32, 0.3, False, True), (0.42, 0.4, False, True), (0.5, 0.3, False, False), (0.32, 0.3, True, False)],
)
def test_an_exposure_table_that_explains_as_much_as_a_delay_of_each_frame_is_the_finding(
    left_px: float, noise_px: float, unexplained: bool, better: bool
) -> None:
    """As much of what exceeds the noise, which another tracking may have changed, and nothing new left."""
    gain = HeldOutGain(GEOMETRY, 1.0, 0.31, 0.3)
    late = FieldFinding(("time",), "delay", "jitter", "late", 0.002, "s", None, gain, 1e-9, (), 1.0, "", "")
    found, given = _judged(1.1, 0.3, fields=(late,)), _judged(left_px, noise_px, unexplained=unexplained)
    told = with_own_exposures_told(found, given, OwnExposures(-1))
    if not better:
        assert told is found
        return
    (table,) = told.fields
    assert (table.kind, table.size, table.p_value, told.verdict) == ("exposure_rows", -1.0, 1e-9, EXPLAINED)
    assert "logged 1 frame early" in table.sentence
    assert table.held_out.gain == pytest.approx(1 - (left_px**2 - noise_px**2) / (1 - noise_px**2))
    assert told.nominal is found.nominal
    assert (told.residuals["before"], told.residuals["after"]) == ({"x_px": 1.1}, {"x_px": left_px})


def _unlogged(gain: np.ndarray, missing: tuple[int, ...] = (), setup: Setup = ALTERNATING) -> OwnExposures | None:
    """Exposures that a recording's points confirm; the log has one value.

    gain: (frames,) of the light, without a value for the frames in ``missing``; if that is all, only the delays of
    frames and the brightness of pairs are known.
    """
    camera = Recording(setup)
    observed = replace(camera.observed, exposure_s=np.full(len(camera.stamp_s), setup.exposure_s))
    pairs = tuple(replace(p, levels=LevelChange(gain[p.second] / gain[p.first])) for p in observed.pairs)
    evidence = make_evidence(camera.imu.between(-0.2, camera.stamp_s[-1] + 0.25), replace(observed, pairs=pairs))
    model = Model(camera.profile.with_curve(kind="linear"), None, ())
    measured = np.log(gain)
    measured[list(missing)] = np.nan
    verdict = SimpleNamespace(evidence=evidence, nominal=model, model=model)
    frames = [Frame(k, 0, t, setup.exposure_s, iso=100) for k, t in enumerate(camera.stamp_s.tolist())]
    unmeasured = len(missing) == len(gain)
    return exposures_of_points(cast(GeometricVerdict, verdict), frames, None if unmeasured else measured, unmeasured)


@pytest.mark.parametrize("missing", [(), (5, 6, 20), tuple(range(ALTERNATING.frames))])
def test_exposures_that_change_unlogged_are_told_from_a_gain(missing: tuple[int, ...]) -> None:
    """Their scale comes from the points; frames whose brightness was not measured take it from their neighbour's."""
    camera = Recording(ALTERNATING)
    true = camera.exposure_s / ALTERNATING.exposure_s
    found = _unlogged(1.7 * true, missing)
    assert found is not None
    assert found.p_value is not None
    assert found.p_value < 1e-3
    np.testing.assert_allclose(found.gain, true, rtol=0.06)


def test_light_is_measured_whether_or_not_a_gain_was_found(rng: np.random.Generator) -> None:
    """From the patches, over the gains that were given; frames without patches have none."""
    gain = 1 + 0.4 * np.sin(np.arange(FRAMES) / 5)
    observed = made_observations(hidden(gain=tuple(gain.tolist())), rng)
    observed = observed.subset(observed.frame != 7)
    given = NOMINAL.with_extensions(gain=(2.0,) * FRAMES)
    for light in (
        PictureVerdict(given, observations=observed),
        PictureVerdict(hidden(gain=tuple(gain.tolist())), observations=observed, nominal=given),
    ):
        measured = measured_log_light(light, FRAMES)
        assert measured is not None
        assert np.flatnonzero(np.isnan(measured)).tolist() == [7]
        off = measured - np.log(gain)
        assert np.nanstd(off) < 0.02
    assert measured_log_light(PictureVerdict(given), FRAMES) is None


def test_no_exposure_is_longer_than_a_frame() -> None:
    """Up to 39 ms at 29.7 frames/s: whatever the points say, no camera takes such frames."""
    slow = replace(ALTERNATING, exposure_s=0.028)
    true = Recording(slow).exposure_s / slow.exposure_s
    assert _unlogged(true, setup=slow) is None
    assert _unlogged(true, setup=replace(slow, exposure_s=0.02)) is not None


def test_light_that_changes_is_no_exposure() -> None:
    """Gains that the exposures do not share, in none of six seeds."""
    rng = np.random.default_rng(5)
    for seed in range(71, 77):
        gain, setup = np.exp(rng.normal(0, 0.2, 45)), replace(ALTERNATING, seed=seed)
        assert _unlogged(gain, setup=setup) is None
        assert _unlogged(gain, tuple(range(45)), setup) is None


def test_exposures_that_hardly_change_are_not_told() -> None:
    """Brightness that follows them by a fiftieth makes the points agree better, but changes nothing that matters."""
    true = Recording(ALTERNATING).exposure_s / ALTERNATING.exposure_s
    assert _unlogged(true**0.02) is None


def test_unlogged_exposures_are_the_finding_if_they_leave_no_gain() -> None:
    """One account of delays and gains; a gain or delays that remain show another cause."""
    drift = Finding("gain_drift", {}, HeldOutGain("photometric_rms", 9.0, 1.0, 1.0), (), 0.0, "")
    found, given = replace(_judged(1.1, 0.3), causes=(drift,)), _judged(0.31, 0.3)
    found = replace(found, fields=(FieldFinding(
        ("time",), "delay", "jitter", "late", 0.002, "s", None, HeldOutGain(GEOMETRY, 1.0, 0.31, 0.3), 1e-9, (), 1.0,
        "", ""),))  # fmt: skip
    own = OwnExposures(gain=(0.6, 1.45, 0.6), p_value=1e-6)
    told = with_own_exposures_told(found, given, own)
    (table,) = told.fields
    assert (table.kind, table.size, table.unit) == ("exposure_gain", pytest.approx(0.45), "1")
    assert table.p_value == 1e-6
    assert not told.causes
    assert with_own_exposures_told(found, replace(given, causes=(drift,)), own) is found
    assert with_own_exposures_told(found, replace(given, fields=found.fields), own) is found
    by_delays = with_own_exposures_told(found, replace(given, causes=(drift,)), OwnExposures(gain=own.gain))
    assert by_delays.causes == (drift,)  # the ISO that compensates
    assert "as frames are late" in by_delays.fields[0].sentence
    assert by_delays.fields[0].p_value == 1e-9
    profile = own.on(CameraProfile(640, 480).with_extensions(exposure_gain=(2.0,)))
    assert profile.extensions.exposure_gain == pytest.approx((1.2, 1.45, 0.6))
    scale = Finding("exposure_time", {}, HeldOutGain("blur_rms_px", 2.0, 1.0, 1.0), (), 0.0, "")
    halved = own.on(CameraProfile(640, 480)).with_shutter(exposure_scale=0.5)
    told = with_own_exposures_told(found, replace(given, causes=(scale,), extended_profile=halved), own)
    assert not told.causes  # one factor for all exposures is theirs
    assert told.extended_profile.shutter.exposure_scale == 1.0
    assert told.extended_profile.extensions.exposure_gain == pytest.approx((0.3, 0.725, 0.3))
    assert told.fields[0].size == pytest.approx(-0.7)
    assert OwnExposures(-1).on(profile).extensions.exposures_late_frames == -1
