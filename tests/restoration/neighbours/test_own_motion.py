"""What moves against the predicted motion is deblurred along its own path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from virest.app.evaluation_captures import TrueCapture, open_true_capture
from virest.app.simulate import simulate_command
from virest.evaluation.fidelity import psnr_db
from virest.image_formation.kernels import KernelField
from virest.restoration.capture import RestorationPlan
from virest.restoration.neighbours.own_motion import OwnMotion, moves_on_its_own, own_motion
from virest.restoration.settings import PRESETS

Array = NDArray[np.float64]
TILES_PX = np.stack(np.meshgrid([64.0, 192.0, 320.0], [64.0, 192.0]), -1).reshape(-1, 2)
SPEED_PX_S = np.array([[0.0, 0.0], [0.0, 0.0], [180.0, -20.0], [0.0, 0.0], [0.0, 0.0], [170.0, 30.0]])


def seen_from(frames: tuple[int, ...], rng: np.random.Generator, noise_px: float = 0.1) -> Any:
    """Neighbours some frames of 1/30 s away that show the tiles' speeds; the second tile is hidden in the first."""
    found = []
    for number, apart in enumerate(frames):
        shift_px = -SPEED_PX_S * apart / 30 + noise_px * rng.normal(size=SPEED_PX_S.shape)
        precision, apart_s = np.full(len(TILES_PX), 5.0), np.full(len(TILES_PX), apart / 30)
        if number == 0:
            shift_px[1], precision[1] = 40.0, 0.0
        found.append(SimpleNamespace(centres_px=TILES_PX, own_shift_px=shift_px, precision=precision, apart_s=apart_s))
    return found


def test_speeds_grow_with_the_time_between_frames(rng: np.random.Generator) -> None:
    """They are found to their noise, still tiles stay still, and one neighbour alone tells none."""
    own = own_motion(seen_from((-1, 1, 2), rng))
    assert own is not None
    moving = np.linalg.norm(SPEED_PX_S, axis=1) > 0
    assert own.speed_px_s[moving] == pytest.approx(SPEED_PX_S[moving], abs=8)
    assert np.abs(own.speed_px_s[~moving]).max() < 3
    assert own_motion(seen_from((1,), rng)) is None
    assert own_motion(()) is None


def test_shifts_that_do_not_grow_with_time_are_no_speed(rng: np.random.Generator) -> None:
    """A periodic texture is matched one period off in one neighbour."""
    found = seen_from((-1, 1, 2), rng)
    found[-1].own_shift_px[4] = (6.0, 0.0)  # by least squares 60 px/s
    own = own_motion(found)
    assert own is not None
    assert not own.speed_px_s[4].any()


def plane(rng: np.random.Generator) -> NDArray[np.uint8]:
    """A textured picture, 400 × 300."""
    rough = cv2.GaussianBlur(rng.uniform(0, 1, (300, 400)), (0, 0), 2.0)
    return np.asarray(cv2.normalize(rough, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U))


def moved(picture: NDArray[np.uint8], matrix: Array) -> NDArray[np.uint8]:
    """The picture warped by an affine map (2, 3)."""
    return np.asarray(cv2.warpAffine(picture, matrix, picture.shape[::-1], borderMode=cv2.BORDER_REFLECT))


@pytest.mark.parametrize(
    ("width_px", "path_px", "turned_rad", "expected"),
    [(0, 0.0, 0.0, False), (70, 2.0, 0.0, True), (70, 0.7, 0.0, False), (0, 0.0, 0.02, False)],
    ids=["static", "moving figure", "short of the least path", "wrong roll"],
)
def test_a_moving_figure_is_told_from_errors_of_the_prediction(
    rng: np.random.Generator, width_px: int, path_px: float, turned_rad: float, expected: bool
) -> None:
    """A rectangle that slides, and a background that turns by 0.02 rad more; some points have no prediction."""
    exposure_s, apart_s = 0.012, 1 / 30
    first = plane(rng)
    second = moved(first, cv2.getRotationMatrix2D((200, 150), float(np.degrees(turned_rad)), 1.0))
    shift_px = path_px * apart_s / exposure_s
    figure = np.s_[60:240, 150 : 150 + width_px]
    second[figure] = moved(first, np.array([[1, 0, shift_px], [0, 1, 0]]))[figure]
    view: Any = SimpleNamespace(
        frame=SimpleNamespace(exposure_s=exposure_s),
        places_px=lambda points_px: np.where(points_px[:, :1] > 380, np.nan, points_px),
        apart_s=lambda points_px: np.full(len(points_px), apart_s),
    )
    assert moves_on_its_own(view, first, second, 1.0) == expected


@pytest.mark.parametrize("anchor", [0.0, 0.5])
def test_the_path_is_that_of_moving_content(anchor: float, rng: np.random.Generator) -> None:
    """A texture that moves during the exposure equals the sharp one, shown at the anchor, blurred by the kernel."""
    sharp = cv2.GaussianBlur(rng.uniform(0, 1, (96, 96)), (0, 0), 2.0)
    speed_px_s, exposure_s = np.array([300.0, -120.0]), 0.02
    times_s = exposure_s * ((np.arange(64) + 0.5) / 64 - anchor)
    shots = [
        cv2.warpAffine(sharp, np.array([[1, 0, x], [0, 1, y]]), (96, 96), flags=cv2.INTER_CUBIC)
        for x, y in times_s[:, None] * speed_px_s
    ]

    def still(centres_px: Array) -> KernelField:
        return KernelField(centres_px, np.zeros((len(centres_px), 32, 2)), anchor)

    own = OwnMotion(TILES_PX, np.broadcast_to(speed_px_s, TILES_PX.shape))
    (kernel,) = own.kernels(still, exposure_s)(np.array([[48.0, 48.0]])).arrays()
    blurred = cv2.filter2D(sharp, cv2.CV_64F, kernel)
    inner = np.s_[16:-16, 16:-16]
    assert np.abs(blurred - np.mean(shots, axis=0))[inner].max() < 0.02 * np.ptp(sharp)


@pytest.mark.scenario
def test_frames_gain_where_all_content_moves_otherwise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bias of the gyroscope, which no rotation of the neighbours corrects, moves the whole scene."""
    simulate_command(
        tmp_path / "shake", width=320, height=384, focal_px=350.0, exposure_ms=14.0, rate_rad_s=1.2, frames=8, seed=35,
        readout_ms=2.0,
    )  # fmt: skip
    capture = open_true_capture(tmp_path / "shake")
    plan = replace(capture.plan(PRESETS["balanced"]), missing_turn=None, confirmed=None)
    plan = replace(plan, profile=replace(plan.profile, gyro_bias_rad_s=(0.5, -0.4, 0.0)))
    along_own_path = quality_db(capture, plan)
    monkeypatch.setattr("virest.restoration.frame.own_motion", lambda _: None)
    gain_db = along_own_path - quality_db(capture, plan)
    assert gain_db.mean() > 0.1


def quality_db(capture: TrueCapture, plan: RestorationPlan) -> Array:
    """PSNR of each restored frame."""
    return np.array([psnr_db(r.picture, capture.truth(r.frame.index), r.valid_px) for r in capture.restored(plan)])
