"""Brightness that follows the phone's log has the log as its rival; independent gains have none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnosis.test_photometry import FRAMES, NOMINAL, dimmed, hidden, made_observations
from numpy.typing import NDArray

from virest.camera.profile import CameraProfile
from virest.capture.records import Frame
from virest.diagnosis.findings import Finding
from virest.diagnosis.followed_log import with_followed_log
from virest.diagnosis.photometry import PhotometricObservations
from virest.diagnosis.picture_ladder import PictureVerdict, climb_observations

Array = NDArray[np.float64]
STEPS = 0.5 * np.sin(0.4 * (np.arange(FRAMES) // 6 * 6) + 0.3)
"""Log exposure × ISO of the frames, which changes every sixth frame."""


def frames_of(log_iso: Array, log_exposure: Array | float = 0.0) -> list[Frame]:
    """Frames with these logged values."""
    exposure_s = 0.007 * np.exp(np.broadcast_to(log_exposure, FRAMES))
    iso = 100 * np.exp(log_iso)
    return [Frame(k, 0, k / 29.7, float(e), float(i)) for k, (e, i) in enumerate(zip(exposure_s, iso, strict=True))]


def seen(true_log: Array, logged: Array, rng: np.random.Generator) -> PhotometricObservations:
    """Patches whose light follows ``true_log`` per frame, with ``logged`` in the table."""
    plain = made_observations(hidden(), rng, patches=40)
    lit = dimmed(plain, np.exp(true_log)[plain.frame])
    return replace(lit, log_product=(logged - np.median(logged))[lit.frame])


def told(observed: PhotometricObservations, frames: list[Frame], given: CameraProfile = NOMINAL) -> Finding:
    """The only cause, with its rivals."""
    verdict = PictureVerdict(given)
    climb_observations(verdict, observed, FRAMES)
    (finding,) = with_followed_log(verdict, frames).findings
    return finding


def test_an_iso_that_stops_acting_is_a_rival_of_the_light(rng: np.random.Generator) -> None:
    """Above some ISO the sensor does not amplify further: the gains are a curve over the logged ISO."""
    found = told(seen(np.minimum(STEPS, 0.1), STEPS, rng), frames_of(STEPS))
    assert found.name == "gain_drift"
    assert [rival.name for rival in found.rivals] == ["gain over ISO"]
    assert "the gains follow the ISO" in found.sentence
    assert "at one exposure time and several ISO values" in found.sentence


def test_gains_beside_given_ones_follow_the_log(rng: np.random.Generator) -> None:
    """What the profile's own gains leave is a curve over the logged ISO."""
    known = 0.3 * np.sin(np.arange(FRAMES))
    given = NOMINAL.with_extensions(gain=tuple(np.exp(known - np.median(known)).tolist()))
    found = told(seen(known + np.minimum(STEPS, 0.1), STEPS, rng), frames_of(STEPS), given)
    assert found.name == "gain_drift"
    assert [rival.name for rival in found.rivals] == ["gain over ISO"]


def test_an_iso_that_acts_too_strongly_is_a_rival_of_the_curve(rng: np.random.Generator) -> None:
    """ISO to the power of 1.08 looks like a gamma; where exposures change along, they are named too."""
    observed = seen(1.08 * STEPS, STEPS, rng)
    found = told(observed, frames_of(STEPS))
    assert found.name == "response_curve"
    assert [rival.name for rival in found.rivals] == ["gain over ISO"]
    both = told(observed, frames_of(0.5 * STEPS, 0.5 * STEPS))
    assert {rival.name for rival in both.rivals} == {"gain over ISO", "gain over exposure time"}


@pytest.mark.parametrize(("rows", "name"), [(2, "2 frames late"), (-2, "2 frames early")])
def test_a_table_that_is_some_frames_off_is_named(rows: int, name: str, rng: np.random.Generator) -> None:
    """A row holds the values of an earlier or later frame."""
    jumps = 0.5 * (np.arange(FRAMES) // 6 % 2)
    logged = jumps[np.clip(np.arange(FRAMES) - rows, 0, FRAMES - 1)]
    found = told(seen(jumps, logged, rng), frames_of(logged))
    assert found.name == "gain_drift"
    assert found.rivals[0].name == f"exposure and ISO logged {name}"
    assert f"logged {name} would explain it" in found.sentence


def test_independent_gains_have_no_rival(rng: np.random.Generator) -> None:
    """Gains that follow nothing in the log; and a lamp that dims, which follows time alone."""
    gains = 0.15 * rng.normal(size=FRAMES)
    found = told(seen(STEPS + gains, STEPS, rng), frames_of(STEPS))
    assert (found.name, found.rivals) == ("gain_drift", ())
    assert "follow" not in found.sentence
    dimming = told(seen(STEPS - 0.4 * np.arange(FRAMES) / FRAMES, STEPS, rng), frames_of(STEPS))
    assert (dimming.name, dimming.rivals) == ("gain_drift", ())
    assert dimming.sentence.endswith("the gains follow time, a straight line")
