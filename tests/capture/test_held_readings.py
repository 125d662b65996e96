"""Gyroscope readings that a log repeats in several rows: found, and reduced to one row each."""

from __future__ import annotations

import numpy as np
import pytest
from capture_writing import CaptureWriter

from virest.arrays import Array
from virest.capture.folder import read_capture
from virest.capture.imu import ImuSamples, without_held_readings


def samples(gyro_rad_s: Array) -> ImuSamples:
    """At 200 Hz, with an accelerometer that is read anew in every row."""
    count = len(gyro_rad_s)
    return ImuSamples(0.005 * np.arange(count), gyro_rad_s, np.random.default_rng(1).normal(size=(count, 3)))


@pytest.mark.parametrize("rows", [2, 5])
def test_each_reading_keeps_its_first_row(rng: np.random.Generator, rows: int) -> None:
    """Also where polling catches a reading once more or once less often."""
    readings = rng.normal(size=(200, 3))
    counts = rows + (rng.random(200) < 0.2).astype(int)
    imu, held = without_held_readings(samples(np.repeat(readings, counts, axis=0)))
    assert held == rows
    np.testing.assert_array_equal(imu.gyro_rad_s, readings)
    np.testing.assert_allclose(imu.time_s, 0.005 * np.concatenate([[0], np.cumsum(counts)[:-1]]))


def test_other_logs_stay_as_they_are(rng: np.random.Generator) -> None:
    """A reading per row, the coarse digits of a gyroscope at rest, one that sticks, one that is dead."""
    moving = rng.normal(size=(300, 3))
    resting = 0.01 * np.round(rng.normal(0, 0.004, (2000, 3)) / 0.01)
    sticking = moving.copy()
    sticking[100:160] = sticking[100]
    for gyro in (moving, resting, sticking, np.zeros((300, 3)), moving[:10]):
        imu = samples(gyro)
        assert without_held_readings(imu) == (imu, 1)


def test_a_capture_says_that_its_readings_are_repeated(writer: CaptureWriter) -> None:
    """The note names the file and the number of rows."""
    folder = writer.write()
    lines = (folder / "gyro_accel.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines[1:]]
    rng = np.random.default_rng(2)
    for number, row in enumerate(rows):
        row[1:4] = [f"{v:.6f}" for v in rng.normal(size=3)] if number % 3 == 0 else rows[number - 1][1:4]
    text = "\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n"
    (folder / "gyro_accel.csv").write_text(text, encoding="utf-8")
    capture = read_capture(folder)
    (note,) = [note.text for note in capture.notes if note.code == "gyro-held"]
    assert "gyro_accel.csv repeats each gyroscope reading in about 3 rows" in note
    assert len(capture.imu) == -(-len(rows) // 3)
