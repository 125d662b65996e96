"""Calibration errors in standard deviations: drawing captures, and comparing, summarising and plotting errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from virest.app.bench import calibration
from virest.app.bench.workload import Scale
from virest.app.simulate import simulate_command
from virest.calibration.geometry import GeometryCalibration
from virest.camera.profile_file import read_profile


def _row(ratio: float, shared: float = 0.5, blur: float = 0.5) -> dict[str, object]:
    return {"value": "k1", "error": ratio, "std": 1.0, "shared_std": shared, "blur_std": blur, "error_in_std": ratio}


def test_errors_are_summarised() -> None:
    """The summary gives median, part within two deviations, mean and histogram.

    It also gives the shared part at which the median would be that of a normal distribution.
    """
    one = calibration.summed([_row(ratio) for ratio in (-2.5, -0.5, 0.5, 1.5)])
    assert (one["count"], one["median"], one["within_two"], one["mean"]) == (4, 1.0, 0.75, -0.25)
    assert one["histogram"] == [0, 1, 0, 1, 1, 1, 0, 0]
    rng = np.random.default_rng(1)
    asked = [calibration.summed([_row(wide * r) for r in rng.normal(size=4000)]) for wide in (1.0, 1.5, 1.2)]
    shares = [one["share_asked"] / one["share_in_use"] for one in asked]
    expected = [np.sqrt(wide**2 - 0.75) / 0.5 for wide in (1.0, 1.5, 1.2)]
    np.testing.assert_allclose(shares, expected, rtol=0.15)


def test_the_parts_of_the_deviation_are_found_by_their_likelihood() -> None:
    """Rows in which one part or the other dominates separate the two."""
    rng = np.random.default_rng(2)
    kinds = ((0.9, 0.1), (0.1, 0.9), (0.1, 0.1))
    rows = []
    for shared, blur in kinds:
        wide = np.sqrt(1 + 3 * shared**2 - 0.75 * blur**2)
        rows += [_row(wide * r, shared, blur) for r in rng.normal(size=1500)]
    share, left = calibration.most_likely(rows)
    assert share == pytest.approx(2 * calibration.EVEN_SHARED, rel=0.2)
    assert left == pytest.approx(calibration.LEFT_BY_EVEN_BLUR / 2, abs=0.051)


def test_the_section_writes_a_table_and_a_figure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each seed from the first reserved one gives one capture; rejected captures leave no row."""
    seeds: list[int] = []

    def rows(_work: Path, seed: int) -> list[dict[str, object]]:
        seeds.append(seed)
        return [_row(0.3), _row(-5.0)] if seed % 2 else []

    monkeypatch.setattr(calibration, "calibrated_rows", rows)
    facts, text = calibration.calibration_section(tmp_path, Scale(seeds=3, figures=tmp_path))
    assert seeds == [calibration.FIRST_SEED + k for k in range(3)]
    assert "3 simulated captures" in text
    assert "most likely for all values" in text
    assert facts["summary"]["k1"]["count"] == 4
    assert (tmp_path / calibration.FIGURE).read_bytes().startswith(b"\x89PNG")


def test_drawn_captures_vary_and_are_reproducible() -> None:
    """A seed always draws the same capture; many seeds cover all kinds."""
    assert calibration.drawn_capture(7) == calibration.drawn_capture(7)
    drawn = [calibration.drawn_capture(seed) for seed in range(60)]
    assert {taken["scene"] for taken, _, _ in drawn} == set(calibration.SCENES)
    assert {"depth_m" in taken for taken, _, _ in drawn} == {True, False}
    for taken, hidden, extra in drawn:
        assert ("exposure_time" in hidden) == ("exposure-scale" in extra) == ("auto_exposure_ev" in taken)


@pytest.fixture(scope="module")
def wrong_lens(tmp_path_factory: pytest.TempPathFactory) -> tuple[GeometryCalibration, Path]:
    """A distant scene through a lens that the profile has wrong, calibrated with focal length and distortion."""
    folder = tmp_path_factory.mktemp("lens") / "capture"
    hidden = ("time_offset=0.006", "focal_length=0.94", "radial_distortion=-0.1")
    simulate_command(
        folder, width=320, height=240, frames=45, exposure_ms=8, noise_levels=1.0, bitrate_bits_per_px=1.0, seed=21,
        effects=hidden, truth_frames=False,
    )  # fmt: skip
    return calibration.calibrate_folder(folder, ("focal", "distortion")), folder


@pytest.mark.scenario
def test_a_wrong_lens_is_not_mistaken_for_translation(wrong_lens: tuple[GeometryCalibration, Path]) -> None:
    """Motion that the lens explains needs no translation."""
    assert wrong_lens[0].translation == "none"


@pytest.mark.scenario
def test_each_value_comes_with_its_error(wrong_lens: tuple[GeometryCalibration, Path]) -> None:
    """Every requested value is listed in the profile's units and lies within four deviations of the truth."""
    found, folder = wrong_lens
    rows = calibration.errors_of(found, read_profile(folder / "truth" / "camera.yaml"))
    assert {"time_offset_s", "readout_time_s", "rotation_rad", "gyro_bias_rad_s", "fx_px"} <= {r["value"] for r in rows}
    for row in rows:
        assert abs(row["error_in_std"]) < 4, row
        assert 0 < row["shared_std"] < row["std"], row
