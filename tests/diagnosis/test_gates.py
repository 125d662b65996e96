"""Conditions for naming a cause: significance levels, held-out time blocks, and correlated errors."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnosis.test_photometry import FRAMES, NOISE, NOMINAL, hidden, made_observations
from motion.synthetic_tracks import Recording, Setup

from virest.camera.profile import CameraProfile
from virest.diagnosis import (
    geometric_ladder,
    geometric_significance,
    local_blur,
    local_blur_fit,
    photometry_fit,
    picture_ladder,
)
from virest.diagnosis.candidates import Candidate
from virest.diagnosis.cross_validation import Judged, Screened, choose
from virest.diagnosis.cross_validation import judge as judge_points
from virest.diagnosis.findings import PHOTOMETRY, HeldOutGain, ParameterChange, Rung
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS
from virest.diagnosis.geometric_evidence import Evidence, Model, make_evidence
from virest.diagnosis.geometric_ladder import Trial, _best_single
from virest.diagnosis.geometric_significance import significant
from virest.diagnosis.photometry_effects import VIGNETTING, Flicker, GainDrift
from virest.diagnosis.photometry_fit import fit_photometry, judge, time_blocks
from virest.diagnosis.selection import FALSE_ALARM, MAX_P, Levels
from virest.effects.table import EFFECTS
from virest.inference import profile_terms as terms_of
from virest.inference.descent import Residuals, System
from virest.inference.parallel import one_by_one

HAND = Setup(seed=61, frames=37, points=15, readout_direction="top_to_bottom", gyro_noise_rad_s=0.001)
EFFECT = {effect.name: effect for effect in GEOMETRIC_EFFECTS}


@lru_cache(maxsize=1)
def hand() -> tuple[Recording, Evidence]:
    """A recording and its evidence."""
    camera = Recording(HAND)
    return camera, make_evidence(camera.imu.between(-0.2, camera.stamp_s[-1] + 0.25), camera.observed)


# ── held-out data ────────────────────────────────────────────────────────────────────────────────────────────────


def test_points_are_judged_by_fits_to_the_other_blocks() -> None:
    """Half of the time blocks are shifted in time: each half is judged with the other half's offset."""
    camera, evidence = hand()
    late = (evidence.block % 2).astype(float) * 0.012
    stamps = camera.observed.stamp_s.copy()
    for pair, shift_s in zip(camera.observed.pairs, late, strict=True):
        stamps[pair.second] = camera.observed.stamp_s[pair.second] + shift_s
    torn = make_evidence(evidence.imu, replace(camera.observed, stamp_s=stamps))
    model = Model(camera.profile, None, ())
    candidate = Candidate("time_offset", model, (terms_of.TIME_OFFSET,), EFFECT["time_offset"])
    (judged,) = judge_points(torn, [Screened(candidate, (model, model), (0.0, 0.0), 1.0, 0.0)], 1.0, 0.0, one_by_one)
    table = torn.table(model, 3500)
    for fold in (0, 1):
        fitted = torn.fit(model, (terms_of.TIME_OFFSET,), table, torn.block % 2 == fold)
        held = torn.block[table.pair] % 2 != fold
        expected = torn.distances(fitted, table, 0.0)
        np.testing.assert_allclose(judged.distance[held], expected[held], rtol=1e-6)


def test_a_choice_is_judged_on_blocks_that_did_not_make_it() -> None:
    """A cause favoured by a single time block is not chosen, not even for that block."""
    _, evidence = hand()
    table = evidence.table(Model(hand()[0].profile, None, ()), 3500)
    block, blocks = evidence.block[table.pair], int(evidence.block.max()) + 1

    def made(name: str, losses: Any) -> Judged:
        candidate = Candidate(name, Model(hand()[0].profile, None, ()), (), None)
        each = np.asarray(losses, float)
        return Judged(candidate, np.sqrt(np.expm1(each))[block] * 2.4, each, np.zeros(len(evidence.block)), 1.0)

    base = made("", np.full(blocks, 1.0))
    steady = made("focal_length", np.full(blocks, 0.95))
    lucky = np.full(blocks, 1.04)
    lucky[2] = 0.2
    by_chance = made("clock_skew", lucky)
    both = frozenset({"focal_length", "clock_skew"})
    found = choose(evidence, [base, steady, by_chance], (both, both), 1.0)
    assert found.block_loss[2] == pytest.approx(0.95)
    # other blocks of its parity include that block and may choose by it
    assert found.block_loss[1] == pytest.approx(0.95)
    nothing = choose(evidence, [base, steady, by_chance], (frozenset(), frozenset()), 1.0)
    np.testing.assert_allclose(nothing.block_loss, 1.0)


def test_brightness_is_judged_on_the_other_blocks(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """No fit uses an observation that it is judged on, and every observation judges one fit."""
    observed = replace(made_observations(hidden(), rng), x_px=np.arange(150.0 * FRAMES))
    seen: list[Any] = []
    held: list[Any] = []

    def fitted(observations: Any, _profile: Any, _effects: Any, use: Any = None) -> Any:
        seen.append(observations.x_px if use is None else observations.x_px[use])
        return SimpleNamespace(memory=0.0, profile=NOMINAL)

    monkeypatch.setattr(photometry_fit, "fit_photometry", fitted)
    monkeypatch.setattr(photometry_fit, "normalised_rms", lambda o, _: held.append(o.x_px) or (1.0, 0.5))
    judge(observed, NOMINAL, [VIGNETTING])
    assert len(seen) == len(held) == 4
    for used, judged in zip(seen, held, strict=True):
        assert not np.intersect1d(used, judged).size
    assert len(np.unique(np.concatenate(held))) == len(observed)


def test_the_noise_of_brightness_is_the_measured_one(rng: np.random.Generator) -> None:
    """The residual of a fit does not define the noise, whether it is smaller or larger."""
    observed = made_observations(hidden(vignetting_corner_loss=0.3), rng)
    noisier = replace(observed, noise=1.5 * observed.noise)
    held = judge(noisier, NOMINAL, [VIGNETTING])
    assert held.after < 0.8 * held.noise
    assert held.noise == pytest.approx(1.5 * NOISE, rel=0.01)


def test_blur_is_judged_on_blocks_that_it_was_not_fitted_to(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit and judgement share no residual; each effect is judged on the kind of residual that determines the other."""
    time_s = np.linspace(0.0, 4.0, 80)
    fits: list[Any] = []
    judged: list[Any] = []
    monkeypatch.setattr(local_blur_fit, "fit", lambda *a: fits.append(a[4]))
    monkeypatch.setattr(local_blur_fit, "judge", lambda *a: judged.append(a[3]) or 0.0)
    seen = SimpleNamespace(time_s=time_s, is_edge=np.arange(80) % 3 == 0)
    effects = (local_blur_fit.ExposureTime(), local_blur_fit.Defocus())
    gains = local_blur_fit.held_out(seen, CameraProfile(64, 48), None, effects)  # type: ignore[arg-type]
    assert len(gains) == 2
    assert len(fits) == 4
    assert len(judged) == 8
    assert np.array_equal(fits[0], ~fits[-1])
    for fold in range(2):
        of_exposure, _, of_defocus, _ = judged[4 * fold : 4 * fold + 4]
        assert np.array_equal(of_exposure, ~fits[2 * fold] & ~seen.is_edge)
        assert np.array_equal(of_defocus, ~fits[2 * fold] & seen.is_edge)


# ── conditions for points ────────────────────────────────────────────────────────────────────────────────────────


def trial_of(monkeypatch: pytest.MonkeyPatch, losses: dict[str, Any], p_value: float = 0.0) -> Any:
    """The ladder's decision for causes with these held-out losses by block; the model without them has 1 everywhere."""
    camera, evidence = hand()
    model = Model(camera.profile, None, ())

    def judged(name: str, each: Any) -> Judged:
        candidate = Candidate(name, model, (), EFFECT.get(name))
        return Judged(candidate, np.zeros(1), np.asarray(each, float), np.zeros(1), float(np.mean(each)))

    entries = [judged(name, each) for name, each in losses.items()]
    before = judged("", np.ones(len(next(iter(losses.values())))))
    monkeypatch.setattr(geometric_ladder, "choose", lambda _evidence, judged, *_: judged[1])
    monkeypatch.setattr(geometric_ladder, "significant", lambda *_: (model if p_value < MAX_P else None, p_value))
    allowed = frozenset(losses)
    return _best_single(model, Trial(evidence, before, entries, (allowed, allowed), 1.0))


WOBBLE = np.array([0.01, -0.01, 0.02, -0.02, 0.01, -0.01, 0.0, 0.0])


def test_a_gain_must_exceed_a_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gain of 0.2 % of the loss does not count, however even it is; a gain of 2 % does."""
    assert trial_of(monkeypatch, {"focal_length": 0.998 + 1e-3 * WOBBLE})[0] is None
    assert trial_of(monkeypatch, {"focal_length": 0.98 + 1e-2 * WOBBLE})[0] is not None


def test_a_gain_must_be_consistent_over_time_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gain of a single block does not count; a large gain may be less even than a small one."""
    single = np.ones(8)
    single[3] = 0.5
    assert trial_of(monkeypatch, {"focal_length": single})[0] is None
    uneven = np.array([1.0, 0.99, 0.94, 0.98, 1.0, 0.93, 0.97, 1.01])
    gain = 1 - uneven
    t = gain.mean() / (gain.std(ddof=1) / np.sqrt(8))
    assert 1.9 < t < 3.0
    assert trial_of(monkeypatch, {"focal_length": uneven})[0] is None
    assert trial_of(monkeypatch, {"focal_length": 1 - 4 * gain})[0] is not None


def test_causes_that_time_blocks_cannot_separate_are_rivals(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cause slightly worse in every block is no rival; one equal on average and better in some blocks is."""
    best = 0.80 + WOBBLE
    step, other = trial_of(monkeypatch, {"focal_length": best, "gyro_scale": best + 0.02 + 0.3 * WOBBLE})
    assert step is not None
    assert (step.accepted[0].rivals, other) == ((), None)
    step, other = trial_of(monkeypatch, {"focal_length": best, "gyro_scale": best + 0.01 + 3 * WOBBLE[::-1]})
    assert step is not None
    assert [rival.name for rival in step.accepted[0].rivals] == ["gyro_scale"]
    assert other is not None
    assert other.accepted[0].name == "gyro_scale"


def test_a_parameter_must_be_significant(monkeypatch: pytest.MonkeyPatch) -> None:
    """A p-value of 1e-3 is too large for one of many causes; for a word the gain by time blocks decides."""
    assert MAX_P * len(EFFECTS) == pytest.approx(FALSE_ALARM)
    camera, evidence = hand()
    model = Model(camera.profile, None, ())
    candidate = Candidate("time_offset", model, (terms_of.TIME_OFFSET,), EFFECT["time_offset"])
    for p_value, named in ((0.5 * MAX_P, True), (1e-3, False)):
        monkeypatch.setattr(geometric_significance, "p_value_of", lambda *_, p=p_value: p)
        entered, told = significant(evidence, candidate, camera.profile, np.zeros(3))
        assert (entered is not None, told) == (named, p_value)
    word = Candidate("readout_direction", model, (), EFFECT["readout_direction"], "top_to_bottom")
    even, uneven = np.array([0.1, 0.11, 0.1, 0.09, 0.1, 0.1]), np.array([0.1, -0.05, 0.3, 0.0, 0.1, 0.02])
    assert significant(evidence, word, camera.profile, even)[0] is not None
    assert significant(evidence, word, camera.profile, uneven)[0] is None


# ── conditions for brightness ────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("held", "p_value", "named"),
    [
        (HeldOutGain(PHOTOMETRY, 2.0, 1.0, 0.9), 1e-9, True),
        (HeldOutGain(PHOTOMETRY, 2.0, 1.9, 0.9), 1e-9, False),
        (HeldOutGain(PHOTOMETRY, 2.0, 1.0, 0.9), 1e-3, False),
        (HeldOutGain(PHOTOMETRY, 2.0, 1.99, 1.98), 1e-9, False),
        (HeldOutGain(PHOTOMETRY, 1.0, 0.9, 1.1), 1e-9, True),
    ],
)
def test_a_brightness_cause_must_gain_and_be_significant(
    held: HeldOutGain, p_value: float, named: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It removes enough of the excess and of the whole residual and is significant; its rung has held-out values."""
    observed = made_observations(hidden(), rng)
    plain, better = (
        SimpleNamespace(cost=10.0, memory=0.0, rms=3.0, profile=NOMINAL),
        SimpleNamespace(cost=1.0, memory=0.0, rms=1.0, of=lambda _name: (np.zeros(1), np.zeros((1, 1)))),
    )
    monkeypatch.setattr(picture_ladder, "fit_photometry", lambda *_: better)
    monkeypatch.setattr(picture_ladder, "judge", lambda *_, **__: held)
    monkeypatch.setattr(picture_ladder, "significance", lambda *_: (9.0, p_value))
    rung, effect, _ = picture_ladder._rung(observed, NOMINAL, plain, [VIGNETTING], [], one_by_one)  # type: ignore[arg-type]
    shown = ({"vignetting": held.after}, held.before) if p_value < 1e-6 else ({}, plain.rms)
    assert rung == Rung("vignetting" if named else None, *shown, PHOTOMETRY)
    assert (effect is not None) is named


@pytest.mark.parametrize(("after", "named"), [(1.2, True), (1.6, False)])
def test_gains_per_frame_must_remove_half_of_the_excess(
    after: float, named: bool, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A vignette needs to remove less. Both are judged together with the effects already included."""
    observed = made_observations(hidden(), rng)
    held, beside = HeldOutGain(PHOTOMETRY, 2.0, after, 0.9), []

    def judge(*_: object, **how: object) -> HeldOutGain:
        beside.append(how["beside"])
        return held

    monkeypatch.setattr(picture_ladder, "judge", judge)
    gain = GainDrift((0, 1), 2)
    assert picture_ladder._judged(observed, NOMINAL, [Flicker()], gain, one_by_one) == (held, named)
    assert beside == [[Flicker()]]
    assert picture_ladder._judged(observed, NOMINAL, [], VIGNETTING, one_by_one) == (held, True)
    assert len(beside) == 3


# ── correlated errors ────────────────────────────────────────────────────────────────────────────────────────────


def test_points_of_one_pair_have_correlated_errors(rng: np.random.Generator) -> None:
    """A shift common to each pair's points makes an offset less certain than independent shifts of the same size."""
    camera, evidence = hand()
    model = Model(camera.profile, None, (terms_of.TIME_OFFSET,))
    table = evidence.table(model, 3500)
    common = 0.15 * rng.normal(size=(table.n_pairs, 2))[table.pair]
    own = rng.permutation(common)
    stds = [
        evidence.fit(model, model.terms, replace(table, second_px=table.second_px + off)).std("time_offset")[0]
        for off in (common, own)
    ]
    assert stds[0] > 1.6 * stds[1]


def test_patches_of_one_time_block_have_correlated_errors(rng: np.random.Generator) -> None:
    """Light that varies towards the corners from block to block makes vignetting less certain."""
    observed = made_observations(hidden(), rng)
    lean = rng.normal(size=int(time_blocks(observed).max()) + 1)[time_blocks(observed)]
    wandering = replace(observed, grey=observed.grey + 2.0 * NOISE * lean * (observed.radius**2 - 0.2))
    mixed = rng.permutation(FRAMES)[observed.frame]
    as_often = np.array([lean[np.argmax(observed.frame == k)] for k in range(FRAMES)])[mixed]
    scattered = replace(observed, grey=observed.grey + 2.0 * NOISE * as_often * (observed.radius**2 - 0.2))
    stds = [fit_photometry(one, NOMINAL, [VIGNETTING]).std[0] for one in (wandering, scattered)]
    assert stds[0] > 1.25 * stds[1]


def test_blur_of_one_time_block_has_correlated_errors(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Residuals that are equal within a time block are weaker evidence than independent ones."""
    time_s = np.linspace(0.0, 4.0, 400)
    edges = SimpleNamespace(width_px=np.zeros(0), reach_px=np.zeros(0))
    seen = SimpleNamespace(time_s=time_s, damping_std=0.1, is_edge=np.zeros(400, bool), edges=edges)
    effects = [local_blur_fit.ExposureTime()]
    evidence = local_blur_fit._Widths(seen, CameraProfile(64, 48), None, effects, np.ones(400, bool))  # type: ignore[arg-type]
    slope = np.stack([np.ones(400), np.zeros(400), np.zeros(400)], axis=-1)
    common = rng.normal(size=8)[local_blur.time_blocks(time_s)]
    variances = []
    for left in (common, rng.permutation(common)):
        # residuals do not change with damping
        monkeypatch.setattr(local_blur_fit._Widths, "left", lambda *_, r=left: r)
        look, none = Residuals(left, slope, left), np.zeros(3)
        found = System(none, look, slope[:, None], left[:, None], np.zeros(400), 1.0, np.array([0.0, 1.0, 1.0]), none)
        variances.append(evidence.covariance(found)[0, 0])
    assert variances[0] > 8 * variances[1]


def test_the_same_levels_apply_to_all_evidence() -> None:
    """Significance, size, held-out gain and evenness can each keep a cause from being named."""
    levels = Levels(1e-3, 0.1, 0.05, ((0.1, 0.01), (0.3, 0.05)), {"defocus": 0.5})
    assert levels.significant(9e-4)
    assert not levels.significant(1e-3)
    assert levels.matters("defocus", 0.51)
    assert not levels.matters("defocus", 0.49)
    assert levels.matters("flicker", 0.01)
    assert levels.gains(HeldOutGain(PHOTOMETRY, 2.0, 1.5, 1.0))
    assert not levels.gains(HeldOutGain(PHOTOMETRY, 2.0, 1.96, 1.0))
    assert [levels.gains(HeldOutGain(PHOTOMETRY, 2.0, after, 2.0)) for after in (1.94, 1.96)] == [True, False]
    asked = ((0.05, 0.0), (0.2, 0.009), (0.2, 0.02), (0.4, 0.02), (0.4, 0.06))
    assert [levels.holds(*one) for one in asked] == [False, True, False, True, False]


@pytest.mark.parametrize(("name", "change"), [("exposure_time", 0.19), ("defocus", 1.0)])
def test_blur_names_a_cause_by_its_p_value(name: str, change: float) -> None:
    """Deviations are estimated from few blocks: by Student's distribution, 4.2 deviations are too few."""
    value = ParameterChange(0.0, change, 0.0)
    named = {z: picture_ladder._BlurChange(value, change, z).is_named(name) for z in (4.2, 12.0)}
    assert named == {4.2: False, 12.0: True}
    assert picture_ladder._blur_p_value(name, 4.2) > MAX_P
