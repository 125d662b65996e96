"""Stray Scanner (iOS, LiDAR): ``rgb.mp4``, ``camera_matrix.csv``, ``odometry.csv`` and ``imu.csv``; depth is not used.

    camera_matrix.csv   3 × 3 intrinsics of the stored picture
    odometry.csv        timestamp (s), frame, x, y, z, qx, qy, qz, qw[, ...]: one row per frame
    imu.csv             timestamp (s), a_x, a_y, a_z, alpha_x, alpha_y, alpha_z (rad/s)

All times are the phone's host time.  The published unit of acceleration is m/s², but recordings in g exist, so the
unit is detected from the magnitude of gravity.  As usual on iOS, the sign is that of gravity, not of specific force.
Pictures are stored in landscape.  Source: the app's published data specification.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile
from virest.capture.files import label, scan_text
from virest.capture.marslogger_ios import stamps_from_movie
from virest.capture.phone_tables import G_M_S2, note_exposures, without_accelerometer
from virest.capture.profile_source import phone_profile
from virest.capture.records import Note
from virest.capture.source import FileNames, Source, find_movie, present
from virest.capture.tables import GyroTable, make_gyro_table, read_rows
from virest.capture.video import MovieIndex, probe_movie
from virest.errors import CaptureError

MATRIX, ODOMETRY, IMU = "camera_matrix.csv", "odometry.csv", "imu.csv"
IN_G, IN_M_S2 = (0.5, 2.0), (5.0, 15.0)
"""Ranges of the median acceleration by which its unit is detected."""
PRINTED_NS = 1e3
"""Timestamps are printed in microseconds."""
HINT = "copy the app's whole folder"


def is_stray_scanner(names: set[str]) -> bool:
    """Whether the folder holds this app's files."""
    return {MATRIX, ODOMETRY, IMU} <= names


def read_stray_scanner(folder: Path, notes: list[Note]) -> Source:
    """Read a scan.  Raises CaptureError for missing or unusable files."""
    path = find_movie(folder, "rgb")
    movie = probe_movie(path)
    rows = read_rows(folder / ODOMETRY, [1], error=CaptureError, hint=HINT)
    if not len(rows.time_ns):
        raise CaptureError(f"{label(folder / ODOMETRY)}: has no rows", hint=HINT)
    stamps = stamps_from_movie(movie, rows, PRINTED_NS, ODOMETRY, notes)
    note_exposures(notes)
    names = FileNames(path.name, ODOMETRY, ODOMETRY, IMU)
    inputs = (path, *present(folder, MATRIX, ODOMETRY, IMU))
    profile = _with_matrix(phone_profile(movie.width, movie.height, "iPhone, Stray Scanner"), folder / MATRIX, movie)
    gyro = _read_motion(folder, notes)
    return Source("Stray Scanner", path, movie, gyro, stamps, names=names, profile=profile, inputs=inputs)


def _read_motion(folder: Path, notes: list[Note]) -> GyroTable:
    path = folder / IMU
    rows = read_rows(path, [4, 5, 6, 1, 2, 3], required=3, hint=HINT)
    accel = rows.values[:, 3:]
    typical = float(np.nanmedian(np.linalg.norm(accel, axis=1))) if len(accel) else 0.0
    if IN_G[0] <= typical <= IN_G[1]:
        force = -accel * G_M_S2
    elif IN_M_S2[0] <= typical <= IN_M_S2[1]:
        force = -accel
    else:
        without_accelerometer(folder, f"a median acceleration of {typical:.2g} is neither in g nor in m/s^2", notes)
        force = np.full_like(accel, np.nan)
    return make_gyro_table(path, rows.time_ns, np.hstack([rows.values[:, :3], force]), rows.rows, rows.dropped)


def _with_matrix(profile: CameraProfile, path: Path, movie: MovieIndex) -> CameraProfile:
    """The profile with the file's intrinsics. Raises CaptureError for an implausible or unreadable matrix."""
    try:
        text = scan_text(path, CaptureError, HINT).head.replace(",", " ").split()
        matrix = np.array([float(value) for value in text[:9]]).reshape(3, 3)
    except ValueError:
        raise CaptureError(f"{label(path)}: is not a 3 x 3 matrix", hint=HINT) from None
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    plausible = 0.3 <= fx / movie.width <= 3.0 and 0.5 * fx <= fy <= 2.0 * fx
    if not (plausible and 0 < cx < movie.width and 0 < cy < movie.height):
        raise CaptureError(
            f"{label(path)}: fx {fx:.4g}, fy {fy:.4g}, cx {cx:.4g}, cy {cy:.4g} "
            f"do not fit a {movie.width}x{movie.height} picture",
            hint="give a camera.yaml",
        )
    lens = Intrinsics(movie.width, movie.height, float(fx), float(fy), float(cx), float(cy))
    return profile.with_estimate("fx_px", float(fx), None, path.name, intrinsics=lens)
