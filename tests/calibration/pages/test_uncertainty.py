"""What decides u, in words: the source, its size, what would be left of u without it."""

import math

from results import coefficient, result

from counterspin.calibration.pages.document import answer_blocks
from counterspin.calibration.pages.uncertainty import (
    assumption_sentence,
    default_prior_sentence,
    prior_blocks,
    split_small_lines,
)
from counterspin.calibration.result_parts import Knowledge
from counterspin.inference.joint.summary import BudgetLine
from counterspin.reports.blocks import Paragraph, Table


def line(source, kind, contribution, total, **more):
    """A line of a budget whose sensitivity is one."""
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


def resting(unstated, noise=1e-7, **more):
    """A result whose u(K_II) is of noise and of K_OO, which nothing states."""
    u = math.hypot(unstated, noise)
    lines = [line("K_OO", "unstated", unstated, u), line("noise of Qx", "noise", noise, u)]
    k_ii = coefficient(2.7e-5, u, "g/g^2", u_noise=noise, u_stated=0.0, u_unstated=unstated)
    square = unstated**2
    update = {
        "names": ["K_II", "K_OO"],
        "units": ["g/g^2", "g/g^2"],
        "known": {"K_OO": unstated},
        # The data say nothing of K_OO, which K_II takes up whole.
        "weighed": [[u**2, -square], [-square, square]],
    }
    found = result(
        coefficients={"K_II": k_ii}, budget={"K_II": lines}, correlation=None, what_if=update
    )
    return found.model_copy(update=more)


def test_the_largest_unstated_source_is_named_with_what_would_be_left():
    told = default_prior_sentence(resting(2e-6).accelerometers["Qx"])
    # Known to a tenth of its typical size, K_OO leaves hypot(0.2, 0.1) ug/g^2.
    assert told == (
        "K_OO (second-order output-axis coefficient) contributes 100 % of the variance of K_II. "
        "No uncertainty was stated for this term, so the default of 2 ug/g^2 was used. If K_OO "
        "were known to 0.2 ug/g^2, u would fall to 0.22 ug/g^2."
    )


def test_the_answer_has_one_sentence_about_its_uncertainty_whatever_decides_it():
    stated = resting(5e-8)
    _, _, told, *_ = answer_blocks(stated)
    assert told.text == "Noise of Qx contributes 80 % of the variance of K_II."
    _, _, told, *_ = answer_blocks(resting(2e-6))
    assert told.text == default_prior_sentence(resting(2e-6).accelerometers["Qx"])


def test_where_noise_or_what_is_stated_decides_there_is_nothing_to_say():
    assert default_prior_sentence(resting(5e-8).accelerometers["Qx"]) == ""
    stated = result().accelerometers["Qx"]
    assert default_prior_sentence(stated) == ""
    assert default_prior_sentence(stated, "K_I") == ""


def test_lines_that_add_next_to_nothing_are_said_together():
    lines = [BudgetLine(**line(f"K_{k}", "stated", 10.0**-k, 1.0)) for k in range(7)]
    shown, rest = split_small_lines(lines)
    # Shares are 1, 1e-2, 1e-4 and then less: of four lines it pays to say how many they are.
    assert [one.source for one in shown] == ["K_0", "K_1", "K_2"]
    assert len(rest) == 4
    assert split_small_lines(lines[:6]) == (lines[:6], ())


def test_what_is_assumed_is_named():
    assert assumption_sentence(resting(2e-6)) == ""
    assert assumption_sentence(resting(2e-6, assumed=["K_4", "K_IP"])) == (
        "These terms are fixed at their nominal values, so u does not include them: K_4, K_IP."
    )
    many = [f"K_{k}" for k in range(11)]
    assert assumption_sentence(resting(2e-6, assumed=many)).endswith("K_7 and 3 more.")


def test_what_counts_in_a_budget_is_in_the_table_the_largest_first():
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
    blocks = list(prior_blocks(resting(2e-6, rests_on=rows, assumed=["K_4"])))
    (table,) = (block for block in blocks if isinstance(block, Table))
    assert [row[0] for row in table.rows] == ["Qx.K_OO", "noise of Qx"]
    assert table.rows[0][1:3] == ("second-order output-axis coefficient", "default")
    assert table.rows[1][4] == "held (considered)"
    assert isinstance(blocks[-1], Paragraph)
    assert blocks[-1].text.startswith("These terms are fixed")
    assert list(prior_blocks(resting(2e-6))) == []
