"""Campaigns in memory: same results as from files, and complete provenance."""

import hashlib
import shlex
from dataclasses import replace

import frames
import polars as pl
import pytest
from raising import raises

from counterspin import cli
from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.pages.document import full_report_blocks
from counterspin.calibration.result import Result
from counterspin.campaign.description import read_campaign
from counterspin.campaign.memory import make_campaign


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    return frames.simulate_columns(tmp_path_factory.mktemp("records"))


@pytest.fixture(scope="module")
def memory_campaign(records):
    return make_campaign(frames.parse_description_without_truth(), records)


@pytest.fixture(scope="module")
def memory_result(memory_campaign):
    return calibrate(memory_campaign)


@pytest.fixture(scope="module")
def written_folder(memory_campaign, tmp_path_factory):
    folder = tmp_path_factory.mktemp("written") / "campaign"
    memory_campaign.write(folder)
    return folder


def block_texts(result):
    return [block.text for block in full_report_blocks(result) if hasattr(block, "text")]


def test_folder_has_identical_result(memory_result, written_folder):
    again = calibrate(written_folder)
    for part in ("accelerometers", "runs", "platform", "inputs"):
        assert getattr(again, part) == getattr(memory_result, part), part


def test_frames_and_arrays_give_same_result(memory_result, records):
    framed = {name: pl.DataFrame(dict(columns)) for name, columns in records.items()}
    again = calibrate(make_campaign(frames.parse_description_without_truth(), framed))
    assert again.accelerometers == memory_result.accelerometers
    assert again.provenance == memory_result.provenance


def test_provenance_states_inputs_in_memory(
    memory_result, memory_campaign, written_folder, records
):
    provenance = memory_result.provenance
    assert provenance.in_memory == {
        "campaign.toml": "made in Python",
        "slow.parquet": "arrays",
        "middle.parquet": "arrays",
        "fast.parquet": "arrays",
    }
    of_text = hashlib.sha256((written_folder / "campaign.toml").read_bytes()).hexdigest()
    assert provenance.inputs["campaign.toml"] == f"sha256:{of_text}"
    digest = hashlib.sha256()
    for name, values in records["slow"].items():
        digest.update(name.encode() + b"\0" + values.tobytes())
    assert provenance.inputs["slow.parquet"] == f"sha256:{digest.hexdigest()}"
    text = " ".join(block_texts(memory_result))
    assert (
        "some inputs are not files: campaign.toml (made in Python); slow.parquet (arrays)" in text
    )
    assert "counterspin calibrate" not in text


def test_changed_description_is_marked_with_new_checksum(written_folder):
    campaign = read_campaign(written_folder)
    plain, changed = (
        calibrate(c).provenance
        for c in (campaign, campaign.change({"centrifuge": {"radius": "2.6 m"}}))
    )
    assert plain.in_memory == {}
    assert changed.in_memory == {"campaign.toml": "changed: centrifuge.radius"}
    assert changed.inputs["campaign.toml"] != plain.inputs["campaign.toml"]
    assert changed.inputs["slow.parquet"] == plain.inputs["slow.parquet"]


def test_replaced_field_is_marked_as_changed(memory_campaign, memory_result):
    other = calibrate(replace(memory_campaign, noise=None)).provenance
    assert other.in_memory["campaign.toml"] == "changed"
    assert other.inputs["campaign.toml"] != memory_result.provenance.inputs["campaign.toml"]
    same = calibrate(replace(memory_campaign)).provenance
    again = calibrate(replace(memory_campaign)).provenance
    assert same == again != other


@pytest.mark.parametrize("name", ["campaign.toml", "my campaign.toml"])
def test_command_in_report_reproduces_result(written_folder, tmp_path, monkeypatch, name):
    folder = tmp_path / "elsewhere"
    read_campaign(written_folder).write(folder)
    (folder / "campaign.toml").rename(folder / name)
    first = calibrate(folder / name)
    (command,) = (b.text for b in full_report_blocks(first) if getattr(b, "style", "") == "command")
    monkeypatch.chdir(folder)
    assert cli.main([*shlex.split(command)[1:], "--json=again.json"]) == 0
    assert Result.read(folder / "again.json") == first


def test_duplicate_record_names_runs(records):
    twice = {**records, "fast": records["slow"]}
    description = frames.parse_description_without_truth()
    description["runs"][2]["rate"] = description["runs"][0]["rate"]
    with raises("duplicate-record", "fast", "slow"):
        calibrate(make_campaign(description, twice))
