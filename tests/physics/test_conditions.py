"""Conditions of a run, and conditions that a description states."""

from dataclasses import fields

import numpy as np

from counterspin.campaign.runs import Run
from counterspin.physics.conditions import STATED_CONDITIONS, RunConditions, StatedConditions


def test_unchanged_condition_has_value_at_start():
    conditions = RunConditions(start=750.0, temperature_offset=-1.7, direction=-0.5)
    assert not conditions.changing_conditions
    start = conditions.at_start(3.0)
    expected = {"time": 750.0, "temperature": -1.7, "direction": -0.5, "force": 9.0}
    assert {name: start[name] for name in expected} == expected
    later = conditions.at(np.array([0.0, 4.0, 9.0]), 3.0)
    assert {name: values.tolist() for name, values in later.items()} == {
        name: [value] * 3 for name, value in start.items()
    }


def test_condition_changing_within_run_is_named():
    profile = RunConditions(temperature_profile=(0.0, 1.0), length=2.0, reversal_times=(1.0,))
    assert profile.changing_conditions == {"temperature", "direction"}
    assert profile.changing_conditions <= profile.at_start(1.0).keys()


def test_stated_conditions_are_keys_of_runs_and_fields_of_readings():
    assert {part.name for part in fields(StatedConditions)} == set(STATED_CONDITIONS)
    assert set(STATED_CONDITIONS) <= RunConditions().at_start(1.0).keys()
    assert set(STATED_CONDITIONS) <= Run.model_fields.keys()
