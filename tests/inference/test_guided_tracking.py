"""Tracking guided by the gyroscope: its benefit, and cases where the guide must not be used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion.synthetic_motion import hand_motion
from motion.turning_pictures import R_CAM_IMU, Phone, Recording, blobs, chessboard, grating, shaken
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.image_formation.point_model import integrate_motion, predict
from virest.inference.guidance import gyro_guide, map_between
from virest.inference.guide_choice import find_guide
from virest.inference.observed_tracks import track_table
from virest.inference.tracking import TrackPair, track_pairs
from virest.restoration.capture import restore_frames
from virest.restoration.capture_estimation import plan_restoration
from virest.restoration.settings import PRESETS

Array = NDArray[np.float64]
SQUARE_PX, FAST_RAD_S = 40, 2.0
"""The content moves by more than a square per frame (median 43 px)."""


@pytest.fixture(scope="module")
def board() -> Recording:
    """A shaken chessboard."""
    return shaken(chessboard(SQUARE_PX), FAST_RAD_S)


@pytest.fixture(scope="module")
def wall() -> Recording:
    """Texture without repetition, shaken as much."""
    return shaken(blobs(), FAST_RAD_S)


def off_px(recording: Recording, pairs: list[TrackPair]) -> Array:
    """Distances (n,) of points from their true positions."""
    stamp_s = np.array([frame.time_s for frame in recording.capture.frames])
    exposure_s = np.full(len(stamp_s), recording.phone.exposure_s)
    table = track_table(pairs, stamp_s, exposure_s, np.ones(len(pairs)))
    put = predict(integrate_motion(recording.capture.imu, recording.phone.profile, translation=False), table, None)
    return np.asarray(np.linalg.norm(table.second_px - put.second_px, axis=1))


def followed(recording: Recording, profile: CameraProfile | None = None) -> list[TrackPair]:
    """Points tracked with the gyroscope as a guide."""
    guide = gyro_guide(recording.capture, profile or recording.phone.profile)
    return track_pairs(recording.gray(recording.frames), guide=guide)


def strange_logs(recording: Recording) -> dict[str, Array]:
    """Gyroscope logs unrelated to the frames."""
    own, rng = recording.capture.imu.gyro_rad_s, np.random.default_rng(1)
    time_s = recording.capture.imu.time_s
    others = {f"other {k}": hand_motion(100 + k, FAST_RAD_S).rate(time_s) @ np.array(R_CAM_IMU) for k in range(3)}
    pieces = [
        piece for _, piece in sorted(zip(rng.random(12), np.array_split(own, 12), strict=True), key=lambda p: p[0])
    ]
    return {"reversed": own[::-1], "shuffled": rng.permutation(own), "pieces": np.concatenate(pieces), **others}


# ── benefits ─────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("drawing", [chessboard(SQUARE_PX), chessboard(12), grating(24)], ids=["40", "12", "waves"])
def test_repeating_texture_is_tracked(drawing: NDArray[np.uint8]) -> None:
    """Squares and waves move by several periods per frame.

    Without the guide most points are matched to a neighbouring period.
    """
    recording = shaken(drawing, FAST_RAD_S, frames=10)
    assert find_guide(recording.capture, recording.phone.profile, recording.gray, recording.frames) is not None
    off = off_px(recording, followed(recording))
    assert (off > 3).mean() < 0.02
    assert len(off) > 80 * (len(recording.pictures) - 1)
    assert np.median(off) < 0.1
    assert (off_px(recording, track_pairs(recording.gray(recording.frames))) > 3).mean() > 0.5


def test_a_fast_pan_over_a_chessboard_is_tracked() -> None:
    """A rotation at 4 rad/s, 60 px to 100 px per frame, is similar in every frame and for many axis maps."""
    recording = Phone(chessboard(SQUARE_PX), hand_motion(3, 1.0, pan_rad_s=(0.0, 4.0, 0.0)), frames=10).record()
    guide = find_guide(recording.capture, recording.phone.profile, recording.gray, recording.frames)
    assert guide is not None
    off = off_px(recording, track_pairs(recording.gray(recording.frames), guide=guide))
    assert (off > 3).mean() < 0.02


def test_an_unknown_offset_and_permuted_axes_are_found(board: Recording) -> None:
    """The log is 0.3 s late with permuted axes, and the profile knows neither; the frames determine both."""
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    late = np.roll(board.capture.imu.gyro_rad_s @ turn.T, 60, axis=0)
    profile = replace(board.phone.profile, time_offset_s=None)
    guide = find_guide(board.with_log(late).capture, profile, board.gray, board.frames)
    assert guide is not None
    found = guide.known.profile
    assert found.time_offset_s == pytest.approx(0.3, abs=0.006)
    assert np.allclose(found.rotation_cam_imu, np.array(R_CAM_IMU) @ turn.T)


def test_fast_and_blurred_frames_keep_their_points() -> None:
    """At motion of more than 55 px per frame, more than 60 % as many points are kept as at a tenth of the motion."""
    drawing = blobs()
    fast, slow = (shaken(drawing, 3.3 * part, instants=8, frames=8) for part in (1.0, 0.1))
    moved = np.concatenate([pair.points_second_px - pair.points_first_px for pair in followed(fast)])
    assert np.median(np.linalg.norm(moved, axis=1)) > 55
    kept = [off_px(recording, followed(recording)) for recording in (fast, slow)]
    assert (kept[0] < 1).sum() > 0.6 * (kept[1] < 1).sum()


def test_guided_tracking_has_no_more_noise(wall: Recording) -> None:
    """Guided points are at least as accurate and as numerous as unguided ones."""
    plain, guided = off_px(wall, track_pairs(wall.gray(wall.frames))), off_px(wall, followed(wall))
    assert len(guided) >= len(plain)
    assert np.median(guided) <= np.median(plain)


@pytest.mark.scenario
def test_a_shaken_chessboard_is_restored(board: Recording) -> None:
    """Planned and restored as by ``process``, frames improve by more than 5 dB."""
    plan = plan_restoration(board.capture, board.phone.profile, PRESETS["fast"], board.gray)
    assert plan.copy_reason is None
    chosen = [3, 6, 9]
    recorded = [(board.capture.frames[k], np.repeat(board.pictures[k][..., None], 3, -1)) for k in chosen]
    for restored in restore_frames(recorded, board.capture.imu, plan):
        number, inner = restored.frame.index, (slice(40, -40), slice(40, -40))
        truth = board.sharp(number)[inner]
        before, after = (
            np.mean((shown[inner] - truth) ** 2) for shown in (board.pictures[number], restored.picture[..., 1])
        )
        assert 10 * np.log10(before / after) > 5, number


# ── limits ───────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.filterwarnings("error")
def test_a_log_in_degrees_gives_no_guide(board: Recording) -> None:
    """Predicted points turn behind the camera."""
    strange = board.with_log(180 / np.pi * board.capture.imu.gyro_rad_s)
    assert find_guide(strange.capture, board.phone.profile, board.gray, board.frames) is None


def test_an_unrelated_log_gives_no_guide(board: Recording, wall: Recording) -> None:
    """Reversed, shuffled or cut logs, and those of other recordings, give no guide for any content."""
    for recording in (board, wall):
        for name, log in strange_logs(recording).items():
            for offset_s in (0.0, None):
                profile = replace(recording.phone.profile, time_offset_s=offset_s)
                strange = recording.with_log(log)
                assert find_guide(strange.capture, profile, recording.gray, recording.frames) is None, name


def test_an_unrelated_log_is_refused(board: Recording) -> None:
    """A chessboard with another recording's log is copied."""
    strange = board.with_log(strange_logs(board)["other 0"])
    plan = plan_restoration(strange.capture, board.phone.profile, PRESETS["fast"], board.gray)
    assert plan.copy_reason is not None
    assert "disagree" in plan.copy_reason


def test_a_still_camera_with_a_moving_log_is_refused(board: Recording) -> None:
    """A phone at rest films a chessboard, and the log belongs to a moving phone."""
    rest = replace(shaken(chessboard(SQUARE_PX), 0.0, instants=1), capture=board.capture)
    for offset_s in (None, 0.0):
        profile = replace(board.phone.profile, time_offset_s=offset_s)
        assert find_guide(rest.capture, profile, rest.gray, rest.frames) is None
    plan = plan_restoration(rest.capture, board.phone.profile, PRESETS["fast"], rest.gray)
    assert plan.copy_reason is not None


def test_a_wrong_profile_does_not_pull_points(wall: Recording) -> None:
    """Less than 3 % of the guide's error appears in the points, which follow the frames."""
    lens = wall.phone.profile.intrinsics
    assert lens is not None
    wrong = replace(wall.phone.profile, time_offset_s=0.006, intrinsics=lens.scaled_focal(1.04))
    right, pulled = followed(wall), followed(wall, wrong)
    error, change = [], []
    for one, other in zip(right, pulled, strict=True):
        _, i, j = np.intersect1d(one.points_first_px @ [1, 1e4], other.points_first_px @ [1, 1e4], return_indices=True)
        pair = replace(one, points_first_px=one.points_first_px[i], points_second_px=one.points_second_px[i])
        error.append(put_by(wall, wrong, pair) - put_by(wall, wall.phone.profile, pair))
        change.append(other.points_second_px[j] - pair.points_second_px)
    errors, changes = np.concatenate(error), np.concatenate(change)
    assert np.median(np.linalg.norm(errors, axis=1)) > 1.5
    assert abs((errors * changes).sum() / (errors**2).sum()) < 0.03
    assert len(errors) > 0.95 * sum(map(len, right))


def put_by(recording: Recording, profile: CameraProfile, pair: TrackPair) -> Array:
    """Positions of a pair's points (n, 2) in the second frame, as predicted by a profile."""
    stamp_s = np.array([frame.time_s for frame in recording.capture.frames])
    table = track_table([pair], stamp_s, np.full(len(stamp_s), recording.phone.exposure_s), np.ones(1))
    return predict(integrate_motion(recording.capture.imu, profile, translation=False), table, None).second_px


def test_independently_moving_parts_are_still_tracked(wall: Recording) -> None:
    """A dashboard in the lower third is static in the frames, and so are its points."""
    edge, dashboard = 240, blobs(seed=9)[:120, :480]
    pictures = [np.concatenate([picture[:edge], dashboard]) for picture in wall.pictures]
    driving = replace(wall, pictures=pictures)
    pairs = followed(driving)
    kept = [pair.points_first_px[:, 1] > edge + 12 for pair in pairs]
    moved = np.concatenate([(p.points_second_px - p.points_first_px)[k] for p, k in zip(pairs, kept, strict=True)])
    still = np.linalg.norm(moved, axis=1) < 0.5
    plain = track_pairs(driving.gray(driving.frames))
    assert still.mean() > 0.9
    assert still.sum() > 0.7 * sum((pair.points_first_px[:, 1] > edge + 12).sum() for pair in plain)


# ── the map ──────────────────────────────────────────────────────────────────────────────────────────────────────


def test_the_map_matches_the_forward_model(wall: Recording) -> None:
    """Its polynomials match the prediction within 0.01 px, and its inverse leads back."""
    guide = gyro_guide(wall.capture, wall.phone.profile)
    between = guide.seen_before(4, 5, (wall.phone.height, wall.phone.width), 1)
    assert between is not None
    rng = np.random.default_rng(0)
    points = rng.uniform((80, 80), (400, 280), (200, 2))
    there = between.second_of(points)
    assert np.abs(between.first_of(there) - points).max() < 0.005
    pair = TrackPair(4, 5, points, there)
    assert np.abs(put_by(wall, wall.phone.profile, pair) - there).max() < 0.01


@pytest.mark.filterwarnings("error")
def test_a_map_beyond_the_picture_stays_finite() -> None:
    """At 12 rad/s, frames share nothing: the inverse map has no solution, and ends without an overflow."""

    def first_of(points: Array) -> Array:
        return points + 900.0 + 0.01 * points**2

    bend = map_between(first_of, (240, 320), 1)
    corners = np.array([[0.0, 0.0], [319.0, 0.0], [0.0, 239.0], [319.0, 239.0]])
    assert np.isfinite(bend.second_of(corners)).all()
    np.testing.assert_allclose(bend.first_of(corners), first_of(corners), atol=1e-6)
