"""A capture of half a second, small enough to be processed in every test."""

import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import yaml

WIDTH, HEIGHT, FRAMES, PERIOD_NS = 160, 120, 24, 33_333_000
START_NS, IMU_STEP_NS = 5_000_000_000, 5_000_000


def write_movie(path: Path) -> None:
    """Write a texture that moves a little from frame to frame, with a key frame every 8."""
    rng = np.random.default_rng(7)
    texture = np.kron(rng.integers(30, 220, (24, 34, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"g": "8", "crf": "18", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1_000_000)
        for i in range(FRAMES):
            frame = av.VideoFrame.from_ndarray(texture[i : i + HEIGHT, 2 * i : 2 * i + WIDTH].copy(), format="rgb24")
            frame.pts, frame.time_base = i * PERIOD_NS // 1000, Fraction(1, 1_000_000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_logs(folder: Path) -> None:
    """Write stamps, exposures, and a phone that turns unevenly about all three axes."""
    stamps = [START_NS + i * PERIOD_NS for i in range(FRAMES)]
    (folder / "frame_timestamps.txt").write_text("Frame timestamp[nanosec]\n" + "".join(f"{t}\n" for t in stamps))
    head = (
        "Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],Sensor frame duration[nanosec],"
        "Frame readout time[nanosec],ISO,Focal length,Focus distance,AF mode\n"
    )
    rows = [f"{t},130.0,130.0,{i + 9},9000000,33333000,20000000,200,4.0,0.0,3\n" for i, t in enumerate(stamps)]
    (folder / "movie_metadata.csv").write_text(head + "".join(rows))
    head = "Timestamp[nanosec], gx[rad/s], gy[rad/s], gz[rad/s], ax[m/s^2], ay[m/s^2], az[m/s^2]\n"
    first, last = stamps[0] - 500_000_000, stamps[-1] + 500_000_000
    with (folder / "gyro_accel.csv").open("w") as file:
        file.write(head)
        for t in range(first, last, IMU_STEP_NS):
            s = (t - START_NS) / 1e9
            rates = 1.1 * np.sin(9 * s + 0.3), 1.7 * np.cos(6 * s), 0.6 * np.sin(13 * s)
            file.write(f"{t}," + ",".join(f"{rate:.6f}" for rate in rates) + ",0.1,9.7,0.4\n")
    epochs = "#Camera frame timestamp source according to CameraCharacteristics.SENSOR_INFO_TIMESTAMP_SOURCE is "
    (folder / "edge_epochs.txt").write_text(epochs + "SENSOR_INFO_TIMESTAMP_SOURCE_REALTIME.\n")


def write_profile(folder: Path) -> None:
    """Write a profile with nothing left to estimate."""
    profile = {
        "virest_profile": 1,
        "image": {"width": WIDTH, "height": HEIGHT},
        "intrinsics": {"fx_px": 130.0, "fy_px": 130.0},
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
    write_movie(folder / "movie.mp4")
    write_logs(folder)
    write_profile(folder)
    return folder


@pytest.fixture
def tiny(_tiny_capture: Path, tmp_path: Path) -> Path:
    """A good capture of 24 frames, 160 × 120, named ``tiny``; the test may damage it."""
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
    """The program in this process, in an empty folder: quicker than a process of its own for each call."""
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
    """As ``swing``, but of 32 frames: several segments for each of two workers."""
    from virest.app.simulate import simulate_command

    folder = tmp_path_factory.mktemp("captures") / "swing"
    simulate_command(folder, width=240, height=176, frames=32, exposure_ms=12.0, readout_ms=24.0,
                     rate_rad_s=2.5, seed=8, bitrate_bits_per_px=2.0)  # fmt: skip
    return folder
