"""The scale of the noise where few rows, or none, are left beside the unknowns."""

import math
from dataclasses import replace

import numpy as np
import pytest

from counterspin.errors import NotIdentifiableError
from counterspin.inference.noise.likelihood import WHITE, RecordData, RestrictedLikelihood
from counterspin.inference.noise.model import Noise, make_whitener


def likelihood(unknowns, width, noise=1e-6):
    """Six samples of specific force, of a polynomial whose coefficients have priors."""
    rng = np.random.default_rng(1)
    design = np.vander(np.linspace(-1.0, 1.0, 6), unknowns)
    values = design @ rng.normal(0.0, 1e-3, unknowns) + rng.normal(0.0, noise, 6)
    data = RecordData(np.arange(6.0), 0, design, values)
    return RestrictedLikelihood.from_records([data], np.eye(unknowns) / width, np.zeros(unknowns))


@pytest.mark.parametrize("unknowns", [6, 7, 12])
@pytest.mark.parametrize("width", [1.0, 1e3, 1e9])
def test_saturated_fit_raises(unknowns, width):
    with pytest.raises(NotIdentifiableError, match="the unknowns fit all 6 rows"):
        likelihood(unknowns, width).best_scale(WHITE)


@pytest.mark.parametrize("width", [1.0, 1e3, 1e9])
def test_single_surplus_row_determines_noise(width):
    few = likelihood(5, width)
    scale = few.best_scale(WHITE)
    assert few.dof(scale, WHITE) == pytest.approx(1.0, abs=1e-6)
    assert abs(few.slope(scale, WHITE)) < 1e-6
    # A single degree of freedom: within the central 99.9 % of chi-square.
    assert 3.9e-7 < math.exp(scale) / 1e-12 < 12.2


def test_strong_priors_leave_degrees_of_freedom():
    held = likelihood(7, 1e-9, noise=1e-2)
    scale = held.best_scale(WHITE)
    assert held.dof(scale, WHITE) == pytest.approx(6.0, abs=1e-3)
    # Six degrees of freedom: within the central 99.9 % of chi-square.
    assert 0.299 < 6.0 * math.exp(scale) / 1e-4 < 24.11


@pytest.mark.parametrize("order", [1, 2])
def test_likelihood_matches_whitened_rows(order):
    """Patterson and Thompson's, with the whitener whose rows are tested for themselves."""
    rng = np.random.default_rng(5)
    times = np.linspace(0.0, 200.0, 101)
    design = np.column_stack([times**order, np.cos(0.3 * times)])
    values = rng.standard_normal(times.size)
    records = [RecordData(times, order, design, values, walk_duration=50.0)]
    likelihood_of = RestrictedLikelihood.from_records(records, None, None)
    white = 0.7
    log_likelihood = likelihood_of.value(math.log(white), (1.0, 1e-4, 1e-5, 1e-6))
    noise = Noise(*(math.sqrt(white * part) for part in (1.0, 1e-4)), 0.0)
    noise = replace(noise, flicker=math.sqrt(white * 1e-5), bias_walk=math.sqrt(white * 1e-6))
    whitener = make_whitener(times, order, noise, walk_duration=50.0)
    x, y = whitener.apply(design), whitener.apply(values)
    _, log_information = np.linalg.slogdet(x.T @ x)
    left = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    expected = -(whitener.log_det + log_information + left @ left) / 2
    assert log_likelihood == pytest.approx(expected, rel=1e-9)
