"""Repeating a result: inputs found by checksum, equal numbers, or the list of changes."""

import json
import math
import shutil
from pathlib import Path

import pytest
from campaigns import SMALL, write_description
from results import remove_seal, seal_document

import counterspin as cs
from counterspin.calibration.options import (
    TwoStageOptions,
    command_arguments,
    extra_arguments,
    parse_options,
)
from counterspin.cli import main
from counterspin.comparisons.rerun import find_changes
from counterspin.comparisons.result import RepeatedCalibration
from counterspin.errors import CampaignError, RecordError

FROZEN = Path(__file__).parents[1] / "frozen"


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Return a folder with a campaign, its records and its result."""
    folder = tmp_path_factory.mktemp("archive")
    cs.simulate(write_description(folder, SMALL, "plan.toml"), folder / "camp")
    cs.calibrate(folder / "camp").write(folder / "camp" / "result.json")
    return folder / "camp"


@pytest.fixture
def campaign_folder(archive, tmp_path):
    return Path(shutil.copytree(archive, tmp_path / "camp"))


def test_same_files_reproduce_numbers(campaign_folder, capsys, tmp_path):
    assert (
        main(
            ["rerun", str(campaign_folder / "result.json"), "--json", str(tmp_path / "again.json")]
        )
        == 0
    )
    assert "equals the original within 1e-12" in " ".join(capsys.readouterr().out.split())
    repeated = RepeatedCalibration.read(tmp_path / "again.json")
    assert repeated.same
    assert repeated.largest <= repeated.limit
    assert repeated.changes == []
    original = cs.Result.read(campaign_folder / "result.json")
    coefficient_by_name = {coefficient.name: coefficient for coefficient in repeated.coefficients}
    assert coefficient_by_name["Qx.K_II"].before == original.coefficient("Qx.K_II").value
    assert set(coefficient_by_name) >= {
        f"Qx.{symbol}" for symbol in original.accelerometers["Qx"].coefficients
    }


def test_missing_seal_is_reported(campaign_folder):
    assert cs.rerun(campaign_folder / "result.json").unsealed == []
    remove_seal(campaign_folder / "result.json")
    repeated = cs.rerun(campaign_folder / "result.json")
    assert repeated.same
    assert repeated.unsealed == [str(campaign_folder / "result.json")]
    assert "result.json has no seal" in cs.report(repeated, "md")


def test_moved_inputs_are_found_by_checksum(campaign_folder, tmp_path):
    (campaign_folder / "old").mkdir()
    (campaign_folder / "slow.csv").rename(campaign_folder / "old" / "somewhere else.csv")
    result = Path(shutil.move(campaign_folder / "result.json", tmp_path / "result.json"))
    repeated = cs.rerun(result, campaign_folder)
    assert repeated.same
    assert repeated.moved == {"slow.csv": str(campaign_folder / "old" / "somewhere else.csv")}


def test_changed_inputs_are_named_with_their_effect(campaign_folder, capsys):
    description = campaign_folder / "campaign.toml"
    text = description.read_text(encoding="utf-8")
    original = cs.Result.read(campaign_folder / "result.json")
    line = next(line for line in text.splitlines() if line.startswith("radius"))
    description.write_text(text.replace(line, 'radius = "2.5001 m"'), encoding="utf-8")
    repeated = cs.rerun(campaign_folder / "result.json")
    assert not repeated.same
    changed = {change.subject: change.values for change in repeated.changes}
    assert {"campaign.toml", "radius"} <= set(changed)
    value_now = cs.calibrate(campaign_folder).coefficient("Qx.K_II").value
    original_k_ii = original.coefficient("Qx.K_II")
    (row,) = (coefficient for coefficient in repeated.coefficients if coefficient.name == "Qx.K_II")
    assert row.in_u == pytest.approx((value_now - original_k_ii.value) / original_k_ii.u, rel=1e-9)
    assert repeated.largest_in_u >= abs(row.in_u) > 0.0
    assert main(["rerun", str(campaign_folder / "result.json")]) == 1
    output = " ".join(capsys.readouterr().out.split())
    assert "Changed: radius; campaign.toml" in output


def test_changes_have_units_of_description(campaign_folder):
    result = cs.Result.read(campaign_folder / "result.json")
    inputs = {"latitude": math.radians(48.0), "radius": 0.0}
    other = result.model_copy(update={"inputs": result.inputs.model_copy(update=inputs)})
    changes = find_changes([result, other])
    values = {change.subject: change.values[1] for change in changes}
    assert values == {"latitude": "48 deg", "radius": "-"}


def test_difference_above_rounding_is_reported(campaign_folder):
    path = campaign_folder / "result.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    document["accelerometers"]["Qx"]["coefficients"]["K_II"]["u"] *= 1.0 + 1e-11
    path.write_text(seal_document(document), encoding="utf-8")
    repeated = cs.rerun(path)
    assert not repeated.same
    assert repeated.largest == pytest.approx(1e-11, rel=1e-3)


def test_result_without_environment_can_be_repeated(campaign_folder):
    path = campaign_folder / "result.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    assert set(document["provenance"].pop("environment")) == {"python", "numpy", "scipy", "machine"}
    path.write_text(seal_document(document), encoding="utf-8")
    repeated = cs.rerun(path)
    assert repeated.same
    changed = {change.subject: change.values for change in repeated.changes}
    assert changed["numpy"][0] == "-"


def test_frozen_result_is_reproduced():
    """On any computer, rounding is far below a millionth of u."""
    repeated = cs.rerun(FROZEN / "repeat" / "result.json")
    assert repeated.largest_in_u < 1e-6
    assert {coefficient.name for coefficient in repeated.coefficients} >= {"A.K_F", "A.K_I"}
    # Four readings leave one degree of freedom, for which the old version had no finding.
    assert (repeated.state_before, repeated.state_now) == ("good", "reservations")
    assert not {"campaign.toml", "options", "method"} & {
        coefficient.subject for coefficient in repeated.changes
    }


def test_folder_may_be_its_description(campaign_folder, tmp_path):
    result = campaign_folder / "result.json"
    assert cs.rerun(result, campaign_folder / "campaign.toml").same
    with pytest.raises(RecordError, match="nowhere: folder not found"):
        cs.rerun(result, tmp_path / "nowhere")


def test_rerun_uses_stored_options(campaign_folder):
    options = TwoStageOptions(weighted=False)
    cs.calibrate(campaign_folder, method="two-stage", options=options).write(
        campaign_folder / "stages.json"
    )
    assert cs.rerun(campaign_folder / "stages.json").same
    assert not cs.rerun(campaign_folder / "result.json", campaign_folder).changes


@pytest.mark.parametrize("path", sorted(FROZEN.glob("schema-*.json")), ids=lambda path: path.stem)
def test_missing_input_is_named(path):
    with pytest.raises(RecordError, match=r"the input campaign\.toml \(sha256:"):
        cs.rerun(path)


def test_rejects_rerun_of_data_in_memory(campaign_folder, capsys):
    campaign = cs.read_campaign(campaign_folder).change({"centrifuge": {"radius": "2.6 m"}})
    cs.calibrate(campaign).write(campaign_folder / "memory.json")
    assert main(["rerun", str(campaign_folder / "memory.json")]) == 1
    assert "in memory" in capsys.readouterr().err
    with pytest.raises(RecordError, match="`folder`"):
        cs.rerun(cs.Result.read(campaign_folder / "result.json"))


def test_options_are_parsed_from_command():
    options = TwoStageOptions("as-printed", False, "ratio", False, True)
    arguments = [*command_arguments("two-stage", options), *extra_arguments(["slow"], 0)]
    assert parse_options(arguments) == ("two-stage", options, ("slow",))
    assert parse_options([]) == ("joint", TwoStageOptions(), ())
    with pytest.raises(CampaignError, match="--newer"):
        parse_options(["--newer"])
