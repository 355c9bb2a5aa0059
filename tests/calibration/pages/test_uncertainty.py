"""Sentences on the uncertainty: the largest source, its size and u without it."""

import math

from results import make_coefficient, make_qx_result

from counterspin.calibration.pages.document import answer_blocks
from counterspin.calibration.pages.uncertainty import (
    assumption_sentence,
    default_prior_sentence,
    prior_blocks,
    split_budget,
)
from counterspin.calibration.result_parts import Knowledge
from counterspin.inference.joint.summary import BudgetLine
from counterspin.reports.blocks import Paragraph, Table


def make_line(source, kind, contribution, total, **more):
    """Return a budget line with a sensitivity of 1."""
    return {
        "source": source,
        "kind": kind,
        "u": None if kind == "noise" else contribution,
        "unit": "" if kind == "noise" else "g/g^2",
        "sensitivity": None if kind == "noise" else 1.0,
        "contribution": contribution,
        "share": (contribution / total) ** 2,
        **more,
    }


def make_result(unstated, noise=1e-7, **more):
    """Return a result whose u(K_II) comes from noise and from a default prior of K_OO."""
    u = math.hypot(unstated, noise)
    lines = [
        make_line("K_OO", "unstated", unstated, u),
        make_line("noise of Qx", "noise", noise, u),
    ]
    k_ii = make_coefficient(2.7e-5, u, "g/g^2", u_noise=noise, u_stated=0.0, u_unstated=unstated)
    square = unstated**2
    update = {
        "names": ["K_II", "K_OO"],
        "units": ["g/g^2", "g/g^2"],
        "known": {"K_OO": unstated},
        # The data do not determine K_OO, so its error is fully in K_II.
        "weighed": [[u**2, -square], [-square, square]],
    }
    calibration = make_qx_result(
        coefficients={"K_II": k_ii}, budget={"K_II": lines}, correlation=None, what_if=update
    )
    return calibration.model_copy(update=more)


def test_largest_default_prior_is_named_with_remaining_u():
    sentence = default_prior_sentence(make_result(2e-6).accelerometers["Qx"])
    # With u(K_OO) at a tenth of its typical size, hypot(0.2, 0.1) ug/g^2 remains.
    assert sentence == (
        "K_OO (second-order output-axis coefficient) contributes 100 % of the variance of K_II. "
        "No uncertainty was stated for this term, so the default of 2 ug/g^2 was used. If K_OO "
        "were known to 0.2 ug/g^2, u would fall to 0.22 ug/g^2."
    )


def test_answer_has_one_sentence_on_largest_source():
    stated = make_result(5e-8)
    _, _, source_sentence, *_ = answer_blocks(stated)
    assert source_sentence.text == "Noise of Qx contributes 80 % of the variance of K_II."
    _, _, source_sentence, *_ = answer_blocks(make_result(2e-6))
    assert source_sentence.text == default_prior_sentence(make_result(2e-6).accelerometers["Qx"])


def test_no_default_prior_sentence_if_noise_or_stated_prior_dominates():
    assert default_prior_sentence(make_result(5e-8).accelerometers["Qx"]) == ""
    stated = make_qx_result().accelerometers["Qx"]
    assert default_prior_sentence(stated) == ""
    assert default_prior_sentence(stated, "K_I") == ""


def test_negligible_lines_are_combined():
    lines = [BudgetLine(**make_line(f"K_{k}", "stated", 10.0**-k, 1.0)) for k in range(7)]
    shown, combined = split_budget(lines)
    # Shares are 1, 1e-2, 1e-4 and smaller: four lines are combined.
    assert [one.source for one in shown] == ["K_0", "K_1", "K_2"]
    assert len(combined) == 4
    assert split_budget(lines[:6]) == (lines[:6], ())


def test_assumed_terms_are_named():
    assert assumption_sentence(make_result(2e-6)) == ""
    assert assumption_sentence(make_result(2e-6, assumed=["K_4", "K_IP"])) == (
        "u does not include the uncertainty of these terms, which are fixed at their nominal "
        "values: K_4, K_IP."
    )
    many = [f"K_{k}" for k in range(11)]
    assert assumption_sentence(make_result(2e-6, assumed=many)).endswith("K_7 and 3 more.")


def test_table_lists_main_sources_in_descending_order():
    rows = [
        Knowledge(name="Qx.K_PP", kind="stated", unit="g/g^2", value=0.0, u=1e-6),
        Knowledge(
            name="Qx.K_OO",
            kind="unstated",
            unit="g/g^2",
            value=0.0,
            u=2e-6,
            found=1e-7,
            u_found=1.9e-6,
        ),
        Knowledge(name="noise of Qx", kind="held", unit="g/g^2", value=0.0, u=1e-6),
    ]
    blocks = list(prior_blocks(make_result(2e-6, rests_on=rows, assumed=["K_4"])))
    (table,) = (block for block in blocks if isinstance(block, Table))
    assert [row[0] for row in table.rows] == ["Qx.K_OO", "noise of Qx"]
    assert table.rows[0][1:3] == ("second-order output-axis coefficient", "default")
    assert table.rows[1][4] == "held (considered)"
    assert isinstance(blocks[-1], Paragraph)
    assert blocks[-1].text.startswith("u does not include")
    assert list(prior_blocks(make_result(2e-6))) == []
