"""Comparison of results: u of differences against closed forms, the fit itself and trials."""

import copy
import json
import math
from datetime import UTC, datetime
from pathlib import Path

import frames
import numpy as np
import pytest
import results as by_hand
from campaigns import find_runs
from scipy.stats import binom
from scipy.stats import chi2 as chi2_distribution

import counterspin as cs
from counterspin.cli import main
from counterspin.comparisons.page import comparison_blocks, short_names
from counterspin.comparisons.result import ResultComparison
from counterspin.errors import CampaignError
from counterspin.physics.terms import term
from counterspin.reports.blocks import Paragraph, Plot, Table
from counterspin.reports.publication import make_publication

TERMS = ["K_F", "K_I", "K_II"]
TRIALS = 10


def make_description():
    """Return a small campaign of one accelerometer, with an uncertain radius and scale factor."""
    document = frames.parse_description_without_truth()
    del document["accelerometers"]["Qy"], document["accelerometers"]["Qx"]["scale_factor"]
    document["centrifuge"]["radius"] = "2.5 ± 1e-4 m"
    return document | {
        "model": {
            "terms": TERMS,
            "assume": "all",
            "hold": ["K_IP"],
            "priors": {"K_I": "1.002 ± 1e-5 g/g", "K_IP": "0 ± 1e-5 g/g^2"},
        },
        "truth": {"Qx": {"K_F": "0.005 g", "K_I": "1.002 g/g", "K_II": "2.7e-5 g/g^2"}},
        "simulation": {"sampling_rate": "10 Hz", "seed": 1, "revolutions": 12},
    }


@pytest.fixture(scope="module")
def calibrate_seed():
    """Return a function from a seed to (records, calibration, with K_III, without a run)."""
    base = cs.make_campaign(make_description())

    def calibrate_records(seed, count=4):
        records = cs.simulate(base.change({"simulation": {"seed": seed}}))
        larger_model = records.change({"model": {"terms": [*TERMS, "K_III"]}})
        two_runs = records.change({"runs": find_runs(records, "slow", "fast")})
        results = [
            cs.calibrate(campaign) for campaign in (records, larger_model, two_runs)[: count - 1]
        ]
        return records, *results

    return calibrate_records


@pytest.fixture(scope="module")
def seed_1(calibrate_seed):
    return calibrate_seed(1)


def comparison_text(comparison):
    return "\n".join(
        block.text for block in comparison_blocks(comparison) if isinstance(block, Paragraph)
    )


def k_ii_estimate(comparison, result_index=1):
    (row,) = (coefficient for coefficient in comparison.coefficients if coefficient.term == "K_II")
    return row.estimates[result_index]


# --- the same records -----------------------------------------------------------------------------


def test_added_term_explains_chi2_of_difference(seed_1):
    _, small_model, large_model, _ = seed_1
    comparison = cs.compare(small_model, large_model)
    (agreement,) = comparison.agreements
    # The estimates can differ only by the effect of the new term: closed form.
    k_iii = large_model.coefficient("Qx.K_III")
    assert (agreement.records, agreement.dof, agreement.assumed) == ("same", 1, [])
    assert agreement.shared == ["K_IP"]
    assert agreement.chi2 == pytest.approx((k_iii.value / k_iii.u) ** 2, rel=1e-4)
    assert k_ii_estimate(comparison).u_difference < 0.1 * small_model.coefficient("Qx.K_II").u
    reversed_comparison = cs.compare(large_model, small_model)
    assert k_ii_estimate(reversed_comparison).difference == -k_ii_estimate(comparison).difference
    assert k_ii_estimate(reversed_comparison).u_difference == pytest.approx(
        k_ii_estimate(comparison).u_difference, rel=1e-9
    )


def test_estimated_noise_is_taken_from_larger_model():
    """With a common noise the variances subtract; then K_III alone determines z, of K_II too."""
    document = make_description()
    document["centrifuge"]["radius"] = "2.5 m"
    document["model"] = {"terms": TERMS, "assume": "all"}
    qx = document["accelerometers"]["Qx"]
    del qx["displacement"]
    qx["specific_force"] = {"column": "force", "unit": "g"}
    base = cs.make_campaign(document | {"noise": {"specific_force": "1e-5 g"}})
    records = cs.simulate(base.change({"simulation": {"seed": 2}})).change({"noise": None})
    small_model = cs.calibrate(records)
    large_model = cs.calibrate(records.change({"model": {"terms": [*TERMS, "K_III"]}}))
    noise = [
        result.accelerometers["Qx"].noise["specific_force"].value
        for result in (small_model, large_model)
    ]
    ratio = noise[1] / noise[0]
    assert abs(ratio - 1.0) > 1e-3
    k_iii = large_model.coefficient("Qx.K_III")
    for comparison in (cs.compare(small_model, large_model), cs.compare(large_model, small_model)):
        assert comparison.agreements[0].chi2 == pytest.approx(
            (k_iii.value / k_iii.u) ** 2, rel=1e-6
        )
        u = [result.coefficient("Qx.K_II").u for result in (small_model, large_model)]
        expected = math.sqrt(u[1] ** 2 - (ratio * u[0]) ** 2)
        assert k_ii_estimate(comparison).u_difference == pytest.approx(expected, rel=1e-6)


def test_omitted_run_matches_jackknife(seed_1):
    _, all_runs, _, two_runs = seed_1
    comparison = cs.compare(all_runs, two_runs)
    (left_out,) = (line for line in all_runs.accelerometers["Qx"].jackknife if line.run == "middle")
    estimate = k_ii_estimate(comparison)
    assert comparison.agreements[0].records == "part"
    assert estimate.difference == pytest.approx(left_out.shift, rel=1e-6)
    assert abs(estimate.z) == pytest.approx(abs(left_out.z), rel=1e-3)


def test_changes_round_default_priors(seed_1):
    records, result, _, _ = seed_1
    free = cs.calibrate(records.change({"model": {"assume": ["K_OO"]}}))
    (texts,) = (
        change.values
        for change in cs.compare(result, free).changes
        if change.subject == "default priors"
    )
    texts = texts[1].split(", ")
    assert {"delta_O ± 10.31 arcsec", "records.clock ± 2e-5", "K_PP ± 2 ug/g^2"} <= set(texts)


def test_changes_list_assumed_and_unstated_terms(seed_1):
    records, result, _, _ = seed_1
    but_k_oo = [name for name in result.assumed if name != "K_OO"]
    part, tuned = (
        cs.calibrate(records.change({"model": {"assume": but_k_oo, **extra_model}}))
        for extra_model in ({}, {"typical": {"K_OO": "1e-6 g/g^2"}})
    )
    comparison = cs.compare(result, part, tuned)
    values_by_subject = {change.subject: change.values for change in comparison.changes}
    assert set(values_by_subject) == {"terms fixed at nominal", "default priors", "campaign.toml"}
    fixed = [text.split(", ") for text in values_by_subject["terms fixed at nominal"]]
    assert fixed == [result.assumed, but_k_oo, but_k_oo]
    assert values_by_subject["default priors"] == ["-", "K_OO ± 2 ug/g^2", "K_OO ± 1 ug/g^2"]
    # The same records: u of the difference is the contribution of K_OO.
    u = [r.coefficient("Qx.K_II").u for r in (result, part)]
    assert k_ii_estimate(comparison).u_difference == pytest.approx(
        math.sqrt(u[1] ** 2 - u[0] ** 2), rel=1e-3
    )


def test_method_comparison_matches_check_of_joint_fit(seed_1):
    records, joint, _, _ = seed_1
    comparison = cs.compare(joint, cs.calibrate(records, method="two-stage"))
    check = joint.accelerometers["Qx"].two_stage
    assert k_ii_estimate(comparison).u_difference == pytest.approx(check.u_difference, rel=1e-12)
    assert k_ii_estimate(comparison).z == pytest.approx(check.z, rel=1e-9)
    assert any(
        "joint method gives the best estimate" in text for text in comparison.agreements[0].assumed
    )
    method = next(change for change in comparison.changes if change.subject == "method")
    assert method.values == ["joint", "two-stage"]


def test_differences_have_stated_standard_uncertainty(calibrate_seed):
    pairs = [cs.compare(*calibrate_seed(seed, 3)[1:]) for seed in range(10, 10 + TRIALS)]
    total = sum(comparison.agreements[0].chi2 for comparison in pairs)
    dof = sum(comparison.agreements[0].dof for comparison in pairs)
    low, high = chi2_distribution.interval(0.999, dof)
    assert low < total < high
    sum_of_squares = sum(k_ii_estimate(comparison).z ** 2 for comparison in pairs)
    low, high = chi2_distribution.interval(0.999, TRIALS)
    assert low < sum_of_squares < high


def test_changed_input_has_difference_without_uncertainty(seed_1):
    records, result, _, _ = seed_1
    exact = records.change({"centrifuge": {"radius": "2.5 m"}})
    changed_radius = cs.compare(
        cs.calibrate(exact), cs.calibrate(records.change({"centrifuge": {"radius": "2.5001 m"}}))
    )
    assert k_ii_estimate(changed_radius).difference
    assert (k_ii_estimate(changed_radius).u_difference, k_ii_estimate(changed_radius).z) == (
        0.0,
        None,
    )
    assert changed_radius.agreements[0].p is None
    assert {change.subject for change in changed_radius.changes} == {"radius", "campaign.toml"}
    assert "The changes listed below cause the difference" in comparison_text(changed_radius)
    repeated = cs.compare(cs.calibrate(exact), cs.calibrate(exact))
    assert repeated.agreements[0].p is None
    assert "are equal (both use the same records)" in comparison_text(repeated)
    # The same change of an uncertain radius, stated twice: the values are independent.
    twice = cs.compare(
        result, cs.calibrate(records.change({"centrifuge": {"radius": "2.5001 ± 1e-4 m"}}))
    )
    (line,) = (
        line
        for line in result.accelerometers["Qx"].budget["K_II"]
        if line.source == "centrifuge.radius"
    )
    expected = math.sqrt(2.0) * line.contribution
    assert k_ii_estimate(twice).u_difference == pytest.approx(expected, rel=1e-3)


# --- independent records --------------------------------------------------------------------------


def make_result(value=2.7e-5, **changes):
    result = by_hand.make_qx_result()
    document = json.loads(result.to_json())
    document["accelerometers"]["Qx"]["coefficients"]["K_II"]["value"] = value
    document["provenance"]["inputs"] = {"run.csv": f"sha256:{value}{changes}"}
    document["inputs"] |= changes
    return cs.Result.model_validate(document)


def test_shared_prior_is_counted_once():
    # u of each is 1e-9 with 0.6e-9 from the shared K_I: sqrt(2) 0.8e-9 remains.
    first, second = make_result(), make_result(2.7002e-5)
    estimate = k_ii_estimate(cs.compare(first, second))
    assert estimate.u_difference == pytest.approx(math.sqrt(2.0 * (1e-18 - 0.36e-18)), rel=1e-12)
    agreement = cs.compare(first, second).agreements[0]
    assert (agreement.records, agreement.shared) == ("independent", ["K_I"])


#: All terms that act on readings at rest, except K_OO.
PERFECT = [
    *(f"K_{name}" for name in ("F", "I", "II", "III", "4", "IP", "IO", "PO", "PP", "OQ")),
    *("delta_O", "delta_P", "head.zero", "site.*"),
]


def calibrate_tumble(k_oo, roll, generator, noise):
    """Return a result of twelve positions; `roll` is from the pendulous axis to the plane."""
    runs = []
    for place, angle in enumerate(2.0 * np.pi * (np.arange(12) + 0.3) / 12):
        # The vertical and the axis of rotation in instrument axes: input, pendulous, output.
        side = math.sin(angle)
        up = np.array([math.cos(angle), side * math.cos(roll), side * math.sin(roll)])
        east = np.array([0.0, -math.sin(roll), math.cos(roll)])
        rows = np.column_stack([east, np.cross(up, east), up])
        f = 1e-3 + up[0] + 1e-5 * up[0] ** 2 + k_oo * up[2] ** 2
        f += noise * generator.standard_normal()
        axes = {"input": rows[0].tolist(), "pendulous": rows[1].tolist()}
        run = {"name": f"p{place}", "motion": "static", "axes": axes}
        runs.append({**run, "reading": f"{float(f)!r} ± {noise!r} g"})
    return cs.calibrate(
        cs.make_campaign(
            {
                "schema": 1,
                "site": {"gravity": "9.81 m/s^2", "latitude": "52 deg"},
                "accelerometers": {"A": {"input_axis": "up", "pendulous_axis": "east"}},
                "model": {"terms": ["K_F", "K_I", "K_II"], "assume": PERFECT},
                "runs": runs,
            }
        )
    )


def test_shared_default_prior_is_counted_once():
    """True K_OO is drawn once for each instrument with two results."""
    instruments, noise = 16, 2e-7
    common = ["K_0_asym", "K_5", "K_I_asym", "K_OO"]
    generator = np.random.default_rng(11)
    z = []
    for _ in range(instruments):
        k_oo = term("K_OO").typical * generator.standard_normal()
        first, second = (
            calibrate_tumble(k_oo, math.radians(roll), generator, noise) for roll in (75.0, 60.0)
        )
        comparison = cs.compare(first, second)
        (agreement,) = comparison.agreements
        assert (agreement.records, agreement.shared) == ("independent", common)
        z.append(k_ii_estimate(comparison).z)
        # Counted twice, K_OO would contribute most of u.
        independent_u = math.hypot(*(result.coefficient("A.K_II").u for result in (first, second)))
        assert k_ii_estimate(comparison).u_difference < 0.5 * independent_u
    low, high = chi2_distribution.interval(1.0 - 1e-4, instruments)
    assert low < np.sum(np.square(z)) < high
    min_count, _ = binom.interval(1.0 - 1e-4, instruments, 0.95)
    assert np.count_nonzero(np.abs(z) < 1.96) >= min_count


def test_different_priors_are_independent():
    first, second = make_result(), make_result(2.7002e-5)
    document = json.loads(second.to_json())
    document["accelerometers"]["Qx"]["known"]["K_I"]["value"] = 1.003
    other_prior = cs.Result.model_validate(document)
    estimate = k_ii_estimate(cs.compare(first, other_prior))
    assert estimate.u_difference == pytest.approx(math.sqrt(2.0) * 1e-9, rel=1e-12)


def change_document(result, serial=None, **details):
    document = json.loads(result.to_json())
    document["details"] |= details
    document["accelerometers"]["Qx"]["serial_number"] = serial
    return cs.Result.model_validate(document)


@pytest.mark.parametrize(
    ("serials", "laboratories", "shared", "words"),
    [
        (("1", "1"), ("A", "A"), ["K_I", "centrifuge.radius"], "values of radius, gravity"),
        (("1", None), ("A", None), ["K_I", "centrifuge.radius"], "values of radius, gravity"),
        (("1", "2"), ("A", "A"), ["centrifuge.radius"], "The serial numbers of Qx differ (1 and 2"),
        (("1", "1"), ("A", "B"), ["K_I"], "The laboratories differ (A and B)"),
        (("1", "2"), ("A", "B"), [], "The comparison treats all inputs as independent."),
    ],
)
def test_common_sources_need_same_instrument_and_machine(serials, laboratories, shared, words):
    pair = []
    for value, serial, name in zip((2.7e-5, 2.7002e-5), serials, laboratories, strict=True):
        document = json.loads(make_result(value).to_json())
        line = document["accelerometers"]["Qx"]["budget"]["K_II"][0]
        radius = line | {"source": "centrifuge.radius", "u": 1e-5, "sensitivity": 6e-5}
        document["accelerometers"]["Qx"]["budget"]["K_II"].append(radius)
        result = cs.Result.model_validate(document)
        details = {} if name is None else {"laboratory": name}
        pair.append(change_document(result, serial, **details))
    comparison = cs.compare(*pair)
    assert comparison.agreements[0].shared == shared
    assert words in comparison_text(comparison)
    # Each of the two sources contributes 0.6e-9 to u = 1e-9 of each result.
    expected = math.sqrt(2.0 * (1e-18 - 0.36e-18 * len(shared)))
    assert k_ii_estimate(comparison).u_difference == pytest.approx(expected, rel=1e-9)
    if "2" in serials:
        assert comparison.changes[0].subject == "serial number of Qx"


def test_campaign_serial_number_identifies_unnumbered_instruments():
    first, second = make_result(), change_document(make_result(2.7002e-5), serial_number="P-2")
    first = change_document(first, serial_number="P-1")
    assert cs.compare(first, second).agreements[0].shared == []


def test_nominal_output_does_not_appear_as_difference():
    first, second = make_result(), make_result(2.7e-5 * 1.25 / 1.3)
    pair = []
    for result, sensitivity in ((first, 1.25), (second, 1.3)):
        document = json.loads(result.to_json())
        document["accelerometers"]["Qx"]["nominal"] = {"unit": "mA", "sensitivity": sensitivity}
        pair.append(cs.Result.model_validate(document))
    comparison = cs.compare(*pair, names=["old", "new"])
    estimate = k_ii_estimate(comparison)
    assert estimate.difference == pytest.approx(0.0, abs=1e-15)
    assert estimate.u == pytest.approx(1e-9 * 1.3 / 1.25)
    assert "1.25 mA/g in old and 1.3 mA/g in new" in comparison_text(comparison)
    assert comparison.changes[0].model_dump() == {
        "subject": "output of Qx",
        "values": ["1.25 mA/g", "1.3 mA/g"],
    }


def test_nominal_zero_is_converted():
    # The true output at zero specific force is 4.00625 mA.
    pair = []
    for value, zero, gravity in ((0.005, 4.0, 9.8066), (-0.075, 4.1, 9.9)):
        document = json.loads(make_result(2.7e-5, gravity=gravity).to_json())
        accelerometer = document["accelerometers"]["Qx"]
        accelerometer["nominal"] = {"unit": "mA", "sensitivity": 1.25, "zero": zero}
        accelerometer["coefficients"] = {"K_F": by_hand.make_coefficient(value, 1e-6, "g")}
        accelerometer |= {"correlation": None, "budget": {}, "confounded": []}
        pair.append(cs.Result.model_validate(document))
    comparison = cs.compare(*pair, names=["old", "new"])
    assert comparison.coefficients[0].estimates[1].value == pytest.approx(0.005, abs=1e-12)
    text = comparison_text(comparison)
    assert "new was calibrated at a gravity of 9.9 m/s^2" in text
    assert "The conversion changes" not in text


def test_values_are_converted_to_gravity_of_first_result():
    local_result, remote_result = make_result(), make_result(gravity=9.9)
    comparison = cs.compare(local_result, remote_result)
    assert k_ii_estimate(comparison).value == pytest.approx(2.7e-5 * 9.8 / 9.9, rel=1e-12)
    assert comparison.gravity == 9.8


def test_conversion_to_local_gravity_is_reported():
    local_result, remote_result = make_result(), make_result(gravity=9.9)
    text = comparison_text(cs.compare(local_result, remote_result, names=["here", "there"]))
    assert "there was calibrated at a gravity of 9.9 m/s^2" in text
    assert "here (9.8 m/s^2). The conversion changes K_F by +1 %; K_II by -1 %." in text
    assert "calibrated at" not in comparison_text(cs.compare(local_result, make_result()))


def add_qy(result):
    document = json.loads(result.to_json())
    document["accelerometers"]["Qy"] = copy.deepcopy(document["accelerometers"]["Qx"])
    return cs.Result.model_validate(document)


def test_accelerometer_missing_in_first_result_has_later_reference():
    first_result, second_result, third_result = (
        make_result(2.7e-5 + shift) for shift in (0.0, 1e-10, 2e-10)
    )
    second_result, third_result = add_qy(second_result), add_qy(third_result)
    comparison = cs.compare(
        first_result, second_result, third_result, names=["one", "two", "three"]
    )
    assert comparison.reference("Qx").name == "one"
    assert comparison.reference("Qy").name == "two"
    text = comparison_text(comparison)
    assert "Qx: two and one agree" in text
    assert "Qy: three and two agree" in text
    assert "Qy: three and one" not in text
    assert "Differences are relative to one (Qx) and two (Qy)" in text
    tables = [block for block in comparison_blocks(comparison) if isinstance(block, Table)]
    assert {row[1] for row in tables[0].rows} == {"one", "two", "three"}
    assert {row[1] for row in tables[1].rows} == {"two", "three"}


def test_disagreement_is_reported_first():
    comparison = cs.compare(*map(make_result, (2.7e-5, 2.70001e-5, 2.9e-5)))
    first_block, second_block, *_ = (
        block for block in comparison_blocks(comparison) if isinstance(block, Paragraph)
    )
    assert (first_block.style, second_block.style) == ("warning", "answer")


def test_contradicted_result_is_reported():
    document = json.loads(make_result(2.7002e-5).to_json())
    document["accelerometers"]["Qx"]["residual"] |= {"chi2": 6400.0, "lack_of_fit_p": 0.0}
    contradicted = cs.Result.model_validate(document)
    words = "The records contradict new, so its uncertainties"
    for result, is_reported in ((contradicted, True), (make_result(2.7002e-5), False)):
        text = comparison_text(cs.compare(make_result(), result, names=["old", "new"]))
        assert (words in text) is is_reported
        assert "contradict old" not in text


def test_report_is_typeset():
    text = make_publication(cs.compare(make_result(), make_result(2.6e-5))).text(
        ".md", datetime(2026, 3, 1, tzinfo=UTC)
    )
    assert "µg/g²" in text
    assert "−1.0000" in text
    assert "ug/g^2" not in text


def test_plot_names_only_results_with_value():
    comparison = cs.compare(
        *map(make_result, (2.7e-5, 2.70001e-5)),
        names=["y2024/a/result.json", "y2025/a/result.json"],
    )
    (plot,) = (block for block in comparison_blocks(comparison) if isinstance(block, Plot))
    assert plot.x_names == ("y2024", "y2025")
    assert plot.series[0].x == (0.0, 1.0)
    assert short_names(["three/result.json", "b.json"]) == ("three/result.json", "b.json")
    assert short_names(["a/one.json", "a/two.json"]) == ("one.json", "two.json")
    assert short_names(["a.json", "a.json"]) == ("a.json", "a.json")


def test_coefficients_are_compared_jointly():
    first, second = make_result(), make_result(2.7002e-5)
    (agreement,) = cs.compare(first, second).agreements
    covariance = np.array([[2e-12, 0.5e-15], [0.5e-15, 1.28e-18]])
    # K_F has no budget line, so its shared sources are unknown.
    assert agreement.terms == ["K_F", "K_II"]
    difference = np.array([0.0, 2e-9])
    expected = difference @ np.linalg.solve(covariance, difference)
    assert agreement.chi2 == pytest.approx(expected, rel=1e-6)
    assert agreement.p == pytest.approx(chi2_distribution.sf(expected, 2), rel=1e-6)


# --- display and files ----------------------------------------------------------------------------


def test_comparison_has_repr_and_round_trip(seed_1, tmp_path):
    comparison = cs.compare(*seed_1[1:], names=["small", "large", "part"])
    assert len(repr(comparison).splitlines()) <= 20
    assert "large and small" in repr(comparison)
    assert "<table" in comparison._repr_html_()
    assert "| middle.parquet " in comparison._repr_markdown_()
    comparison.write(tmp_path / "c.json")
    assert ResultComparison.read(tmp_path / "c.json") == comparison
    table = comparison.table()
    assert table.height == 3 * len(comparison.coefficients)
    assert comparison.table("pandas").shape == table.shape
    row = table.filter(term="K_II", result="large").row(0, named=True)
    assert row["difference"] == pytest.approx(k_ii_estimate(comparison).difference * 1e6)
    assert row["unit"] == "ug/g^2"


def test_missing_seals_are_reported(seed_1, tmp_path):
    names = [str(tmp_path / f"{name}.json") for name in ("sealed", "unsealed")]
    for name in names:
        seed_1[1].write(name)
    by_hand.remove_seal(Path(names[1]))
    comparison = cs.compare(*names)
    assert comparison.unsealed == names[1:]
    assert f"The file of {names[1]} has no seal" in comparison_text(comparison)
    json_path = tmp_path / "c.json"
    comparison.write(json_path)
    assert "this comparison" not in cs.report(ResultComparison.read(json_path), "md")
    by_hand.remove_seal(json_path)
    text = cs.report(ResultComparison.read(json_path), "md")
    assert text.count("The file of this comparison has no seal") == 1
    assert "The file of this comparison has no seal" in repr(ResultComparison.read(json_path))


@pytest.mark.parametrize("ending", ["html", "md", "pdf"])
def test_command_writes_report(ending, seed_1, tmp_path, capsys):
    for name, result in zip("ab", seed_1[1:3], strict=True):
        result.write(tmp_path / f"{name}.json")
    arguments = ["compare", str(tmp_path / "a.json"), str(tmp_path / "b.json")]
    report = tmp_path / f"c.{ending}"
    assert main([*arguments, "--report", str(report), "--json", str(tmp_path / "c.json")]) == 0
    assert "chi-square" in capsys.readouterr().out
    assert report.stat().st_size > 1000
    # Only an earlier comparison is overwritten, and only on request.
    assert main([*arguments, "--report", str(report)]) == 1
    assert main([*arguments, "--report", str(report), "--overwrite"]) == 0
    # A report of a single result has a different type.
    assert main(["report", arguments[1], "-o", str(report), "--overwrite"]) == 1
    report.write_text("mine")
    assert main([*arguments, "--report", str(report), "--overwrite"]) == 1
    assert report.read_text() == "mine"


def test_rejects_results_that_are_not_comparable(seed_1):
    result = seed_1[1]
    with pytest.raises(CampaignError, match="two or more results"):
        cs.compare(result)
    with pytest.raises(CampaignError, match="2 results and 1 `names`"):
        cs.compare(result, result, names=["a"])
    other = copy.deepcopy(json.loads(result.to_json()))
    other["accelerometers"]["A"] = other["accelerometers"].pop("Qx")
    with pytest.raises(CampaignError, match="no accelerometer in common"):
        cs.compare(result, cs.Result.model_validate(other))


def test_result_does_not_differ_from_itself(seed_1):
    comparison = cs.compare(seed_1[1], seed_1[1])
    assert comparison.changes == []
    assert all(
        estimate.difference in (None, 0.0)
        for coefficient in comparison.coefficients
        for estimate in coefficient.estimates
    )
