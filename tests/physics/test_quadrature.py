"""The integrator: exact where it must be, right between edges, and stopped at kinks."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from counterspin.physics.quadrature import NODES, Panels, integrate, panel_edges, sign_changes
from counterspin.physics.spindle import Ripple, Spindle

EDGES = np.array([0.0, 0.4, 1.0, 1.1, 2.5])
TIMES = np.array([0.0, 0.05, 0.4, 0.7, 1.05, 1.1, 2.0, 2.5])


@pytest.mark.parametrize("order", [1, 2])
@settings(deadline=None, derandomize=True, max_examples=60)
@given(coefficients=st.lists(st.floats(-3, 3), min_size=1, max_size=NODES))
def test_polynomials_up_to_node_count_are_exact(order, coefficients):
    polynomial = Polynomial(coefficients)
    got = integrate(lambda t: polynomial(t)[None], EDGES, TIMES, order)[:, 0]
    expected = polynomial.integ(order)(TIMES)
    size = Polynomial(np.abs(coefficients)).integ(order)(TIMES)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-14 * size.max() + 1e-300)


@pytest.mark.parametrize("order", [1, 2])
def test_several_functions_with_unordered_times(order):
    shuffled = TIMES[[5, 0, 7, 2, 2, 1]]
    got = integrate(lambda t: np.stack([np.exp(t), np.cos(3 * t)]), EDGES, shuffled, order)
    exp, cos = np.exp(shuffled), np.cos(3 * shuffled)
    expected = {
        1: [exp - 1, np.sin(3 * shuffled) / 3],
        2: [exp - 1 - shuffled, (1 - cos) / 9],
    }[order]
    assert got.shape == (6, 2)
    np.testing.assert_allclose(got.T, expected, rtol=0, atol=3e-14)


def test_many_times_are_evaluated_exactly():
    many = np.linspace(0.0, 2.5, 200_001)  # more than one chunk
    got = integrate(lambda t: np.cos(t)[None], EDGES, many, 2)[:, 0]
    np.testing.assert_allclose(got, 1 - np.cos(many), rtol=0, atol=3e-15)


@pytest.mark.parametrize("order", [1, 2])
def test_unevenly_distributed_times_are_evaluated_exactly(order):
    edges = np.linspace(0.0, 2.5, 40)
    crowd = np.linspace(1.2, 1.21, 500)
    times = np.concatenate([crowd[::-1], edges[5:30:7], [2.5, 0.0], crowd])
    got = integrate(lambda t: np.cos(3 * t)[None], edges, times, order)[:, 0]
    expected = np.sin(3 * times) / 3 if order == 1 else (1 - np.cos(3 * times)) / 9
    np.testing.assert_allclose(got, expected, rtol=0, atol=3e-14)


def test_single_and_double_integrals_match_separate_calls():
    panels = Panels(EDGES)
    cos, exp = np.cos(3 * panels.nodes), np.exp(panels.nodes)
    once, twice = panels.series(cos[None], 1), panels.series(np.stack([exp, cos]), 2)
    got = panels.at(TIMES, np.concatenate([once, twice]))
    expected = [np.sin(3 * TIMES) / 3, np.exp(TIMES) - 1 - TIMES, (1 - np.cos(3 * TIMES)) / 9]
    np.testing.assert_allclose(got, expected, rtol=0, atol=3e-14)
    assert panels.at(TIMES, once[:0]).shape == (0, TIMES.size)


def test_no_times_return_no_rows():
    assert integrate(lambda t: np.cos(t)[None], EDGES, np.empty(0), 2).shape == (0, 1)


@pytest.mark.parametrize("outside", [-0.15, 2.51])
def test_times_outside_panels_raise(outside):
    with pytest.raises(ValueError, match="outside the panels"):
        integrate(lambda t: np.cos(t)[None], EDGES, np.array([1.0, outside]), 1)


@pytest.mark.parametrize("rate", [2.0, -2.0])
@pytest.mark.parametrize("harmonic", [0, 1, 5])
def test_panels_resolve_highest_harmonic(rate, harmonic):
    ripples = (Ripple(harmonic, 1e-3, 0.0),) if harmonic else ()
    duration = 100.0
    edges = panel_edges(Spindle(rate, ripples=ripples), duration)
    assert edges[0] == 0.0
    assert edges[-1] == duration
    # The cubed force has three times the spindle's frequency; ripple adds its own.
    period = 2 * math.pi / ((3 + harmonic) * abs(rate))
    assert np.all(np.diff(edges) > 0.0)
    assert np.diff(edges).max() <= 0.75 * period * (1 + 1e-9)


def test_short_duration_has_one_panel():
    edges = panel_edges(Spindle(1.0), 1e-6)
    np.testing.assert_array_equal(edges, [0.0, 1e-6])


def test_breaks_become_unique_edges():
    plain = panel_edges(Spindle(1.0), 10.0)
    breaks = np.array([-1.0, 0.0, 0.123, plain[3], plain[4] * (1 + 1e-15), 10.0, 11.0])
    edges = panel_edges(Spindle(1.0), 10.0, breaks)
    assert edges.size == plain.size + 1
    assert 0.123 in edges
    assert np.diff(edges).min() > 1e-9
    np.testing.assert_array_equal(panel_edges(Spindle(1.0), 10.0, np.empty(0)), plain)


def test_sign_changes_are_exact_to_rounding():
    changes = sign_changes(lambda t: np.sin(3 * t + 0.5), np.linspace(0.0, 20.0, 30))
    expected = (np.arange(1, 20) * math.pi - 0.5) / 3
    np.testing.assert_allclose(changes, expected, rtol=4e-16, atol=4e-16)


def test_function_without_sign_change_has_no_breaks():
    assert sign_changes(lambda t: 1.5 + np.sin(t), np.linspace(0.0, 20.0, 30)).size == 0


def test_kink_at_panel_edge_is_integrated_exactly():
    """|sin| over many half waves: exact with the edges at the zeros, poor without."""
    duration = 40.3
    plain = panel_edges(Spindle(1.0), duration)
    breaks = sign_changes(np.sin, plain)
    split = panel_edges(Spindle(1.0), duration, breaks)
    waves = int(duration / math.pi)
    expected = 2.0 * waves + 1.0 - math.cos(duration - waves * math.pi)
    end = np.array([duration])
    errors = [
        abs(integrate(lambda t: np.abs(np.sin(t))[None], edges, end, 1)[0, 0] - expected)
        for edges in (plain, split)
    ]
    assert errors[0] > 1e-5
    assert errors[1] < 1e-13


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("kink", [1e-12, 1e-6, 1e-3, 0.4])
def test_times_before_short_first_panel_are_extrapolated(order, kink):
    """Corrected stamps precede the start by milliseconds; the integrals change by f t at most."""
    edges = np.array([0.0, kink, 0.5, 1.0])
    times = np.array([-4e-3, -1e-3, 0.0, kink, 0.7])
    got = integrate(lambda t: np.sign(t - kink)[None], edges, times, order)[:, 0]
    after = np.maximum(times - kink, 0.0)
    expected = 2.0 * after**order / order - times**order / order
    bound = np.abs(np.minimum(times, 0.0)) ** order
    assert (np.abs(got - expected) <= bound + 1e-14).all()
