"""Frames and their neighbours: the true motion between them, the gain of deblurring, and joint restoration."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from virest.app.evaluation_captures import TrueCapture, open_true_capture
from virest.app.simulate import simulate_command
from virest.evaluation.fidelity import psnr_db
from virest.motion.integration import integrate_gyro
from virest.motion.optics import moving_lens
from virest.restoration.capture import RestorationPlan, restore_frames
from virest.restoration.neighbours.confirmation import ConfirmedGain
from virest.restoration.neighbours.sights import Sight, light_of, turn_between, with_neighbours
from virest.restoration.settings import PRESETS
from virest.restoration.taken_part import LEAST_CONFIRMED_DB
from virest.simulation.phone_isp import PhoneIsp

SIZE = {"width": 320, "height": 384, "focal_px": 350.0, "exposure_ms": 14.0, "rate_rad_s": 1.4, "frames": 8}


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., TrueCapture]:
    """Simulate a small shaken capture with truth; options are those of simulate_command, and ``config``."""
    made: dict[str, Path] = {}

    def make(config: bool = False, **options: object) -> TrueCapture:
        key = repr(sorted(options.items(), key=str))
        if key not in made:
            made[key] = tmp_path_factory.mktemp("neighbours") / "shaken"
            simulate_command(made[key], **{**SIZE, "seed": 31, **options})  # type: ignore[arg-type]
        folder = made[key]
        return open_true_capture(folder, folder / "truth" / "camera.yaml" if config else None)

    return make


def _gains(capture: TrueCapture, plan: RestorationPlan) -> np.ndarray:
    """PSNR of each frame with a plan, minus that of straightening alone with the same plan."""
    alone = replace(plan, settings=replace(plan.settings, deblur="none"))
    base = {r.frame.index: r for r in capture.restored(alone)}
    found = []
    for restored in capture.restored(plan):
        number = restored.frame.index
        truth, valid = capture.truth(number), base[number].valid_px
        found.append(psnr_db(restored.picture, truth, valid) - psnr_db(base[number].picture, truth, valid))
    return np.array(found)


def test_a_missing_turn_is_measured_between_two_frames(simulated):
    """An added turn rate is found with its sign within four standard deviations, although the frames are blurred."""
    capture = simulated()
    plan = capture.plan(replace(PRESETS["fast"], deblur="none"))
    motions, pictures = capture.motions(plan), dict(capture.recorded())
    trajectory = integrate_gyro(capture.capture.imu, plan.profile)
    lens = moving_lens(trajectory, plan.profile)
    frames = sorted(pictures, key=lambda frame: frame.index)
    sights = [Sight(f, pictures[f], motions[f.index]) for f in frames[2:4]]
    true = turn_between(*sights, *map(light_of, sights), trajectory, lens)
    rate = np.array([0.11, -0.07, 0.16])
    wrong = replace(plan.profile, gyro_bias_rad_s=tuple(-plan.profile.rotation_cam_imu.T @ rate))
    wrongly = integrate_gyro(capture.capture.imu, wrong)
    told = turn_between(*sights, *map(light_of, sights), wrongly, moving_lens(wrongly, wrong))
    assert true is not None
    assert told is not None
    deviations = np.sqrt(np.diag(told.covariance))
    assert np.all(np.abs(true.rate_rad_s) < 4 * np.sqrt(np.diag(true.covariance)))
    assert np.all(np.abs(told.rate_rad_s - rate) < 4 * deviations)
    assert np.all(deviations < 0.05)


def test_a_correct_prediction_is_not_changed(simulated):
    """Where neighbours agree with the gyroscope nothing is corrected."""
    assert simulated().plan(PRESETS["fast"]).missing_turn is None


def test_clipped_highlights_in_every_tile_allow_confirmation(simulated):
    """Neighbours confirm deblurring although no tile is free of clipped light."""
    confirmed = simulated(scene="bright").plan(PRESETS["fast"]).confirmed
    assert confirmed is not None
    assert confirmed.share > 0.5


@pytest.mark.scenario
@pytest.mark.parametrize(
    "isp",
    [PhoneIsp(offset_s=0.004), PhoneIsp(offset_s=-0.003, gyro_noise=0.002, tone=0.3, sharpen=0.5)],
    ids=["offset", "processed"],
)
def test_frames_are_corrected_by_their_neighbours(simulated, isp):
    """Errors missing from the profile spoil no frame, and corrected frames gain 0.3 dB over uncorrected ones."""
    capture = simulated(isp=isp)
    plan = capture.plan(PRESETS["balanced"])
    assert plan.missing_turn is not None
    gains = _gains(capture, plan)
    uncorrected = _gains(capture, replace(plan, missing_turn=None, settings=replace(plan.settings, neighbours=0)))
    assert gains.min() > -0.1
    assert gains.mean() > uncorrected.mean() + 0.3


@pytest.mark.scenario
def test_frames_restored_together_are_better_than_each_alone(simulated):
    """Neighbours blurred along other paths restore what a frame's own path cancels, and make no frame worse."""
    capture = simulated()
    plan = capture.plan(PRESETS["balanced"])
    single = _gains(capture, replace(plan, settings=replace(plan.settings, neighbours=0)))
    joint = _gains(capture, plan)
    assert np.all(joint > single - 0.1)
    assert joint.mean() > single.mean() + 0.5
    promised = [r.parameters["deblur"] for r in capture.restored(plan)]
    assert {bool(p["neighbours"]) == (p["neighbours_gain_db"] > 0) for p in promised} == {True}


@pytest.mark.scenario
def test_neighbours_help_beside_clipped_light_as_they_do_elsewhere(simulated):
    """Around overexposed areas, beyond their streaks, frames gain 70 % of what they gain far from them."""
    capture = simulated(effects=["gain_drift=" + ",".join(["1.6"] * SIZE["frames"])], bitrate_bits_per_px=3.0)
    plan = capture.plan(PRESETS["balanced"])
    alone = replace(plan, settings=replace(plan.settings, neighbours=0))
    power = np.zeros((2, 2))
    for joint, single in zip(capture.restored(plan), capture.restored(alone), strict=True):
        truth = capture.truth(joint.frame.index).astype(float)
        clipped = (truth.min(axis=2) >= 254).astype(np.uint8)
        streaks, around = (cv2.dilate(clipped, np.ones((side, side), np.uint8)) > 0 for side in (25, 51))
        x0, y0, x1, y1 = joint.valid_px
        inside = np.zeros_like(streaks)
        inside[y0 + 16 : y1 - 16, x0 + 16 : x1 - 16] = True
        for place, pixels in enumerate((around & ~streaks & inside, ~around & inside)):
            power[place] += [((one.picture - truth)[pixels] ** 2).sum() for one in (joint, single)]
    near_db, far_db = 10 * np.log10(power[:, 1] / power[:, 0])
    assert far_db > 1.0
    assert near_db > 0.7 * far_db


def test_a_frame_that_is_expected_to_lose_is_only_straightened(simulated, monkeypatch):
    """A predicted loss of 0.3 dB leaves the frame blurred, with a warning of a gain of only 0.00 dB."""
    capture = simulated()
    plan = replace(capture.plan(PRESETS["fast"]), confirmed=ConfirmedGain(1.0, 0.2, 0.02, 4))
    straight = next(capture.restored(replace(plan, settings=replace(plan.settings, deblur="none"))))
    monkeypatch.setattr(ConfirmedGain, "of_change_db", lambda *_: (-0.3, 0.2))
    left = next(capture.restored(plan))
    assert left.degradation is not None
    assert left.degradation.deblur is None
    assert any("expected to gain only 0.00 dB" in warning for warning in left.warnings)
    np.testing.assert_array_equal(left.picture, straight.picture)


@pytest.mark.parametrize(
    ("predicted_db", "deblurred"), [(LEAST_CONFIRMED_DB - 0.01, False), (LEAST_CONFIRMED_DB, True)]
)
def test_only_gains_above_a_minimum_are_acted_on(simulated, monkeypatch, predicted_db, deblurred):
    """Frames with a predicted gain below the minimum are not deblurred and have a warning."""
    capture = simulated()
    plan = replace(capture.plan(PRESETS["fast"]), confirmed=ConfirmedGain(1.0, 0.2, 0.02, 4))
    monkeypatch.setattr(ConfirmedGain, "of_change_db", lambda *_: (predicted_db, 0.2))
    found = next(capture.restored(plan))
    assert found.degradation is not None
    assert (found.degradation.deblur is not None) == deblurred
    assert any("expected to gain only 0.49 dB" in warning for warning in found.warnings) != deblurred


def test_chroma_is_restored_jointly(simulated):
    """Joining neighbours for chroma lowers its error by 5 % or more beyond the joint luma."""
    capture = simulated(rate_rad_s=2.4, bitrate_bits_per_px=2.0)
    plan = replace(capture.plan(PRESETS["best"]), confirmed=None)

    def colour_error() -> float:
        errors = []
        for restored in capture.restored(plan):
            left, top, right, bottom = restored.valid_px
            error = restored.picture.astype(float) - capture.truth(restored.frame.index)
            error = (error - (error @ (0.299, 0.587, 0.114))[..., None])[top:bottom, left:right]
            errors.append(np.mean(error[16:-16, 16:-16] ** 2))
        return float(np.mean(errors))

    joint = colour_error()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("virest.restoration.colour.join_neighbours", lambda *_: None)
        alone = colour_error()
    assert joint < 0.95 * alone


def test_a_neighbour_that_shows_something_else_is_left_out(simulated):
    """A picture of another scene in place of a neighbour does not lower the quality of the frame."""
    capture = simulated()
    plan = replace(capture.plan(PRESETS["balanced"]), confirmed=None)
    frames = list(capture.recorded())
    foreign = frames[0][1][::-1, ::-1].copy()
    mixed = [(frame, picture if k != 4 else foreign) for k, (frame, picture) in enumerate(frames)]
    alone = next(restore_frames([frames[3]], capture.capture.imu, plan))
    beside = next(restore_frames(mixed[3:5], capture.capture.imu, plan, {frames[3][0].index}))
    truth = capture.truth(frames[3][0].index)
    assert psnr_db(beside.picture, truth, alone.valid_px) > psnr_db(alone.picture, truth, alone.valid_px) - 0.1


@pytest.mark.parametrize("number", [3, 4], ids=["last before", "first after"])
def test_a_scene_cut_does_no_harm(simulated, number):
    """Frames beside a cut are as good as from frames of the same scene, or as from themselves alone."""
    capture = simulated()
    plan = replace(capture.plan(PRESETS["balanced"]), confirmed=None)
    frames = list(capture.recorded())
    cut = [(f, p if (k < 4) == (number < 4) else p[::-1, ::-1].copy()) for k, (f, p) in enumerate(frames)]
    wanted = {frames[number][0].index}
    alone = next(restore_frames([frames[number]], capture.capture.imu, plan))
    own = next(restore_frames(frames[:4] if number < 4 else frames[4:], capture.capture.imu, plan, wanted))
    beside = next(restore_frames(cut, capture.capture.imu, plan, wanted))
    truth = capture.truth(frames[number][0].index)
    db = [psnr_db(restored.picture, truth, alone.valid_px) for restored in (beside, own, alone)]
    assert db[0] > max(db[1:]) - 0.1


@pytest.mark.scenario
def test_moving_objects_do_not_become_worse(simulated):
    """Their blur is not the camera's: they stay as recorded, and the static scene still gains from neighbours."""
    capture = simulated(moving_px_s=240.0)
    plan = replace(capture.plan(PRESETS["balanced"]), confirmed=None)
    joint = _gains(capture, plan)
    single = _gains(capture, replace(plan, settings=replace(plan.settings, neighbours=0)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("virest.restoration.frame.static_part", lambda _: None)
        all_taken = _gains(capture, plan)
    assert joint.min() > -0.1
    assert np.all(joint > single - 0.1)
    assert joint.mean() > max(single.mean() + 0.3, all_taken.mean())


@pytest.mark.scenario
def test_moving_objects_do_not_become_worse_in_frames_restored_alone(simulated, monkeypatch):
    """Adjacent frames show what moves, and the static scene still gains.

    Less is taken of frames that the coder predicted, of both alike: here none counts as predicted.
    """
    capture = simulated(moving_px_s=240.0)
    monkeypatch.setattr("virest.restoration.capture.predicted_from", lambda *_: ())
    plan = replace(capture.plan(PRESETS["fast"]), confirmed=None)
    checked = _gains(capture, plan)
    monkeypatch.setattr("virest.restoration.neighbours.sights.moves_on_its_own", lambda *_: False)
    unchecked = _gains(capture, plan)
    assert checked.min() > -0.1
    assert checked.mean() > unchecked.mean() + 0.1


def test_a_frame_does_not_depend_on_the_rest_of_the_movie(simulated):
    """Its bytes are the same from the whole movie and from its neighbours alone."""
    capture = simulated()
    plan = capture.plan(PRESETS["balanced"])
    frames = list(capture.recorded())
    whole = {r.frame.index: r for r in restore_frames(frames, capture.capture.imu, plan)}
    number = frames[4][0].index
    part = list(restore_frames(frames[4 - plan.reach : 5 + plan.reach], capture.capture.imu, plan, {number}))
    assert [r.frame.index for r in part] == [number]
    np.testing.assert_array_equal(part[0].picture, whole[number].picture)
    assert part[0].parameters["deblur"] == whole[number].parameters["deblur"]


def test_an_unconfirmed_gain_is_null(simulated):
    """Without confirmation the gain is null; with it every deblurred frame has a gain and a deviation."""
    capture = simulated()
    plan = capture.plan(PRESETS["fast"])
    confirmed = [r.parameters["deblur"] for r in capture.restored(plan)]
    alone = [r.parameters["deblur"] for r in capture.restored(replace(plan, confirmed=None))]
    deblurred = [d for d in confirmed if d["method"] != "none"]
    assert deblurred
    assert all(d["expected_gain_db"] > 0 and d["expected_gain_std_db"] >= 0 for d in deblurred)
    assert all(d["expected_gain_db"] is None for d in alone if d["method"] != "none")


def test_nothing_is_deblurred_if_neighbours_see_no_gain(simulated):
    """A share of 0 leaves every frame undeblurred, and the log gives the expected gain."""
    capture = simulated()
    plan = capture.plan(PRESETS["fast"])
    assert plan.confirmed is not None
    refused = list(capture.restored(replace(plan, confirmed=replace(plan.confirmed, share=0.0))))
    assert all(r.parameters["deblur"]["method"] == "none" for r in refused)
    assert any("0.00 dB" in text for r in refused for text in r.warnings)


@pytest.mark.parametrize("reach", [0, 1, 3])
def test_each_frame_comes_once_with_its_neighbours(reach):
    """Windows are cut at both ends and miss no frame."""
    sights = [Sight(None, np.zeros((k + 1, 1), np.uint8), None) for k in range(6)]  # type: ignore[arg-type]
    seen = [([len(s.picture) for s in b], len(h.picture), [len(s.picture) for s in a])
            for b, h, a in with_neighbours(sights, reach)]  # fmt: skip
    assert [here for _, here, _ in seen] == [1, 2, 3, 4, 5, 6]
    assert all(before == list(range(max(here - reach, 1), here)) for before, here, _ in seen)
    assert all(after == list(range(here + 1, min(here + reach, 6) + 1)) for _, here, after in seen)


@pytest.mark.scenario
@pytest.mark.parametrize(("rate", "exposure_ms"), [(0.3, 5.0), (1.5, 8.0)], ids=["gentle", "fast"])
def test_a_known_defocus_never_spoils_a_frame(simulated, rate, exposure_ms):
    """A Gaussian passes hardly anything at high frequencies, where the recorded values are noise."""
    capture = simulated(True, effects=["defocus=1.8"], rate_rad_s=rate, exposure_ms=exposure_ms)
    gains = _gains(capture, capture.plan(replace(PRESETS["balanced"], neighbours=0)))
    assert gains.min() > -0.1
    assert gains.mean() > 0.5


@pytest.mark.scenario
def test_a_blur_longer_than_a_tile_is_undone(simulated):
    """Paths of 100 px and more in a large picture are measured at a reduced size and restored."""
    capture = simulated(width=480, height=400, focal_px=700.0, rate_rad_s=6.0, exposure_ms=30.0, frames=3)
    settings = replace(PRESETS["fast"], min_blur_px=1.0)
    plan = replace(capture.plan(settings), confirmed=None, refusal=None)
    lengths = [r.parameters["blur"]["length_px"] for r in capture.restored(plan)]
    gains = _gains(capture, plan)
    assert max(lengths) > 100
    assert gains.min() > -0.1
    assert gains[int(np.argmax(lengths))] > 0.2


def test_frames_smaller_than_a_compared_tile_have_no_neighbours(simulated):
    """They are restored alone; the comparison used to fail."""
    capture = simulated(width=72, height=56, focal_px=70.0, exposure_ms=30.0, frames=4)
    plan = capture.plan(PRESETS["balanced"])
    assert plan.missing_turn is None
    assert plan.confirmed is None
    assert [restored.status for restored in capture.restored(plan)] == ["restored"] * 4


@pytest.mark.parametrize("effect", ["vignetting=0.6", "flicker=0.4,100"])
def test_uneven_light_keeps_no_neighbour_away(simulated, effect):
    """Frame and neighbours are joined without their vignetting and flicker, which lie elsewhere in each."""
    capture = simulated(config=True, effects=[effect], width=208, height=272, frames=5, bitrate_bits_per_px=2.0)
    plan = RestorationPlan(capture.profile, PRESETS["balanced"])
    gains = []
    for one in (plan, replace(plan, settings=replace(plan.settings, neighbours=0))):
        pictures = [(frame, picture) for frame, picture in capture.recorded()]
        (found,) = restore_frames(pictures, capture.capture.imu, one, {2})
        gains.append(psnr_db(found.picture, capture.truth(2), found.valid_px))
        assert bool(found.degradation.deblur.neighbours) == (one is plan)
    assert gains[0] > gains[1] + 0.5
