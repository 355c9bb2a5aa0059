"""Test methods of a result and their consistency."""

import pytest
from results import make_accelerometer_result, make_bare_result, make_coefficient, make_run

from counterspin.calibration.pages.methods import (
    describe_tests,
    method_blocks,
    reading_blocks,
    tabulate_tests,
)
from counterspin.calibration.result_parts import ReadingResult
from counterspin.reports.blocks import Paragraph


def make_reading(motion, rate=0.0, value=1.0, mounting="", axis=(0.0, 0.0, 1.0)):
    return ReadingResult(
        name="r",
        motion=motion,
        mounting=mounting,
        input_axis=axis,
        pendulous_axis=(1.0, 0.0, 0.0),
        rate=rate,
        value=value,
        u=1e-6,
        residual=0.0,
        z=0.0,
    )


TUMBLE = [make_reading("static", value=v, axis=(0.0, 0.0, v)) for v in (1.0, -1.0, 1.0)]
ARM = [
    make_reading("arm", rate, side * rate**2 / 9.8, name, (-float(side), 0.0, 0.0))
    for name, side in (("in", 1), ("out", -1))
    for rate in (7.0, 14.0)
]


def make_result(readings, runs=()):
    return make_bare_result(
        accelerometers={"A": make_accelerometer_result(readings=readings)},
        runs=dict.fromkeys(runs, make_run()),
        platform={
            "centrifuge.radius.in": make_coefficient(2.5, 1e-5, "m"),
            "centrifuge.stretch": make_coefficient(4e-9, 1e-9, "s^2/m"),
        },
    )


def test_each_test_method_has_sentence():
    lines = list(describe_tests(make_result(TUMBLE + ARM, ("slow", "fast"))))
    assert lines == [
        "Readings at rest in 2 positions: 3 readings (multi-position test, IEEE Std 1293).",
        "Readings on the arm of a centrifuge (IEEE Std 836) at 2 rates, 7 to 14 rad/s, one sense "
        "of rotation, 2 mountings (in, out): 4 readings. Each reading is the mean over whole "
        "revolutions.",
        "Double-turntable centrifuge records at the stated rates: 2 records.",
    ]


def test_both_senses_at_single_rate():
    (line,) = describe_tests(
        make_result([make_reading("counter-rotating", w) for w in (6.0, -6.0)])
    )
    assert line.startswith(
        "Readings on a double turntable at 1 rate, 6 rad/s, both senses of rotation: 2"
    )


def test_table_has_row_per_mounting():
    rows = tabulate_tests(TUMBLE + ARM).rows
    assert rows[0][1:] == ("", "2", "", "-1 to 1", "3")
    assert rows[1][1:] == ("in", "1", "7 to 14", "5 to 20", "2")
    assert rows[2][1:] == ("out", "1", "7 to 14", "-20 to -5", "2")


def test_only_forces_of_used_motions_are_listed():
    text = [block.text for block in reading_blocks(make_result(ARM))]
    assert any(line.startswith("On the arm") for line in text)
    assert not any("At rest" in line or "double turntable" in line for line in text)
    assert text[-1].endswith("together with the coefficients: centrifuge.radius.in.")
    assert list(reading_blocks(make_result([]))) == []


def test_empty_columns_are_omitted():
    titles = [column.title for column in tabulate_tests(TUMBLE).columns]
    assert titles == ["Test", "Positions", "Indication, g", "Readings"]
    titles = [column.title for column in tabulate_tests(TUMBLE + ARM).columns]
    assert titles[1:4] == ["Mounting", "Positions", "Rates, rad/s"]


def make_methods(p):
    """Two methods with one shift each, so that four tests share the significance of 0.01."""
    kind = {
        "count": 1,
        "coefficients": {"K_F": make_coefficient(0.005, 1e-6, "g")},
        "without": {"K_F": {"shift": 1e-7, "u": 1e-6, "z": 0.1}},
        "chi2": 9.0,
        "dof": 2,
        "p": p,
    }
    return make_accelerometer_result(
        coefficients={"K_F": make_coefficient(0.005, 1e-6, "g")},
        kinds=[{"kind": "at rest", **kind}, {"kind": "arm", **kind}],
    )


@pytest.mark.parametrize(
    ("p", "verdict"),
    [
        (0.0013, "consistent with the others"),
        (0.0012, "not consistent with the others"),
    ],
)
def test_significance_is_shared_by_all_tests(p, verdict):
    (words,) = [b.text for b in method_blocks(make_methods(p)) if isinstance(b, Paragraph)]
    assert words.startswith(f"Agreement between the test methods: at rest, {verdict} (chi")
