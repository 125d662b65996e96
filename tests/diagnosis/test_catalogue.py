"""Every cause that can be hidden can be found."""

from __future__ import annotations

import pickle

from virest.diagnosis.findings import BLUR, EDGES, GEOMETRY, PHOTOMETRY
from virest.diagnosis.geometric_effects import GEOMETRIC_EFFECTS
from virest.diagnosis.local_blur_fit import Defocus, ExposureTime
from virest.diagnosis.photometry_effects import BLACK_LEVEL, RESPONSE_GAMMA, VIGNETTING, Flicker
from virest.effects.table import EFFECTS as CATALOGUE
from virest.simulation.effects import EFFECTS

SPECIAL = {"scene_depth", "frame_lag"}
"""Judged with the points, without being a term of their fit: a plane, and other stamps."""


def test_the_simulator_hides_what_the_catalogue_names_and_nothing_else() -> None:
    """25 effects on both sides."""
    assert set(EFFECTS) == set(CATALOGUE)
    assert len(CATALOGUE) == 25


def test_every_named_cause_has_somebody_who_looks_for_it() -> None:
    """Points, brightness, blur and edges share the catalogue between them; exposures that vary move points too."""
    points = {effect.name for effect in GEOMETRIC_EFFECTS} - {"exposure_time"} | SPECIAL
    light = {effect.name for effect in (RESPONSE_GAMMA, BLACK_LEVEL, VIGNETTING, Flicker())} | {"gain_drift"}
    blur = {effect().name for effect in (ExposureTime, Defocus)}
    for quantity, seekers in ((GEOMETRY, points), (PHOTOMETRY, light), (BLUR, blur), (EDGES, {"sharpening"})):
        assert {name for name, cause in CATALOGUE.items() if cause.seen_in == quantity} == seekers


def test_a_cause_is_the_same_in_another_process() -> None:
    """Its functions stay where they are; its name goes."""
    assert all(pickle.loads(pickle.dumps(effect)) is effect for effect in GEOMETRIC_EFFECTS)
