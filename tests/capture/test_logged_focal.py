"""A logged focal length that changes from frame to frame is used; rounding is not treated as a change."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture_writing import METADATA_11, CaptureWriter

from virest.app.simulate import simulate_command
from virest.camera.profile_file import parse_profile, profile_mapping
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.logged_focal import corners, focal_scales, written_step
from virest.motion.integration import integrate_gyro
from virest.motion.optics import moving_lens
from virest.simulation.hidden import Hidden

TIMES = np.arange(60) / 30
HALF_DIAGONAL = 734.0


def write_with(writer: CaptureWriter, focal: list[str]) -> Path:
    """The writer's capture with a separate focal length for each frame."""
    writer.write()
    rows = [
        f"{t},{fx},{fx},{n + 200},{writer.exposure_ns},33333333,{writer.readout_ns},144,3.95,0.1,3"
        for n, (t, fx) in enumerate(zip(writer.metadata_ns, focal, strict=True))
    ]
    writer.text("movie_metadata.csv", [METADATA_11, *rows])
    return writer.folder


def test_a_focusing_lens_is_followed(writer: CaptureWriter) -> None:
    """The focal length changes in steps, as an actuator moves.

    The lens has the logged value at the middle of each frame.
    """
    focal = [80.0] * 10 + [81.5] * 8 + [83.25] * 12
    capture = read_capture(write_with(writer, [f"{fx:.2f}" for fx in focal]))
    assert [n.text for n in capture.notes if n.code == "focal-varies"]
    profile, _ = resolve_profile(capture)
    assert profile.intrinsics is not None
    assert profile.intrinsics.fx_px == pytest.approx(np.median(focal))
    profile = replace(profile, time_offset_s=0.07)
    lens = moving_lens(integrate_gyro(capture.imu, profile), profile)
    for frame in capture.frames:
        middle_s = frame.time_s + 0.5 * ((frame.exposure_s or 0.0) + 0.02) + 0.07
        seen = lens.project(np.array([0.3, 0.2, 1.0]), middle_s)
        assert seen[0] == pytest.approx(profile.intrinsics.cx_px + 0.3 * focal[frame.index], abs=1e-6)
    field = next(f for f in profile.fields if f.covariates == ("focal",))
    assert field.log is not None
    assert len(field.log[0]) == 6
    assert "field" not in str(profile_mapping(profile)["extensions"])


def test_a_focal_drift_in_the_profile_takes_precedence(writer: CaptureWriter) -> None:
    """The log is not added to a drift in camera.yaml."""
    folder = write_with(writer, [f"{80 + 0.1 * k:.2f}" for k in range(30)])
    own = {"virest_profile": 1, "image": {"width": 64, "height": 96}, "intrinsics": {"fx_px": 80.0}}
    drift = {"extensions": {"focal_drift": {"focal_drift_per_s": 0.03}}}
    for extra, followed in ((drift, False), ({}, True)):
        assert parse_profile({**own, **extra})
        (folder / "camera.yaml").write_text(str({**own, **extra}))
        profile, _ = resolve_profile(read_capture(folder))
        assert any(f.covariates == ("focal",) for f in profile.fields) is followed


@pytest.mark.parametrize(
    ("logged", "followed"),
    [
        (np.full(60, 980.4812), False),
        (980.0 + (np.arange(60) // 7 % 2), False),
        (980.4812 + 1e-4 * (np.arange(60) % 3), False),
        (980.0 + 4.0 * (np.arange(60) > 30), True),
        (980.4812 * (1 + 0.01 * TIMES), True),
        (np.where(np.arange(60) % 9 == 4, np.nan, 980.4812 * (1 + 0.01 * TIMES)), True),
        (np.full(60, np.nan), False),
    ],
    ids=["constant", "last digit", "rounding", "one step", "drift", "holes", "none"],
)
def test_only_changes_beyond_rounding_count(logged: np.ndarray, followed: bool) -> None:
    """Two steps of the last digit do not count; missing values are interpolated."""
    scales = focal_scales(logged, TIMES, HALF_DIAGONAL)
    assert (scales is not None) is followed
    if scales is not None and np.isfinite(logged).all():
        np.testing.assert_allclose(scales, logged / np.median(logged))
    elif scales is not None:
        np.testing.assert_allclose(np.diff(scales), np.diff(scales)[0], rtol=1e-6)


def test_an_outlier_in_the_log_is_not_a_zoom() -> None:
    """A single row with a very different focal length is interpolated."""
    logged = 980.4812 * (1 + 0.01 * TIMES)
    spoilt = logged.copy()
    spoilt[20] = 2766.0
    scales = focal_scales(spoilt, TIMES, HALF_DIAGONAL)
    assert scales is not None
    np.testing.assert_allclose(scales[20], 0.5 * (scales[19] + scales[21]))


def test_steps_and_corners() -> None:
    """``written_step`` finds the smallest decimal; ``corners`` keeps two points of a constant segment."""
    assert written_step(np.array([3.0, 7.0])) == 1.0
    assert written_step(np.array([3.25, 7.0])) == pytest.approx(0.01)
    times, values = corners(np.arange(6.0), np.array([1.0, 1.0, 1.0, 2.0, 2.0, 3.0]))
    assert times.tolist() == [0.0, 2.0, 3.0, 4.0, 5.0]
    np.testing.assert_allclose(np.interp(np.arange(6.0), times, values), [1, 1, 1, 2, 2, 3])


def test_a_simulated_autofocus_is_followed(tmp_path: Path) -> None:
    """The focal length varies by ±6 % within a second; the lens is right between frames too."""

    def breathing(time_s: np.ndarray) -> np.ndarray:
        return 1.0 + 0.06 * np.sin(2 * np.pi * time_s)

    hidden = Hidden(focal_scale=breathing)
    simulate_command(tmp_path / "trip", width=120, height=160, frames=20, seed=4, exposure_ms=10, hidden=hidden)
    table = tmp_path / "trip" / "movie_metadata.csv"
    rows = list(csv.reader(table.read_text().splitlines()))
    for k, row in enumerate(rows[1:]):  # logged for the middle of each frame, with 10 ms exposure and 20 ms readout
        row[1:3] = [f"{float(px) * breathing(np.array(k / 30 + 0.015)):.4f}" for px in row[1:3]]
    table.write_text("\n".join(",".join(row) for row in rows) + "\n")
    capture = read_capture(tmp_path / "trip")
    profile, _ = resolve_profile(capture)
    lens = moving_lens(integrate_gyro(capture.imu, profile), profile)
    at = np.linspace(0.02, 0.6, 200)
    across = lens.project(np.tile([0.2, 0.0, 1.0], (200, 1)), at)[:, 0] - lens.lens.cx_px
    ratio = across / breathing(at)
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=2e-3)
