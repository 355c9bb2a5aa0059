"""Repeatability: variation of results with turn-on, mounting and day."""

import json
import math

import numpy as np
import pytest
from results import make_dated_document

import counterspin as cs
from counterspin.calibration.result import Result
from counterspin.histories.history import history
from counterspin.histories.page import history_blocks
from counterspin.histories.result import History
from counterspin.inference.variance_components import variance_components
from counterspin.reports.blocks import Table

U = 5e-8


def make_result(value, date, **labels):
    """Return Qx of the frozen result with a K_II, a date and names of mounting and turn-on."""
    document = make_dated_document(value, date, u=U, run=f"{value}{date}{labels}")
    document["accelerometers"]["Qx"]["budget"] = {}
    document["details"] |= labels
    return Result.model_validate(document)


#: Two mountings on each of three days, with two turn-ons per mounting.
DAYS = np.repeat(["2026-03-01", "2026-03-02", "2026-03-03"], 4)
MOUNTINGS = np.repeat(["a", "b", "c", "d", "e", "f"], 2)
VALUES = 2.7e-5 + 1e-7 * np.array([0, 1, 9, 7, -4, -2, 6, 5, -9, -8, 2, 0.5])


def make_twelve_results(**extra_labels):
    return [
        make_result(value, str(day), mounting=str(mounting), turn_on=f"t{place}", **extra_labels)
        for place, (value, day, mounting) in enumerate(zip(VALUES, DAYS, MOUNTINGS, strict=True))
    ]


def evaluate_repeatability(results):
    (instrument,) = history(results).instruments
    return instrument.repeatability


def test_variance_components_of_nested_days_mountings_and_turn_ons():
    """With known u: mean squares of balanced classes, with u^2 subtracted from the finest."""
    repeatability = evaluate_repeatability(make_twelve_results())
    cube = VALUES.reshape(3, 2, 2)
    mounting_means, day_means = cube.mean(axis=2), cube.mean(axis=(1, 2))
    within_variance = float(np.sum((cube - mounting_means[:, :, None]) ** 2)) / 6.0
    between = 2.0 * float(np.sum((mounting_means - day_means[:, None]) ** 2)) / 3.0
    days = 4.0 * float(day_means.var(ddof=1))
    # The component of the day is zero, and its mean square is pooled with the mountings.
    assert days < between
    pooled = (2.0 * days + 3.0 * between) / 5.0
    assert repeatability.components["day"].value == 0.0
    expected = {"turn_on": within_variance - U**2, "mounting": (pooled - within_variance) / 2.0}
    for name, variance in expected.items():
        assert repeatability.components[name].value == pytest.approx(math.sqrt(variance), rel=1e-3)
    assert repeatability.total == pytest.approx(math.sqrt(sum(expected.values())), rel=1e-3)
    assert [component.freedom for component in repeatability.components.values()] == [2, 3, 6]
    assert repeatability.value == pytest.approx(VALUES.mean(), rel=1e-9)
    assert repeatability.u == pytest.approx(math.sqrt(pooled / 12.0), rel=1e-3)
    assert repeatability.about == "mean"
    assert repeatability.not_told == {}


def test_unstated_or_constant_factor_has_no_component():
    unlabelled_results = [
        make_result(value, day) for value, day in zip(VALUES[::2], DAYS[::2], strict=True)
    ]
    repeatability = evaluate_repeatability(unlabelled_results)
    assert list(repeatability.components) == ["day"]
    assert repeatability.not_told == {
        "mounting": "this value is missing in 6 of 6 results",
        "turn_on": "this value is missing in 6 of 6 results",
    }
    results_of_one_day = [
        make_result(value, "2026-03-01", mounting="a", turn_on=str(value)) for value in VALUES[:4]
    ]
    repeatability = evaluate_repeatability(results_of_one_day)
    assert list(repeatability.components) == ["turn_on"]
    assert repeatability.not_told["mounting"] == "all results have the same label"
    assert evaluate_repeatability(unlabelled_results[:2]) is None
    assert (
        evaluate_repeatability([make_result(value, "2026-03-01") for value in VALUES[:4]]) is None
    )


def test_drifting_results_are_evaluated_about_line():
    years = np.arange(8)
    values = 2.7e-5 + 1e-6 * years + U * np.array([1, -1, 0.5, -0.5, 1, -1, 0.5, -0.5])
    repeatability = evaluate_repeatability(
        [make_result(value, f"{2010 + y}-03-01") for value, y in zip(values, years, strict=True)]
    )
    assert repeatability.about == "line"
    assert repeatability.components["day"].value == 0.0
    assert repeatability.u == pytest.approx(U / math.sqrt(8.0), rel=1e-6)


def test_shared_uncertainty_is_not_repeatability():
    """A bias common to all results (of the radius) is not part of their variation."""
    budget = [
        {
            "source": "centrifuge.radius",
            "kind": "stated",
            "sensitivity": 2e-7,
            "u": 1.0,
            "unit": "m",
        }
    ]
    results = []
    for result in make_twelve_results():
        document = json.loads(result.model_dump_json(by_alias=True))
        qx = document["accelerometers"]["Qx"]
        line = {"contribution": 2e-7, "share": 0.9, **budget[0]}
        qx["budget"] = {"K_II": [line]}
        qx["coefficients"]["K_II"]["u"] = math.hypot(U, 2e-7)
        results.append(Result.model_validate(document))
    (instrument,) = history(results).instruments
    assert instrument.shared == ["centrifuge.radius"]
    independent, shared = evaluate_repeatability(make_twelve_results()), instrument.repeatability
    for name, component in independent.components.items():
        assert shared.components[name].value == pytest.approx(component.value, rel=1e-3, abs=1e-12)
    assert shared.u == pytest.approx(math.hypot(independent.u, 2e-7), rel=1e-2)


def test_report_lists_components_with_intervals(tmp_path):
    histories = history(make_twelve_results())
    blocks = list(history_blocks(histories))
    (table,) = (
        block
        for block in blocks
        if isinstance(block, Table) and block.columns[0].title == "Changed condition"
    )
    rows = {row[0]: row[1:] for row in table.rows}
    assert list(rows) == ["another day", "another mounting", "another turn-on", "all results"]
    turn_on_component = histories.instruments[0].repeatability.components["turn_on"]
    assert rows["another turn-on"][2:] == ("12 turn-ons", "6")
    assert float(rows["another turn-on"][0]) == pytest.approx(
        turn_on_component.value * 1e6, rel=0.05
    )
    assert rows["another day"][1].startswith("0 to ")
    text = " ".join(getattr(block, "text", "") for block in blocks)
    assert (
        "With few days and mountings, the estimates are unreliable. Use the intervals instead."
        in text
    )
    path = tmp_path / "history.json"
    histories.write(path)
    assert History.read(path) == histories
    labelled_results = [
        make_result(value, str(day), mounting=str(day), turn_on=f"t{i}")
        for i, (value, day) in enumerate(zip(VALUES, DAYS, strict=True))
    ]
    (table, *_) = (
        block
        for block in history_blocks(history(labelled_results))
        if isinstance(block, Table) and block.columns[0].title == "Changed condition"
    )
    assert table.rows[0][0] == "another day or mounting"


def test_mounting_and_turn_on_are_read_from_campaigns():
    """Tumbles whose bias differs from mounting to mounting by 20 ug, and with each turn-on by 5."""
    rng = np.random.default_rng(3)
    angles = np.arange(0.0, 360.0, 30.0)
    results, moved = [], []
    for mounting in "abc":
        mounting_shift = 20e-6 * rng.standard_normal()
        for turn in range(3):
            bias = 2e-3 + mounting_shift + 5e-6 * rng.standard_normal()
            moved.append(bias)
            described = {
                "site": {"gravity": "9.8 m/s^2", "latitude": "45 deg"},
                "campaign": {
                    "date": f"2026-03-{10 + turn}",
                    "mounting": mounting,
                    "turn_on": f"{mounting}{turn}",
                },
                "centrifuge": {"radius": "1 m"},
                "records": {"time": {"column": "t", "unit": "s"}},
                "accelerometers": {
                    "A": {"input_axis": "up", "pendulous_axis": "east", "serial_number": "7"}
                },
                "model": {"terms": ["K_F", "K_I"], "assume": "all"},
                "readings": {"columns": {"attitude": "deg", "reading": "g", "u": "u"}},
            }
            frame = {
                "deg": angles,
                "g": bias + np.cos(np.deg2rad(angles)) + 1e-6 * rng.standard_normal(12),
                "u": np.full(12, 1e-6),
            }
            results.append(cs.calibrate(cs.make_campaign(described, readings=frame)))
    (instrument,) = cs.history(results, term="K_F").instruments
    assert {(point.mounting, point.turn_on) for point in instrument.points} >= {
        ("a", "a0"),
        ("c", "c2"),
    }
    components = instrument.repeatability.components
    assert list(components) == ["day", "mounting", "turn_on"] or list(components) == [
        "mounting",
        "day",
        "turn_on",
    ]
    biases = [point.value for point in instrument.points]
    expected = variance_components(
        np.array(biases),
        np.diag([point.u**2 for point in instrument.points]),
        {
            "day": [point.date for point in instrument.points],
            "mounting": [point.mounting for point in instrument.points],
            "turn_on": [point.turn_on for point in instrument.points],
        },
        np.ones((9, 1)),
    )
    for name, expected_component in expected.components.items():
        assert components[name].value == pytest.approx(expected_component.value, rel=1e-2, abs=1e-9)
    assert components["mounting"].low < 20e-6 < components["mounting"].high
    assert components["turn_on"].low < 5e-6 < components["turn_on"].high
