"""Interlaboratory comparison: common sources, errors and output files."""

import json

import numpy as np
import pytest
import results as by_hand
from raising import raises

import counterspin as cs
from counterspin.cli import main
from counterspin.comparisons.intercomparison_page import (
    intercomparison_blocks,
    intercomparison_plots,
    reference_sentence,
)
from counterspin.errors import CampaignError
from counterspin.reports.blocks import Table

U = 1e-7


def make_result(laboratory, k_ii, k_f=0.0, sources=(), **parts):
    """Return a laboratory result; sources are names, u and shifts of K_II, the rest is noise."""
    budget = [
        {"source": name, "kind": "unstated", "u": u, "unit": "", "share": 0.0}
        | {"sensitivity": shift / u, "contribution": shift}
        for name, u, shift in sources
    ]
    accelerometer = by_hand.make_accelerometer_result(
        coefficients={
            "K_II": by_hand.make_coefficient(k_ii, U, "g/g^2"),
            "K_F": by_hand.make_coefficient(k_f, U, "g"),
        },
        budget={"K_II": budget},
        serial_number=parts.pop("serial", None),
    )
    details = {} if laboratory is None else {"laboratory": laboratory}
    return by_hand.make_bare_result(accelerometers={"Qx": accelerometer}, details=details, **parts)


@pytest.fixture
def laboratories():
    values = zip("ABCD", (15.0, 15.1, 15.2, 16.2), (1.0, 1.1, 1.05, 1.9), strict=True)
    return [make_result(name, k_ii * 1e-6, k_f * 1e-6) for name, k_ii, k_f in values]


def test_outlier_is_named(laboratories):
    k_ii, k_f = cs.intercompare(*laboratories).references
    assert (k_ii.value, k_ii.u) == pytest.approx((15.1e-6, U / 3**0.5))
    degree = k_ii.degrees["D"]
    assert not degree.member
    assert degree.d == pytest.approx(1.1e-6)
    assert degree.zeta == pytest.approx(11 / (4 / 3) ** 0.5)
    assert degree.e_n == pytest.approx(degree.zeta / 2)
    assert k_ii.pairs[2].d == pytest.approx(1.2e-6)
    assert k_ii.pairs[2].e_n == pytest.approx(12 / 8**0.5)
    assert "Results outside the subset: D" in reference_sentence(k_ii)
    assert [
        plot.title.split()[0] for plot in intercomparison_plots(cs.intercompare(*laboratories))
    ] == [*("Degrees", "Degrees", "Youden")]
    assert k_f.term == "K_F"


@pytest.mark.parametrize(
    ("names", "source", "shared"),
    [
        (("A", "B"), "K_OO", True),  # a term of the instrument is common to all laboratories
        (("A", "B"), "centrifuge.radius", False),  # each laboratory has a separate machine
        (("A", None), "centrifuge.radius", True),  # the same machine according to the statements
    ],
)
def test_common_sources_are_covariances(names, source, shared):
    shift = 0.8 * U
    pair = [make_result(name, 2e-5, sources=[(source, 1e-6, shift)]) for name in names]
    comparison = cs.intercompare(*pair, coefficients=["K_II"])
    (reference,) = comparison.references
    assert reference.shared == ([source] if shared else [])
    independent = U**2 - shift**2 if shared else U**2
    assert reference.u**2 == pytest.approx(independent / 2 + (shift**2 if shared else 0.0))
    assert reference.pairs[0].expanded_u_d == pytest.approx(2 * (2 * independent) ** 0.5)
    assert bool(comparison.assumed) is (None in names)


def test_values_are_converted_to_gravity_of_first_laboratory():
    inputs = {"gravity": 9.78, "latitude": 0.0, "radius": 2.5}
    first, second = make_result("A", 2e-5), make_result("B", 2e-5, inputs=inputs)
    (k_ii, _) = cs.intercompare(first, second).references
    # K_II is in g/g^2: proportional to g.
    assert k_ii.degrees["B"].value == pytest.approx(2e-5 * first.inputs.gravity / 9.78)


def test_values_are_converted_to_nominal_output_of_first_laboratory():
    pair = []
    for name, k_ii, sensitivity in (("A", 2e-5, 1.25), ("B", 2e-5 * 1.25 / 1.3, 1.3)):
        document = json.loads(make_result(name, k_ii).to_json())
        nominal = {"unit": "V", "sensitivity": sensitivity}
        document["accelerometers"]["Qx"]["nominal"] = nominal
        pair.append(cs.Result.model_validate(document))
    comparison = cs.intercompare(*pair)
    assert comparison.references[0].degrees["B"].value == pytest.approx(2e-5)
    assert "1.25 V/g in A and 1.3 V/g in B" in comparison.assumed[0]


def test_difference_has_last_digit_of_its_uncertainty():
    k_i = {"K_I": by_hand.make_coefficient(1.0, 2.5e-6, "g/g")}
    pair = []
    for name, value in (("A", 1.0), ("B", 1.0000004)):
        coefficients = {"K_I": k_i["K_I"] | {"value": value}}
        accelerometer = by_hand.make_accelerometer_result(coefficients=coefficients)
        pair.append(
            by_hand.make_bare_result(
                accelerometers={"Qx": accelerometer}, details={"laboratory": name}
            )
        )
    *_, (row,) = [
        block.rows
        for block in intercomparison_blocks(cs.intercompare(*pair))
        if isinstance(block, Table)
    ]
    assert row == ("B - A", "0.4e-6", "7.1e-6", "0.06")


def test_two_inconsistent_laboratories_have_no_reference_value():
    (k_ii, _) = cs.intercompare(make_result("A", 1e-5), make_result("B", 2e-5)).references
    assert k_ii.value is None
    assert k_ii.degrees["A"].d is None
    assert "no reference value" in reference_sentence(k_ii)


def test_requested_coefficient_is_compared_once(laboratories):
    comparison = cs.intercompare(*laboratories, coefficients=["K_II", "K_II"])
    assert [reference.term for reference in comparison.references] == ["K_II"]


def add_records(laboratory):
    provenance = {"version": "1", "inputs": {"a.csv": "sha256:" + "1" * 64}}
    return make_result(laboratory, 1e-5, provenance=provenance)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([make_result("A", 1e-5)], "give 2 to 16 results"),
        ([add_records("A"), add_records("B")], "A and B use the same records"),
        (
            [make_result("A", 1e-5, serial="1"), make_result("B", 1e-5, serial="2")],
            "different serial numbers: 1, 2",
        ),
        (
            [make_result("A", 1e-5), make_result("B", 1e-5, model="as-printed")],
            "half the true K_II",
        ),
        (
            [make_result(name, 1e-5, sources=[("K_OO", 1e-6, U)]) for name in "AB"],
            "no independent uncertainty",
        ),
        (
            [make_result("A", 1e-5), by_hand.make_bare_result()],
            "the results have no accelerometer in common",
        ),
    ],
)
def test_rejects_results_that_are_not_comparable(given, message):
    with pytest.raises(CampaignError, match=message):
        cs.intercompare(*given)


def test_unknown_coefficient_is_named():
    for symbol in ("K_II K_I", ""):
        with pytest.raises(CampaignError, match=f'coefficient "{symbol}" of Qx; '):
            cs.intercompare(make_result("A", 1e-5), make_result("B", 1e-5), coefficients=[symbol])


def test_rejects_coefficient_determined_by_one_result():
    with raises("results-not-comparable", "K_III", "Qx"):
        cs.intercompare(make_result("A", 1e-5), make_result("B", 1e-5), coefficients=["K_III"])


def test_command_writes_files(laboratories, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, result in zip("abcd", laboratories, strict=True):
        result.write(f"{name}.json")
    files = [f"{name}.json" for name in "abcd"]
    outputs = ["--json", "o.json", "--report", "o.md", "--figure", "o.svg"]
    assert main(["intercompare", *files, "--coefficient", "K_II, K_F", *outputs]) == 0
    assert "15.100 ± 0.058" in capsys.readouterr().out
    document = json.loads((tmp_path / "o.json").read_text())
    weights = np.array(
        [degree["u"] ** -2 for degree in document["references"][0]["degrees"].values()]
    )
    assert document["references"][0]["dof"] == weights.size - 1
    assert "Results outside the subset: D" in (tmp_path / "o.md").read_text()
    assert (tmp_path / "o.svg").stat().st_size > 1000
    assert main(["report", "o.json", "-o", "p.html"]) == 0
