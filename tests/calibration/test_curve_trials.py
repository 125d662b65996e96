"""Derivatives of a bracket's residuals with respect to the curve and the exposures."""

from __future__ import annotations

import numpy as np
import pytest
from bracket_making import FIVE, GAMMA, make_bracket

from virest.calibration.bracket_samples import sample_bracket
from virest.calibration.curve_families import log_lookup, make_family
from virest.calibration.curve_trials import optimise, residual_of, slopes_of
from virest.calibration.exposure_check import fit_first_curve
from virest.camera.response import ResponseCurve


@pytest.mark.parametrize(("truth", "kind"), [(FIVE, "five_segment"), (GAMMA, "table"), (GAMMA, "gamma")])
def test_slopes_match_finite_differences(truth: ResponseCurve, kind: str) -> None:
    """At the fit, each column equals the difference quotient of the residuals with each sample's light refitted."""
    samples = sample_bracket(make_bracket(truth, np.random.default_rng(5), count=5), np.random.default_rng(0))
    first = fit_first_curve(samples)
    family = make_family(kind, first, samples.low, samples.high, samples.top)
    start = np.concatenate([family.start, np.zeros(len(first.suspect))])
    p, correction = optimise(family, start, samples, first.suspect)
    slopes = slopes_of(family, p, correction, samples)
    here, h = residual_of(log_lookup(family.build(p)), samples, correction), 1e-4
    for k in range(len(p) + len(correction)):
        step = h * np.eye(1, len(p) + len(correction), k)[0]
        if k < len(p) and p[k] + h > family.upper[k]:
            step = -step
        there = residual_of(log_lookup(family.build(p + step[: len(p)])), samples, correction + step[len(p) :])
        quotient = ((there - here) / step.sum()).T
        size = np.sqrt(np.mean(quotient[samples.measured.T] ** 2))
        assert np.sqrt(np.mean((slopes[..., k] - quotient)[samples.measured.T] ** 2)) < 0.1 * size
