"""Write tiny recordings in formats other than MARSLogger for Android, with known content."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from capture_writing import moving_pictures, write_movie

T0_NS = 1_403_636_579_763_555_584
PERIOD_NS = 50_000_000
IMU_PERIOD_NS = 5_000_000


def colour_pictures(count: int, width: int = 96, height: int = 64) -> list[np.ndarray]:
    """RGB pictures whose channels differ."""
    rng = np.random.default_rng(3)
    return [rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(count)]


def stamps(count: int) -> list[int]:
    """Timestamps with uneven steps, so that a shift by a frame would show."""
    return [T0_NS + i * PERIOD_NS + (1_234_567 if i > 2 else 0) for i in range(count)]


def imu_rows(first_ns: int, last_ns: int) -> list[tuple[int, list[float]]]:
    """Six columns with different values, reaching at least 100 ms beyond the frames on both sides."""
    times = range(first_ns - 100_000_000, last_ns + 150_000_000, IMU_PERIOD_NS)
    return [(t, [0.1 + 1e-3 * k, -0.25, 0.75, 0.3, 9.7, -0.4]) for k, t in enumerate(times)]


def write_euroc(root: Path, count: int = 8, camera: str = "cam0", ending: str = "\r\n") -> list[np.ndarray]:
    """A sequence of one camera with the line ends of the original data set; returns its pictures, RGB."""
    pictures, times = colour_pictures(count), stamps(count)
    folder = root / "mav0" / camera
    (folder / "data").mkdir(parents=True)
    for time, picture in zip(times, pictures, strict=True):
        cv2.imwrite(str(folder / "data" / f"{time}.png"), picture[..., ::-1])
    lines = ["#timestamp [ns],filename", *(f"{t},{t}.png" for t in times)]
    (folder / "data.csv").write_text(ending.join(lines) + ending, newline="")
    (folder / "sensor.yaml").write_text(SENSOR)
    samples = root / "mav0" / "imu0"
    samples.mkdir(exist_ok=True)
    rows = [f"{t},{','.join(map(str, v))}" for t, v in imu_rows(times[0], times[-1])]
    (samples / "data.csv").write_text(
        ending.join(["#timestamp [ns],w_RS_S_x [rad s^-1],…", *rows]) + ending, newline=""
    )
    (samples / "sensor.yaml").write_text("sensor_type: imu\nT_BS: {cols: 4, rows: 4, data: [" + IMU_POSE + "]}\n")
    return pictures


IMU_POSE = "0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1"
SENSOR = """#General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [96, 64]
camera_model: pinhole
intrinsics: [78.5, 78.25, 46.5, 33.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


def write_film(path: Path, count: int, first_ns: int = 0, width: int = 96, height: int = 64) -> list[int]:
    """A movie with uneven steps; returns its times in ns."""
    steps = [i * 33_400_000 + (17_000_000 if i > 7 else 0) for i in range(count)]
    write_movie(path, moving_pictures(count, (), width, height), steps)
    return [first_ns + step for step in steps]
