"""A capture of half a second, small enough to be processed in every test."""

import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
import yaml

WIDTH, HEIGHT, FOCAL_PX, FRAMES, PERIOD_NS, EXPOSURE_NS = 160, 120, 130.0, 24, 33_333_000, 9_000_000
START_NS, IMU_STEP_NS = 5_000_000_000, 5_000_000


def rates_rad_s(time_s: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angular rates of the phone about its three axes, by seconds since the first frame."""
    return 1.1 * np.sin(9 * time_s + 0.3), 1.7 * np.cos(6 * time_s), 0.6 * np.sin(13 * time_s)


def write_movie(folder: Path) -> None:
    """Write what the profile's camera sees of a distant texture during this motion; every 8th frame is a key frame."""
    from virest.camera.profile_file import read_profile
    from virest.simulation.exposure import expose, make_view
    from virest.simulation.recorded_motion import recorded_motion
    from virest.simulation.scenes import Scene
    from virest.simulation.sensor import eight_bit, grey_of_light

    camera, rng = read_profile(folder / "camera.yaml"), np.random.default_rng(7)
    sample_s = np.arange(-0.5, FRAMES * PERIOD_NS * 1e-9 + 0.5, IMU_STEP_NS * 1e-9)
    motion = recorded_motion(sample_s, np.stack(rates_rad_s(sample_s), axis=-1), camera, 0.0)
    squares = np.kron(rng.uniform(0.02, 0.7, (60, 80, 3)), np.ones((10, 10, 1))).astype(np.float32)
    scene, view = Scene(cv2.GaussianBlur(squares, (0, 0), 1.0), 2 * FOCAL_PX), make_view(camera, motion)
    with av.open(str(folder / "movie.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"g": "8", "crf": "18", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1_000_000)
        for i in range(FRAMES):
            light = expose(scene, motion, view, i * PERIOD_NS * 1e-9, EXPOSURE_NS * 1e-9)
            picture = eight_bit(grey_of_light(light, camera.response), 1.0, rng)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = i * PERIOD_NS // 1000, Fraction(1, 1_000_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_logs(folder: Path) -> None:
    """Write frame timestamps, exposure times and the gyroscope rates of an unevenly turning phone."""
    stamps = [START_NS + i * PERIOD_NS for i in range(FRAMES)]
    (folder / "frame_timestamps.txt").write_text("Frame timestamp[nanosec]\n" + "".join(f"{t}\n" for t in stamps))
    head = (
        "Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],Sensor frame duration[nanosec],"
        "Frame readout time[nanosec],ISO,Focal length,Focus distance,AF mode\n"
    )
    rows = [
        f"{t},{FOCAL_PX},{FOCAL_PX},{i + 9},{EXPOSURE_NS},33333000,20000000,200,4.0,0.0,3\n"
        for i, t in enumerate(stamps)
    ]
    (folder / "movie_metadata.csv").write_text(head + "".join(rows))
    head = "Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]\n"
    first, last = stamps[0] - 500_000_000, stamps[-1] + 500_000_000
    with (folder / "gyro_accel.csv").open("w") as file:
        file.write(head)
        for t in range(first, last, IMU_STEP_NS):
            s = (t - START_NS) / 1e9
            file.write(f"{t}," + ",".join(f"{rate:.6f}" for rate in rates_rad_s(s)) + ",0.1,9.7,0.4\n")
    epochs = "#Camera frame timestamp source according to CameraCharacteristics.SENSOR_INFO_TIMESTAMP_SOURCE is "
    (folder / "edge_epochs.txt").write_text(epochs + "SENSOR_INFO_TIMESTAMP_SOURCE_REALTIME.\n")


def write_profile(folder: Path) -> None:
    """Write a profile that leaves nothing to estimate."""
    profile = {
        "virest_profile": 1,
        "image": {"width": WIDTH, "height": HEIGHT},
        "intrinsics": {"fx_px": FOCAL_PX, "fy_px": FOCAL_PX},
        "shutter": {"readout_time_s": 0.02, "readout_direction": "top_to_bottom"},
        "imu": {"time_offset_s": 0.0},
        "response": {"kind": "gamma", "gamma": 2.2},
        "scene": {"depth_m": "inf"},
    }
    (folder / "camera.yaml").write_text(yaml.safe_dump(profile))


@pytest.fixture(scope="session")
def _tiny_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "tiny"
    folder.mkdir()
    write_logs(folder)
    write_profile(folder)
    write_movie(folder)
    return folder


@pytest.fixture
def tiny(_tiny_capture: Path, tmp_path: Path) -> Path:
    """An intact capture of 24 frames, 160 × 120, named ``tiny``; the test may damage it."""
    return Path(shutil.copytree(_tiny_capture, tmp_path / "tiny"))


@pytest.fixture
def edit_gyro(tiny: Path) -> Callable[[Callable[[list[str]], list[str]]], None]:
    """Change the data rows of the capture's gyro_accel.csv."""

    def edit(change: Callable[[list[str]], list[str]]) -> None:
        path = tiny / "gyro_accel.csv"
        head, *rows = path.read_text().splitlines(keepends=True)
        path.write_text(head + "".join(change(rows)))

    return edit


@pytest.fixture
def virest_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., SimpleNamespace]:
    """Run the program in this process, in an empty folder: faster than a new process for each call."""
    from virest.app.cli import run

    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> SimpleNamespace:
        capfd.readouterr()
        code = run([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return SimpleNamespace(returncode=code, stdout=out, stderr=err)

    return call


@pytest.fixture(scope="session")
def swing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated capture whose frames are restored: 10 frames of 240 × 176 in a quick turn, nothing to estimate."""
    from virest.app.simulate import simulate_command

    folder = tmp_path_factory.mktemp("captures") / "swing"
    simulate_command(folder, width=240, height=176, frames=10, exposure_ms=12.0, readout_ms=24.0,
                     rate_rad_s=2.5, seed=8, bitrate_bits_per_px=2.0)  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def long_swing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Like ``swing``, but with 24 frames: more segments than two workers start at once."""
    from virest.app.simulate import simulate_command

    folder = tmp_path_factory.mktemp("captures") / "swing"
    simulate_command(folder, width=240, height=176, frames=24, exposure_ms=12.0, readout_ms=24.0,
                     rate_rad_s=2.5, seed=8, bitrate_bits_per_px=2.0)  # fmt: skip
    return folder
