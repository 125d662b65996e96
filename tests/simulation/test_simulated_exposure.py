"""Times of rows, the mean over many instants, and the direction of picture motion."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from steady_hand import constant_motion

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import Extensions
from virest.simulation.exposure import (
    expose,
    hat_weights,
    high_passed_angles,
    instant,
    make_view,
    pixel_rays,
    start_fractions,
)
from virest.simulation.scenes import Scene
from virest.simulation.session import nominal_camera

WIDTH, HEIGHT, FOCAL = 120, 90, 100.0


def spot_scene(x: float = 0.0, y: float = 0.0, *, depth_m: float = np.inf) -> Scene:
    """Draw a bright soft spot in direction (x, y, 1) on a dark background."""
    focal = 2 * FOCAL
    rows, columns = np.mgrid[0:801, 0:1001]
    distance = (columns - 500 - focal * x) ** 2 + (rows - 400 - focal * y) ** 2
    return Scene(np.repeat(np.exp(-distance / (2 * 6.0**2))[..., None], 3, 2).astype(np.float32), focal, depth_m)


def plain_scene(light: float) -> Scene:
    """Draw the same light everywhere."""
    return Scene(np.full((801, 1001, 3), light, np.float32), 2 * FOCAL)


def camera(**options):
    """Make a small camera whose principal point is off the middle, lying on its side."""
    profile = nominal_camera(WIDTH, HEIGHT, focal_px=FOCAL, **options)
    return replace(profile, intrinsics=replace(profile.intrinsics, cx_px=57.0, cy_px=47.0))


def centroid_px(light: np.ndarray) -> np.ndarray:
    """(x, y) of the centre of light."""
    weight = light[..., 0].astype(float)
    rows, columns = np.mgrid[0 : weight.shape[0], 0 : weight.shape[1]]
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


@pytest.mark.parametrize(
    ("direction", "fractions"),
    [
        ("top_to_bottom", [0.0, 0.2, 0.4, 0.6, 0.8]),
        ("bottom_to_top", [0.8, 0.6, 0.4, 0.2, 0.0]),
        ("left_to_right", [0.0, 0.25, 0.5, 0.75]),
        ("right_to_left", [0.75, 0.5, 0.25, 0.0]),
    ],
)
def test_rows_start_at_hand_computed_times(direction, fractions):
    """In a picture of 4 × 5 pixels, rows or columns start at these fractions of the readout."""
    assert start_fractions(direction, 4, 5) == pytest.approx(fractions)


def test_weights_take_the_mean_of_light_that_is_linear_in_time(rng):
    """Each row's weights sum to 1 and put the mean of L(t) = t at the middle of its exposure."""
    start = rng.uniform(0.0, 0.02, 31)
    instants = np.linspace(start.min(), start.max() + 0.007, 57)
    weights = hat_weights(instants, start, 0.007)
    assert weights.sum(axis=0) == pytest.approx(np.ones(31))
    assert weights.T @ instants == pytest.approx(start + 0.0035)


def test_a_uniform_scene_stays_uniform():
    """The mean over an exposure neither adds nor loses light."""
    profile = camera(readout_direction="left_to_right")
    motion = constant_motion((1.0, -2.0, 3.0))
    light = expose(plain_scene(0.37), motion, make_view(profile, motion), 0.05, 0.01)
    assert light == pytest.approx(0.37, abs=1e-5)


def test_an_exposure_at_rest_equals_an_instant():
    """Without motion the exposure is the sharp picture."""
    motion = constant_motion((0.0, 0.0, 0.0))
    view = make_view(camera(), motion)
    scene = spot_scene(0.1, -0.1)
    assert expose(scene, motion, view, 0.1, 0.01) == pytest.approx(instant(scene, motion, view, 0.3), abs=1e-5)


@pytest.mark.parametrize(
    ("rate", "spot", "moves"),
    [
        ((0.0, 1.0, 0.0), (0.0, 0.0), (-1, 0)),  # yaw right: the picture moves left
        ((1.0, 0.0, 0.0), (0.0, 0.0), (0, 1)),  # pitch up: the picture moves down
        ((0.0, 0.0, 1.0), (0.25, 0.0), (0, -1)),  # roll clockwise: the right side moves up
    ],
)
def test_the_picture_moves_against_the_camera(rate, spot, moves):
    """The signs of yaw, pitch and roll are right; camera axes are x right, y down, z forward."""
    motion = constant_motion(rate)
    view, scene = make_view(camera(), motion), spot_scene(*spot)
    shift = centroid_px(instant(scene, motion, view, 0.05)) - centroid_px(instant(scene, motion, view, 0.0))
    expected = FOCAL * 0.05 * np.array(moves) * (np.hypot(*spot) or 1.0)
    assert shift == pytest.approx(expected, abs=0.08)


def test_moving_right_shifts_the_picture_left():
    """A step of 0.1 m to the right at 2 m depth shifts the picture by f · 0.1 / 2 px to the left."""
    scene = spot_scene(depth_m=2.0)
    places = []
    for x in (0.0, 0.1):
        motion = constant_motion((0.0, 0.0, 0.0), position_m=(x, 0.0, 0.0))
        places.append(centroid_px(instant(scene, motion, make_view(camera(), motion), 0.0)))
    assert places[1] - places[0] == pytest.approx([-5.0, 0.0], abs=0.02)


def test_a_tilted_plane_is_seen_at_its_3d_points(rng):
    """Rays through the homography meet the plane at the chart points of a line and a plane intersected in 3-D."""
    normal = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    scene = replace(spot_scene(), depth_m=1.5, normal=tuple(normal))
    position = np.array([0.1, -0.2, 0.15])
    ray = np.array([0.2, 0.1, 1.0])
    found = scene.chart_from_ray(np.eye(3), position) @ ray
    centre = np.array([0, 0, 1.5])
    point = position + ray * (normal @ (centre - position)) / (normal @ ray)
    e1 = np.array([1, 0, 0]) - normal[0] * normal
    e1 /= np.linalg.norm(e1)
    chart = np.array([e1 @ (point - centre), np.cross(normal, e1) @ (point - centre)]) * 200.0 / 1.5 + [500, 400]
    assert found[:2] / found[2] == pytest.approx(chart)


def test_blur_is_centred_on_the_middle_of_the_row_exposure():
    """A spot swept by a yaw is centred where it was at the middle of its own row's exposure."""
    profile = camera(readout_time_s=0.02, readout_direction="bottom_to_top")
    motion = constant_motion((0.0, 1.5, 0.0))
    light = expose(spot_scene(), motion, make_view(profile, motion), 0.0, 0.01)
    x, y = centroid_px(light)
    start = 0.02 * (1 - (y + 1) / HEIGHT)
    assert x == pytest.approx(57.0 - FOCAL * np.tan(1.5 * (start + 0.005)), abs=0.03)


@pytest.mark.parametrize(
    ("direction", "sign"), [("top_to_bottom", -1), ("bottom_to_top", 1), ("left_to_right", 0), ("right_to_left", 0)]
)
def test_a_rolling_shutter_tilts_an_upright_line(direction, sign):
    """With a yaw to the right, rows read later are further left, so the line leans with the row order."""
    profile = camera(readout_time_s=0.04, readout_direction=direction)
    motion = constant_motion((0.0, 1.0, 0.0))
    chart = np.zeros((801, 1001, 3), np.float32)
    chart[:, 490:511] = 1.0
    light = expose(Scene(chart, 2 * FOCAL), motion, make_view(profile, motion), -0.02, 0.001)[..., 0]
    place = (light * np.arange(WIDTH)).sum(axis=1) / light.sum(axis=1)
    lean = (place[75] - place[15]) / 60
    assert lean == pytest.approx(sign * FOCAL * 1.0 * 0.04 / HEIGHT, abs=1e-3)


def test_flicker_scales_rows_by_its_mean_over_the_exposure():
    """Each row has the mean of 1 + a sin(2πft + φ) over its exposure, in closed form."""
    profile = replace(
        camera(readout_time_s=0.02, readout_direction="top_to_bottom"),
        extensions=Extensions(flicker_amplitude=0.3, flicker_frequency_hz=120.0, flicker_phase_rad=0.4),
    )
    motion = constant_motion((0.0, 0.3, 0.0))
    light = expose(plain_scene(0.5), motion, make_view(profile, motion), 0.0123, 0.004)[:, 30, 1]
    start = 0.0123 + 0.02 * np.arange(HEIGHT) / HEIGHT
    omega = 2 * np.pi * 120
    mean = 0.3 * (np.cos(omega * start + 0.4) - np.cos(omega * (start + 0.004) + 0.4)) / (omega * 0.004)
    assert light == pytest.approx(0.5 * (1 + mean), abs=1e-3)


def test_a_full_stabiliser_cancels_fast_pitch_and_yaw():
    """With a fraction of 1 and a very low cutoff the middle of the picture stays still."""
    profile = replace(camera(), extensions=Extensions(stabilisation_fraction=1.0, stabilisation_cutoff_hz=1e-4))
    motion = constant_motion((0.3, -0.5, 0.0))
    scene = spot_scene()
    fixed, plain = make_view(profile, motion, rest_s=0.0), make_view(camera(), motion)
    at_rest = centroid_px(instant(scene, motion, plain, 0.0))
    assert centroid_px(instant(scene, motion, fixed, 0.1)) == pytest.approx(at_rest, abs=0.1)
    assert np.linalg.norm(centroid_px(instant(scene, motion, plain, 0.1)) - at_rest) > 5


def test_a_stabiliser_stops_at_the_end_of_its_travel():
    """After 0.1 s at 0.3 and 0.5 rad/s the lens has cancelled 0.02 rad about each axis; the rest moves the picture."""
    held = Extensions(stabilisation_fraction=1.0, stabilisation_cutoff_hz=1e-4, stabilisation_travel_rad=0.02)
    profile, motion, scene = replace(camera(), extensions=held), constant_motion((0.3, -0.5, 0.0)), spot_scene()
    limited, plain = make_view(profile, motion, rest_s=0.0), make_view(camera(), motion)
    moved = centroid_px(instant(scene, motion, limited, 0.1)) - centroid_px(instant(scene, motion, plain, 0.1))
    assert moved == pytest.approx(FOCAL * 0.02 * np.array([-1.0, -1.0]), abs=0.1)


def test_the_high_pass_follows_its_closed_form():
    """A constant rate from rest gives ω/c (1 − exp(−c t)), c = 2π cutoff."""
    motion = constant_motion((0.4, -0.7, 0.0), start_s=-0.1, end_s=0.9)
    time_s, angle = high_passed_angles(motion, 1.3, -0.1)
    corner = 2 * np.pi * 1.3
    expected = (1 - np.exp(-corner * (time_s + 0.1)))[:, None] / corner * [0.4, -0.7]
    assert angle == pytest.approx(expected, abs=1e-9)


def test_focal_drift_magnifies_with_time():
    """With f(t) = f (1 + drift · t) a spot off the centre moves outwards in proportion."""
    profile = replace(camera(), extensions=Extensions(focal_drift_per_s=0.2))
    motion = constant_motion((0.0, 0.0, 0.0))
    view, scene = make_view(profile, motion), spot_scene(0.3, 0.2)
    place = centroid_px(instant(scene, motion, view, 0.5)) - (57.0, 47.0)
    assert place == pytest.approx(FOCAL * 1.1 * np.array([0.3, 0.2]), abs=0.05)


@pytest.mark.parametrize("model", ["radtan", "fisheye"])
def test_rays_invert_the_lens(model):
    """Projecting a pixel's ray with OpenCV's distortion, or the fisheye formula, gives the pixel again."""
    coefficients = (-0.12, 0.03, 0.002, -0.001, 0.01) if model == "radtan" else (0.02, -0.01, 0.003, -0.001)
    lens = Intrinsics(80, 60, 70.0, 72.0, 38.0, 31.0, model, coefficients)
    x, y = (a.astype(float) for a in pixel_rays(lens))
    if model == "radtan":
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), lens.matrix, np.array(coefficients))[0]
        found = pixels.reshape(60, 80, 2)
    else:
        theta = np.arctan(np.hypot(x, y))
        k1, k2, k3, k4 = coefficients
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        found = np.stack([70 * x, 72 * y], axis=-1) * (bent / np.maximum(np.hypot(x, y), 1e-9))[..., None] + (
            38.0,
            31.0,
        )
    rows, columns = np.mgrid[0:60, 0:80]
    assert np.abs(found - np.stack([columns, rows], axis=-1)).max() < 1e-3


def test_a_sliding_scene_is_blurred_by_its_own_motion():
    """A still camera sees a sliding spot at the middle of its row's exposure, blurred over speed × exposure."""
    speed_px_s, exposure_s, readout_s = 300.0, 0.02, 0.03
    profile = camera(readout_time_s=readout_s)
    motion = constant_motion((0.0, 0.0, 0.0))
    sliding = replace(spot_scene(), drift_per_s=(speed_px_s / FOCAL, 0.0))
    light = expose(sliding, motion, make_view(profile, motion), 0.0, exposure_s)
    middle_s = 47.0 / HEIGHT * readout_s + exposure_s / 2
    np.testing.assert_allclose(centroid_px(light), (57.0 + speed_px_s * middle_s, 47.0), atol=0.3)
    weight = light[..., 0].astype(float)
    columns = np.arange(WIDTH)
    spread = np.average((columns - np.average(columns, weights=weight.sum(0))) ** 2, weights=weight.sum(0))
    box = (speed_px_s * exposure_s) ** 2 / 12
    assert spread == pytest.approx(3.0**2 + box, rel=0.1)


@pytest.mark.filterwarnings("error")
def test_rays_past_the_horizon_of_the_chart_carry_light() -> None:
    """A camera that looks along the chart's plane or away from it sees the horizon, at any rate of rotation."""
    quarter = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    x, y = np.meshgrid(np.linspace(-1, 1, 9, dtype=np.float32), np.linspace(-1, 1, 7, dtype=np.float32))
    assert (plain_scene(0.5).sample(quarter, x, y) == 0.5).all()
