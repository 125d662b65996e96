"""Boards drawn at known positions are found there, whether complete, cut off or moved."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from virest.camera.intrinsics import Intrinsics
from virest.evaluation.board_scenes import BoardSetting, board_scene, board_session, sideways_motion
from virest.evaluation.boards import find_board, matched, plane_lattice
from virest.simulation.exposure import instant

KINDS = ("chessboard", "aprilgrid")
FOCAL_PX = 400.0
WIDTH, HEIGHT = 480, 360


def picture_of(kind: str, turn_rad: tuple[float, float, float] = (0.03, -0.02, 0.05), seed: int = 3) -> np.ndarray:
    """A board seen by a rotated camera, in grey."""
    scene = board_scene(BoardSetting("x", kind, WIDTH, HEIGHT, seed=seed), FOCAL_PX)
    chart = np.clip(255 * scene.chart ** (1 / 2.2), 0, 255).astype(np.uint8)
    finer = scene.chart_focal_px
    to_picture = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1]])
    to_chart = np.array([[finer, 0, (chart.shape[1] - 1) / 2], [0, finer, (chart.shape[0] - 1) / 2], [0, 0, 1]])
    homography = to_picture @ cv2.Rodrigues(np.array(turn_rad))[0] @ np.linalg.inv(to_chart)
    seen = cv2.warpPerspective(chart, homography, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY), np.uint8)


@pytest.mark.parametrize("kind", KINDS)
def test_corners_lie_on_a_plane_with_subpixel_accuracy(kind: str) -> None:
    """Without distortion all corners fit one homography, and none is missing."""
    board = find_board(picture_of(kind))
    assert board is not None
    assert board.kind == kind
    assert board.points_px.shape == {"chessboard": (6, 8, 2), "aprilgrid": (8, 10, 2)}[kind]
    assert np.isfinite(board.points_px).all()
    assert np.sqrt(np.mean((plane_lattice(board) - board.points_px) ** 2)) < 0.04
    assert (np.diff(board.points_px[..., 0], axis=1) > 0).all()
    assert (np.diff(board.points_px[..., 1], axis=0) > 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_moved_board_is_matched_corner_by_corner(kind: str) -> None:
    """Corners of a picture moved by 11 px lie 11 px from the true ones, although this is close to half a square."""
    picture = picture_of(kind)
    moved = cv2.warpAffine(
        picture, np.array([[1.0, 0, 11], [0, 1, -4]]), (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT
    )
    truth, board = find_board(picture), find_board(moved)
    assert truth is not None
    apart = matched(board, truth) - truth.points_px
    assert np.isfinite(apart).all()
    np.testing.assert_allclose(apart, np.broadcast_to([11.0, -4.0], apart.shape), atol=0.1)


def test_a_board_cut_off_by_the_edge_keeps_its_corner_numbers() -> None:
    """With three columns outside the frame, the others match the same corners of the complete board."""
    picture = picture_of("chessboard", (0.0, 0.0, 0.0))
    truth = find_board(picture)
    assert truth is not None
    cut = picture.copy()
    cut[:, int(truth.points_px[0, 5, 0] + 0.5 * truth.step_px) :] = 128
    found = matched(find_board(cut), truth)
    assert np.isfinite(found[:, :5]).all()
    np.testing.assert_allclose(found[:, :5], truth.points_px[:, :5], atol=0.1)


def test_a_distorted_board_is_a_plane_through_its_lens() -> None:
    """Barrel distortion bends the lattice by more than 0.5 px; with the lens model, a plane fits it."""
    lens = Intrinsics(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, 241.0, 177.0, "radtan", (-0.12, 0.02, 0.0, 0.0, 0.0))
    board = find_board(picture_of("chessboard"))
    assert board is not None
    ideal = Intrinsics(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, 241.0, 177.0)
    bent = replace(board, points_px=lens.project(ideal.rays(board.points_px)))
    assert np.abs(plane_lattice(bent) - bent.points_px).max() > 0.5
    assert np.abs(plane_lattice(bent, lens) - bent.points_px).max() < 0.15


def test_texture_without_a_board_gives_no_board(rng: np.random.Generator) -> None:
    """No board is found in random texture."""
    noise = cv2.resize(rng.uniform(0, 255, (40, 60)).astype(np.float32), (480, 320), interpolation=cv2.INTER_CUBIC)
    assert find_board(np.clip(noise, 0, 255).astype(np.uint8)) is None


@pytest.mark.parametrize(("width", "height", "axis"), [(640, 480, 1), (480, 640, 0)])
def test_the_motion_is_across_the_readout(width: int, height: int, axis: int) -> None:
    """A landscape phone turns about y, a portrait one about x: across the rows or columns that are read."""
    motion = sideways_motion(BoardSetting("x", "chessboard", width, height, turn_rad_s=2.0, seed=5))
    rate = np.abs(motion.rate_rad_s(np.linspace(0, 2, 500)))
    assert int(rate.max(axis=0).argmax()) == axis
    assert rate[:, axis].max() == pytest.approx(2.0, rel=0.3)


def test_a_session_shows_the_board_at_its_depth() -> None:
    """Near boards are on a plane at their depth, and the complete board is visible in the middle of the motion."""
    setting = BoardSetting("x", "aprilgrid", WIDTH, HEIGHT, frames=4, turn_rad_s=0.5, travel_m_s=0.3, depth_m=1.4)
    session = board_session(setting)
    assert session.scene.depth_m == 1.4
    light = instant(session.scene, session.motion, session.view, 0.05)
    board = find_board(np.clip(255 * light[..., 1] ** 0.45, 0, 255).astype(np.uint8))
    assert board is not None
    assert np.isfinite(board.points_px).all()
