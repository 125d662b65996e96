"""Every cause that the simulator can hide can be diagnosed."""

from __future__ import annotations

import pickle

from virest.diagnosis.findings import BLUR, EDGES, GEOMETRY, PHOTOMETRY
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS
from virest.diagnosis.local_blur_fit import Defocus, ExposureTime
from virest.diagnosis.photometry_effects import BLACK_LEVEL, RESPONSE_GAMMA, VIGNETTING, Flicker
from virest.effects.table import EFFECTS as CATALOGUE
from virest.simulation.effects import EFFECTS

SPECIAL = {"scene_depth", "frame_lag"}
"""Judged with the points but not fitted as terms: a plane, and other timestamps."""


def test_the_simulator_and_the_catalogue_have_the_same_effects() -> None:
    """Both have the same 28 effects."""
    assert set(EFFECTS) == set(CATALOGUE)
    assert len(CATALOGUE) == 28


def test_every_cause_of_the_catalogue_has_a_test() -> None:
    """Points, brightness, blur and edges cover the catalogue. Varying exposures also move points."""
    points = {effect.name for effect in GEOMETRIC_EFFECTS} - {"exposure_time"} | SPECIAL
    light = {effect.name for effect in (RESPONSE_GAMMA, BLACK_LEVEL, VIGNETTING, Flicker())} | {"gain_drift"}
    blur = {effect().name for effect in (ExposureTime, Defocus)}
    for quantity, seekers in ((GEOMETRY, points), (PHOTOMETRY, light), (BLUR, blur), (EDGES, {"sharpening"})):
        assert {name for name, cause in CATALOGUE.items() if cause.seen_in == quantity} == seekers


def test_a_cause_is_the_same_in_another_process() -> None:
    """A cause is pickled by its name, without its functions."""
    assert all(pickle.loads(pickle.dumps(effect)) is effect for effect in GEOMETRIC_EFFECTS)
