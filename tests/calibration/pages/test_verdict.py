"""Whether a result is good, in one or more sentences."""

import pytest
from results import result

from counterspin.calibration.findings import judge_result
from counterspin.calibration.pages.verdict import misfit_blocks, verdict_sentence


def sentence(**changes):
    return verdict_sentence("Qx", judge_result(result(**changes)).accelerometers["Qx"])


def test_a_good_result():
    assert sentence() == (
        "Qx is good: the residuals look like the stated noise (p = 0.5); no run drives the "
        "result; the two-stage method agrees."
    )


def test_reservations_say_the_gravest_first_and_how_many_more():
    told = sentence(
        warnings=["Qx: one", "Qx: two"],
        jackknife=[{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": -3.1}],
    )
    assert told == (
        "Qx is to be used with reservations: Without slow K_II moves by 1e-08 g/g^2, 3.1 times "
        "what its uncertainty explains: this run disagrees with the others. There are 2 more "
        "findings. In its favour: the residuals look like the stated noise (p = 0.5); the "
        "two-stage method agrees."
    )


def test_nothing_speaks_for_a_contradicted_result():
    told = sentence(jackknife=[{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": -6.1}])
    assert told.startswith("Qx is contradicted by its records and must not be used: Without slow")
    assert "In its favour" not in told


def test_what_is_taken_as_zero_is_named_where_it_would_be_noticed():
    # 1 ug/g^2 of K_OO moves K_II by 1 ug/g^2, a thousand times its u; 1 ug/g^3 of K_III does not.
    left_out = {
        "K_OO": {"sensitivity": -1.0, "unit": "g/g^2"},
        "K_III": {"sensitivity": 1e-4, "unit": "g/g^3"},
    }
    told = sentence(left_out=left_out)
    assert told.startswith("Qx is good")
    assert told.endswith("which the model leaves out: K_OO.")


@pytest.mark.parametrize(("z", "lines"), [(1.0, 0), (4.0, 0), (7.0, 1)])
def test_only_a_contradiction_stands_before_the_numbers(z, lines):
    jackknife = [{"run": "slow", "value": 1e-5, "shift": 1e-8, "z": z}]
    assert len(list(misfit_blocks(judge_result(result(jackknife=jackknife))))) == lines
