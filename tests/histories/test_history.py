"""Histories of instruments: included files, verdicts and display."""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from raising import raises
from results import FROZEN_DOCUMENT as FROZEN_RESULT
from results import make_dated_document, make_qx_result, seal_document

from counterspin.calibration.result import Result
from counterspin.cli import main
from counterspin.errors import CampaignError, CounterspinError
from counterspin.histories import result as history_result
from counterspin.histories.history import history
from counterspin.histories.page import control_plot, history_blocks, history_plots
from counterspin.histories.result import History
from counterspin.physics.terms import TERMS
from counterspin.reports.blocks import Plot
from counterspin.reports.charts import save_figure

ROOT = Path(__file__).parents[2]
FROZEN = ROOT / "tests" / "frozen"
DATES = ("2022-03-01", "2023-03-01", "2024-03-01", "2025-03-01", "2026-03-01")
U = 5e-8


def write_results(folder, **results):
    folder.mkdir(parents=True, exist_ok=True)
    for name, document in results.items():
        text = document if isinstance(document, str) else json.dumps(document)
        # A lone surrogate becomes a byte that is not UTF-8.
        (folder / f"{name}.json").write_text(text, encoding="utf-8", errors="surrogateescape")
    return folder


def write_series(folder, values, dates=DATES, **options):
    return write_results(
        folder,
        **{
            f"r{i}": make_dated_document(value, date, **options)
            for i, (value, date) in enumerate(zip(values, dates, strict=False))
        },
    )


def only_instrument(found_history):
    assert len(found_history.instruments) == 1
    return found_history.instruments[0]


# Verdicts


def test_results_are_sorted_by_date_with_differences(tmp_path):
    folder = write_series(tmp_path, [2.71e-5, 2.70e-5, 2.72e-5], DATES[:3][::-1])
    instrument = only_instrument(history([folder]))
    assert [point.date for point in instrument.points] == list(DATES[:3])
    assert [Path(point.file).name for point in instrument.points] == [
        "r2.json",
        "r1.json",
        "r0.json",
    ]
    assert instrument.mean == pytest.approx(2.71e-5)
    assert instrument.u_mean == pytest.approx(U / math.sqrt(3.0))
    assert [point.difference for point in instrument.points] == pytest.approx(
        [1e-7, -1e-7, 0.0], abs=1e-15
    )
    # u of each difference: sqrt(u^2 - u^2/3).
    assert instrument.points[0].z == pytest.approx(1e-7 / (U * math.sqrt(2.0 / 3.0)))
    expanded = 1.959963984540054 * U * math.sqrt(2.0)
    assert [point.e_n for point in instrument.points[1:]] == pytest.approx(
        [-2e-7 / expanded, 1e-7 / expanded]
    )
    assert instrument.points[0].e_n is None


def test_drift_is_per_year(tmp_path):
    instrument = only_instrument(
        history([write_series(tmp_path, [2.70e-5 + 1e-7 * i for i in range(5)])])
    )
    # Leap years make calendar years differ from 365.25 days by 0.3 % at most.
    assert instrument.drift.value == pytest.approx(1e-7, rel=0.003)
    assert instrument.drift.level == pytest.approx(2.72e-5, rel=1e-5)
    assert instrument.drift.date == "2024-02-29"
    # Times -2, -1, 0, 1, 2: u of the slope is u/sqrt(10).
    assert instrument.drift.u == pytest.approx(U / math.sqrt(10.0), rel=0.003)


@pytest.mark.parametrize(
    ("shifts", "verdict", "words"),
    [
        ([0], "single", "There is only one result; a comparison requires at least two"),
        ([0, 1], "constant", "2 results are consistent with"),
        ([0, 6], "differ", "With two results, a drift cannot be distinguished from a jump"),
        ([0, 0.5, -0.5, 0.5, 0], "constant", "No significant drift"),
        ([0, 2, 4, 6, 8], "drifts", "but not with a constant"),
        ([0, 0, 0, 0, 8], "disagree", "deviates most"),
        ([0, 6, 0, 6, 0], "disagree", "a steady drift does not explain the scatter"),
    ],
)
def test_verdict_follows_from_shifts(tmp_path, shifts, verdict, words):
    histories = history([write_series(tmp_path, [2.7e-5 + U * shift for shift in shifts])])
    assert only_instrument(histories).verdict == verdict
    text = " ".join(getattr(block, "text", "") for block in history_blocks(histories))
    assert words in text


def test_results_of_one_date_have_no_drift(tmp_path):
    instrument = only_instrument(
        history([write_series(tmp_path, [2.7e-5, 2.75e-5], [DATES[0]] * 2)])
    )
    assert instrument.drift is None
    assert instrument.verdict == "disagree"


def test_false_alarm_rate_is_as_stated(tmp_path):
    """In about 1 % of the trials for each test, a constant instrument gets another verdict."""
    rng = np.random.default_rng(6)
    trials = 60
    alarms = 0
    for trial in range(trials):
        folder = write_series(tmp_path / str(trial), 2.7e-5 + rng.normal(0.0, U, 4), DATES[:4])
        alarms += only_instrument(history([folder])).verdict != "constant"
    # Two tests of 1 % each: at most 2 % expected; more than 7 of 60 has probability below 1e-4.
    assert alarms <= 7


def test_values_are_converted_to_latest_nominal_output(tmp_path):
    documents = {}
    for date, sensitivity in zip(DATES, (1.25, 1.3, 1.2, 1.25), strict=False):
        document = make_dated_document(2.7e-5 * 1.25 / sensitivity, date)
        nominal = {"unit": "mA", "sensitivity": sensitivity}
        document["accelerometers"]["Qx"]["nominal"] = nominal
        documents[f"r{date}"] = document
    histories = history([write_results(tmp_path, **documents)])
    instrument = only_instrument(histories)
    assert [point.value for point in instrument.points] == pytest.approx([2.7e-5] * 4)
    assert instrument.points[1].u == pytest.approx(U * 1.3 / 1.25)
    assert "differ (1.25 mA/g, 1.3 mA/g, 1.2 mA/g)" in " ".join(histories.notes)


def test_values_are_converted_to_latest_nominal_zero(tmp_path):
    documents = {}
    # The true output at zero specific force is 4.00625 mA.
    for date, value, zero in zip(DATES, (0.005, -0.075), (4.0, 4.1), strict=False):
        document = make_dated_document(date=date)
        accelerometer = document["accelerometers"]["Qx"]
        accelerometer["coefficients"]["K_F"] |= {"value": value, "u": 1e-6}
        accelerometer["nominal"] = {"unit": "mA", "sensitivity": 1.25, "zero": zero}
        documents[f"r{date}"] = document
    instrument = only_instrument(history([write_results(tmp_path, **documents)], term="K_F"))
    assert [point.value for point in instrument.points] == pytest.approx([-0.075] * 2)


@pytest.mark.parametrize(
    ("values", "laboratories", "shared"),
    [
        ((0.0, 0.0), ("A", "A"), ["K_OO", "platform.compliance.zy"]),
        ((1e-6, 2e-6), ("A", "A"), ["platform.compliance.zy"]),  # K_OO was measured again
        ((0.0, 0.0), ("A", "B"), ["K_OO"]),  # another machine
    ],
)
def test_common_sources_need_same_measurement_and_machine(values, laboratories, shared):
    results = []
    for date, value, laboratory in zip(DATES, values, laboratories, strict=False):
        lines = [
            {"source": source, "kind": "stated", "u": 1e-6, "unit": "", "share": 0.36}
            | {"sensitivity": 0.6e-3, "contribution": 0.6e-9}
            for source in ("K_OO", "platform.compliance.zy")
        ]
        known = {"K_OO": {"value": value, "u": 1e-6, "unit": "g/g^2", "estimated": False}}
        result = make_qx_result(budget={"K_II": lines}, known=known)
        details = {"date": date, "laboratory": laboratory}
        results.append(result.model_copy(update={"details": details}))
    instrument = only_instrument(history(results))
    assert instrument.shared == shared
    assert instrument.correlation == pytest.approx(0.36 * len(shared))


def test_control_limits_are_rounded(tmp_path):
    histories = history([write_series(tmp_path, [2.7e-5, 2.70123e-5, 2.69876e-5])])
    text = " ".join(getattr(block, "text", "") for block in history_blocks(histories))
    assert "centre 27.000 ug/g^2, action limits 26.951 to 27.049 ug/g^2" in text


def test_values_of_other_sites_are_converted_to_latest_gravity(tmp_path):
    remote_document = make_dated_document(2.7e-5, "2023-03-01") | {
        "inputs": FROZEN_RESULT["inputs"] | {"gravity": 9.78}
    }
    local_document = make_dated_document(2.7e-5, "2024-03-01") | {
        "inputs": FROZEN_RESULT["inputs"] | {"gravity": 9.83}
    }
    folder = write_results(tmp_path, there=remote_document, here=local_document)
    histories = history([folder])
    assert histories.gravity == 9.83
    assert histories.converted
    # K_II in SI is K_II/g: the same sensor has a larger number where g is larger.
    assert only_instrument(histories).points[0].value == pytest.approx(
        2.7e-5 * 9.83 / 9.78, rel=1e-12
    )
    assert only_instrument(histories).points[1].value == 2.7e-5
    bias = only_instrument(history([folder], term="K_F")).points[0]
    frozen_bias = FROZEN_RESULT["accelerometers"]["Qx"]["coefficients"]["K_F"]["value"]
    assert bias.value == pytest.approx(frozen_bias * 9.78 / 9.83, rel=1e-12)
    text = " ".join(getattr(block, "text", "") for block in history_blocks(histories))
    assert "g = 9.83 m/s^2" in text


# Included files


def test_frozen_results_of_every_schema_are_read():
    histories = history([FROZEN])
    assert not histories.damaged
    assert [instrument.serial_number for instrument in histories.instruments] == [
        "P-7 Qx",
        "P-7 Qy",
    ]
    for instrument, name in zip(histories.instruments, ("Qx", "Qy"), strict=True):
        assert instrument.stated_by == "campaign"
        coefficients = [
            json.loads(path.read_text("utf-8"))["accelerometers"][name]["coefficients"]["K_II"]
            for path in (FROZEN / "schema-1-joint.json", FROZEN / "schema-1-two-stage.json")
        ]
        assert [(point.value, point.u) for point in instrument.points] == [
            (coefficient["value"], coefficient["u"]) for coefficient in coefficients
        ]
    assert "(of the campaign)" in str(list(history_blocks(histories)))


def test_results_are_grouped_by_serial_number(tmp_path):
    write_series(tmp_path / "a", [2.7e-5, 2.7e-5], serial="A")
    write_series(tmp_path / "deep" / "b", [3.1e-5, 3.1e-5, 3.1e-5], serial="B")
    histories = history([tmp_path])
    assert [(i.serial_number, len(i.points)) for i in histories.instruments] == [("A", 2), ("B", 3)]
    assert only_instrument(history([tmp_path], serial="B")).mean == pytest.approx(3.1e-5)
    assert (
        only_instrument(history([tmp_path / "a", tmp_path / "a" / "r0.json"])).serial_number == "A"
    )
    with raises("no-results", '"C"', "A, B"):
        history([tmp_path], serial="C")


def test_campaign_serial_number_selects_its_accelerometers():
    assert len(history([FROZEN], serial="P-7").instruments) == 2
    assert only_instrument(history([FROZEN], serial="P-7 Qy")).points[0].accelerometer == "Qy"


def remove_estimate():
    document = make_dated_document()
    document["accelerometers"]["Qx"]["coefficients"]["K_II"] |= {"estimated": False}
    return document


def remove_term():
    document = make_dated_document()
    del document["accelerometers"]["Qx"]["coefficients"]["K_II"]
    return document


def make_contradicted(**changes):
    document = make_dated_document(**changes)
    document["accelerometers"]["Qx"]["residual"] |= {
        "chi2": 6400.0,
        "dof": 100.0,
        "lack_of_fit_p": 0,
    }
    return document


def test_accepted_misfit_is_included(tmp_path):
    accepted = make_contradicted(state="contradicted", accepted_misfit="known play of the arm")
    accepted["accelerometers"]["Qx"] |= {"state": "contradicted"}
    histories = history(
        [write_results(tmp_path, good=make_dated_document(run="1"), other=accepted)]
    )
    assert len(only_instrument(histories).points) == 2


@pytest.mark.parametrize(
    ("document", "reason"),
    [
        (make_contradicted(), "the records contradict the result: The residuals are 8 times"),
        (make_dated_document(date=None), "the result has no date"),
        (
            make_dated_document(date="last spring"),
            'the date of the result, "last spring", is not valid',
        ),
        (make_dated_document(serial=None), "has no serial number"),
        (make_dated_document(model="as-printed"), "which yield half the true K_II"),
        (remove_estimate(), "does not determine K_II"),
        (remove_term(), "has no K_II"),
        (make_dated_document(2.9e-5, run="same"), "uses the same records as"),
        (make_dated_document(2.8e-5, run="same", method="two-stage"), "uses the same records as"),
        ({"schema": 1, "campaigns": {}}, "is a summary of several campaigns"),
    ],
)
def test_excluded_result_has_reason(tmp_path, document, reason):
    folder = write_results(tmp_path, good=make_dated_document(run="same"), other=document)
    histories = history([folder])
    assert [Path(point.file).name for point in only_instrument(histories).points] == ["good.json"]
    (unused_result,) = histories.left_out
    assert Path(unused_result.file).name == "other.json"
    assert reason in unused_result.reason
    assert histories.damaged == []
    text = " ".join(getattr(block, "text", "") for block in history_blocks(histories))
    assert reason in text


def test_joint_result_replaces_two_stage_of_same_records(tmp_path):
    write_results(
        tmp_path,
        a=make_dated_document(2.8e-5, run="x", method="two-stage"),
        b=make_dated_document(2.7e-5, run="x"),
    )
    assert [point.method for point in only_instrument(history([tmp_path])).points] == ["joint"]


def test_copies_are_counted_once(tmp_path):
    folder = write_results(tmp_path, a=make_dated_document(), b=make_dated_document())
    histories = history([folder, folder / "a.json"])
    assert len(only_instrument(histories).points) == 1
    (unused_result,) = histories.left_out
    assert unused_result.reason == f"this file is the same as {folder / 'a.json'}"


def test_shared_records_are_reported(tmp_path):
    first_document, second_document = (
        make_dated_document(2.7e-5, DATES[0]),
        make_dated_document(2.71e-5, DATES[1]),
    )
    for document, file_stem in ((first_document, "b"), (second_document, "c")):
        document["provenance"]["inputs"] = {"1.csv": "sha256:a", "2.csv": f"sha256:{file_stem}"}
    histories = history(
        [
            write_results(
                tmp_path, first=seal_document(first_document), second=seal_document(second_document)
            )
        ]
    )
    assert len(only_instrument(histories).points) == 2
    (note,) = histories.notes
    assert "second.json shares 1 of 2 records with" in note


def test_missing_seals_are_reported(tmp_path):
    folder = write_results(
        tmp_path,
        a=seal_document(make_dated_document(2.71e-5, DATES[0])),
        b=make_dated_document(2.7e-5, DATES[1]),
    )
    (note,) = history([folder]).notes
    assert note.startswith(f"The file of {folder / 'b.json'} has no seal")
    write_results(
        tmp_path, **{f"c{n}": make_dated_document(2.7e-5 + 1e-8 * n, DATES[2]) for n in range(6)}
    )
    (note,) = history([folder]).notes
    assert note.startswith(f"7 files have no seal ({folder / 'b.json'}, {folder / 'c0.json'}, ")
    assert "c4.json" not in note


def test_other_json_files_are_skipped(tmp_path):
    folder = write_results(
        tmp_path, good=make_dated_document(), plan={"schema": 1, "runs": []}, numbers=[1, 2]
    )
    histories = history([folder])
    assert [Path(name).name for name in histories.passed_over] == ["numbers.json", "plan.json"]
    assert histories.damaged == []
    # A file given by name must be a result.
    assert len(history([folder / "good.json", folder / "plan.json"]).damaged) == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (json.dumps(make_dated_document())[:300], "not a result file, or damaged"),
        ("", "not a result file, or damaged"),
        ("[" * 100_000, "damaged"),
        (
            json.dumps(make_dated_document() | {"schema": Result.newest_schema() + 1}),
            "written by a newer version of counterspin",
        ),
        (json.dumps(make_dated_document(u=-1.0)), "damaged result"),
        ("\udc80", "damaged"),
        (
            '{"campaigns": [], "campaigns": [], ' + json.dumps(make_dated_document())[1:],
            "occurs twice",
        ),
    ],
    ids=["cut", "empty", "deep", "newer", "negative", "bytes", "twice"],
)
def test_damaged_file_does_not_stop_history(tmp_path, text, words, capsys):
    folder = write_results(tmp_path, good=make_dated_document(), bad=text)
    histories = history([folder])
    assert len(only_instrument(histories).points) == 1
    (damaged,) = histories.damaged
    assert words in damaged.reason
    output_path = tmp_path / "kept.txt"
    assert main(["history", str(folder), "--json", str(output_path)]) == 1
    captured = capsys.readouterr()
    assert "Q-104" in captured.out
    assert "bad.json" in captured.out.replace("\n", "")
    assert captured.err.startswith("counterspin: 1 of the result files")
    assert History.read(output_path).damaged[0].file.endswith("bad.json")


def test_empty_history_states_cause(tmp_path):
    with pytest.raises(CounterspinError, match=r"contains no results.*`write_result`"):
        history([tmp_path])
    write_results(tmp_path, a=make_dated_document(date=None))
    with raises("no-results", "Qx of", "a.json:"):
        history([tmp_path])


def test_wrong_usage_exits_with_2(tmp_path, capsys):
    assert main(["history"]) == 2
    assert "give result files, or folders" in capsys.readouterr().err
    assert main(["history", str(tmp_path / "x"), str(tmp_path / "y")]) == 2
    error = capsys.readouterr().err
    assert "2 mistakes" in error
    assert error.count("file not found") == 2
    assert main(["history", str(tmp_path / "x")]) == 2
    assert capsys.readouterr().err == f"counterspin: {tmp_path / 'x'}: file not found\n"
    write_results(tmp_path, a=make_dated_document())
    for term, message in (
        ("K_IV", "unknown term"),
        ("platform.tilt.up", "is a machine term"),
        ("offset.X", 'use "offset", which tracks it for all accelerometers'),
    ):
        assert main(["history", str(tmp_path), "--term", term]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("term", ["K_F", "K_III"])
def test_history_of_other_term(tmp_path, term):
    histories = history([write_results(tmp_path, a=make_dated_document())], term=term)
    coefficient = FROZEN_RESULT["accelerometers"]["Qx"]["coefficients"][term]
    assert (only_instrument(histories).points[0].value, histories.unit) == (
        coefficient["value"],
        TERMS[term].unit,
    )


def test_date_with_time_zone_is_converted_to_utc(tmp_path):
    folder = write_results(tmp_path, a=make_dated_document(date="2026-03-01T01:00:00+02:00"))
    assert only_instrument(history([folder])).points[0].date == "2026-02-28T23:00:00"


# Display


def test_control_plot_shows_results_mean_and_drift(tmp_path):
    histories = history([write_series(tmp_path, [2.70e-5 + 1e-7 * i for i in range(5)])])
    mean, centre, *limits, drift, results = control_plot(
        histories, only_instrument(histories)
    ).series
    assert centre.y == pytest.approx((27.2, 27.2))
    # Each change is 0.1: limits are two and three times 0.1/1.1284 from the centre.
    shifts = [2.0, -2.0, 3.0, -3.0]
    assert [limit.y[0] for limit in limits] == pytest.approx(
        [27.2 - shift * 0.1 / 1.128379 for shift in shifts], rel=1e-6
    )
    assert results.kind == "points"
    assert results.y == pytest.approx([27.0, 27.1, 27.2, 27.3, 27.4])
    assert results.high[0] - results.low[0] == pytest.approx(2 * 1.959963984540054 * U * 1e6)
    dates = np.array(
        [point.date for point in only_instrument(histories).points], dtype="datetime64[D]"
    )
    assert results.x == tuple(dates.astype(float))
    assert mean.y == pytest.approx((27.2, 27.2))
    assert drift.y == pytest.approx((27.0, 27.4), abs=1e-3)
    assert drift.is_highlighted
    assert any(isinstance(block, Plot) for block in history_blocks(histories))


def test_limits_of_two_results_follow_from_their_uncertainties(tmp_path):
    histories = history([write_series(tmp_path, [2.70e-5, 2.71e-5])])
    _, upper, lower, _ = control_plot(histories, only_instrument(histories)).series
    # Three standard uncertainties of the difference from the mean of both results.
    limit = 3e6 * U * math.sqrt(1 - 1 / 2)
    assert upper.y == pytest.approx([27.05 + limit] * 2)
    assert lower.y == pytest.approx([27.05 - limit] * 2)


def add_limits(document, low=-2.9e-5, high=2.75e-5, laboratory=None):
    """Return a result with a specification, and the laboratory that it comes from."""
    document["accelerometers"]["Qx"]["conformity"] = {
        "K_II": {
            "specification": "as agreed",
            "low": low,
            "high": high,
            "unit": "g/g^2",
            "rule": "simple",
            "guard_band": 0.0,
            "verdict": "pass",
            "probability": 1.0,
            "risk": 0.0,
        }
    }
    if laboratory is not None:
        document["details"]["laboratory"] = laboratory
    return document


def test_drift_towards_limit_sets_due_date(tmp_path):
    documents = {
        f"r{i}": add_limits(make_dated_document(2.70e-5 + 5e-8 * i, date, u=1e-8))
        for i, date in enumerate(DATES)
    }
    histories = history([write_results(tmp_path, **documents)])
    instrument = only_instrument(histories)
    assert (instrument.specification.high, instrument.verdict) == (2.75e-5, "drifts")
    # 27.2 in March 2026, at 0.05 per year: six years minus the effect of u.
    assert instrument.due.date.startswith("2031")
    earlier_date = only_instrument(history([tmp_path], reliability=0.999)).due.date
    assert earlier_date < instrument.due.date
    text = " ".join(getattr(block, "text", "") for block in history_blocks(histories))
    assert (
        f"is due on {instrument.due.date}. Until this date, the straight line through the results "
        "stays within the specification with 95.0 %" in text
    )
    lines = [series.label for series in control_plot(histories, instrument).series]
    assert lines.count("specification") == 1
    with pytest.raises(CampaignError, match="is not between"):
        history([tmp_path], reliability=0.4)


def test_no_due_date_without_specification_or_after_jump(tmp_path):
    assert (
        "none of the results states a spec"
        in only_instrument(history([write_series(tmp_path / "a", [2.7e-5])])).due.reason
    )
    jump = {
        f"r{i}": add_limits(make_dated_document(2.70e-5 + shift * U, date))
        for i, (shift, date) in enumerate(zip([0, 0, 0, 0, 8], DATES, strict=True))
    }
    histories = history([write_results(tmp_path / "b", **jump)])
    assert "are not consistent with a straight line" in only_instrument(histories).due.reason


def test_difference_of_laboratories_has_last_digit_of_uncertainty(tmp_path):
    documents = {
        name: make_dated_document(value, date)
        for name, value, date in (("A", 2.7e-5, DATES[0]), ("B", 3.93412e-5, DATES[1]))
    }
    for name, document in documents.items():
        document["details"]["laboratory"] = name
    histories = history([write_results(tmp_path, **documents)])
    text = " ".join(getattr(block, "text", "") for block in history_blocks(histories))
    assert "B minus A = 12.3 ug/g^2" in text


def test_laboratories_are_compared(tmp_path):
    values = [("A", 2.70e-5), ("B", 2.72e-5), ("A", 2.70e-5), ("B", 2.74e-5)]
    documents = {
        f"r{i}": add_limits(make_dated_document(value, DATES[i]), laboratory=name)
        for i, (name, value) in enumerate(values)
    }
    histories = history([write_results(tmp_path, **documents)])
    (pair,) = only_instrument(histories).laboratories
    assert (pair.first, pair.second) == ("A", "B")
    assert pair.difference == pytest.approx(3e-7)
    # Each mean has u over sqrt(2): U of the difference is 1.96 u (ISO 13528:2015, 9.7).
    assert pair.e_n == pytest.approx(3e-7 / (1.959964 * U), rel=1e-6)
    text = " ".join(getattr(block, "text", "") for block in history_blocks(histories))
    assert "B minus A = 0.3 ug/g^2, E_n = 3.06; the results differ significantly." in text


def test_result_beyond_action_limits_is_named(tmp_path):
    dates = [f"{year}-03-01" for year in range(2000, 2021)]
    shifts = [0, 1] * 8 + [30] + [0, 1] * 2
    histories = history(
        [write_series(tmp_path, [2.7e-5 + 1e-8 * shift for shift in shifts], dates)]
    )
    (beyond,) = only_instrument(histories).control.beyond
    assert beyond.endswith("r16.json")
    text = " ".join(getattr(block, "text", "") for block in history_blocks(histories))
    assert f"The process is out of control: {beyond} is outside the action limits;" in text


def test_figure_has_chart_per_instrument_and_is_reproducible(tmp_path):
    write_series(tmp_path / "a", [2.7e-5, 2.71e-5, 2.69e-5], serial="A")
    write_series(tmp_path / "b", [3.1e-5], serial="B")
    histories = history([tmp_path])
    for name in ("one.svg", "two.svg"):
        save_figure(history_plots(histories), tmp_path / name)
    svg = (tmp_path / "one.svg").read_text("utf-8")
    assert svg == (tmp_path / "two.svg").read_text("utf-8")
    assert "K_II of A" in svg
    assert "K_II of B" in svg
    assert "K_II, µg/g²" in svg


def test_figure_axis_has_no_offset(tmp_path):
    write_series(tmp_path, [2.7e-5, 2.70001e-5], u=1e-11)
    save_figure(history_plots(history([tmp_path])), tmp_path / "one.svg")
    # The labels are not 0.0001 with an offset of 27.
    assert ">27.0001" in (tmp_path / "one.svg").read_text("utf-8")


def test_names_in_figure_are_not_formulas(tmp_path):
    serial = r"A$\frac$ 日<b>"
    write_series(tmp_path / "a", [2.7e-5, 2.71e-5], serial=serial)
    save_figure(history_plots(history([tmp_path / "a"])), tmp_path / "one.svg")
    assert r"K_II of A$\frac$ 日&lt;b&gt;" in (tmp_path / "one.svg").read_text("utf-8")


def test_command_prints_and_writes_history(tmp_path, capsys):
    folder = write_series(tmp_path / "results", [2.7e-5, 2.71e-5, 2.69e-5])
    chart, json_path = tmp_path / "chart.svg", tmp_path / "history.json"
    arguments = ["history", str(folder), "--figure", str(chart), "--json", str(json_path)]
    assert main(arguments) == 0
    output = capsys.readouterr().out
    assert (
        "K_II is constant: 3 results are consistent with 27.000 ± 0.029 ug/g^2"
        in output.replace("\n", " ")
    )
    assert chart.read_text("utf-8").startswith("<?xml")
    read_history = history_result.History.model_validate_json(json_path.read_text("utf-8"))
    assert read_history == history([folder])
    # The output of the command is not a result of an instrument.
    assert main(["history", str(tmp_path)]) == 0


def test_unwritable_target_leaves_no_file(tmp_path, capsys):
    folder = write_series(tmp_path / "results", [2.7e-5])
    assert main(["history", str(folder), "--json", str(tmp_path / "no" / "h.json")]) == 1
    assert "cannot be written" in capsys.readouterr().err
    assert main(["history", str(folder), "--figure", str(tmp_path / "h.gif")]) == 2
    captured = capsys.readouterr()
    assert ".svg, .png, .pdf" in captured.err
    assert not captured.out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["results"]


# The page


def test_documentation_explains_all_verdicts():
    page = (ROOT / "docs" / "history.md").read_text(encoding="utf-8")
    verdicts = history_result.Verdict.__args__
    assert all(f"| `{verdict}` |" in page for verdict in verdicts)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files here")
def test_hidden_files_and_pipes_are_skipped(tmp_path):
    folder = write_results(
        tmp_path, good=make_dated_document(), **{".tmpx1y2": make_dated_document(2.6e-5)}
    )
    write_results(tmp_path / ".git", index=make_dated_document(2.5e-5))
    os.mkfifo(folder / "pipe.json")
    histories = history([folder])
    assert len(only_instrument(histories).points) == 1
    (hidden_file,) = histories.left_out
    assert hidden_file.file.endswith(".tmpx1y2.json")
    assert "hidden file was left by an interrupted command" in hidden_file.reason
    (pipe_file,) = histories.damaged
    assert "this is a pipe, not a file" in pipe_file.reason
    # A file given by name must be a result.
    assert len(only_instrument(history([folder / ".tmpx1y2.json"])).points) == 1


def test_result_objects_match_their_files(tmp_path):
    values = [2.7e-5, 2.71e-5, 2.72e-5]
    folder = write_series(tmp_path / "results", values, dates=DATES[:3])
    file_history = history([folder])
    results = [Result.read(file) for file in sorted(folder.glob("*.json"))]
    memory_history = history(results)
    (file_instrument,), (memory_instrument,) = file_history.instruments, memory_history.instruments
    assert (
        [point.value for point in file_instrument.points]
        == [point.value for point in memory_instrument.points]
        == values
    )
    title = results[0].title
    assert [point.file for point in memory_instrument.points] == [
        f"result {n} ({title})" for n in (1, 2, 3)
    ]
    mixed = history([folder, results[0].model_copy(update={"title": "again"})])
    assert [unused.file for unused in mixed.left_out] == ["result 2 (again)"]
    with raises("no-results", "Qx of result 1"):
        history([results[0].model_copy(update={"details": {}})])
