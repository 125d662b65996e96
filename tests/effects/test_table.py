"""The table of effects: derived values, documentation and simulator are consistent with it."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion.synthetic_tracks import Setup, recorded
from scipy.spatial.transform import Rotation

from virest.camera.field import KINDS, Field
from virest.camera.profile import CameraProfile, Estimate, Extensions
from virest.camera.response import ResponseCurve
from virest.effects.records import GEOMETRY
from virest.effects.table import EFFECTS
from virest.effects.touches import touched
from virest.image_formation.point_model import IntegratedMotion, integrate_motion, predict, with_profile
from virest.report.words import UNITS
from virest.simulation import effects as simulated

DOCS = Path(__file__).resolve().parents[2] / "docs"
SWAYING = Setup(seed=91, frames=8, points=6, sway_m=0.05, plane_per_m=(0.1, -0.1, 0.5), stabilised=(0.4, 0.9))
LOGGED = Field("scale", ("focus",), ((0.0, 1.0),), ((0.0,), (0.02,)), log=((0.0, 0.1, 0.25), (0.1, 0.9, 0.3)))
DRIVEN = Field("rate", ("time",), ((0.0, 0.3),), ((0.01, -0.02, 0.0), (0.0, 0.03, 0.02)))
FOUND = Field("scale", ("time",), ((0.0, 0.3),), ((0.01,), (-0.02,)))
LATE = Field("delay", ("time",), ((0.0, 0.3),), ((0.001,), (-0.002,)))
SOFT = Field("blur", ("time",), ((0.0, 0.3),), ((0.0,), (1.5,)))
SHADED = Field("gain", ("x", "y"), ((0.0, 400.0), (0.0, 600.0)), ((0.0,), (0.1,), (0.2,), (0.1,)))


def whole_profile() -> CameraProfile:
    """A profile with every effect switched on, so that any change shows."""
    profile = recorded(SWAYING).profile
    extensions = replace(
        profile.extensions, gyro_lowpass_hz=20.0, focal_drift_per_s=0.01, flicker_amplitude=0.3, field=(LOGGED, DRIVEN)
    )
    return replace(profile, extensions=extensions, p_cam_imu_m=(0.01, 0.02, 0.0))


def of_lens(profile: CameraProfile) -> Any:
    """A lens with other values."""
    assert profile.intrinsics is not None
    lens = replace(profile.intrinsics, model="radtan", coefficients=(0.03, 0.0, 0.0, 0.0, 0.0))
    return replace(lens, cx_px=lens.cx_px + 3, fx_px=lens.fx_px * 1.02)


TURN = Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix()
OTHER: dict[str, Any] = {
    "width": lambda p: p.width - 20,
    "height": lambda p: p.height + 20,
    "device": lambda p: "another",
    "intrinsics": of_lens,
    "shutter": lambda p: replace(p.shutter, readout_time_s=0.011, exposure_scale=1.3, timestamp="exposure_end"),
    "readout_known": lambda p: False,
    "axes_known": lambda p: False,
    "r_cam_imu": lambda p: tuple(map(tuple, (TURN @ p.rotation_cam_imu).tolist())),
    "p_cam_imu_m": lambda p: (0.05, -0.03, 0.02),
    "time_offset_s": lambda p: p.time_offset_s + 0.004,
    "clock_skew": lambda p: 0.004,
    "gyro_bias_rad_s": lambda p: (0.03, -0.02, 0.01),
    "gyro_scale": lambda p: (1.02, 0.99, 1.01),
    "open_imu": lambda p: ("gyro_scale",),
    "response": lambda p: ResponseCurve("gamma"),
    "sensor_width_mm": lambda p: 5.0,
    "sensor_height_mm": lambda p: 4.0,
    "focal_length_mm": lambda p: 4.0,
    "depth_m": lambda p: 2.0,
    "estimates": lambda p: {"fx_px": Estimate(1.0, None, "")},
    "imu_untrusted_s": lambda p: ((0.1, 0.2),),
    "imu_untrusted_stamp_0_ns": lambda p: 7,
    "lens_shape": lambda p: p.intrinsics,
}
OTHER_EXTENSION: dict[str, Any] = {
    "focal_drift_per_s": 0.03,
    "stabilisation_fraction": 0.7,
    "stabilisation_cutoff_hz": 1.4,
    "stabilisation_travel_rad": 0.005,
    "stabilisation_at_end": "stops",
    "stabilisation_lean_rad": (0.01, -0.02),
    "frame_lag_s": 0.1,
    "frame_lag_frames": 3,
    "exposures_late_frames": 2,
    "exposure_gain": (1.0, 0.6),
    "vignetting_corner_loss": 0.3,
    "flicker_amplitude": 0.5,
    "flicker_frequency_hz": 120.0,
    "flicker_phase_rad": 1.0,
    "gain": (1.0, 1.1),
    "defocus_sigma_px": 1.0,
    "gyro_lowpass_hz": 12.0,
    "gyro_averaging_s": 0.01,
    "gyro_misalignment_rad": (0.02, -0.01, 0.03),
    "field": (LOGGED, replace(DRIVEN, values=((0.05, 0.0, 0.0), (0.0, 0.0, 0.05)))),
}


def changed_profiles() -> dict[str, CameraProfile]:
    """Profiles with a single changed value or a step of a single effect."""
    profile = whole_profile()
    found = {name: replace(profile, **{name: change(profile)}) for name, change in OTHER.items()}
    for name, value in OTHER_EXTENSION.items():
        found[f"extensions.{name}"] = replace(profile, extensions=replace(profile.extensions, **{name: value}))
    for more in (FOUND, LATE, SHADED, SOFT):
        field = replace(profile.extensions, field=(LOGGED, DRIVEN, more))
        found[f"extensions.field of {more.kind}"] = replace(profile, extensions=field)
    for effect in EFFECTS.values():
        if effect.steps is not None:
            found[f"effect {effect.name}"] = effect.steps.change(profile, 3 * np.array(effect.steps.quotient))
        if effect.choice is not None:
            now = next(iter(effect.read(profile, profile).values()))
            word = next(word for word in effect.choice.words if word != now)
            found[f"effect {effect.name}"] = effect.choice.choose(profile, word)
    return found


def seen_px(known: IntegratedMotion, travels: bool) -> np.ndarray:
    """Predicted positions of the points."""
    recording = recorded(SWAYING)
    table = recording.table()
    return predict(known, table, recording.scene(table) if travels else None).second_px


def test_every_value_of_a_profile_is_changed_in_these_tests() -> None:
    """A new value must be added here too."""
    assert set(OTHER) == {entry.name for entry in fields(CameraProfile)} - {"extensions"}
    assert set(OTHER_EXTENSION) == {entry.name for entry in fields(Extensions)}


@pytest.mark.parametrize("name", changed_profiles())
def test_a_changed_value_gives_the_predictions_of_a_new_integration(name: str) -> None:
    """Cached parts of an earlier profile's integration are never stale."""
    imu, before, after = recorded(SWAYING).imu, whole_profile(), changed_profiles()[name]
    for travels in (True, False):
        known = integrate_motion(imu, before, translation=travels)
        fresh = seen_px(integrate_motion(imu, after, translation=travels), travels)
        np.testing.assert_allclose(seen_px(with_profile(known, imu, after), travels), fresh, atol=1e-9)


def test_every_kind_of_field_is_changed_in_these_tests() -> None:
    """Displacements belong to the lens; a new kind must be added here too."""
    known = {field.kind for field in (LOGGED, DRIVEN, FOUND, LATE, SHADED, SOFT)}
    assert known == KINDS.keys() - {"displacement"}


def test_an_extension_missing_from_the_table_is_integrated_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The result is slower but never stale."""
    profile = whole_profile()
    other = replace(profile, extensions=replace(profile.extensions, defocus_sigma_px=1.0))
    assert not touched(profile, other).rates
    monkeypatch.delitem(touched.__globals__["OF_EXTENSIONS"], "defocus_sigma_px")
    assert touched(profile, other).rates
    assert not touched(profile, other).only_motion


def test_the_documentation_has_the_table() -> None:
    """Each effect's row in the profile documentation has its parameters and its key in the file."""
    page = (DOCS / "profile.md").read_text(encoding="utf-8")
    rows = {row[0]: row[1:] for row in re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \|$", page, re.MULTILINE)}
    for effect in EFFECTS.values():
        parameters, place = rows[effect.name]
        assert all(parameter.name in parameters for parameter in effect.parameters), effect.name
        assert place == effect.place or not effect.place


def test_the_simulator_has_exactly_the_effects_of_the_table() -> None:
    """Each drawn effect has a size for every parameter."""
    assert simulated._BY_NAME.keys() == EFFECTS.keys()
    context = simulated.EffectContext(20, 30.0, np.random.default_rng(1))
    for name, effect in simulated.EFFECTS.items():
        assert effect.per_frame or len(effect.draw(whole_profile(), context)) == len(effect.parameters), name


def test_every_sentence_can_be_filled_and_every_unit_is_known() -> None:
    """A parameter's suffix is a unit, unless it is a ratio or a word."""
    plain = {"clock_skew", "readout_direction", "timestamp", "exposure_scale", "gyro_scale", "focal_scale", "k1",
             "k2", "pixel_aspect", "axis_scale", "fraction", "frames", "gamma", "black_level", "corner_loss",
             "amplitude", "gain", "amount"}  # fmt: skip
    for effect in EFFECTS.values():
        assert (effect.sentence + effect.addition).format(**{parameter.name: 1.0 for parameter in effect.parameters})
        assert effect.in_words
        for parameter in effect.parameters:
            assert any(parameter.name.endswith(unit) for unit in UNITS) != (parameter.name in plain), parameter.name


@pytest.mark.parametrize("name", [name for name, effect in EFFECTS.items() if effect.steps is not None])
def test_values_follow_their_steps(name: str) -> None:
    """After a step, each parameter has moved by its first-order spread."""
    effect = EFFECTS[name]
    assert effect.steps is not None
    profile = recorded(SWAYING).profile
    profile = profile.with_extensions(gyro_lowpass_hz=20.0, stabilisation_travel_rad=0.02)
    for step in np.diag(1e-3 * np.array(effect.steps.quotient)):
        before, after = (effect.read(p, profile) for p in (profile, effect.steps.change(profile, step)))
        for parameter, size in effect.spread(before, step).items():
            moved = np.abs(np.subtract(after[parameter], before[parameter]))
            np.testing.assert_allclose(moved, size, rtol=1e-2, atol=1e-12)


def test_causes_of_points_except_depth_and_lag_have_steps_or_words() -> None:
    """A plane and other timestamps cannot be expressed as steps of a profile."""
    without = {e.name for e in EFFECTS.values() if e.seen_in == GEOMETRY and not e.in_points}
    assert without == {"scene_depth", "frame_lag"}
