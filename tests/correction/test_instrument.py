"""Predicted indications: Eq. 7 and the covariance of the coefficients."""

import numpy as np
import pytest
from campaigns import SMALL, replace_parts, write_description
from results import make_accelerometer_result, make_bare_result, make_coefficient

from counterspin.calibration.calibrate import calibrate
from counterspin.correction.apply import ApplyOptions, apply
from counterspin.simulation.simulate import simulate

CROSSED = replace_parts(
    SMALL,
    (
        '[model]\nassume = "all"\n',
        '[model]\nassume = "all"\nterms = ["K_F", "K_II", "K_III"]\n',
    ),
)
FORCE = np.array([-2.0, -1.0, 0.0, 0.5, 3.0])
PENDULOUS = np.array([-1.0, 0.0, 1.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    where = tmp_path_factory.mktemp("prediction")
    simulate(write_description(where, CROSSED, "plan.toml"), where / "records")
    return calibrate(where / "records")


def test_indication_is_sum_of_terms(result):
    k = {symbol: c.value for symbol, c in result.accelerometers["Qx"].coefficients.items()}
    scale = result.accelerometers["Qx"].known["K_I"].value
    expected = k["K_F"] + scale * FORCE + k["K_II"] * FORCE**2 + k["K_III"] * FORCE**3
    assert result.predict("Qx", FORCE).indicated == pytest.approx(expected, rel=1e-14, abs=1e-15)
    prediction = result.predict("Qx", 2.0)
    assert prediction.indicated == pytest.approx(
        [k["K_F"] + 2.0 * scale + 4.0 * k["K_II"] + 8.0 * k["K_III"]], rel=1e-14
    )


def test_cross_axis_forces_act_through_product_terms():
    """K_IP a_I a_P, K_OO a_O^2 and delta_P a_O with its sign, with u of each."""
    terms = {"K_IP": (3e-6, 1e-7), "K_OO": (2e-6, 2e-7), "K_I": (1.0, 1e-5)}
    units = {"K_IP": "g/g^2", "K_OO": "g/g^2", "K_I": "g/g"}
    own = {symbol: make_coefficient(*pair, units[symbol]) for symbol, pair in terms.items()}
    bare_result = make_bare_result(
        accelerometers={"Qx": make_accelerometer_result(coefficients=own)}
    )
    indication = bare_result.predict("Qx", FORCE, pendulous=PENDULOUS, output_axis=0.5)
    products = {"K_IP": FORCE * PENDULOUS, "K_OO": 0.25 * np.ones(5), "K_I": FORCE}
    expected = sum(terms[symbol][0] * products[symbol] for symbol in terms)
    assert indication.indicated == pytest.approx(expected, rel=1e-14)
    u = np.sqrt(sum((terms[symbol][1] * products[symbol]) ** 2 for symbol in terms))
    assert indication.u == pytest.approx(u, rel=1e-14)


def test_u_matches_covariance(result):
    """J C J^T, with the result's own covariance; the prior of K_I is exact here."""
    names = ["Qx.K_F", "Qx.K_II", "Qx.K_III"]
    jacobian = np.stack([np.ones_like(FORCE), FORCE**2, FORCE**3], axis=1)
    places = [result.covariance.terms.index(name) for name in names]
    covariance = result.covariance.matrix[np.ix_(places, places)]
    variance = np.einsum("ni,ij,nj->n", jacobian, covariance, jacobian)
    prediction = result.predict("Qx", FORCE)
    assert prediction.u == pytest.approx(np.sqrt(variance), rel=1e-9)
    assert repr(prediction).startswith("<5 indications from ")


def test_u_includes_default_prior(result, tmp_path):
    """A typical K_4 acts with the fourth power of the force."""
    less = CROSSED.replace('"K_II", "K_III"', '"K_II"').replace('assume = "all"\n', "")
    simulate(write_description(tmp_path, less, "plan.toml"), tmp_path / "r")
    wider = calibrate(tmp_path / "r")
    (known,) = (known for known in wider.rests_on if known.name == "Qx.K_4")
    assert known.kind == "unstated"
    assert wider.predict("Qx", 100.0).u[0] >= known.u * 100.0**4


def test_correction_inverts_prediction(result):
    prediction = result.predict("Qx", FORCE, pendulous=PENDULOUS)
    back = apply(result, "Qx", prediction.indicated, ApplyOptions(pendulous=PENDULOUS))
    assert back.corrected == pytest.approx(FORCE, abs=1e-12)
    assert repr(back).startswith("<5 corrected in g, u at most ")


def test_rejects_invalid_prediction_input(result):
    with pytest.raises(KeyError, match="Qz; the accelerometers are Qx"):
        result.predict("Qz", 1.0)
    for wrong in ([[1.0]], [], [np.nan]):
        with pytest.raises(ValueError, match="finite numbers, or arrays"):
            result.predict("Qx", wrong)
    with pytest.raises(ValueError, match="shape"):
        result.predict("Qx", [1.0, 2.0], pendulous=[1.0, 2.0, 3.0])
