"""Errors that state how to continue, and rough results that are still written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motion.synthetic_tracks import Setup, recorded

from virest.app.calibrate import _require_offset
from virest.app.calibrate_curve import calibrate_curve
from virest.app.process import _advice
from virest.calibration.calibrated_values import ROUGH_OFFSET_S, CalibratedValue, roughly_known, with_estimates
from virest.calibration.geometry import GeometryCalibration
from virest.capture.detect import choose_reader
from virest.errors import CalibrationError, CaptureError, OutputError
from virest.inference.profile_terms import TIME_OFFSET
from virest.inference.track_fit import TrackFit, fit_tracks
from virest.restoration.capture import RestorationPlan
from virest.restoration.plan_notes import NoteCode
from virest.restoration.settings import RestorationSettings


def fit_of(recording) -> TrackFit:
    """An offset fitted to the tracked points of a recording."""
    return fit_tracks(recording.imu, recording.table(), recording.profile, [TIME_OFFSET])


def calibrated(value: CalibratedValue) -> GeometryCalibration:
    """A calibration in which only one value matters."""
    recording = recorded(Setup(seed=5, frames=14))
    fit = fit_of(recording)
    return GeometryCalibration(recording.profile, (value,), (), "none", 0.1, 0.1, 0.2, 0.9, 0.0, 13, 500, (), fit)


@pytest.mark.parametrize(("std_s", "rough"), [(0.0032, True), (1.5 * ROUGH_OFFSET_S, False)])
def test_a_roughly_known_offset_is_written_with_a_note(std_s: float, rough: bool) -> None:
    """A deviation of 3.2 ms is accepted with a note; one of half a frame is an error."""
    fit = fit_of(recorded(Setup(seed=5, frames=14)))
    value = roughly_known(CalibratedValue("time_offset_s", None, 0.45, std_s, determined=False), fit)
    assert value.rough is rough
    assert bool(value.note) is rough
    if rough:
        _require_offset(calibrated(value))
    else:
        with pytest.raises(CalibrationError, match=r"15\.0 ms"):
            _require_offset(calibrated(value))


def test_an_offset_from_one_time_block_is_not_roughly_known() -> None:
    """No second time block confirms the value."""
    fit = replace(fit_of(recorded(Setup(seed=5, frames=14))), stretches=np.array([1.1]))
    assert not roughly_known(CalibratedValue("time_offset_s", None, 0.45, 0.0032, determined=False), fit).rough


def test_an_existing_curve_is_replaced_only_on_request(tmp_path: Path) -> None:
    """The error comes before any work and names the option."""
    out = tmp_path / "curve.yaml"
    out.write_text("mine")
    with pytest.raises(OutputError) as refused:
        calibrate_curve(tmp_path / "nothing", out=out)
    assert "--overwrite" in (refused.value.hint or "")
    assert out.read_text() == "mine"


def test_curve_and_plot_need_two_names_and_spare_the_list(tmp_path: Path) -> None:
    """One name for both is refused, and so is the list of exposures as the output."""
    figure, exposures = tmp_path / "curve.png", tmp_path / "exposures.csv"
    with pytest.raises(OutputError, match="named by both --out and --plot"):
        calibrate_curve(tmp_path, out=figure, plot=figure)
    exposures.write_text("file,exposure_s\n")
    with pytest.raises(OutputError, match="belongs to the recording"):
        calibrate_curve(tmp_path, exposures=exposures, out=exposures, overwrite=True)


def test_a_stabilised_movie_must_be_recorded_again() -> None:
    """The advice is to switch stabilisation off. It does not name a calibration, which would be refused."""
    unknown = replace(recorded(Setup(seed=3, frames=6)).profile, time_offset_s=None)
    plan = RestorationPlan(unknown, RestorationSettings())
    assert "virest calibrate" in _advice(plan)
    advice = _advice(plan.refused(NoteCode.NOT_FOLLOWING, "the frames do not follow the gyroscope"))
    assert "stabilisation off" in advice
    assert "calibrate" not in advice
    axes = _advice(plan.refused(NoteCode.OTHER_AXES, "the gyroscope's axes are not the profile's: virest calibrate"))
    assert "virest calibrate" in axes
    assert "stabilisation" not in axes


def test_a_calibration_that_left_values_open_is_not_advised_again() -> None:
    """A profile that holds a calibration's estimates gets no advice to calibrate the same capture again."""
    profile = replace(recorded(Setup(seed=3, frames=6)).profile, time_offset_s=None, intrinsics=None)
    assert "run virest calibrate" in _advice(RestorationPlan(profile, RestorationSettings()))
    offset = CalibratedValue("time_offset_s", None, 0.43, 0.0028, determined=True)
    written = replace(with_estimates(profile, (offset,)), time_offset_s=0.43)
    advice = _advice(RestorationPlan(written, RestorationSettings()))
    assert "run virest calibrate" not in advice
    assert "focal length unknown" in advice
    assert "record again" in advice


def test_an_empty_folder_is_called_empty(tmp_path: Path) -> None:
    """For another folder the error lists what it holds."""
    with pytest.raises(CaptureError, match="; it is empty"):
        choose_reader(tmp_path)
    (tmp_path / "notes.txt").touch()
    with pytest.raises(CaptureError, match=r"\(it holds notes.txt\)"):
        choose_reader(tmp_path)
