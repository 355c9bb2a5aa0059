"""NIST Statistical Reference Datasets, linear regression.

Source: NIST/ITL StRD, Linear Least Squares Regression, certified values to 15 digits,
https://www.itl.nist.gov/div898/strd/lls/lls.shtml. The agreement is measured as there, by the log
relative error LRE = -log10(|computed - certified| / |certified|), the number of right digits. Data
and certified values are those of the validation's cases.
"""

import numpy as np
import pytest

from counterspin.inference.least_squares import fit
from counterspin.validation.cases import case, cases
from counterspin.validation.kernels import run_case
from counterspin.validation.validate import check_case

NIST = [one.name for one in cases() if one.name.startswith("NIST")]


def correct_digits(name, quantity):
    """Return the correct digits of the worst number, at most the 15 certified."""
    computed, certified = run_case(case(name))[quantity], case(name).expected[quantity]
    error = np.abs(np.asarray(computed) - certified) / np.abs(certified)
    return -np.log10(np.maximum(error, 1e-15)).min()


@pytest.mark.parametrize("name", NIST)
def test_certified_values(name):
    checked = check_case(case(name))
    assert checked.state == "passed", checked


def test_all_levels_of_difficulty_are_included():
    lower, average = {"Norris", "Pontius"}, {"NoInt1", "NoInt2"}
    higher = {"Filip", "Longley", *(f"Wampler{i}" for i in range(1, 6))}
    assert {f"NIST {name}" for name in lower | average | higher} == {*NIST}


@pytest.mark.parametrize(
    ("name", "estimate", "others"), [("Pontius", 11.0, 12.0), ("Longley", 10.0, 10.5)]
)
def test_correct_digits_of_difficult_datasets(name, estimate, others):
    assert correct_digits(f"NIST {name}", "estimate") > estimate
    assert correct_digits(f"NIST {name}", "u") > others
    assert correct_digits(f"NIST {name}", "sigma") > max(others, 11.0)
    assert correct_digits(f"NIST {name}", "chi2") > max(others, 11.0)


def test_filip_dataset():
    """The condition number of the scaled columns is 5e9.

    So about 7 of the 16 digits of a double remain with the best algorithm.
    """
    assert correct_digits("NIST Filip", "sigma") > 7.0
    # Centred and scaled, the problem is well conditioned: the fit is well determined.
    given = case("NIST Filip").given
    x = np.array(given["x"])
    centred = fit(np.vander((x + 6) / 3, 11, increasing=True), given["y"])
    sigma = float(case("NIST Filip").expected["sigma"])
    assert centred.sigma == pytest.approx(sigma, rel=1e-12)
    assert centred.chi2 == pytest.approx(71 * sigma**2, rel=1e-12)
