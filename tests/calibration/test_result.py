"""Reading result files: damaged files are rejected."""

import json
from pathlib import Path

import pytest
from raising import raises

from counterspin.calibration.result import Result
from counterspin.calibration.result_file import upgrade_document
from counterspin.errors import RecordError
from counterspin.reports.blocks import Paragraph

K_II = {"value": 2e-5, "u": 1e-9, "unit": "g/g^2", "estimated": True}
RESULT = {
    "schema": 1,
    "method": "joint",
    "model": "exact",
    "accelerometers": {
        "Qx": {
            "coefficients": {"K_II": K_II},
            "correlation": {"terms": ["K_II"], "matrix": [[1.0]]},
            "residual": {"rms": 0.01, "unit": "m", "dof": 100.0},
            "traces": {
                "run1": {
                    "time": [0.5, 1.5],
                    "low": [-0.25, -0.125],
                    "high": [0.25, 0.125],
                    "spectrum": {"frequency": [0.1, 0.2], "power": [0.75, 1.25]},
                    "quantiles": {"normal": [-0.6, 0.6], "found": [-0.7, 0.7]},
                }
            },
        }
    },
    "runs": {"run1": {"rate": 3.25, "drift": 0.0, "samples": 100, "rejected": 0}},
    "inputs": {"gravity": 9.8, "latitude": 0.7, "radius": 2.5},
    "provenance": {"version": "0", "inputs": {}},
}


def write_document(folder, document):
    path = folder / "result.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def test_complete_result_is_read(tmp_path):
    accelerometer = Result.read(write_document(tmp_path, RESULT)).accelerometers["Qx"]
    assert accelerometer.coefficients["K_II"].value == 2e-5


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"g/g^2"', '"ug/g^2"', "damaged result: K_II of Qx is in ug/g^2, not in g/g^2"),
        ('"u": 1e-09', '"u": -1.0', "damaged result: K_II of Qx is 2e-05 ± -1.0"),
        ('"value": 2e-05', '"value": 1e999', "damaged result: K_II of Qx is inf ± 1e-09"),
        ('"value": 2e-05', '"value": NaN', "or damaged (NaN is not a valid number in JSON)"),
        ('"u": 1e-09', '"u": 1e-09, "dof": 0.0', "K_II of Qx has 0.0 degrees of freedom"),
        ('"gravity": 9.8', '"gravity": 0.0', "damaged result: the gravity is 0.0 m/s^2"),
        ('"rate": 3.25', '"rate": 0.0', "damaged result: the rate of run1 is 0.0 rad/s"),
        ("-0.25, -0.125", "-0.25", "the trace of Qx in run1 are of unequal length"),
        ("0.75, 1.25", "0.75", "the trace of Qx in run1 are of unequal length"),
        ("-0.7, 0.7", "-0.7", "the trace of Qx in run1 are of unequal length"),
        (
            json.dumps(RESULT["accelerometers"]),
            "{}",
            "damaged result: the result has no accelerometers",
        ),
        (json.dumps({"K_II": K_II}), "{}", "damaged result: Qx has no coefficients"),
        ('["K_II"]', '["K_II", "K_F"]', "the correlation matrix of Qx is not one of 2 terms"),
        ('"method": "joint", ', "", "not a result file: method: is missing"),
        (json.dumps(RESULT), "[]", "not a result file: must be an object"),
    ],
)
def test_damaged_file_is_rejected(tmp_path, old, new, words):
    text = json.dumps(RESULT)
    assert old in text
    path = write_document(tmp_path, text.replace(old, new))
    with pytest.raises(RecordError) as caught:
        Result.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert words in str(caught.value)


# Results of earlier versions

FROZEN = sorted((Path(__file__).parents[1] / "frozen").glob("schema-*.json"))


WHOLE = {"weighed": [[1e-12, 0.0], [0.0, 0.0]], "held": {"K_OO": [1e-6, 0.0]}}


@pytest.mark.parametrize(
    "wrong",
    [
        {"weighed": [[1e-12, 0.0]]},
        {"held": {"K_OO": [1e-6]}},
        {"held": {"K_PP": [1e-6, 0.0]}},
    ],
)
def test_rejects_what_if_matrix_with_other_names(wrong, tmp_path):
    path = Path(__file__).parents[1] / "frozen" / "schema-2-joint.json"
    document = json.loads(path.read_text(encoding="utf-8")) | {"seal": None}
    document["accelerometers"]["Qx"]["what_if"] = {
        "names": ["K_II", "K_OO"],
        "units": ["g/g^2", "g/g^2"],
        "known": {"K_OO": 2e-6},
        **WHOLE,
    }
    assert Result.read(write_document(tmp_path, document)).accelerometers["Qx"].what_if.held
    document["accelerometers"]["Qx"]["what_if"] |= wrong
    with raises("file-damaged", "what_if", "Qx"):
        Result.read(write_document(tmp_path, document))


def test_all_schemas_have_frozen_examples():
    assert {int(path.name.split("-")[1]) for path in FROZEN} == set(
        range(1, Result.newest_schema() + 1)
    )


def contains_document(old, new):
    """Return whether a document contains all values of an older document."""
    if isinstance(old, dict):
        return all(key in new and contains_document(value, new[key]) for key, value in old.items())
    if isinstance(old, list):
        return len(old) == len(new) and all(map(contains_document, old, new))
    return old == new


@pytest.mark.parametrize("path", FROZEN, ids=lambda path: path.stem)
def test_earlier_results_are_read_completely(path):
    old = json.loads(path.read_text(encoding="utf-8"))
    read = Result.read(path)
    actual_old = old if old["schema"] == Result.newest_schema() else upgrade_document(old)
    # Written again, it has newer fields as null and a new seal.
    actual_old = {key: value for key, value in actual_old.items() if key != "seal"}
    assert contains_document(actual_old, json.loads(read.to_json()))
    for name, actual_accelerometer in read.accelerometers.items():
        stated = old["accelerometers"][name]["coefficients"]["K_II"]
        assert (
            actual_accelerometer.coefficients["K_II"].value,
            actual_accelerometer.coefficients["K_II"].u,
        ) == (
            stated["value"],
            stated["u"],
        )
    # Fields unknown to the old version are empty.
    assert all(not accelerometer.conformity for accelerometer in read.accelerometers.values())


def test_contains_document_detects_lost_numbers():
    assert contains_document({"a": [1.0, {"b": 2}]}, {"a": [1.0, {"b": 2, "new": 3}]})
    assert not contains_document({"a": [1.0]}, {"a": [1.1]})
    assert not contains_document({"a": 1}, {"b": 1})


def test_newer_schema_is_rejected(tmp_path):
    path = write_document(tmp_path, RESULT | {"schema": Result.newest_schema() + 1})
    with raises("newer-version", "schema"):
        Result.read(path)


@pytest.mark.parametrize(("removed", "warnings"), [([], 0), (["seal"], 1)])
def test_report_warns_of_missing_seal(tmp_path, removed, warnings):
    path = Path(__file__).parents[1] / "frozen" / "schema-2-joint.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    kept = {key: value for key, value in document.items() if key not in removed}
    result = Result.read(write_document(tmp_path, kept))
    result.write_report(tmp_path / "report.md")
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    screen = "\n".join(block.text for block in result.blocks() if isinstance(block, Paragraph))
    for text in (report, screen):
        assert text.count("The file of this result has no seal") == warnings
