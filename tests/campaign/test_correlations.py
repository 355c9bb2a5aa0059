"""Correlated priors against the prior itself, dense generalised least squares and draws."""

import math

import numpy as np
import pytest
from raising import raises

import counterspin as cs
from counterspin.calibration.pages.uncertainty import prior_blocks
from counterspin.campaign.description import read_campaign
from counterspin.correction.instrument import determined_terms, term_covariance
from counterspin.errors import CampaignError
from counterspin.inference.identifiability import assess
from counterspin.inference.least_squares import reduce_block, solve
from counterspin.studies.draws import VariedQuantity, _correlate_samples

CORRELATION = np.array([[1.0, 0.4, -0.3], [0.4, 1.0, 0.0], [-0.3, 0.0, 1.0]])
SD = np.array([2.0, 0.5, 1.5])
MEAN = np.array([1.0, -1.0, 0.5])


def test_priors_without_data_are_returned():
    """The design contains only the sum of the first two unknowns, with zero weight."""
    block = reduce_block(np.array([[1e-9, 1e-9, 0.0]]), [0.0])
    solution = solve([block], prior_mean=MEAN, prior_sd=SD, prior_correlation=CORRELATION)
    np.testing.assert_allclose(solution.estimate, MEAN, rtol=1e-12)
    covariance = np.outer(SD, SD) * CORRELATION
    np.testing.assert_allclose(solution.covariance, covariance, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(solution.sensitivity_prior, np.eye(3), atol=1e-12)


def test_data_and_priors_match_dense_generalised_least_squares():
    """Four unknowns, of which the third has no prior; the others are correlated."""
    rng = np.random.default_rng(3)
    design, y = rng.normal(size=(9, 4)), rng.normal(size=9)
    places = [0, 1, 3]
    sd, mean, correlation = np.full(4, np.inf), np.zeros(4), np.eye(4)
    sd[places], mean[places] = SD, MEAN
    correlation[np.ix_(places, places)] = CORRELATION
    solution = solve(
        [reduce_block(design, y)],
        prior_mean=mean,
        prior_sd=sd,
        prior_correlation=correlation,
        limits=[1e6] * 4,
    )
    weight = np.zeros((4, 4))
    weight[np.ix_(places, places)] = np.linalg.inv(np.outer(SD, SD) * CORRELATION)
    covariance = np.linalg.inv(design.T @ design + weight)
    estimate = covariance @ (design.T @ y + weight @ mean)
    np.testing.assert_allclose(solution.estimate, estimate, rtol=1e-10)
    np.testing.assert_allclose(solution.covariance, covariance, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(solution.sensitivity_prior, covariance @ weight, atol=1e-10)
    residual = y - design @ estimate
    step = estimate - mean
    assert solution.chi2 == pytest.approx(residual @ residual + step @ weight @ step, rel=1e-9)
    combined = solution.combine([1.0, -2.0, 0.5, 3.0])
    assert combined.u**2 == pytest.approx(
        np.array([1.0, -2.0, 0.5, 3.0]) @ covariance @ [1.0, -2.0, 0.5, 3.0], rel=1e-9
    )
    variance = np.diag(assess(solution, ["a", "b", "c", "d"]).u[:, None] ** 2)[0]
    assert variance == pytest.approx(covariance[0, 0], rel=1e-9)


def test_shifted_prior_changes_its_row():
    """An error d of the priors gives -W d in their rows, with W'W the inverse covariance.

    Without data the residual is zero; with W lower triangular, row i has the unknowns up to i.
    """
    block = reduce_block(np.zeros((1, 3)), [0.0])
    solution = solve([block], prior_mean=MEAN, prior_sd=SD, prior_correlation=CORRELATION)
    rows = solution.whiten_priors(np.eye(3))
    weight = np.linalg.inv(np.outer(SD, SD) * CORRELATION)
    np.testing.assert_allclose(rows.T @ rows, weight, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(rows[np.triu_indices(3, 1)], 0.0)


CAMPAIGN = """schema = 1
site = {{ gravity = "9.8 m/s^2", latitude = "45 deg" }}
[accelerometers.A]
input_axis = "up"
pendulous_axis = "west"
K_OO = "1 ± 3 ug/g^2"
[model]
terms = ["K_F", "K_I", "K_II"]
assume = "all"
{hold}
[model.priors]
K_PP = {prior}
K_IP = "0 g/g^2"
{correlation}
"""
ANGLES = [(angle, about) for about in ("north", "east") for angle in range(0, 360, 45)]
READINGS = [
    round(math.cos(math.radians(angle)) + 1e-6 * math.sin(7.0 * place), 9)
    for place, (angle, _) in enumerate(ANGLES)
]
RUNS = "".join(
    f'[[runs]]\nname = "{about}{angle}"\nmotion = "static"\n'
    f'attitude = "{angle} deg about {about}"\nreading = "{reading:.9f} ± 1e-6 g"\n'
    for (angle, about), reading in zip(ANGLES, READINGS, strict=True)
)
PAIR = 'correlation = [["K_OO", "K_PP", {r}]]'


def write_tumble(folder, correlation, prior='"0 ± 2 ug/g^2"', hold="", more=""):
    text = CAMPAIGN.format(correlation=correlation, prior=prior, hold=hold) + more + RUNS
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return folder


def solve_dense(r):
    """Return estimate and covariance of K_F, K_I, K_II, K_OO and K_PP, K_I minus 1."""
    cos, sin = (np.array([f(math.radians(a)) for a, _ in ANGLES]) for f in (np.cos, np.sin))
    north = np.array([about == "north" for _, about in ANGLES])
    # Rotation about north tilts the pendulous axis, west, into the vertical; about east the other.
    squares = [sin**2 * ~north, sin**2 * north]
    design = np.column_stack([np.ones(16), cos, cos**2, *squares])
    prior = np.array([[9.0, 6.0 * r], [6.0 * r, 4.0]]) * 1e-12
    weight = np.zeros((5, 5))
    weight[3:, 3:] = np.linalg.inv(prior)
    covariance = np.linalg.inv(design.T @ design * 1e12 + weight)
    y = np.array(READINGS) - cos
    return covariance @ (design.T @ y * 1e12 + weight @ [0, 0, 0, 1e-6, 0]), covariance


@pytest.mark.parametrize("r", [0.4, -0.9])
def test_calibration_uses_prior_correlation(tmp_path, r):
    result = cs.calibrate(write_tumble(tmp_path, PAIR.format(r=r)), monte_carlo=100_000)
    estimate, covariance = solve_dense(r)
    a = result.accelerometers["A"]
    for place, symbol in enumerate(("K_F", "K_I", "K_II")):
        nominal = 1.0 if symbol == "K_I" else 0.0
        c = a.coefficients[symbol]
        assert c.value - nominal == pytest.approx(estimate[place], rel=1e-6, abs=1e-12)
        assert c.u == pytest.approx(math.sqrt(covariance[place, place]), rel=1e-6)
        assert math.hypot(c.u_noise, c.u_stated) == pytest.approx(c.u, rel=1e-9)
        lines = a.budget[symbol]
        assert math.hypot(*(line.contribution for line in lines)) == pytest.approx(c.u, rel=1e-9)
        # The relative standard deviation of a standard deviation is (2 N)^-1/2, here 0.22 %.
        assert a.monte_carlo[symbol].u == pytest.approx(c.u, rel=0.01)
    sources = {line.source for line in a.budget["K_II"]}
    assert "K_PP given K_OO" in sources or "K_OO given K_PP" in sources
    kept = {row.name: row for row in result.rests_on}
    for place, name in ((3, "A.K_OO"), (4, "A.K_PP")):
        assert kept[name].found == pytest.approx(estimate[place], abs=1e-12)
        assert kept[name].u_found == pytest.approx(math.sqrt(covariance[place, place]), rel=1e-6)


def test_result_states_prior_correlation(tmp_path):
    result = cs.calibrate(write_tumble(tmp_path, PAIR.format(r=0.4)))
    result.write(tmp_path / "r.json")
    read = cs.read_result(tmp_path / "r.json").accelerometers["A"]
    assert read.prior_correlations == {"K_OO": {"K_PP": 0.4}, "K_PP": {"K_OO": 0.4}}
    terms = determined_terms(read)
    symbols = list(terms)
    i, j = symbols.index("K_OO"), symbols.index("K_PP")
    assert term_covariance(read, terms)[i, j] == pytest.approx(0.4 * 3e-6 * 2e-6)
    text = "".join(map(str, prior_blocks(result)))
    assert "A.K_OO and A.K_PP 0.4" in text
    # A correlated prior cannot be improved separately.
    assert read.what_if is None or not read.what_if.known.keys() & {"K_OO", "K_PP"}


def test_zero_correlation_leaves_result_unchanged(tmp_path):
    plain = cs.calibrate(write_tumble(tmp_path, ""))
    zero = cs.calibrate(write_tumble(tmp_path, PAIR.format(r=0.0)))
    for symbol, c in plain.accelerometers["A"].coefficients.items():
        assert zero.accelerometers["A"].coefficients[symbol].u == pytest.approx(c.u, rel=1e-12)


def test_terms_of_two_accelerometers_can_be_correlated(tmp_path):
    other = CAMPAIGN.split("[accelerometers.A]")[1].split("[model]", maxsplit=1)[0]
    folder = write_tumble(
        tmp_path,
        'correlation = [["A.K_OO", "B.K_OO", 0.5], ["K_OO", "K_PP", 0.2]]',
        more=f"[accelerometers.B]{other}",
    )
    text = (folder / "campaign.toml").read_text("utf-8").replace("reading = ", "A = ")
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    with pytest.raises(CampaignError) as caught:
        read_campaign(folder)
    assert "correlation" not in str(caught.value)


def test_studies_draw_correlated_truths():
    quantities = [
        VariedQuantity("A", s, "normal", m, sd, correlations={f"A.{other}": -0.7})
        for s, other, m, sd in (("K_OO", "K_PP", 1.0, 2.0), ("K_PP", "K_OO", 0.0, 0.5))
    ]
    rng = np.random.default_rng(1)
    drawn = [quantity.draw(rng, 1, 40_000) for quantity in quantities]
    _correlate_samples(quantities, drawn)
    values = np.vstack(drawn)
    # The standard deviation of a correlation is (1 - r^2) N^-1/2 = 0.0026.
    assert np.corrcoef(values)[0, 1] == pytest.approx(-0.7, abs=5 * 0.0026)
    assert values.std(axis=1) == pytest.approx([2.0, 0.5], rel=0.02)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ('"K_OO"', "must be a list such as"),
        ('[["K_OO", "K_PP"]]', "must be two terms and their correlation"),
        ('[["K_OO", "K_PP", 1.0]]', "less than 1, but it is 1"),
        ('[["K_OO", "K_OO", 0.5]]', "are not two different terms"),
        ('[["K_OO", "K_PQ", 0.5]]', '"K_PQ" is not a term of an accelerometer'),
        ('[["K_OO", "site.gravity", 0.5]]', '"site.gravity" is not a term'),
        ('[["K_OO", "K_IO", 0.5]]', "A.K_IO has no stated prior"),
        ('[["K_OO", "K_IP", 0.5]]', "A.K_IP is stated without an uncertainty"),
        ('[["K_OO", "K_PP", 0.5], ["A.K_PP", "K_OO", 0.5]]', "is stated twice"),
    ],
)
def test_rejects_invalid_correlations(tmp_path, entries, message):
    with pytest.raises(CampaignError) as caught:
        read_campaign(write_tumble(tmp_path, f"correlation = {entries}"))
    assert message in str(caught.value)
    assert "model.priors.correlation" in str(caught.value)


def test_indefinite_correlation_matrix_names_pairs(tmp_path):
    """r = 0.9, 0.9 and -0.9 have the eigenvalue -0.8."""
    pairs = '[["K_OO", "K_PP", 0.9], ["K_OO", "K_IO", 0.9], ["K_PP", "K_IO", -0.9]]'
    folder = write_tumble(tmp_path, f'K_IO = "0 ± 1 ug/g^2"\ncorrelation = {pairs}')
    with raises("invalid-correlation", "A.K_OO", "A.K_IO 0.9"):
        read_campaign(folder)


def test_rejects_correlation_of_rectangular_prior(tmp_path):
    limits = '{ value = "0 g/g^2", half_width = "2e-6 g/g^2", distribution = "rectangular" }'
    with pytest.raises(CampaignError, match=r"rectangular distribution; correlated priors are"):
        read_campaign(write_tumble(tmp_path, PAIR.format(r=0.4), prior=limits))


def test_rejects_correlation_of_held_term(tmp_path):
    with raises("conflicting-keys", "K_PP", "model.hold"):
        read_campaign(write_tumble(tmp_path, PAIR.format(r=0.4), hold='hold = ["K_PP"]'))
