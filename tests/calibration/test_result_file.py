"""Upgrade of results from schema 1 to schema 2: components of the uncertainty."""

import copy
import json
import math
from pathlib import Path

import pytest
from results import make_coefficient, make_qx_result

from counterspin.calibration.result import Result
from counterspin.calibration.result_file import find_faults, upgrade_document
from counterspin.errors import RecordError

FROZEN = Path(__file__).parents[1] / "frozen"
FILES = [FROZEN / "schema-1-joint.json", FROZEN / "schema-1-two-stage.json"]
REPEAT = FROZEN / "repeat" / "result.json"

#: Suffix of a budget line in schema 1 -> its kind.
KINDS = {" (prior)": "stated", " (considered)": "held", " (input)": "held", " (encoder)": "noise"}


def read_document(path):
    return json.loads(path.read_text(encoding="utf-8"))


def coefficient_pairs(old, new):
    """Yield pairs of old and new coefficients with components of u."""
    if isinstance(old, dict):
        if "u_prior" in old:
            yield old, new
        for key in set(old) & set(new):
            yield from coefficient_pairs(old[key], new[key])


@pytest.mark.parametrize("path", [*FILES, REPEAT], ids=lambda path: path.stem)
def test_components_of_u_are_renamed(path):
    old = read_document(path)
    new = upgrade_document(copy.deepcopy(old))
    pairs = list(coefficient_pairs(old, new))
    assert len(pairs) >= 2
    for before, after in pairs:
        assert not {"u_prior", "u_considered", "u_typical"} & set(after)
        assert [after[key] for key in ("value", "u", "u_noise")] == [
            before[key] for key in ("value", "u", "u_noise")
        ]
        if before["u_prior"] is None:
            assert (after["u_stated"], after["u_unstated"]) == (None, None)
        else:
            stated = math.hypot(before["u_prior"], before["u_considered"])
            assert (after["u_stated"], after["u_unstated"]) == (stated, 0.0)
            whole = math.hypot(after["u_noise"], stated)
            assert after["u"] == pytest.approx(whole, rel=1e-9)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_budget_lines_have_kind(path):
    old = read_document(path)
    new = upgrade_document(copy.deepcopy(old))
    seen = set()
    for name, own in old["accelerometers"].items():
        for symbol, lines in own.get("budget", {}).items():
            upgraded_lines = new["accelerometers"][name]["budget"][symbol]
            for line, now in zip(lines, upgraded_lines, strict=True):
                ending = next((e for e in KINDS if line["source"].endswith(e)), "")
                assert now["source"] == line["source"].removesuffix(ending)
                assert now["kind"] == KINDS.get(ending, "noise")
                seen.add(now["kind"])
                assert {**now, "source": 0, "kind": 0} == {**line, "source": 0, "kind": 0}
    assert seen == ({"noise", "stated", "held"} if "joint" in path.stem else set())


def test_inputs_and_rotations_are_held_or_noise():
    document = read_document(FILES[0])
    lines = document["accelerometers"]["Qx"]["budget"]["K_II"]
    lines[0]["source"], lines[1]["source"] = "centrifuge.radius (input)", "run1.angle (encoder)"
    new = upgrade_document(document)["accelerometers"]["Qx"]["budget"]["K_II"]
    sources_and_kinds = [(line["source"], line["kind"]) for line in new[:2]]
    assert sources_and_kinds == [("centrifuge.radius", "held"), ("run1.angle", "noise")]


def test_omitted_terms_are_assumed():
    left_out = read_document(REPEAT)["accelerometers"]["A"]["left_out"]
    assert Result.read(REPEAT).assumed == list(left_out)
    assert {"K_PP", "head.zero", "site.latitude"} <= set(left_out)
    # Terms omitted by either accelerometer, named once.
    both = read_document(FILES[0])["accelerometers"].values()
    assumed = Result.read(FILES[0]).assumed
    assert set(assumed) == {symbol for own in both for symbol in own["left_out"]}
    assert len(assumed) == len(set(assumed))


@pytest.mark.parametrize("path", [*FILES, REPEAT], ids=lambda path: path.stem)
def test_result_is_written_with_schema_2(path, tmp_path):
    result = Result.read(path)
    assert (result.schema_version, result.assumes_all) == (2, True)
    result.write(tmp_path / "again.json")
    again = Result.read(tmp_path / "again.json")
    assert again == result
    assert not again.assumes_all


DAMAGE = [
    ("accelerometers", [], "accelerometers: must be an object"),
    ("accelerometers", {"Qx": 3}, "accelerometers: Qx: must be an object"),
    ("runs", None, "runs: must be an object"),
    ("platform", {"platform.drift.north": {"u_prior": "much"}}, "platform: platform.drift.north: "),
    ("platform", [{"u_prior": 1.0}], "platform: must be an object"),
]
OF_QX = [
    ("budget", [], "budget: must be an object"),
    ("budget", {"K_II": 3}, "budget: K_II: must be a list"),
    ("budget", {"K_II": [3]}, "budget: K_II: 0: must be an object"),
    ("budget", {"K_II": [{"source": 3}]}, "budget: K_II: 0: source: must be a string"),
    ("budget", {"K_II": [{"u": 1.0}]}, "budget: K_II: 0: source: is missing"),
    ("coefficients", {"K_II": {"u_considered": []}}, "coefficients: K_II: "),
    ("coefficients", 3, "coefficients: must be an object"),
]


@pytest.mark.parametrize(
    ("owner", "key", "value", "words"),
    [*(("", *case) for case in DAMAGE), *(("Qx", *case) for case in OF_QX)],
)
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_damaged_result_of_schema_1_is_rejected(path, owner, key, value, words, tmp_path):
    document = read_document(path)
    place = document["accelerometers"][owner] if owner else document
    place[key] = value
    spoilt = tmp_path / "r.json"
    spoilt.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(RecordError) as caught:
        Result.read(spoilt)
    assert f"{spoilt}: not a result file: " in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize("value", [None, "", 3, [], {}])
def test_empty_omitted_terms_are_accepted(value):
    document = read_document(REPEAT)
    document["accelerometers"]["A"]["left_out"] = value
    assert upgrade_document(document)["assumed"] == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"state": "contradicted"}, "the state of Qx is contradicted, but no finding gives the"),
        ({"state": "not-determined"}, "the state of Qx is not-determined, but no finding gives"),
        (
            {"correlation": {"terms": ["K_F", "K_II"], "matrix": [[1.0, 5.0], [5.0, 1.0]]}},
            "the correlation matrix of Qx is not symmetric, or has an element beyond 1",
        ),
        (
            {"correlation": {"terms": ["K_F", "K_II"], "matrix": [[1.0, 0.2], [0.1, 1.0]]}},
            "the correlation matrix of Qx is not symmetric",
        ),
        (
            {"coefficients": {"K_II": make_coefficient(2.7e-5, None, "g/g^2")}},
            "K_II of Qx has a value without u, or u without a value",
        ),
    ],
)
def test_contradictory_parts_are_named(changes, words):
    assert list(find_faults(make_qx_result())) == []
    faults = list(find_faults(make_qx_result(**changes)))
    assert any(words in fault for fault in faults)


def test_contradicted_result_has_finding():
    result = make_qx_result().model_copy(update={"state": "contradicted"})
    assert "the state is contradicted, but no finding gives the reason" in find_faults(result)
