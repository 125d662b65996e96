"""Structure in residuals: none in noise, found along its covariate, and not confused with scatter."""

from __future__ import annotations

import numpy as np
import pytest

from virest.diagnosis.structure import Structure, structures

Array = np.ndarray
PAIRS, POINTS = 60, 50
FLOOR_PX = 0.02


def cloud(seed: int) -> tuple[Array, Array, dict[str, Array], Array]:
    """White residuals of 0.2 px with weights, unrelated covariates, and pairs."""
    rng = np.random.default_rng(seed)
    pair = np.repeat(np.arange(PAIRS), POINTS)
    covariates = {
        "row": rng.uniform(0, 640, len(pair)),
        "radius": rng.rayleigh(150, len(pair)),
        "rate": rng.uniform(0.1, 2, PAIRS)[pair],
    }
    return rng.normal(0, 0.2, (len(pair), 2)), rng.uniform(0.3, 1, len(pair)), covariates, pair


def named(found: list[Structure]) -> dict[str, Structure]:
    """Structures by covariate."""
    return {structure.along: structure for structure in found}


def test_white_residuals_show_no_structure() -> None:
    """Over 25 clouds nothing is significant, sizes stay at a few 0.01 px, and p-values do not cluster near 0."""
    rows, others = [], []
    for seed in range(25):
        values, weight, covariates, pair = cloud(seed)
        bare = named(structures(values, weight, covariates, pair, 0.0))
        floored = named(structures(values, weight, covariates, pair, FLOOR_PX))
        assert max(structure.size for structure in bare.values()) < 0.025
        rows.append([bare[name].p_value for name in ("row", "radius")])
        others.append([floored[name].p_value for name in covariates])
    assert np.min(rows) > 1e-4
    assert np.mean(np.array(rows) < 0.05) < 0.2
    assert 0.25 < np.mean(rows) < 0.75
    assert np.min(others) > 1e-3


def test_a_wave_along_rows_is_found_along_rows() -> None:
    """A wave of 0.1 px over the rows is listed first with its RMS and is not found along other covariates."""
    values, weight, covariates, pair = cloud(31)
    values[:, 1] += 0.1 * np.sin(2 * np.pi * covariates["row"] / 640)
    found = structures(values, weight, covariates, pair, FLOOR_PX)
    assert found[0].along == "row"
    assert found[0].p_value < 1e-6
    # the wave's RMS over both coordinates, reduced by the ten bins and the floor
    assert found[0].size == pytest.approx(0.1 / 2, rel=0.2)
    assert all(structure.p_value > 1e-3 for structure in found[1:])
    assert [s.size for s in found] == sorted((s.size for s in found), reverse=True)


def test_residuals_may_have_one_column() -> None:
    """Residuals (n, 1), as from brightness, with a slope along the radius."""
    values, weight, covariates, pair = cloud(32)
    one = values[:, :1] + 0.0006 * (covariates["radius"][:, None] - 190)
    found = structures(one, weight, covariates, pair, FLOOR_PX)
    assert found[0].along == "radius"
    assert found[0].p_value < 1e-6


def test_a_shift_of_each_pair_is_scatter() -> None:
    """Individual shifts of pairs far above the noise are not structure along rows or radius."""
    values, weight, covariates, pair = cloud(33)
    values += np.random.default_rng(34).normal(0, 0.3, (PAIRS, 2))[pair]
    found = named(structures(values, weight, covariates, pair, FLOOR_PX))
    assert found["row"].p_value > 1e-3
    assert found["radius"].p_value > 1e-3


def test_means_below_the_floor_are_not_counted() -> None:
    """A wave of half the floor is not significant; without a floor it is."""
    values, weight, covariates, pair = cloud(35)
    values = 0.1 * values
    values[:, 0] += 0.01 * np.sin(2 * np.pi * covariates["row"] / 320)
    assert named(structures(values, weight, covariates, pair, FLOOR_PX))["row"].p_value > 0.05
    assert named(structures(values, weight, covariates, pair, FLOOR_PX))["row"].size == 0.0
    assert named(structures(values, weight, covariates, pair, 0.0))["row"].p_value < 1e-6


def test_points_without_weight_have_no_influence() -> None:
    """Extreme residuals with weight 0 change nothing."""
    values, weight, covariates, pair = cloud(36)
    wild = covariates["row"] > 560
    weight[wild] = 0.0
    calm = structures(values, weight, covariates, pair, FLOOR_PX)
    values[wild] += 40.0
    assert structures(values, weight, covariates, pair, FLOOR_PX) == calm


def test_one_pair_gives_no_estimate_of_scatter() -> None:
    """With all points in one pair, no structure is reported along rows."""
    values, weight, covariates, pair = cloud(37)
    values[:, 1] += 0.5 * np.sin(covariates["row"] / 100)
    found = named(structures(values, weight, {"row": covariates["row"]}, 0 * pair, FLOOR_PX))
    assert found["row"].p_value == 1.0
    assert found["row"].size == 0.0
