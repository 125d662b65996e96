"""Auto-exposure changes exposure × ISO and the brightness of pictures together, as logged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from virest.errors import SettingsError
from virest.simulation.auto_exposure import AutoExposure, light_path_ev, plan_exposures

STILL: dict[str, Any] = {"rate_rad_s": 0.0, "noise_levels": 0.0, "response": "linear", "frames": 9}


def logged_light(folder: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Exposure × ISO of movie_metadata.csv."""
    table = pd.read_csv(folder / "movie_metadata.csv")
    return (table["Exposure time[nanosec]"] * table["ISO"]).to_numpy(float)


def truth_light(folder: Path, where: np.ndarray[Any, Any] | None = None) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Mean of each truth picture, (frames,)."""
    pictures = [cv2.imread(str(p)).astype(float) for p in sorted((folder / "truth/frames").glob("*.png"))]
    return np.array([p.mean() if where is None else p[where].mean() for p in pictures])


@pytest.mark.parametrize("steps", [None, 4])
def test_light_follows_logged_exposure_times_iso(simulate, steps: int | None) -> None:
    """With a linear curve and a still camera each picture is as bright as logged, over the given range."""
    folder = simulate("auto", **STILL, auto_exposure_ev=2.0, auto_exposure_steps=steps)
    light = logged_light(folder)
    assert np.log2(light.max() / light.min()) == pytest.approx(2.0, abs=0.02)
    first = cv2.imread(str(folder / f"truth/frames/{int(light.argmax()):06d}.png"))
    dim = (first > 20) & (first < 250)
    mean = truth_light(folder, dim)
    np.testing.assert_allclose(mean / mean.max(), light / light.max(), rtol=0.02)


def test_exposure_and_iso_both_change(simulate) -> None:
    """The file truth/effects.json has the light factor of every slot."""
    folder = simulate("auto", **STILL, auto_exposure_ev=3.0)
    table = pd.read_csv(folder / "movie_metadata.csv")
    assert table["Exposure time[nanosec]"].max() > 2 * table["Exposure time[nanosec]"].min()
    assert table["ISO"].max() > 2 * table["ISO"].min()
    told = json.loads((folder / "truth/effects.json").read_text())
    light = logged_light(folder)
    np.testing.assert_allclose([slot["light"] for slot in told["slots"]], light / (144 * 8e6), rtol=1e-6)
    assert told["settings"]["auto_exposure"] == {"range_ev": 3.0, "steps": None}


def test_without_auto_exposure_the_light_is_constant(simulate) -> None:
    """Alternating exposures change the blur but not the brightness, and no file mentions auto-exposure."""
    folder = simulate("turns", **STILL, exposure_ms=[4.0, 8.0, 11.0])
    assert np.ptp(truth_light(folder)) == 0.0
    assert np.ptp(logged_light(folder)) < 0.01 * logged_light(folder).mean()
    assert "auto_exposure" not in (folder / "truth/effects.json").read_text()


def test_the_walk_is_smooth_and_reaches_both_ends(rng: np.random.Generator) -> None:
    """Over 90 frames and 4 EV no step between frames is larger than a third of an EV."""
    path = light_path_ev(AutoExposure(4.0), 90, rng)
    assert (path.min(), path.max()) == (pytest.approx(-2.0), pytest.approx(2.0))
    assert np.abs(np.diff(path)).max() < 0.33


def test_a_staircase_climbs_in_equal_steps(rng: np.random.Generator) -> None:
    """Nine frames have three exposures, from dark to bright."""
    path = light_path_ev(AutoExposure(5.0, 3), 9, rng)
    np.testing.assert_allclose(path, np.repeat([-2.5, 0.0, 2.5], 3))


@pytest.mark.parametrize("steps", [None, 3])
def test_a_single_frame_has_the_usual_exposure(steps: int | None, rng: np.random.Generator) -> None:
    """It is at neither end of the range."""
    assert light_path_ev(AutoExposure(4.0, steps), 1, rng).tolist() == [0.0]


def test_exposure_and_iso_stay_within_their_limits(rng: np.random.Generator) -> None:
    """If one of them is at its limit, the other changes; their product is the light."""
    plan = plan_exposures((0.008,), AutoExposure(10.0, 21), 21, 30.0, rng)
    assert plan.logged_s.max() <= 1 / 30 + 1e-9
    assert plan.iso.min() >= 50
    np.testing.assert_allclose(np.log2(plan.light), np.linspace(-5, 5, 21), atol=1e-3)


@pytest.mark.parametrize(("range_ev", "steps"), [(0.0, None), (-1.0, None), (13.0, None), (4.0, 1), (float("nan"), 3)])
def test_invalid_ranges_are_refused(range_ev: float, steps: int | None) -> None:
    """A settings error refuses the range or the number of steps."""
    with pytest.raises(SettingsError, match="simulation"):
        AutoExposure(range_ev, steps)
