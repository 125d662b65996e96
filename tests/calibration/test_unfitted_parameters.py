"""Notes about parameters that a calibration kept fixed although the tracked points contradict them."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from virest.calibration.calibrated_values import reset_undetermined, value_of
from virest.calibration.unfitted_parameters import OPTIONAL, HeldValue, held_notes
from virest.camera.intrinsics import Intrinsics
from virest.camera.profile import CameraProfile


def held(name: str, change: Any, std: Any) -> dict[str, HeldValue]:
    """One such parameter."""
    return {name: HeldValue(name, np.atleast_1d(np.array(change, float)), np.atleast_1d(np.array(std, float)))}


def test_every_optional_parameter_has_a_plausibility_bound() -> None:
    """A huge change is implausible for each of them; those of the lens are listed first."""
    assert all(not HeldValue(name, np.array([1e9]), np.ones(1)).believable for name in OPTIONAL)
    assert list(OPTIONAL)[:4] == ["focal", "distortion", "higher-distortion", "principal-point"]


def test_an_undetermined_parameter_is_reset() -> None:
    """Each parameter is reset as in the table of effects; a reset readout time keeps the time of the middle row."""
    lens = Intrinsics(640, 480, 500.0, 500.0, 319, 239)
    given = CameraProfile(640, 480, intrinsics=lens, time_offset_s=0.01, clock_skew=1e-4)
    shutter = replace(given.shutter, readout_time_s=0.03)
    turned = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
    found = replace(
        given, intrinsics=replace(lens, fx_px=520.0, fy_px=520.0, cx_px=330.0), shutter=shutter, clock_skew=2e-4,
        r_cam_imu=turned, gyro_scale=(1.1,) * 3, time_offset_s=0.02,
    )  # fmt: skip
    fit, start = SimpleNamespace(profile=found), replace(given, r_cam_imu=turned[::-1])
    names = ("time_offset", "readout_time", "imu_rotation", "focal_length", "gyro_scale", "clock_skew")
    held = reset_undetermined(fit, given, start, dict.fromkeys(names, False) | {"principal_point": True})  # type: ignore[arg-type]
    assert held.shutter == given.shutter
    assert held.time_offset_s == pytest.approx(0.02 + 0.5 * (0.03 - given.shutter.readout_time_s))
    assert held.r_cam_imu == start.r_cam_imu
    assert (held.gyro_scale, held.clock_skew) == (given.gyro_scale, given.clock_skew)
    assert held.intrinsics == replace(lens, cx_px=330.0)


def test_reset_coefficients_leave_a_plain_lens_plain() -> None:
    """Each undetermined coefficient is reset alone; where both are, the lens has no distortion again."""
    given = CameraProfile(640, 480, intrinsics=Intrinsics(640, 480, 500.0, 500.0, 319, 239))
    assert given.intrinsics is not None
    bent = replace(given.intrinsics, model="radtan", coefficients=(-0.1, 0.02, 0.0, 0.0, 0.0))
    fit = SimpleNamespace(profile=replace(given, intrinsics=bent))
    for k1, k2 in ((True, False), (False, True), (False, False)):
        found = reset_undetermined(fit, given, given, {"radial_distortion": k1, "higher_distortion": k2})  # type: ignore[arg-type]
        left = (-0.1 * k1, 0.02 * k2, 0.0, 0.0, 0.0)
        assert found.intrinsics == (replace(bent, coefficients=left) if any(left) else given.intrinsics)


def test_a_significant_but_small_change_is_not_noted() -> None:
    """A change of five deviations is below the limit."""
    assert held_notes({**held("focal", 0.01, 0.002), **held("principal-point", [5, 2], [1, 1])}, ()) == []


def test_a_wrong_parameter_is_named_with_its_size_and_the_option() -> None:
    """The suggested option also lists the parameters already fitted."""
    values = {**held("focal", np.log(0.97), 0.002), **held("principal-point", [1, -9], [1, 0.5])}
    (note,) = held_notes(values, ["clock-skew"])
    assert "focal (-3.0% ± 0.2%)" in note
    assert "principal-point (+1 ± 1, -9 ± 0.5 px)" in note
    assert "--with clock-skew,focal,principal-point" in note


def test_an_implausible_change_suggests_another_cause() -> None:
    """An exposure near zero means that timestamps refer to another instant: the note suggests ``virest diagnose``."""
    (note,) = held_notes({**held("exposure-scale", -3.1, 0.1), **held("focal", 0.03, 0.002)}, ())
    assert "exposure-scale (-95.5%" in note
    assert "virest diagnose" in note
    assert "--with" not in note


def test_a_focal_length_of_another_resolution_is_recognised() -> None:
    """A factor of 2 points to a profile of another resolution.

    Another plausible change keeps this note, an implausible one does not.
    """
    values = {**held("focal", np.log(2.0), 0.005), **held("distortion", 0.05, 0.002)}
    (note,) = held_notes(values, ["clock-skew"])
    assert "focal (+100.0%" in note
    assert "--with clock-skew,focal" in note
    assert "resolution" in note
    (other,) = held_notes({**values, **held("exposure-scale", -3.1, 0.1)}, ())
    assert "virest diagnose" in other


@pytest.mark.parametrize(
    ("change", "std", "said"),
    [(0.04, 0.01, "is absorbing a wrong gyro-scale"), (0.01, 0.02, "depends on gyro-scale"), (0.01, 0.005, None)],
)
def test_a_parameter_correlated_with_a_fitted_one_is_checked_more_strictly(
    change: float, std: float, said: str | None
) -> None:
    """Focal length and gyroscope scale compensate for each other."""
    notes = held_notes(held("gyro-scale", change, std), ["focal"])
    assert [said in note for note in notes] == ([True] if said else [])


def test_the_deviation_of_an_unknown_focal_length_is_in_pixels() -> None:
    """The deviation is 0.053 focal lengths, also for a value that is undetermined and not adopted."""
    lens = Intrinsics(640, 480, 520.0, 520.0, 319, 239)
    unknown, fitted = CameraProfile(640, 480), CameraProfile(640, 480, intrinsics=lens)
    value = value_of("focal_length", unknown, unknown, fitted, np.array([0.053**2]), determined=False)
    assert value.std == pytest.approx(0.053 * 520)
