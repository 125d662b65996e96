"""A focus that moves is measured from the spectra of frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from virest.camera.field import Field
from virest.camera.response import ResponseCurve
from virest.capture.folder import read_capture, resolve_profile
from virest.capture.video import GrayReader, probe_movie
from virest.diagnosis.field import focus
from virest.diagnosis.field.blur import blur_finding
from virest.diagnosis.field.focus import blur_fields, moving_focus
from virest.diagnosis.findings import BLUR, FieldFinding, HeldOutGain
from virest.diagnosis.local_blur import look_for_blur
from virest.motion.integration import integrate_gyro
from virest.simulation.hidden import Hidden
from virest.simulation.recording import RecordingOptions, write_recording
from virest.simulation.session import SessionSettings, nominal_camera, plan_session

FRAMES = 42


def hunting_px(time_s: float) -> float:
    """A defocus that comes twice and goes."""
    return float(max(2.2 * np.sin(2 * np.pi * time_s / 1.2), 0.0))


def found(folder: Path, blur_px: Callable[[float], float] | None, scene: str, defocus_px: float = 0.0):
    """(the moving focus that a capture shows, all its blur fields, the profile with them)."""
    nominal = nominal_camera(400, 300, focal_px=330.0, readout_time_s=0.02, response=ResponseCurve("srgb"))
    settings = SessionSettings(scene=scene, frames=FRAMES, exposure_s=(0.006,), rate_rad_s=0.8, seed=9)
    plan = plan_session(nominal, nominal, settings, hidden=Hidden(blur_px=blur_px))
    write_recording(plan, folder, options=RecordingOptions(bits_per_px=0.5, truth_frames=False))
    capture = read_capture(folder, look_at_pictures=False)
    profile = resolve_profile(capture)[0].with_extensions(defocus_sigma_px=defocus_px)
    trajectory = integrate_gyro(capture.imu, profile)
    gray = GrayReader(capture.movie, probe_movie(capture.movie))
    seen = look_for_blur(gray, capture, profile, trajectory)
    by_spectra = moving_focus(gray, seen, profile, trajectory, capture)
    moving = None if by_spectra is None else by_spectra.finding
    return moving, *blur_fields(seen, profile, trajectory, capture, by_spectra)


@pytest.mark.parametrize("scene", ["photographs", "leaves"])
def test_a_focus_that_hunts_is_a_blur_over_time(tmp_path: Path, scene: str) -> None:
    """Within 0.3 px in each frame, and no blur is left to the frames in focus, whatever defocus the edges show."""
    moving, fields, profile = found(tmp_path / "hunts", hunting_px, scene, defocus_px=2.0)
    assert isinstance(moving, FieldFinding)
    assert moving.p_value is not None
    assert moving.p_value < 1e-6
    assert moving.held_out.after < 0.4 * moving.held_out.before
    assert fields == [moving]
    assert profile.extensions.defocus_sigma_px == 0.0
    (field,) = profile.extensions.field
    stamps_s = np.array(field.knots[0])
    true_px = np.array([hunting_px(t) for t in stamps_s])
    seen_px = np.array(field.values)[:, 0]
    clear = (true_px > 1.2) | (true_px == 0.0)  # a smaller one may be taken for none
    off_px, std_px = np.abs(seen_px - true_px)[clear], np.array(field.std)[clear, 0]
    assert off_px.max() < 0.3
    assert np.mean(off_px < 2 * std_px) > 0.9


def test_a_focus_that_rests_is_no_field(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Evenly soft frames do not differ, though the profile's defocus is wrong and widths of edges seem to change."""
    wider = Field("blur", ("time",), ((0.0, 1.4),), ((0.0,), (2.0,)), ((0.1,), (0.1,)), 0)
    told = blur_finding(wider, HeldOutGain(BLUR, 0.6, 0.5, None), 1e-9, ())
    monkeypatch.setattr(focus, "blur_field", lambda _seen, profile, *_: (told, profile.with_fields([wider])))
    moving, fields, profile = found(tmp_path / "rests", lambda _t: 1.8, "photographs", defocus_px=1.0)
    assert moving is None
    assert not fields
    assert profile.extensions.defocus_sigma_px == 1.0
