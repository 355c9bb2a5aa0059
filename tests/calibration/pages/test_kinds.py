"""Kinds of test beside each other: the page says what the finding says."""

import pytest
from results import accelerometer, coefficient

from counterspin.calibration.pages.kinds import kind_blocks
from counterspin.reports.blocks import Paragraph


def kinds(p):
    """Two kinds, each with one shift, so that four tests share the significance of 0.01."""
    kind = {
        "count": 1,
        "coefficients": {"K_F": coefficient(0.005, 1e-6, "g")},
        "without": {"K_F": {"shift": 1e-7, "u": 1e-6, "z": 0.1}},
        "chi2": 9.0,
        "dof": 2,
        "p": p,
    }
    return accelerometer(
        coefficients={"K_F": coefficient(0.005, 1e-6, "g")},
        kinds=[{"kind": "at rest", **kind}, {"kind": "arm", **kind}],
    )


@pytest.mark.parametrize(("p", "verdict"), [(0.0013, "agrees"), (0.0012, "does not agree")])
def test_all_tests_of_all_kinds_share_the_significance(p, verdict):
    (words,) = [b.text for b in kind_blocks(kinds(p)) if isinstance(b, Paragraph)]
    assert words.startswith(f"Each test method against the others: at rest: {verdict} (chi")
