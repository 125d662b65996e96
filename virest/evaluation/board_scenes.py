"""Calibration boards before a dead-leaves wall, seen by a camera moving fast sideways: the paper's Case A with truth.

The chessboard or AprilGrid is drawn at the chart's centre, at infinity (only rotation matters) or near (translation
matters too).  The camera moves perpendicular to the readout direction, where a rolling shutter shears most (the paper's
Figure 15).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from virest.simulation.hand_motion import HandMotion, Waves, integrate_motion
from virest.simulation.scenes import LENS_SIGMA_PX, Scene, make_scene
from virest.simulation.session import Session, SessionSettings, nominal_camera, plan_session

Chart = NDArray[np.float32]
WHITE, BLACK = 0.8, 0.03
"""Reflectance of paper and of ink."""
FIELDS = (9, 7)
"""Chessboard squares along the longer and the shorter side."""
TAGS = (5, 4)
"""AprilGrid tags along the longer and the shorter side."""
TAG_SPACING = 0.3
"""Side of the black squares between tags, as a fraction of a tag's side."""
BOARD_FRACTION = 0.84
"""Fraction of the frame's shorter side that the board fills."""
MOTION_LEAD_S = 1.6
"""Motion before and after the frames, longer than the inertial log there."""
MARGIN = 1.25
"""Extent of the chart relative to the field of view."""


@dataclass(frozen=True, slots=True)
class BoardSetting:
    """One capture of a board."""

    name: str
    board: str
    """``chessboard`` or ``aprilgrid``."""
    width: int = 640
    height: int = 480
    frames: int = 12
    turn_rad_s: float = 2.2
    """Amplitude of the sideways angular rate."""
    travel_m_s: float = 0.0
    """Amplitude of the sideways velocity."""
    depth_m: float = np.inf
    exposure_ms: float = 1.0
    readout_ms: float = 20.0
    noise_levels: float = 1.5
    seed: int = 0


def board_session(setting: BoardSetting) -> Session:
    """Plan a recording of a board by a phone moving fast perpendicular to its readout direction."""
    nominal = nominal_camera(
        setting.width, setting.height, readout_time_s=setting.readout_ms / 1000, depth_m=setting.depth_m
    )
    motion = sideways_motion(setting)
    scene = board_scene(setting, nominal.intrinsics.fx_px if nominal.intrinsics else 1.0)
    settings = SessionSettings(
        scene="board",
        frames=setting.frames,
        exposure_s=(setting.exposure_ms / 1000,),
        rate_rad_s=setting.turn_rad_s / np.sqrt(2),
        noise_levels=setting.noise_levels,
        seed=setting.seed,
    )
    return plan_session(nominal, nominal, settings, scene=scene, motion=motion)


def sideways_motion(setting: BoardSetting) -> HandMotion:
    """Rotation and translation perpendicular to the readout, one slow wave each, plus hand tremor on all axes."""
    rng = np.random.default_rng([setting.seed, 11])
    portrait = setting.height > setting.width
    turn_axis, travel_axis = (0, 1) if portrait else (1, 0)
    frequency, amplitude = rng.uniform(0.6, 9.0, (3, 6)), rng.uniform(0.0, 0.06, (3, 6)) * setting.turn_rad_s
    frequency[turn_axis, 0], amplitude[turn_axis, 0] = rng.uniform(1.6, 2.0), setting.turn_rad_s
    rate = Waves(frequency, amplitude, rng.uniform(0, 2 * np.pi, (3, 6)))
    sway_hz, speed = rng.uniform(0.7, 2.2, (3, 3)), rng.uniform(0.0, 0.15, (3, 3)) * setting.travel_m_s
    sway_hz[travel_axis, 0], speed[travel_axis, 0] = rng.uniform(1.0, 1.4), setting.travel_m_s
    sway = Waves(sway_hz, speed / (2 * np.pi * sway_hz), rng.uniform(0, 2 * np.pi, (3, 3)))
    duration_s = setting.frames / 30.0
    return integrate_motion(rate, sway, -MOTION_LEAD_S, duration_s + MOTION_LEAD_S, centre_on_s=(0.0, duration_s))


def board_scene(setting: BoardSetting, focal_px: float) -> Scene:
    """Dead-leaves wall with a board on it, oversampled and blurred by the lens."""
    half = MARGIN * setting.width / (2 * focal_px) + 0.2, MARGIN * setting.height / (2 * focal_px) + 0.2
    rng = np.random.default_rng([setting.seed, 12])
    scene = make_scene("leaves", rng, focal_px=focal_px, half_extent=half)
    oversampling = scene.chart_focal_px / focal_px
    draw = _chessboard if setting.board == "chessboard" else _aprilgrid
    light = draw(
        int(BOARD_FRACTION * min(setting.width, setting.height) * oversampling), setting.width >= setting.height
    )
    scene = replace(scene, chart=_paste_board(scene.chart, light, LENS_SIGMA_PX * oversampling))
    return scene if np.isinf(setting.depth_m) else scene.at_plane(setting.depth_m)


def _chessboard(short_px: int, landscape: bool) -> Chart:
    """Chessboard with a white rim half a square wide; the top-left square is black."""
    columns, rows = FIELDS if landscape else FIELDS[::-1]
    side = short_px // (min(FIELDS) + 1)
    odd = np.add.outer(np.arange(rows), np.arange(columns)) % 2
    fields = np.where(odd, WHITE, BLACK).astype(np.float32)
    return np.pad(np.kron(fields, np.ones((side, side), np.float32)), side // 2, constant_values=WHITE)


def _aprilgrid(short_px: int, landscape: bool) -> Chart:
    """Tags 36h11, numbered row by row from the bottom as in Kalibr, with black squares touching their corners."""
    columns, rows = TAGS if landscape else TAGS[::-1]
    cell = int(short_px / (min(TAGS) * (1 + TAG_SPACING) + TAG_SPACING + 0.4) / 8)
    tag, gap = 8 * cell, round(TAG_SPACING * 8 * cell)
    pitch = tag + gap
    sheet = np.full((rows * pitch + gap, columns * pitch + gap), WHITE, np.float32)
    for top in range(0, len(sheet), pitch):
        for left in range(0, sheet.shape[1], pitch):
            sheet[top : top + gap, left : left + gap] = BLACK
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number in range(rows * columns):
        top, left = gap + (rows - 1 - number // columns) * pitch, gap + number % columns * pitch
        code = cv2.aruco.generateImageMarker(dictionary, number, tag)
        sheet[top : top + tag, left : left + tag] = np.where(code > 0, WHITE, BLACK)
    return np.pad(sheet, gap, constant_values=WHITE)


def _paste_board(chart: Chart, light: Chart, sigma_px: float) -> Chart:
    """Paste a board into the centre of an already blurred chart, and apply the lens blur to it."""
    rim = int(4 * sigma_px) + 1
    top, left = ((whole - part) // 2 for whole, part in zip(chart.shape, light.shape, strict=False))
    result = chart.copy()
    result[top : top + light.shape[0], left : left + light.shape[1]] = light[..., None]
    around = slice(top - rim, top + light.shape[0] + rim), slice(left - rim, left + light.shape[1] + rim)
    result[around] = cv2.GaussianBlur(result[around], (0, 0), sigma_px)
    return result
