"""What every table of readings shows."""

import math

import numpy as np
import pytest

from counterspin.ingest.contents import FileColumn, FileContents
from counterspin.ingest.readings import (
    OutputEstimate,
    assign_roles,
    group_outputs,
    guess_common_role,
    make_column_questions,
    make_columns_question,
    make_output_questions,
    make_role_question,
    output_unit,
)


def make_column(name, unit="", values=(1.0, 2.0)):
    return FileColumn(name, unit, np.array(values))


LOOK = FileContents(
    None, (make_column("a"), make_column("b"), make_column("c")), ("No", "note"), ""
)


@pytest.mark.parametrize(
    ("name", "unit", "role"),
    [
        ("T_degC", "", "temperature"),
        ("Temp", "", "temperature"),
        ("T", "degC", "temperature"),
        ("t_s", "", "time"),
        ("elapsed", "s", "time"),
        ("u_mA", "", "uncertainty"),
        ("Unsicherheit", "mA", "uncertainty"),
        ("Messunsicherheit", "mA", "uncertainty"),
        ("Std dev", "V", "uncertainty"),
        ("Stddev", "V", "uncertainty"),
        ("combined uncertainty", "V", "uncertainty"),
        ("Nr.", "", "unused"),
        ("lfd. Nr", "", "unused"),
        ("Output", "V", "reading"),
        ("Uout", "V", "reading"),
    ],
)
def test_usual_role_of_column(name, unit, role):
    assert guess_common_role(make_column(name, unit)) == role


@pytest.mark.parametrize(
    ("values", "unit", "role"),
    [
        ([1.0, 2.0, 3.0, 4.0], "", "unused"),
        ([0.0, 1.0, 2.0], "", "unused"),
        ([1.0, 2.0, 3.0], "V", "reading"),
        ([2.0, 3.0, 4.0], "", "reading"),
        ([1.0, 2.0, 4.0], "", "reading"),
        ([1.0, 2.0], "", "reading"),
    ],
)
def test_row_counter_is_not_reading(values, unit, role):
    assert guess_common_role(make_column("Test", unit, values)) == role


@pytest.mark.parametrize(
    ("names", "meant"),
    [
        (["Reading 1", "Reading 2"], "repeats"),
        (["Messung 1", "Messung 2"], "repeats"),
        (["QA1", "QA2"], "accelerometers"),
        (["Reading", "QA2"], "accelerometers"),
    ],
)
def test_repeat_columns_are_found_by_name(names, meant):
    columns = [make_column(name, "V", [-1.0, 0.0, 1.0]) for name in names]
    contents = FileContents(None, tuple(columns), (), "")
    roles = dict.fromkeys(names, "reading")
    (question,) = make_columns_question(columns)
    assert question.guess == meant
    (first, *_), *others = group_outputs(contents, roles, {})
    assert first.name == names[0]
    assert len(others) == (meant == "accelerometers")
    assert len(group_outputs(contents, roles, {question.key: "repeats"})) == 1
    assert len(group_outputs(contents, roles, {question.key: "accelerometers"})) == 2
    assert list(make_columns_question(columns[:1])) == []


def test_single_role_column_is_unique_and_answers_take_precedence():
    def roles(**told):
        return assign_roles(
            LOOK, told, lambda one: "position" if one.name == "a" else "reading", parts
        )

    parts = {"position": "a"}
    words = {"No": "name", "note": "unused"}
    assert roles() == {**words, "a": "position", "b": "reading", "c": "reading"}
    answers = {"b is": "position"}
    assert roles(**answers) == {**words, "a": "unused", "b": "position", "c": "reading"}
    answers = {"position": "c", "b is": "time", "note is": "name", "No is": "unused"}
    expected = {"No": "unused", "note": "name", "a": "unused", "b": "time", "c": "position"}
    assert roles(**answers) == expected
    assert "position" not in roles(position="none").values()


def test_voltage_named_u_is_reading_if_no_other_is():
    volts = FileContents(None, (make_column("angle_deg"), make_column("U_V")), (), "")
    guess = {"angle_deg": "position"}
    roles = assign_roles(volts, {}, lambda c: guess.get(c.name) or guess_common_role(c), {})
    assert roles == {"angle_deg": "position", "U_V": "reading"}


def test_columns_are_asked_with_possible_roles():
    roles = {"No": "name", "note": "unused", "a": "position", "b": "reading", "c": "time"}
    questions = {
        question.key: question for question in make_column_questions(LOOK, roles, ["position"])
    }
    assert list(questions) == ["No is", "note is", "b is", "c is"]
    assert questions["No is"].choices == ("name", "unused")
    assert questions["b is"].choices[:2] == ("position", "reading")
    assert questions["b is"].parse_answer("position") == "position"
    needed = make_role_question(
        "position", "Which?", ["b", "c"], {"b": "reading"}, is_required=True
    )
    assert (needed.guess, needed.choices) == (None, ("b", "c"))
    other = make_role_question(
        "position", "Which?", ["b", "c"], {"b": "reading"}, is_required=False
    )
    assert (other.guess, other.choices) == ("none", ("b", "c", "none"))


def test_unit_of_output_is_from_answer_file_or_name():
    assert output_unit(make_column("out_V")) == "V"
    assert output_unit(make_column("out_V", "mV")) == "mV"
    assert output_unit(make_column("out_V", "mV"), {"out_V unit": "uV"}) == "uV"
    assert output_unit(make_column("Reading mV")) == "mV"
    assert output_unit(make_column("counts")) == "count"
    assert output_unit(make_column("V")) is None


def test_sensitivity_is_suggested_and_large_zero_is_asked():
    def questions(per_g, zero):
        sensed = OutputEstimate(per_g, zero)
        return list(make_output_questions(make_column("A", "V"), {}, sensed))[1:]

    (sensitivity,) = questions(2.0, 0.5)
    assert sensitivity.text.endswith("of column 'A'? The data suggest about 2 V/g.")
    sensitivity, zero = questions(-2.0, 2.5)
    assert sensitivity.guess is None
    assert (zero.key, zero.guess) == ("A zero", "2.5 V")
    (sensitivity,) = questions(math.nan, math.nan)
    assert sensitivity.text.endswith("of column 'A'?")


def test_acceleration_needs_no_sensitivity():
    def keys(unit):
        return [
            q.key
            for q in make_output_questions(make_column("A", unit), {}, OutputEstimate(1.25, 2.5))
        ]

    assert keys("g") == ["A unit"]
    assert keys("mA") == ["A unit", "A sensitivity", "A zero"]
    assert keys("") == ["A unit"]
