"""Solvers, tested with matrices small enough for brute force."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from laws import assert_adjoint, assert_linear
from numpy.typing import NDArray

from virest.restoration.deconvolution import (
    add_roughness,
    conjugate_gradients,
    difference,
    difference_adjoint,
    hyper_laplacian,
    richardson_lucy,
    shrink,
    shrinkage_table,
)
from virest.restoration.statistics.on_tiles import on_spectrum
from virest.restoration.statistics.records import unknown_picture
from virest.restoration.statistics.rings import RINGS
from virest.restoration.tile_methods import RESIDUAL_SHARE, _with_residual

Image = NDArray[np.float32]


def _matrix(rng: np.random.Generator) -> tuple[Image, Callable[[Image], Image], Callable[[Image], Image]]:
    """A positive 5 × 7 matrix as an operator from pictures (1, 7) to pictures (1, 5)."""
    a = rng.uniform(0.05, 1, (5, 7)).astype(np.float32) + 2 * np.eye(5, 7, 1, dtype=np.float32)
    return a, lambda x: (a @ x[0])[None], lambda y: (a.T @ y[0])[None]


# ── shrinkage ────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("beta", [0.05, 0.7, 4.0, 60.0])
@pytest.mark.parametrize("exponent", [0.5, 2 / 3, 0.8])
def test_shrinkage_solves_its_scalar_problem(beta: float, exponent: float) -> None:
    """No value on a fine grid has a smaller |w|^a + β/2 (w − v)² than the tabulated one, for either sign."""
    v = np.array([-7.9, -2.5, -0.6, 0.01, 0.3, 0.9, 1.4, 2.2, 5.0], np.float32)
    found = shrink(v, shrinkage_table(beta, exponent)).astype(float)

    def cost(w: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.abs(w) ** exponent + beta / 2 * (w - v) ** 2

    best = np.min([cost(np.full(len(v), w)) for w in np.linspace(-8, 8, 16_001)], axis=0)
    assert (cost(found) <= best * (1 + 2e-3) + 2e-3).all()


def test_shrinkage_zeroes_small_values_and_keeps_large_ones() -> None:
    """Gradients below a threshold vanish, large ones hardly change, and none grows or changes its sign."""
    v = np.linspace(-20, 20, 801).astype(np.float32)
    shrunk = shrink(v, shrinkage_table(3.0))
    assert (shrunk[np.abs(v) < 0.5] == 0).all()
    assert (np.abs(shrunk) <= np.abs(v)).all()
    assert (shrunk * v >= 0).all()
    np.testing.assert_allclose(shrunk[np.abs(v) > 7], v[np.abs(v) > 7], rtol=0.03)


# ── differences ──────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("axis", [0, 1])
def test_differences_and_their_adjoint(axis: int, rng: np.random.Generator) -> None:
    """Forward differences are linear, their adjoint is their transpose, and a slope gives its constant."""
    shape = (7, 11)
    assert_linear(lambda x: difference(x, axis), shape, rng)
    assert_adjoint(lambda x: difference(x, axis), lambda y: difference_adjoint(y, axis), shape, shape, rng)
    y, x = np.mgrid[:7, :11].astype(np.float32)
    slope = difference(2 * x - 3 * y, axis)
    inner = slope[:-1] if axis == 0 else slope[:, :-1]
    np.testing.assert_allclose(inner, -3 if axis == 0 else 2)
    assert not (slope[-1] if axis == 0 else slope[:, -1]).any()


def test_roughness_is_the_adjoint_of_weighted_differences(rng: np.random.Generator) -> None:
    """Dᵀ w D along both axes is added to the array; the picture is unchanged."""
    picture, weight, there = rng.random((3, 7, 11)).astype(np.float32)
    expected, before = there.copy(), picture.copy()
    for axis in (0, 1):
        expected += difference_adjoint(weight * difference(picture, axis), axis)
    add_roughness(there, picture, weight)
    np.testing.assert_allclose(there, expected, atol=1e-5)
    np.testing.assert_array_equal(picture, before)


# ── conjugate gradients ──────────────────────────────────────────────────────────────────────────────────────────


def _positive(rng: np.random.Generator, size: int = 8) -> NDArray[np.float64]:
    a = rng.normal(size=(size, size))
    return a @ a.T + size * np.eye(size)


def test_conjugate_gradients_solve_a_small_system(rng: np.random.Generator) -> None:
    """A few steps solve a positive system from any start and with any positive preconditioner."""
    matrix, right, start = _positive(rng), rng.normal(size=8), rng.normal(size=8)
    before = start.copy()
    for precondition in (np.ones(8), 1 / np.diag(matrix), rng.uniform(0.2, 1, 8)):
        found = conjugate_gradients(lambda x: matrix @ x, right, start, precondition, 10)
        np.testing.assert_allclose(found, np.linalg.solve(matrix, right), atol=1e-5)
    np.testing.assert_array_equal(start, before)


def test_conjugate_gradients_stop_at_the_solution(rng: np.random.Generator) -> None:
    """Starting at the solution, or with a zero right-hand side, further steps change nothing and give no NaN."""
    matrix, solution = np.diag(np.arange(1.0, 9.0)), np.ones(8)
    found = conjugate_gradients(lambda x: matrix @ x, matrix @ solution, solution, np.ones(8), 20)
    np.testing.assert_allclose(found, solution, atol=1e-6)
    nothing = conjugate_gradients(lambda x: matrix @ x, np.zeros(8), np.zeros(8), np.ones(8), 20)
    np.testing.assert_array_equal(nothing, 0)


def test_each_step_lowers_the_energy(rng: np.random.Generator) -> None:
    """½ xᵀ M x − bᵀ x never increases from one step to the next."""
    matrix, right = _positive(rng), rng.normal(size=8)
    found = [conjugate_gradients(lambda x: matrix @ x, right, np.zeros(8), np.ones(8), n) for n in range(7)]
    energy = [0.5 * x @ matrix @ x - right @ x for x in found]
    assert (np.diff(energy) <= 1e-9).all()


# ── Richardson–Lucy ──────────────────────────────────────────────────────────────────────────────────────────────


def test_richardson_lucy_raises_the_likelihood(rng: np.random.Generator) -> None:
    """Each update raises the Poisson likelihood, and many updates explain the observation."""
    _, apply, adjoint = _matrix(rng)
    observed = apply(rng.uniform(0.2, 2, (1, 7)).astype(np.float32))
    start, weight = np.ones((1, 7), np.float32), np.ones((1, 5), np.float32)
    found = [richardson_lucy(observed, apply, adjoint, start, weight, n) for n in (0, 1, 2, 4, 8, 16, 2000)]
    likelihood = [float(np.sum(observed * np.log(apply(f)) - apply(f))) for f in found]
    assert (np.diff(likelihood) > -1e-4).all()
    np.testing.assert_allclose(apply(found[-1]), observed, rtol=0.01)
    assert all((f > 0).all() for f in found)


def test_richardson_lucy_keeps_the_light(rng: np.random.Generator) -> None:
    """The predicted picture keeps the sum of the observed one."""
    _, apply, adjoint = _matrix(rng)
    observed = rng.uniform(0.5, 3, (1, 5)).astype(np.float32)
    found = richardson_lucy(observed, apply, adjoint, np.ones((1, 7), np.float32), np.ones_like(observed), 3)
    assert apply(found).sum() == pytest.approx(observed.sum(), rel=1e-3)


def test_pixels_without_weight_have_no_influence(rng: np.random.Generator) -> None:
    """The value of a censored pixel does not matter."""
    _, apply, adjoint = _matrix(rng)
    observed = rng.uniform(0.5, 3, (1, 5)).astype(np.float32)
    other, weight = observed.copy(), np.ones_like(observed)
    other[0, 2], weight[0, 2] = 50, 0
    start = np.ones((1, 7), np.float32)
    one, two = (richardson_lucy(o, apply, adjoint, start, weight, 20) for o in (observed, other))
    np.testing.assert_array_equal(one, two)
    full = richardson_lucy(other, apply, adjoint, start, np.ones_like(weight), 20)
    assert np.abs(full - one).max() > 0.1


# ── hyper-Laplacian ──────────────────────────────────────────────────────────────────────────────────────────────


def _objective(f: Image, observed: Image, apply: Callable[[Image], Image], data_weight: float, unit: float) -> float:
    return float(data_weight / 2 * np.sum((apply(f) - observed) ** 2) + np.sum(np.abs(np.diff(f[0]) / unit) ** (2 / 3)))


def test_hyper_laplacian_finds_a_step(rng: np.random.Generator) -> None:
    """A step seen through a 5 × 7 matrix is recovered better than by least squares, with a lower objective."""
    a, apply, adjoint = _matrix(rng)
    step = np.array([[1, 1, 1, 4, 4, 4, 4]], np.float32)
    observed = apply(step)
    least_squares = (np.linalg.pinv(a) @ observed[0])[None].astype(np.float32)
    ones = np.ones((1, 7), np.float32)
    betas = tuple(np.geomspace(0.05, 60, 12))
    found = hyper_laplacian(
        observed, apply, adjoint, least_squares, np.ones((1, 5), np.float32), ones, 400.0, 1.0, betas, 20
    )
    assert np.abs(found - step).max() < 0.3 * np.abs(least_squares - step).max()
    cost = [_objective(f, observed, apply, 400.0, 1.0) for f in (found, least_squares)]
    assert cost[0] < cost[1]


def test_hyper_laplacian_trusts_clean_data(rng: np.random.Generator) -> None:
    """With the identity operator and a large data weight, the result is the observation."""
    observed = rng.uniform(0, 1, (6, 9)).astype(np.float32)
    ones = np.ones_like(observed)
    found = hyper_laplacian(observed, np.copy, np.copy, np.zeros_like(observed), ones, ones, 1e6, 1.0, (1.0, 10.0), 30)
    np.testing.assert_allclose(found, observed, atol=2e-3)


def test_hyper_laplacian_fills_pixels_without_weight(rng: np.random.Generator) -> None:
    """A pixel without weight is filled from its neighbours, whatever its value."""
    observed = np.full((6, 9), 0.5, np.float32)
    weight, ones = np.ones_like(observed), np.ones_like(observed)
    observed[2, 4], weight[2, 4] = 30, 0
    found = hyper_laplacian(
        observed, np.copy, np.copy, np.zeros_like(observed), weight, ones, 1e4, 1.0, (1.0, 10.0), 60
    )
    np.testing.assert_allclose(found, 0.5, atol=5e-3)


def test_solvers_do_not_change_their_input(rng: np.random.Generator) -> None:
    """Neither the start nor the observation is overwritten."""
    _, apply, adjoint = _matrix(rng)
    observed, start = np.ones((1, 5), np.float32), rng.uniform(1, 2, (1, 7)).astype(np.float32)
    before = (observed.copy(), start.copy())
    weight, slope = np.ones((1, 5), np.float32), np.ones((1, 7), np.float32)
    richardson_lucy(observed, apply, adjoint, start, weight, 3)
    hyper_laplacian(observed, apply, adjoint, start, weight, slope, 10.0, 1.0, (1.0, 4.0), 3)
    np.testing.assert_array_equal(observed, before[0])
    np.testing.assert_array_equal(start, before[1])


def test_over_relaxed_richardson_lucy_converges_faster(rng: np.random.Generator) -> None:
    """Steps 1.7 times as long come closer to the data in the same number, and light stays positive."""
    matrix, apply, adjoint = _matrix(rng)
    sharp = rng.uniform(0.1, 2.0, (1, matrix.shape[1])).astype(np.float32)
    observed, weight = apply(sharp), np.ones((1, matrix.shape[0]), np.float32)
    start = np.ones_like(sharp)
    plain, far = (richardson_lucy(observed, apply, adjoint, start, weight, 8, r) for r in (1.0, 1.7))
    assert np.abs(apply(far) - observed).sum() < np.abs(apply(plain) - observed).sum()
    assert far.min() > 0


def test_faint_texture_is_restored_from_the_residual(rng: np.random.Generator) -> None:
    """If the solution explains the record nothing is added.

    Otherwise a part of the residual is, with each tile's own spectrum.
    """
    size = 32
    powers, solved = rng.random((2, 2, size, size)).astype(np.float32)
    deconvolution = SimpleNamespace(powers=powers, size=size)

    def restored(projected: Image) -> list[Image]:
        tiles = _with_residual(deconvolution, projected, solved, unknown_picture(), (0.0, 0.7))  # type: ignore[arg-type]
        return [tile.copy() for tile in tiles]

    np.testing.assert_allclose(restored(powers * solved), solved, rtol=1e-6)
    found = restored((powers + 1) * solved)
    ratio = on_spectrum(unknown_picture(), np.full(RINGS, 1 / RESIDUAL_SHARE), size)
    guarded = np.maximum(ratio, 0.7 / RESIDUAL_SHARE)
    guarded[0, 0] = ratio[0, 0]
    for tile, spectrum, power, noise in zip(found, solved, powers, (ratio, guarded), strict=True):
        np.testing.assert_allclose(tile, spectrum + spectrum / (power + noise), rtol=1e-4)
