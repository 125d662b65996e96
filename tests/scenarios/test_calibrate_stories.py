"""Calibration from wrong initial values, and from captures that determine nothing: never confident and wrong."""

import json
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import yaml

from virest.app.simulate import simulate_command
from virest.capture.video import probe_movie

pytestmark = pytest.mark.scenario

OFFSET_S, READOUT_S, DIRECTION = -0.044, 0.0227, "right_to_left"
ROTATION, BIAS = (-0.014, 0.019, 0.008), (-0.012, 0.021, 0.009)
TRUTH = {"time_offset_s": OFFSET_S, "readout_time_s": READOUT_S, "gyro_bias_rad_s": BIAS}
SIZE = {"width": 300, "height": 400}
LARGEST_SIGMA = 4.5
LARGEST = {"time_offset_s": 1e-3, "readout_time_s": 1e-3, "rotation_rad": 4e-3, "gyro_bias_rad_s": 4e-3}


def capture_with(folder: Path, **options: Any) -> Path:
    """Simulate a phone held upright with all basic parameters hidden."""
    hidden = [
        f"time_offset={OFFSET_S}",
        f"readout_time={READOUT_S}",
        "imu_rotation={},{},{}".format(*ROTATION),
        "gyro_bias={},{},{}".format(*BIAS),
    ]
    simulate_command(folder, frames=54, exposure_ms=7, rate_rad_s=1.2, direction=DIRECTION, crf=20, effects=hidden,
                     truth_frames=False, **SIZE, **options)  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def turned(work: Path) -> Path:
    """A phone turned by hand in front of a distant scene."""
    return capture_with(work / "turned", seed=61)


@pytest.fixture(scope="session")
def walked(work: Path) -> Path:
    """A phone turned and moved in front of a slanted wall 1.5 m away."""
    return capture_with(work / "walked", seed=62, depth_m=1.5, sway_m=0.08, tilt_deg=(14.0, -21.0))


def calibrate(virest: Any, capture: Path, folder: Path, *arguments: object) -> dict[str, Any]:
    """Run ``virest calibrate --json``, which must end with exit code 0."""
    folder.mkdir(exist_ok=True)
    out = folder / "calibrated.yaml"
    done = virest("calibrate", capture, "--json", "--out", out, *arguments, timeout=1800)
    assert done.returncode == 0, done.stderr
    facts: dict[str, Any] = json.loads(done.stdout)
    return facts


@pytest.fixture(scope="session")
def calibrated(virest: Any, turned: Path, work: Path) -> tuple[dict[str, Any], Path]:
    """The facts of a calibration of ``turned`` from its own profile, and the profile it wrote."""
    folder = work / "calibrated_turned"
    return calibrate(virest, turned, folder), folder / "calibrated.yaml"


def start_from(capture: Path, folder: Path, **changes: Any) -> Path:
    """Write the capture's own profile with ``section__key`` changed, and return its path."""
    content = yaml.safe_load((capture / "camera.yaml").read_text())
    for name, value in changes.items():
        section, key = name.split("__")
        content[section][key] = value
    (folder / "start.yaml").write_text(yaml.safe_dump(content))
    return folder / "start.yaml"


def value_of(facts: dict[str, Any], name: str) -> dict[str, Any]:
    """One entry of ``values``."""
    return next(value for value in facts["values"] if value["name"] == name)


def assert_true(facts: dict[str, Any], capture: Path, judged: tuple[str, ...] = tuple(TRUTH)) -> None:
    """Check offset, readout, direction, axes and bias against the truth; ``judged`` also by their deviations."""
    for name, truth in TRUTH.items():
        found = value_of(facts, name)
        error = np.abs(np.array(found["value"]) - truth)
        assert found["determined"], name
        assert (error < LARGEST[name]).all(), (name, found)
        if name in judged:
            assert (error < LARGEST_SIGMA * np.array(found["std"])).all(), (name, found)
    assert value_of(facts, "readout_direction")["value"] == DIRECTION
    assert rotation_error_rad(facts["profile"], capture) < LARGEST["rotation_rad"]


def rotation_error_rad(profile: dict[str, Any], capture: Path) -> float:
    """Angle between the profile's axes and the true ones."""
    nominal = np.array(yaml.safe_load((capture / "camera.yaml").read_text())["imu"]["T_cam_imu"])[:3, :3]
    truth = cv2.Rodrigues(np.array(ROTATION))[0] @ nominal
    turn = np.array(profile["imu"]["T_cam_imu"])[:3, :3] @ truth.T
    return float(np.linalg.norm(cv2.Rodrigues(turn)[0]))


def assert_refused_or_open(done: Any, folder: Path) -> None:
    """Require either exit code 6 with one line and no file, or a result in which nothing is determined."""
    if done.returncode == 0:
        assert not [v["name"] for v in json.loads(done.stdout)["values"] if v["determined"]], done.stdout
        return
    errors = [line for line in done.stderr.splitlines() if line.startswith("virest: error: ")]
    assert done.returncode == 6, done.stderr
    assert len(errors) == 1, done.stderr
    assert done.stdout == ""
    assert not list(folder.glob("*.yaml*"))


# ── initial values far off ────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "changes",
    [
        {"imu__time_offset_s": OFFSET_S + 0.5},
        {"imu__time_offset_s": None, "shutter__readout_time_s": None},
        {"imu__T_cam_imu": [[0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]},
        {"shutter__readout_direction": "top_to_bottom", "imu__time_offset_s": 0.3},
    ],
    ids=["500 ms late", "nothing known", "other axes", "wrong axis of the readout"],
)
def test_a_start_far_off_leads_to_the_truth(virest: Any, turned: Path, tmp_path: Path, changes: dict[str, Any]) -> None:
    """The hidden values are found from offsets half a second off, from any axes, and from any readout direction."""
    facts = calibrate(virest, turned, tmp_path / "out", "--config", start_from(turned, tmp_path, **changes))
    assert_true(facts, turned)


def test_a_moving_camera_is_calibrated(virest: Any, walked: Path, tmp_path: Path) -> None:
    """With a slanted wall at 1.5 m and 8 cm of sway, the accelerometer's path explains the parallax."""
    facts = calibrate(virest, walked, tmp_path / "out")
    assert_true(facts, walked, judged=("time_offset_s", "readout_time_s"))
    assert facts["translation"] != "none"
    assert facts["residual_px"] < 1.5 * facts["noise_px"]


def test_a_calibrated_profile_can_be_processed(
    virest: Any, turned: Path, calibrated: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    """``process --config`` accepts the output of ``calibrate`` and uses its offset and readout."""
    assert calibrated[0]["translation"] == "none"
    arguments = ("--config", calibrated[1], "--deblur", "none", "--frames", "20:22", "--jobs", 1)
    done = virest("process", turned, "--out", tmp_path / "run", "--json", *arguments)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["status"] for line in lines] == ["restored", "restored"]
    assert lines[0]["shutter"]["readout_time_s"] == pytest.approx(READOUT_S, abs=1e-3)


def test_values_that_a_motion_cannot_separate_are_named(virest: Any, turned: Path, tmp_path: Path) -> None:
    """With all parameters of --with at once, each value is close to the truth or is named as not determined."""
    names = "focal,distortion,principal-point,gyro-scale,clock-skew"
    facts = calibrate(virest, turned, tmp_path / "out", "--with", names)
    lens = yaml.safe_load((turned / "camera.yaml").read_text())["intrinsics"]
    truth = {"fx_px": lens["fx_px"], "k1": 0.0, "principal_point_px": [lens["cx_px"], lens["cy_px"]], "gyro_scale": 1.0,
             "clock_skew": 0.0, **TRUTH}  # fmt: skip
    for name, true in truth.items():
        found = value_of(facts, name)
        if found["determined"]:
            error = np.abs(np.array(found["value"]) - true) / np.array(found["std"])
            assert (error < LARGEST_SIGMA).all(), (name, found)
        else:
            assert name in facts["not_determined"]
            assert found["value"] == found["start"] or name in TRUTH


# ── captures that determine nothing ──────────────────────────────────────────────────────────────────────────────


def test_a_camera_at_rest_determines_nothing(virest: Any, tmp_path: Path) -> None:
    """A phone on a tripod is refused, or nothing is determined."""
    simulate_command(tmp_path / "still", frames=30, rate_rad_s=0.0, seed=63, **SIZE)
    done = virest("calibrate", tmp_path / "still", "--json", cwd=tmp_path)
    assert_refused_or_open(done, tmp_path)


def test_a_scene_without_texture_determines_nothing(virest: Any, turned: Path, tmp_path: Path) -> None:
    """In front of a grey wall only the sensor's noise moves."""
    capture = copy(turned, tmp_path / "wall")
    rng = np.random.default_rng(64)
    times_us = stamps_us(capture)
    pictures = (np.clip(rng.normal(118, 2, (SIZE["height"], SIZE["width"])), 0, 255) for _ in times_us)
    write_movie(capture / "movie.mp4", times_us, pictures)
    assert_refused_or_open(virest("calibrate", capture, "--json", cwd=tmp_path), tmp_path)


def test_the_gyroscope_of_another_recording_is_not_accepted(
    virest: Any, turned: Path, walked: Path, tmp_path: Path
) -> None:
    """The inertial data come from another shake, with their times shifted to this capture."""
    capture = copy(turned, tmp_path / "mixed")
    shift_ns = first_stamp_ns(turned) - first_stamp_ns(walked)
    head, *rows = (walked / "gyro_accel.csv").read_text().splitlines()
    moved = [f"{int(t) + shift_ns},{rest}" for t, rest in (row.split(",", 1) for row in rows)]
    (capture / "gyro_accel.csv").write_text("\n".join([head, *moved]) + "\n")
    assert_refused_or_open(virest("calibrate", capture, "--json", cwd=tmp_path), tmp_path)


def test_a_constant_pan_determines_nothing(virest: Any, turned: Path, tmp_path: Path) -> None:
    """A constant rate about one axis looks the same at every offset."""
    rate_rad_s = 0.25
    capture = copy(turned, tmp_path / "pan")
    times_us = stamps_us(capture)
    focal = yaml.safe_load((turned / "camera.yaml").read_text())["intrinsics"]["fx_px"]
    write_movie(capture / "movie.mp4", times_us, pan_pictures(times_us * 1e-6, rate_rad_s, focal))
    head, *rows = (turned / "gyro_accel.csv").read_text().splitlines()
    rng = np.random.default_rng(65)
    turns = rng.normal(0, 0.0015, (len(rows), 3))
    # x_cam = diag(1, −1, −1) x_imu: a turn to the right is about the phone's −y
    turns[:, 1] -= rate_rad_s
    lines = [
        f"{row.split(',')[0]},{x:.6f},{y:.6f},{z:.6f},0.1,9.8,0.2" for row, (x, y, z) in zip(rows, turns, strict=True)
    ]
    (capture / "gyro_accel.csv").write_text("\n".join([head, *lines]) + "\n")
    assert_refused_or_open(virest("calibrate", capture, "--json", cwd=tmp_path), tmp_path)


# ── real phones and cameras ──────────────────────────────────────────────────────────────────────────────────────


def test_a_movie_stabilised_in_the_camera_is_refused(virest: Any, realdata: Path, tmp_path: Path) -> None:
    """The movie comes from an action camera with its stabiliser on."""
    done = virest("calibrate", realdata / "gopro_hero7", "--json", cwd=tmp_path, timeout=1800)
    assert_refused_or_open(done, tmp_path)


def test_the_readout_of_a_phone_in_a_car_is_found(virest: Any, realdata: Path, tmp_path: Path) -> None:
    """The readout is 31.7 ms, although the metadata give 33.3 ms, and the offset is −5 ms.

    The car moves without telling accelerations. The set's README.md derives the truth: 30.6 to 32.2 ms and −5.4 to −4.6
    ms over several models.
    """
    facts = calibrate(virest, realdata / "lhaippp_car", tmp_path)
    readout, offset = value_of(facts, "readout_time_s"), value_of(facts, "time_offset_s")
    assert readout["determined"]
    assert readout["value"] == pytest.approx(0.0317, abs=0.0005)
    assert offset["value"] == pytest.approx(-0.0050, abs=0.0007)
    assert value_of(facts, "readout_direction")["value"] == "top_to_bottom"
    assert facts["translation"] != "none"


def test_clock_drift_is_found_without_a_request(
    virest: Any, calibrated: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    """With one offset the value would look certain, but hold at one instant only. Clocks without drift get no skew."""
    right = calibrated[0]
    assert not [v for v in right["values"] if v["name"] == "clock_skew"]
    assert not [note for note in right["notes"] if "held fixed" in note]
    drifting = tmp_path / "drifting"
    hidden = ["time_offset=0.02", "clock_skew=0.003"]
    simulate_command(drifting, frames=48, exposure_ms=7, rate_rad_s=1.2, crf=20, effects=hidden, seed=63,
                     truth_frames=False, **SIZE)  # fmt: skip
    facts = calibrate(virest, drifting, tmp_path / "out")
    for name, truth in (("time_offset_s", 0.02), ("clock_skew", 0.003)):
        found = value_of(facts, name)
        assert found["determined"], name
        assert abs(found["value"] - truth) < LARGEST_SIGMA * found["std"], name
    assert "the clocks drift apart by +" in facts["notes"][0]


def test_a_large_offset_and_a_clock_skew_are_found(virest: Any, realdata: Path, tmp_path: Path) -> None:
    """A hand-shaken phone with evenly spaced made-up timestamps has +0.42 s and +0.45 %, as measured independently."""
    facts = calibrate(virest, realdata / "nexus5_162941", tmp_path)
    assert value_of(facts, "time_offset_s")["value"] == pytest.approx(0.42, abs=0.03)
    skew = value_of(facts, "clock_skew")
    assert skew["determined"]
    assert skew["value"] == pytest.approx(0.0045, abs=0.0012)
    assert "fx_px" in facts["not_determined"]


def test_a_capture_within_its_start_up_is_refused(virest: Any, realdata: Path, tmp_path: Path) -> None:
    """No frame was taken at its timestamp; the error says that no frame can be used."""
    done = virest("calibrate", realdata / "honor_v10", "--json", cwd=tmp_path)
    assert_refused_or_open(done, tmp_path)
    assert "no frame can be used" in done.stderr


# ── helpers ──────────────────────────────────────────────────────────────────────────────────────────────────────


def copy(capture: Path, folder: Path) -> Path:
    """Copy a capture without its truth."""
    return Path(shutil.copytree(capture, folder, ignore=shutil.ignore_patterns("truth")))


def first_stamp_ns(capture: Path) -> int:
    """The timestamp in row 0 of frame_timestamps.txt."""
    return int((capture / "frame_timestamps.txt").read_text().splitlines()[1].split(",")[0])


def stamps_us(capture: Path) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Presentation times of a capture's movie, in whole microseconds."""
    return np.rint(probe_movie(capture / "movie.mp4").pts_s * 1e6).astype(np.int64)


def write_movie(path: Path, times_us: np.ndarray[Any, Any], pictures: Any) -> None:
    """Write grey pictures (h, w) in 0..255 at these times."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "14", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = SIZE["width"], SIZE["height"], "yuv420p"
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1_000_000)
        for time_us, picture in zip(times_us, pictures, strict=True):
            frame = av.VideoFrame.from_ndarray(picture.astype(np.uint8), format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = int(time_us), Fraction(1, 1_000_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def pan_pictures(time_s: np.ndarray[Any, Any], rate_rad_s: float, focal_px: float) -> Any:
    """Yield the views of a distant texture by a global-shutter pinhole camera that turns about y at a constant rate."""
    rng = np.random.default_rng(66)
    panorama = cv2.GaussianBlur(rng.uniform(0, 255, (SIZE["height"] * 2, SIZE["width"] * 6)), (0, 0), 2.5)
    panorama = np.clip(118 + 6 * (panorama - panorama.mean()), 0, 255)
    y, x = np.mgrid[: SIZE["height"], : SIZE["width"]].astype(float)
    across, down = (x - (SIZE["width"] - 1) / 2) / focal_px, (y - (SIZE["height"] - 1) / 2) / focal_px
    azimuth, height = np.arctan(across), down / np.hypot(1, across)
    for t in time_s:
        column = focal_px * (azimuth + rate_rad_s * (t - time_s.mean())) + panorama.shape[1] / 2
        row = focal_px * height + panorama.shape[0] / 2
        seen = cv2.remap(panorama, column.astype(np.float32), row.astype(np.float32), cv2.INTER_CUBIC)
        yield np.clip(seen + rng.normal(0, 1.5, seen.shape), 0, 255)
