"""Read the files of a small simulated capture without virest."""

from pathlib import Path
from typing import Any

import av
import numpy as np
import pandas as pd

SMALL: dict[str, Any] = {
    "width": 96, "height": 128, "frames": 5, "exposure_ms": 8.0, "readout_ms": 18.0, "rate_rad_s": 1.5, "seed": 3,
    "gyro_noise_rad_s": 0.0, "accel_noise_m_s2": 0.0,
}  # fmt: skip
"""The capture of most tests."""


def read_movie(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Luma planes (n, h, w) and timestamps in seconds (n,)."""
    with av.open(str(folder / "movie.mp4")) as container:
        frames = list(container.decode(video=0))
    luma = [frame.to_ndarray(format="yuv420p")[: frame.height] for frame in frames]
    return np.array(luma), np.array([float(frame.pts * frame.time_base) for frame in frames])


def read_imu(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(time in ns, gyroscope, accelerometer) of gyro_accel.csv."""
    table = pd.read_csv(folder / "gyro_accel.csv", skipinitialspace=True)
    return table.iloc[:, 0].to_numpy(), table.iloc[:, 1:4].to_numpy(), table.iloc[:, 4:7].to_numpy()


def read_stamps(folder: Path) -> np.ndarray:
    """Frame timestamps in ns."""
    return pd.read_csv(folder / "frame_timestamps.txt").iloc[:, 0].to_numpy()
