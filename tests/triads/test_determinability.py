"""Parameters that the directions of a triad's poses do not determine, however many poses."""

import numpy as np
import pytest
from scipy import stats

import triads
from counterspin.readings.fit import solve_readings

NOISE = 5e-4
FACES = np.vstack([np.eye(3), -np.eye(3)])
ANGLES = {"Y.delta_P", "Z.delta_O", "Z.delta_P"}
#: Default standard uncertainties of consumer grade: bias, scale factor, misalignment.
DEFAULTS = (0.05, 0.04, 0.02)


def _near_faces(generator, angle):
    """Return 24 directions within an angle (rad, standard deviation) of the six faces."""
    near = np.repeat(FACES, 4, axis=0) + angle * generator.standard_normal((24, 3))
    return near / np.linalg.norm(near, axis=1)[:, None]


def _about_one_axis(generator, count=24):
    turn = generator.uniform(0.0, 2.0 * np.pi, count)
    return np.column_stack([np.cos(turn), np.sin(turn), np.zeros(count)])


def _in_two_planes(generator):
    first, second = _about_one_axis(generator, 12), _about_one_axis(generator, 12)
    return np.vstack([first, second[:, [2, 0, 1]]])


def _nine_in_eight(generator):
    along = triads.draw_directions(8, generator)
    return np.vstack([along, along[:1]])


def _fit(along, generator, rows=triads.ROWS, bias=triads.BIAS):
    values = triads.compute_indications(along, rows, bias)
    values = values + NOISE * generator.standard_normal(values.shape)
    return solve_readings([triads.make_poses(values, NOISE)], triads.make_unknowns(defaults=True))


def _undetermined(fit):
    return {unknown.name for unknown in fit.fit.model.unknowns if unknown.uses_fallback_prior}


@pytest.mark.parametrize(
    ("directions", "undetermined"),
    [
        (lambda generator: np.repeat(FACES, 4, axis=0), ANGLES),
        (lambda generator: np.repeat(FACES, 40, axis=0), ANGLES),
        (lambda generator: _near_faces(generator, np.radians(0.1)), ANGLES),
        (
            lambda generator: np.vstack([np.repeat(FACES, 3, axis=0), _about_one_axis(generator)]),
            {"Z.delta_O", "Z.delta_P"},
        ),
        # Nothing turns about the axis of Z and that of Y, seen along X.
        (_in_two_planes, {"Z.delta_O"}),
        (_about_one_axis, {"Z.K_F", "Z.K_I", "Z.delta_O", "Z.delta_P"}),
        (lambda generator: triads.draw_directions(24, generator), set()),
    ],
)
def test_determinability_depends_on_directions(directions, undetermined):
    generator = np.random.default_rng(11)
    fit = _fit(directions(generator), generator)
    assert _undetermined(fit) == undetermined
    for unknown, u in zip(fit.fit.model.unknowns, fit.solution.u, strict=True):
        if unknown.name in undetermined:
            # Tilts that are noise take away up to a tenth of the prior's variance.
            assert 0.9 * unknown.default_sd**2 < u**2 <= unknown.default_sd**2


def test_nine_poses_in_eight_directions_have_one_undetermined_parameter():
    generator = np.random.default_rng(12)
    assert len(_undetermined(_fit(_nine_in_eight(generator), generator))) == 1


def test_determined_parameters_do_not_use_default_priors():
    generator = np.random.default_rng(13)
    values = triads.compute_indications(triads.draw_directions(24, generator))
    values = values + NOISE * generator.standard_normal(values.shape)
    group = triads.make_poses(values)
    free = solve_readings([group], triads.make_unknowns())
    fit = solve_readings([group], triads.make_unknowns(defaults=True))
    np.testing.assert_allclose(fit.solution.estimate, free.solution.estimate, rtol=1e-7)
    np.testing.assert_allclose(fit.solution.u, free.solution.u, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, np.radians(1.0)])
def test_u_of_six_faces_has_coverage(angle):
    # The sensor is drawn from the default priors. Bounds: 1e-3 of chi-square, to either side.
    generator = np.random.default_rng(14)
    z: dict[str, list[float]] = {"K_F": [], "K_I": [], "delta": []}
    for _ in range(60):
        bias = DEFAULTS[0] * generator.standard_normal(3)
        rows = np.diag(1.0 + DEFAULTS[1] * generator.standard_normal(3))
        rows[[1, 2, 2], [0, 0, 1]] = DEFAULTS[2] * generator.standard_normal(3)
        along = np.repeat(FACES, 4, axis=0) if angle == 0.0 else _near_faces(generator, angle)
        fit = _fit(along, generator, rows, bias)
        truth = triads.true_parameters(rows, bias) - [u.nominal for u in fit.fit.model.unknowns]
        for unknown, error, u in zip(
            fit.fit.model.unknowns, fit.solution.estimate - truth, fit.solution.u, strict=True
        ):
            if not unknown.uses_fallback_prior:
                z[unknown.symbol if unknown.symbol in z else "delta"].append(error / u)
    offsets = np.array(z["K_F"])
    assert stats.chi2(offsets.size).cdf(offsets @ offsets) == pytest.approx(0.5, abs=0.499)
    for key in ("K_I", "delta") if angle > 0.0 else ("K_I",):
        # What a misalignment without data does to a scale factor is an upper bound.
        some = np.array(z[key])
        assert stats.chi2(some.size).sf(some @ some) > 1e-3
    assert bool(z["delta"]) is bool(angle > 0.0)
