"""The log's figures, compared with the true trajectory by an independent calculation."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation, Slerp
from story import process, simulate

pytestmark = pytest.mark.scenario


class Truth:
    """The true camera: orientation by spherical interpolation of trajectory.csv, a pinhole, and times of the slots."""

    def __init__(self, capture: Path) -> None:
        table = np.loadtxt(capture / "truth" / "trajectory.csv", delimiter=",", skiprows=1)
        self.world_cam = Slerp(table[:, 0], Rotation.from_quat(table[:, [5, 6, 7, 4]]))
        profile = yaml.safe_load((capture / "truth" / "camera.yaml").read_text())
        lens, self.shutter = profile["intrinsics"], profile["shutter"]
        self.width, self.height = profile["image"]["width"], profile["image"]["height"]
        self.camera = np.array([[lens["fx_px"], 0, lens["cx_px"]], [0, lens["fy_px"], lens["cy_px"]], [0, 0, 1]], float)
        self.slots = json.loads((capture / "truth" / "effects.json").read_text())["slots"]

    def row_start_s(self, frame: int, x: float, y: float) -> float:
        """Start of exposure of the row or column through a pixel."""
        fraction = {
            "top_to_bottom": y / self.height,
            "bottom_to_top": 1 - (y + 1) / self.height,
            "left_to_right": x / self.width,
            "right_to_left": 1 - (x + 1) / self.width,
        }[self.shutter["readout_direction"]]
        return self.slots[frame]["first_row_start_s"] + fraction * self.shutter["readout_time_s"]

    def turn(self, from_s: float, to_s: float) -> Rotation:
        """Rotation from camera coordinates at one time to those at another."""
        return self.world_cam(to_s).inv() * self.world_cam(from_s)

    def moved(self, x: float, y: float, from_s: float, to_s: float) -> np.ndarray:
        """Position at another time of a distant point seen at a pixel at one time."""
        ray = self.turn(from_s, to_s).apply(np.linalg.solve(self.camera, [x, y, 1.0]))
        image = self.camera @ ray
        return image[:2] / image[2]


def wrapped(angle: float) -> float:
    """Bring an angle to (−π, π]."""
    return float(-((-angle + np.pi) % (2 * np.pi) - np.pi))


@pytest.fixture(scope="module", params=["bottom_to_top", "right_to_left"])
def case(request: pytest.FixtureRequest, virest, work: Path) -> tuple[Truth, list[dict[str, Any]]]:
    """The truth and the log of a run whose profile contains offset and exposure scale."""
    capture = work / f"log_{request.param}"
    simulate(
        virest, capture, "--width", 400, "--height", 300, "--frames", 3, "--exposure-ms", 12, "--rate", 2,
        "--direction", request.param, "--effect", "time_offset=0.021", "--effect", "exposure_time=1.2", "--seed", 41,
    )  # fmt: skip
    config = capture / "truth" / "camera.yaml"
    return Truth(capture), process(virest, capture, work / "log", "--deblur", "none", "--config", config).lines


def test_the_logged_camera_turn_is_true(case: tuple[Truth, list[dict[str, Any]]]):
    """delta_q is the camera's orientation at the end of the central row's exposure, relative to its start."""
    truth, lines = case
    for line in lines:
        start_s = truth.row_start_s(line["frame"], (truth.width - 1) / 2, (truth.height - 1) / 2)
        assert line["exposure_s"] == pytest.approx(0.0144)
        w, x, y, z = line["motion"]["delta_q_wxyz"]
        start_from_end = truth.turn(start_s + line["exposure_s"], start_s)
        error = Rotation.from_quat([x, y, z, w]).inv() * start_from_end
        assert error.magnitude() < 1e-4
        assert start_from_end.magnitude() > 1e-3


def test_the_logged_blur_is_the_chord_of_the_blur_path(case: tuple[Truth, list[dict[str, Any]]]):
    """Angle and length, for the centre and every tile, are those of the chord of the point's path."""
    truth, lines = case
    for line in lines:
        centre = {**line["blur"], "centre_px": [(truth.width - 1) / 2, (truth.height - 1) / 2]}
        for tile in [centre, *line["blur"]["tiles"]]:
            x, y = tile["centre_px"]
            start_s = truth.row_start_s(line["frame"], x, y)
            chord = truth.moved(x, y, start_s, start_s + line["exposure_s"]) - (x, y)
            assert tile["length_px"] == pytest.approx(np.linalg.norm(chord), abs=0.05)
            if tile["length_px"] > 1:
                assert abs(wrapped(tile["angle_rad"] - np.arctan2(chord[1], chord[0]))) < 0.05 / tile["length_px"]


def test_logged_corners_are_where_the_first_row_sees_them(case: tuple[Truth, list[dict[str, Any]]]):
    """corners_px are the corner pixels, each from its row's start, at the start of the first row's exposure."""
    truth, lines = case
    corners = [(0, 0), (truth.width - 1, 0), (truth.width - 1, truth.height - 1), (0, truth.height - 1)]
    for line in lines:
        reference_s = truth.slots[line["frame"]]["first_row_start_s"]
        expected = [truth.moved(x, y, truth.row_start_s(line["frame"], x, y), reference_s) for x, y in corners]
        np.testing.assert_allclose(line["shutter"]["corners_px"], expected, atol=0.08)
        largest = np.linalg.norm(np.subtract(expected, corners), axis=-1).max()
        assert line["shutter"]["max_displacement_px"] == pytest.approx(largest, abs=0.08)
        assert line["shutter"]["readout_time_s"] == pytest.approx(0.020)
