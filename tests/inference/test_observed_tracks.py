"""From tracked pairs to a table: selection, windows, thinning, and rotations of frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion.synthetic_tracks import Setup, recorded

from virest.camera.profile import CameraProfile
from virest.capture.imu import ImuSamples
from virest.capture.records import Capture, CaptureMetadata, Frame
from virest.inference.observed_tracks import MIN_TRACKS, WINDOW_S, ObservedTracks, guessed_lens, observe_tracks
from virest.inference.tracking import TrackPair

HAND = Setup(seed=51, frames=30, points=80)


def with_pairs(pairs: list[TrackPair], stamp_s: np.ndarray) -> ObservedTracks:
    """Tracks in which only the timestamps matter."""
    return replace(
        recorded(HAND).observed,
        pairs=tuple(pairs),
        stamp_s=stamp_s,
        exposure_s=np.full(len(stamp_s), 0.01),
        noise_px=0.1 + 0.001 * np.arange(len(pairs)),
    )


def some_pairs(frames: list[int], points: int = 20) -> list[TrackPair]:
    """Pairs that start at these frames, with arbitrary points."""
    rng = np.random.default_rng(3)
    return [TrackPair(k, k + 1, rng.uniform(0, 470, (points, 2)), rng.uniform(0, 470, (points, 2))) for k in frames]


def test_frame_rotations_match_the_camera() -> None:
    """Rotations from points are right within the noise, at the middle of readout and exposure on the camera's clock."""
    setup = replace(HAND, readout_direction="top_to_bottom", readout_time_s=0.004, timestamp="exposure_end")
    recording = recorded(setup)
    found, truth = recording.observed.turns(recording.profile), recording.turns()
    np.testing.assert_allclose(found.vector_rad, truth.vector_rad, atol=1.5e-3)
    np.testing.assert_allclose(found.first_s, truth.first_s, atol=1e-5)
    np.testing.assert_allclose(found.second_s, truth.second_s, atol=1e-5)
    assert np.abs(truth.vector_rad).max() > 0.03


def test_independently_moving_parts_are_left_out() -> None:
    """A dashboard in the lowest quarter is removed.

    Isolated outliers stay, and so does everything if most points disagree.
    """
    observed = recorded(HAND).observed
    table = observed.table(10**6)
    dashboard = table.first_px[:, 1] > 480
    distance = np.random.default_rng(1).rayleigh(1.0, len(table)) * np.where(dashboard, 6.0, 1.0)
    kept, part = observed.without_astray(table.first_px, distance)
    assert part == pytest.approx(dashboard.mean(), abs=1e-9)
    assert all((pair.points_first_px[:, 1] <= 480).all() for pair in kept.pairs)
    assert kept.tracks == (~dashboard).sum()
    assert len(kept.noise_px) == len(kept.pairs)
    np.testing.assert_allclose(
        kept.pairs[4].points_second_px, observed.pairs[4].points_second_px[~dashboard[table.pair == 4]]
    )
    lone = distance.copy()
    lone[dashboard] = 1.0
    lone[::9] = 50.0
    assert observed.without_astray(table.first_px, lone) == (observed, 0.0)
    most = np.where(table.first_px[:, 1] > 200, 6.0, 1.0) * np.random.default_rng(2).rayleigh(1.0, len(table))
    assert observed.without_astray(table.first_px, most)[1] == 0.0


def test_a_pair_left_with_too_few_points_is_removed() -> None:
    """Pairs that keep fewer than MIN_TRACKS points are removed with their noise."""
    rng = np.random.default_rng(4)
    pairs = []
    for k in range(12):
        above = rng.uniform((0, 0), (480, 470), (MIN_TRACKS - 1 if k == 5 else 40, 2))
        first = np.concatenate([above, rng.uniform((0, 490), (480, 640), (25, 2))])
        pairs.append(TrackPair(k, k + 1, first, first + 1.0))
    observed = with_pairs(pairs, np.arange(13) / 30)
    table = observed.table(10**6)
    distance = np.where(table.first_px[:, 1] > 480, 9.0, 1.0)
    kept, _ = observed.without_astray(table.first_px, distance)
    assert [pair.first for pair in kept.pairs] == [k for k in range(12) if k != 5]
    np.testing.assert_allclose(kept.noise_px, np.delete(observed.noise_px, 5))


def test_a_long_capture_has_windows_of_a_few_seconds() -> None:
    """8 s, a pause of 3 s and 2 s more give equal windows, none across the pause and none too long."""
    stamp_s = np.concatenate([np.arange(240) / 30, 11 + np.arange(61) / 30])
    frames = [k for k in range(300) if k != 239]
    table = with_pairs(some_pairs(frames, 3), stamp_s).table(10**6)
    assert table.n_windows == 4
    second_s = [table.second_stamp_s[table.window == w] for w in range(4)]
    assert all(np.ptp(s) <= WINDOW_S for s in second_s)
    lengths = [np.ptp(s) for s in second_s]
    assert max(lengths[:3]) - min(lengths[:3]) < 0.1
    assert second_s[2].max() < 8
    assert second_s[3].min() > 11
    assert (np.diff(table.window) >= 0).all()
    for window in range(4):
        inside = table.window == window
        assert table.first_stamp_s[inside].min() < table.origin_s[window] < table.second_stamp_s[inside].max()


def test_pairs_outside_the_inertial_data_or_over_a_gap_are_removed() -> None:
    """Both frames must lie inside the samples, with the offset applied, and no gap may lie between them."""
    recording = recorded(replace(HAND, time_offset_s=0.25))
    imu = recording.imu
    whole = recording.observed.covered(imu, recording.profile)
    assert len(whole.pairs) == 29
    inside = (imu.time_s > 0.25 + 0.2) & (imu.time_s < 0.25 + 0.8)
    hole = inside & ~((imu.time_s > 0.25 + 0.45) & (imu.time_s < 0.25 + 0.55))
    short = ImuSamples(imu.time_s[hole], imu.gyro_rad_s[hole], imu.accel_m_s2[hole])
    kept = recording.observed.covered(short, recording.profile)
    stamps = [(recording.stamp_s[pair.first], recording.stamp_s[pair.second]) for pair in kept.pairs]
    assert len(stamps) >= 9
    assert all(first > 0.2 and second < 0.8 for first, second in stamps)
    assert all(second < 0.45 or first > 0.55 for first, second in stamps)
    assert any(second < 0.45 for _, second in stamps)
    assert any(first > 0.55 for first, _ in stamps)
    assert len(kept.noise_px) == len(stamps)


def test_a_table_is_thinned_evenly() -> None:
    """About the requested number of points remains, from every pair, the same in both frames."""
    observed = recorded(HAND).observed
    table = observed.table(500)
    assert 400 < len(table) <= 500 + 29
    counts = np.bincount(table.pair, minlength=29)
    assert counts.min() > 0.7 * counts.mean()
    whole = observed.table(10**6)
    assert len(whole) == observed.tracks
    places = {tuple(row) for row in np.concatenate([whole.first_px, whole.second_px], axis=1)}
    assert {tuple(row) for row in np.concatenate([table.first_px, table.second_px], axis=1)} <= places


def capture(stamps_s: list[float], exposures_s: list[float | None]) -> Capture:
    """A recording in which only the frames matter."""
    frames = tuple(Frame(k, 0, t, e) for k, (t, e) in enumerate(zip(stamps_s, exposures_s, strict=True)))
    imu = ImuSamples(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    return Capture("c", Path("c"), Path("c"), 480, 640, frames, imu, CaptureMetadata(), "REALTIME", 0)


def test_usable_pairs_are_kept() -> None:
    """Pairs with too few points or a frame without timestamp are removed.

    A missing exposure is replaced by the typical one.
    """
    pairs = [*some_pairs([0, 1, 2, 3]), *some_pairs([4], MIN_TRACKS - 1), *some_pairs([5])]
    stamps = [0.0, 0.033, np.nan, 0.1, 0.133, 0.166, 0.2]
    found = observe_tracks(
        capture(stamps, [0.01, 0.012, 0.02, None, 0.011, 0.013, None]), pairs, CameraProfile(480, 640)
    )
    assert [pair.first for pair in found.pairs] == [0, 3, 5]
    assert found.exposure_known
    np.testing.assert_allclose(found.exposure_s, [0.01, 0.012, 0.02, 0.012, 0.011, 0.013, 0.012])
    assert len(found.noise_px) == 3
    assert found.lens == guessed_lens(CameraProfile(480, 640))
    assert found.lens.fx_px == pytest.approx(512)


def test_unknown_exposures_count_as_zero() -> None:
    """If no frame has an exposure, all are zero and marked as unknown; a known lens is the profile's."""
    profile = recorded(HAND).profile
    found = observe_tracks(capture([0.0, 0.03, 0.07], [None, None, None]), some_pairs([0, 1]), profile)
    assert not found.exposure_known
    assert not found.exposure_s.any()
    assert found.lens == profile.intrinsics
