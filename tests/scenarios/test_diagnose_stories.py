"""The diagnosis finds what is hidden in a capture, from the folder alone.

The bench runs all effects with several seeds; these are the shortest cases.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from virest.app.bench.diagnosis import diagnose_folder, errors_in_std
from virest.app.simulate import simulate_command
from virest.camera.response import ResponseCurve
from virest.diagnosis.field.brightness import BAND
from virest.diagnosis.findings import CONSISTENT, EXPLAINED, Diagnosis
from virest.simulation.hidden import Hidden
from virest.simulation.recording import RecordingOptions, write_recording
from virest.simulation.session import SessionSettings, nominal_camera, plan_session

pytestmark = pytest.mark.scenario

LARGEST_SIGMA = 4.5


def _capture(work: Path, name: str, effects: list[str], seed: int, **options: Any) -> Path:
    upright = seed % 2
    size = {"width": 288, "height": 384} if upright else {"width": 384, "height": 288}
    simulate_command(
        work / name, seed=seed, effects=effects, rate_rad_s=1.1, overwrite=True, truth_frames=False,
        **{"frames": 33, "exposure_ms": 8, **size, **options},
    )  # fmt: skip
    return work / name


def _names(found: Diagnosis) -> set[str]:
    return {cause.name for cause in found.causes}


def test_nothing_hidden_is_consistent(work: Path) -> None:
    """There is no false alarm."""
    found = diagnose_folder(_capture(work, "nothing_hidden", [], 421))
    assert found.verdict == CONSISTENT
    assert not found.causes
    assert not found.unexplained.significant


def test_two_hidden_effects_are_both_named(work: Path) -> None:
    """One shifts points, the other changes the light."""
    hidden = ["time_offset=-0.007", "flicker=0.25,120"]
    found = diagnose_folder(_capture(work, "two_hidden", hidden, 422, exposure_ms=6))
    assert _names(found) == {"time_offset", "flicker"}
    assert found.verdict == EXPLAINED
    truth = {"time_offset": {"time_offset_s": -0.007}, "flicker": {"amplitude": 0.25, "frequency_hz": 120.0}}
    for cause in found.causes:
        assert cause.held_out.after < cause.held_out.before
        assert cause.held_out.gain > 0.5
        errors = errors_in_std(found, cause.name, truth[cause.name])
        assert errors, "no deviation stated"
        assert max(errors) < LARGEST_SIGMA


def test_a_gyroscope_low_pass_and_non_square_pixels_are_named(work: Path) -> None:
    """They are not mistaken for a time offset or another focal length, and the extended profile contains them."""
    hidden = {"gyro_lowpass": {"gyro_lowpass_hz": 14.0}, "pixel_aspect": {"pixel_aspect": 0.97}}
    effects = [f"{name}={next(iter(values.values()))}" for name, values in hidden.items()]
    found = diagnose_folder(_capture(work, "filtered_gyroscope", effects, 424))
    assert _names(found) == hidden.keys()
    assert found.verdict == EXPLAINED
    for cause in found.causes:
        errors = errors_in_std(found, cause.name, hidden[cause.name])
        assert errors, "no deviation stated"
        assert max(errors) < LARGEST_SIGMA
    extended = found.extended_profile
    assert extended.extensions.gyro_lowpass_hz == pytest.approx(14.0, rel=0.02)
    assert extended.intrinsics is not None
    assert extended.intrinsics.fy_px / extended.intrinsics.fx_px == pytest.approx(0.97, abs=0.005)


def test_an_uncatalogued_fault_is_described(work: Path) -> None:
    """A clipping gyroscope is not in the catalogue; its rates follow from the tracked points, and no cause is named."""
    folder = _capture(work, "clipping_gyroscope", [], 423)
    log = folder / "gyro_accel.csv"
    head, *rows = log.read_text(encoding="utf-8").splitlines()
    clipped = [head]
    for row in rows:
        cells = row.split(",")
        cells[1:4] = [f"{np.clip(float(cell), -0.6, 0.6):.7g}" for cell in cells[1:4]]
        clipped.append(",".join(cells))
    log.write_text("\n".join(clipped) + "\n", encoding="utf-8")
    found = diagnose_folder(folder)
    assert found.verdict == EXPLAINED
    assert not found.causes
    (field,) = found.fields
    assert "it clips" in field.sentence
    assert field.held_out.after < 1.5 * field.held_out.noise < 0.1 * field.held_out.before


def _diagnosed(folder: Path, hidden: Hidden, seed: int, exposures_s: tuple[float, ...], width: int = 480) -> Diagnosis:
    """The diagnosis of a capture whose phone has a hidden fault; at 120 Hz, its readout lasts three periods."""
    nominal = nominal_camera(
        width, width * 3 // 4, focal_px=width / 1.2, readout_time_s=0.025, response=ResponseCurve("srgb")
    )
    frames = width // 8
    settings = SessionSettings(scene="photographs", frames=frames, exposure_s=exposures_s, rate_rad_s=1.1, seed=seed)
    options = RecordingOptions(bits_per_px=0.4, truth_frames=False)
    write_recording(plan_session(nominal, nominal, settings, hidden=hidden), folder, options=options)
    return diagnose_folder(folder)


def test_exposures_logged_for_other_frames_are_the_only_finding(work: Path) -> None:
    """Neither stamps that jitter nor brightness that drifts; the extended profile gives each frame its own exposure."""
    exposures_s = tuple((0.01 * (1 + 0.5 * np.sin(np.arange(60) / 2))).tolist())
    found = _diagnosed(work / "late_exposures", Hidden(exposures_late_frames=2), 424, exposures_s, width=320)
    assert not found.causes
    (field,) = found.fields
    assert (field.kind, field.size) == ("exposure_rows", 2.0)
    assert "logged 2 frames late" in field.sentence
    assert found.verdict == EXPLAINED
    assert found.extended_profile.extensions.exposures_late_frames == 2
    assert not found.extended_profile.extensions.field


def test_bands_that_belong_to_the_rows_are_no_flicker(work: Path) -> None:
    """Three dark bands at 30 frames/s look like a light at 120 Hz, strong since an exposure nearly averages it out.

    Such a light would move the mean time of each row, which the points contradict.
    """

    def bands(part: np.ndarray) -> np.ndarray:
        return np.asarray(1 + 0.06 * np.sin(6 * np.pi * part))

    found = _diagnosed(work / "bands", Hidden(light=lambda _x, y: bands(y)), 425, (0.0077,), width=400)
    assert not found.causes
    (field,) = found.fields
    assert (field.kind, field.shape) == ("gain", BAND)
    assert "flicker at 120 Hz" in field.confounded
    rows = np.linspace(20, 280, 81)
    factor = 1 + field.fields[0].at(np.full(81, 200.0), rows)[..., 0]
    off = np.log(factor / bands(rows / 300))
    off -= np.polyval(np.polyfit(rows, off, 1), rows)  # patches that move alike do not show a slope
    assert np.std(off) < 0.2 * np.std(bands(rows / 300))
