"""Directions of travel from parallax alone, and the readout time of a camera that drives forward."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_tracks import Setup, recorded

from virest.inference import profile_terms as terms_of
from virest.inference.track_evidence import Linearisation, TrackEvidence
from virest.inference.track_fit import fit_tracks, many_directions, one_direction
from virest.inference.travel_direction import find_directions, without_directions
from virest.motion.scene_motion import DirectedMotion

Array = np.ndarray
DRIVE = Setup(
    seed=41, velocity_m_s=(0.3, -0.2, 2.4), inverse_depth_per_m=(0.01, 0.3), rate_rad_s=0.25, accelerometer=False,
    readout_direction="bottom_to_top", frames=40, points=35, gyro_noise_rad_s=0.0005,
)  # fmt: skip
WANTED = (terms_of.TIME_OFFSET, terms_of.READOUT, terms_of.IMU_ROTATION)


def unit(vectors: Array) -> Array:
    """The vectors, normalised to length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def parallax(seed: int, groups: int, points: int) -> tuple[Array, Array, Array, Array]:
    """Differences (n, 2), flow (n, 2, 3), group (n,) and directions (groups, 3) of a moving pinhole camera."""
    rng = np.random.default_rng(seed)
    direction = unit(rng.normal((0.0, 0.0, 1.5), 1.0, (groups, 3)))
    group = np.arange(groups * points) % groups
    x, y = rng.uniform((-0.45, -0.6), (0.45, 0.6), (len(group), 2)).T
    one, none = np.ones_like(x), np.zeros_like(x)
    flow = 500 * np.stack([np.stack([one, none, -x], axis=-1), np.stack([none, one, -y], axis=-1)], axis=1)
    depth = rng.uniform(0.0, 0.05, len(group))
    difference = depth[:, None] * np.einsum("nij,nj->ni", flow, direction[group])
    return difference + rng.normal(0, 0.3, difference.shape), flow, group, direction


@pytest.mark.parametrize(("groups", "points"), [(1, 300), (4, 150)])
def test_directions_are_found_up_to_their_sign(groups: int, points: int) -> None:
    """With unknown depths, noise and 10 % outliers, each group's direction is right within 2°."""
    difference, flow, group, direction = parallax(3, groups, points)
    lost = np.random.default_rng(4).random(len(group)) < 0.1
    difference = difference + lost[:, None] * np.random.default_rng(5).uniform(-30, 30, difference.shape)
    found = find_directions(flow, difference, group, groups, None)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    assert (np.abs((found * direction).sum(axis=1)) > np.cos(np.radians(2))).all()
    again = find_directions(flow, difference, group, groups, unit(found + np.array([0.05, -0.04, 0.02])))
    assert (np.abs((again * direction).sum(axis=1)) > np.cos(np.radians(2))).all()


def test_directions_are_eliminated() -> None:
    """After the elimination, no rotation of a direction changes the weighted sum of squares to first order."""
    difference, flow, group, direction = parallax(6, 3, 120)
    rng = np.random.default_rng(7)
    weight, rows = rng.uniform(0.2, 1, len(group)), rng.normal(size=(len(group), 2, 2))
    moved = np.einsum("nij,nj->ni", flow, direction[group])
    way = unit(moved)
    normal = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    across = (normal * difference).sum(axis=1)
    left = normal * across[:, None]
    kept_rows, kept = without_directions(rows, left, weight, difference, flow, direction, group)
    np.testing.assert_allclose((way * kept).sum(axis=1), 0, atol=1e-9)
    np.testing.assert_allclose(np.einsum("ni,nik->nk", way, kept_rows), 0, atol=1e-9)
    for turn in np.eye(3):
        step = turn - (direction @ turn)[:, None] * direction
        turned = unit(np.einsum("nij,nj->ni", flow, unit(direction + 1e-6 * step)[group]))
        slope = (turned[:, 0] * difference[:, 1] - turned[:, 1] * difference[:, 0] - across) / 1e-6
        for column in (*np.einsum("ni,nik->kn", normal, kept_rows), (normal * kept).sum(axis=1)):
            for g in range(3):
                cosine = weight * slope * column * (group == g)
                assert abs(cosine.sum()) < 0.01 * np.abs(cosine).sum() + 1e-9


def test_a_drive_is_fitted_across_its_parallax() -> None:
    """Driving forward at unknown depths: rotation alone gives a wrong readout time, a direction gives the right one."""
    recording, aside = recorded(DRIVE), np.array([0.004, -0.006, 0.008, 0.011, -0.009])
    table = recording.table()
    start = recording.profile
    for term, part in zip(WANTED, (aside[:1], aside[1:2], aside[2:]), strict=True):
        start = term.change(start, part)
    plain = fit_tracks(recording.imu, table, start, WANTED)
    found = fit_tracks(recording.imu, table, start, WANTED, one_direction())
    std = np.concatenate([found.std(term.name) for term in WANTED])
    assert plain.scale > 2
    assert abs(plain.profile.shutter.readout_time_s / DRIVE.readout_time_s - 1) > 0.05
    assert found.scale == pytest.approx(1.0, abs=0.1)
    assert (np.abs(found.change + aside) < 4 * std).all()
    assert abs(found.profile.shutter.readout_time_s / DRIVE.readout_time_s - 1) < 0.05
    assert isinstance(found.scene, DirectedMotion)
    truth = recording.in_trajectory_axes(unit(np.array(DRIVE.velocity_m_s)))
    assert abs(found.scene.direction[0] @ truth) > np.cos(np.radians(1))


def test_a_wandering_camera_has_a_direction_for_each_pair() -> None:
    """For a swaying camera near objects, one direction leaves a residual.

    One per pair leaves noise, and the offset is right.
    """
    recording = recorded(
        replace(DRIVE, sway_m=0.08, velocity_m_s=(0.0, 0.0, 0.3), inverse_depth_per_m=(0.05, 0.4), points=60)
    )
    table = recording.table()
    start = terms_of.shift_offset(recording.profile, np.array([0.005]))
    one = fit_tracks(recording.imu, table, start, WANTED[:1], one_direction())
    many = fit_tracks(recording.imu, table, start, WANTED[:1], many_directions(table))
    assert many.scale == pytest.approx(1.0, abs=0.15)
    assert one.scale > 1.3 * many.scale
    assert abs(many.change[0] + 0.005) < 4 * many.std("time_offset")[0]
    assert isinstance(many.scene, DirectedMotion)
    middle_s = np.asarray(recording.profile.imu_time_s(0.5 * (recording.stamp_s[1:] + recording.stamp_s[:-1]) + 0.014))
    travel = recording.position(middle_s, 1)
    fast = np.linalg.norm(travel, axis=1) > 0.25
    agree = np.abs((many.scene.direction * recording.in_trajectory_axes(unit(travel))).sum(axis=1))
    assert fast.sum() > 15
    assert np.median(agree[fast]) > np.cos(np.radians(5))


def test_derivatives_are_reused_while_directions_change(monkeypatch: pytest.MonkeyPatch) -> None:
    """Directions do not change the prediction from rotation, so fewer derivatives suffice."""
    recording = recorded(DRIVE)
    table, taken = recording.table(), []
    start = terms_of.shift_offset(recording.profile, np.array([0.004]))
    of_terms = TrackEvidence._term_slopes
    monkeypatch.setattr(TrackEvidence, "_term_slopes", lambda *given: taken.append(1) or of_terms(*given))
    kept = fit_tracks(recording.imu, table, start, WANTED, one_direction())
    few = len(taken)
    monkeypatch.setattr(Linearisation, "is_stale", lambda look, _limit: look.prediction.second_px is not look.taken_px)
    anew = fit_tracks(recording.imu, table, start, WANTED, one_direction())
    assert 2 * few <= len(taken) - few
    std = np.concatenate([anew.std(term.name) for term in WANTED])
    assert (np.abs(kept.change - anew.change) < 0.1 * std).all()
    np.testing.assert_allclose(np.diag(kept.covariance), np.diag(anew.covariance), rtol=0.05)
