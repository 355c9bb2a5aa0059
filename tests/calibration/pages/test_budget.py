"""The budget of a coefficient as a table."""

import pytest
from results import make_qx_result

from counterspin.calibration.pages.budget import budget_blocks
from counterspin.reports.blocks import Heading, Table


def make_prior(name, value, u, unit, kind="stated"):
    return {"name": name, "kind": kind, "unit": unit, "value": value, "u": u}


def make_line(source, kind, u, unit, sensitivity, contribution):
    return {
        "source": source,
        "kind": kind,
        "u": u,
        "unit": unit,
        "sensitivity": sensitivity,
        "contribution": contribution,
        "share": contribution**2 / 25e-14,
    }


@pytest.fixture
def with_priors():
    """Return a result whose u(K_II) comes from K_OO, the radius and noise as 3 : 4 : 0."""
    lines = [
        make_line("centrifuge.radius", "stated", 1e-5, "m", 4e-2, 4e-7),
        make_line("K_OO", "unstated", 2e-6, "g/g^2", -0.15, 3e-7),
        make_line("noise of Qx", "noise", None, "", None, 0.0),
    ]
    calibration = make_qx_result(budget={"K_II": lines})
    rows = [
        make_prior("centrifuge.radius", 2.5, 1e-5, "m"),
        make_prior("Qx.K_OO", 0.0, 2e-6, "g/g^2", "unstated"),
    ]
    return calibration.model_validate(calibration.model_dump(by_alias=True) | {"rests_on": rows})


def test_budget_has_gum_columns_in_order(with_priors):
    heading, table = budget_blocks("Qx", with_priors)
    assert heading == Heading("Uncertainty budget of K_II, Qx", 3)
    assert [column.title for column in table.columns] == [
        "Source",
        "Meaning",
        "Type",
        "Value",
        "Std. uncertainty",
        "Sensitivity, ug/g^2 per unit",
        "Contribution, ug/g^2",
        "Share of u^2",
    ]


def test_line_has_value_and_uncertainty_in_same_unit(with_priors):
    *_, table = budget_blocks("Qx", with_priors)
    assert isinstance(table, Table)
    radius, k_oo, noise, combined = table.rows
    # 4e-2 g/g^2 per metre times 1e-5 m is 0.40 ug/g^2; 3, 4, 5 make a right triangle.
    assert radius[2:] == ("B", "2.500000 m", "1e-5 m", "4e4", "0.40", "64 %")
    assert k_oo[2:] == ("B, default", "0 ug/g^2", "2 ug/g^2", "-0.15", "0.30", "36 %")
    assert noise[2:5] == ("B", "", "")
    assert combined[-2:] == ("0.50", "")


def test_budget_without_priors_has_no_value_column():
    *_, table = budget_blocks("Qx", make_qx_result())
    assert "Value" not in [column.title for column in table.columns]


def test_estimated_noise_is_type_a():
    noise = {"displacement": {"value": 0.01, "u": 1e-4, "unit": "m", "estimated": True}}
    *_, table = budget_blocks("Qx", make_qx_result(noise=noise))
    assert next(row for row in table.rows if row[0] == "noise of Qx")[2] == "A"
