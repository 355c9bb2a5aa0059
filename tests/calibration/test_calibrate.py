"""Calibration of a campaign folder: the provenance states the files that were read."""

import hashlib
import shutil

import polars as pl
import pytest
from campaigns import SMALL, replace_parts, write_and_read_campaign, write_description
from raising import raises

from counterspin.calibration import observed_runs
from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.checksums import Checksums
from counterspin.simulation.simulate import simulate


def checksum(file):
    return f"sha256:{hashlib.sha256(file.read_bytes()).hexdigest()}"


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    folder = tmp_path_factory.mktemp("records")
    simulate(write_and_read_campaign(folder, SMALL), folder)
    return folder


@pytest.fixture
def folder(records, tmp_path):
    return shutil.copytree(records, tmp_path / "campaign")


def test_folder_name_is_not_a_glob_pattern(records, tmp_path):
    # A second folder, which the pattern would match, has other records.
    folder = shutil.copytree(records, tmp_path / "camp[1]")
    other = write_and_read_campaign(tmp_path / "camp1", replace_parts(SMALL, ("2.7e-5", "9e-5")))
    simulate(other, tmp_path / "camp1")
    result = calibrate(folder)
    assert result.accelerometers["Qx"].coefficients["K_II"].value == pytest.approx(2.7e-5, abs=1e-6)
    assert result.provenance.inputs["slow.csv"] == checksum(folder / "slow.csv")


@pytest.mark.parametrize("changed_when", ["after its checksum", "before its checksum"])
def test_rejects_record_that_changes_during_calibration(folder, monkeypatch, changed_when):
    record, read = folder / "fast.csv", observed_runs.read_record
    early = changed_when == "after its checksum"

    def shorten_record():
        text = record.read_text("utf-8").splitlines()
        record.write_text("\n".join(text[:-1]) + "\n", "utf-8")

    def read_and_change(path, *arguments):
        if path == record and early:
            shorten_record()
        result = read(path, *arguments)
        if path == record and not early:
            shorten_record()
        return result

    monkeypatch.setattr(observed_runs, "read_record", read_and_change)
    # Checksums are computed in a thread; in this test immediately or at the end.
    expect = (lambda self, _: self.checksums([record]) and []) if early else (lambda *_: [])
    monkeypatch.setattr(Checksums, "prefetch", expect)
    with raises("file-changed", "fast.csv:"):
        calibrate(folder)


def test_checksum_of_description_is_of_text_read(folder):
    campaign = write_and_read_campaign(folder, SMALL)
    before = checksum(campaign.path)
    write_description(folder, SMALL + "\n# an afterthought\n")
    assert calibrate(campaign).provenance.inputs["campaign.toml"] == before


def test_record_shorter_than_stated_is_finding(folder):
    stated = replace_parts(SMALL, ('record = "slow.csv"', 'record = "slow.csv"\nduration = "80 s"'))
    assert "short-record" not in {
        f.code for f in calibrate(write_and_read_campaign(folder, stated)).findings
    }
    short = replace_parts(SMALL, ('record = "slow.csv"', 'record = "slow.csv"\nduration = "160 s"'))
    (finding,) = (
        f
        for f in calibrate(write_and_read_campaign(folder, short)).findings
        if f.code == "short-record"
    )
    assert finding.subject == "slow"
    assert "the record lasts 80 s instead of the 160 s stated in the campaign" in finding.text


@pytest.mark.parametrize("part", ["", 'stop = "60 s"\n'])
def test_record_longer_than_stated_has_remark(folder, part):
    """The duration does not select a part of the record."""
    line = 'record = "slow.csv"\n'
    stated = replace_parts(SMALL, (line, f'{line}duration = "40 s"\n{part}'))
    result = calibrate(write_and_read_campaign(folder, stated))
    remarks = [text for text in result.warnings if "stated as duration" in text]
    assert remarks == [] if part else len(remarks) == 1
    for text in remarks:
        assert text.startswith("slow: the record lasts 80 s instead of the 40 s")
        assert "enter start or stop in the run" in text


def test_isolated_row_is_finding_and_does_not_change_result(folder):
    before = calibrate(folder).accelerometers["Qx"].coefficients["K_II"]
    record = pl.read_csv(folder / "slow.csv")
    stray = record.tail(1).with_columns(
        pl.col("time_s") + 40.0, pl.col("angle_rad") + 0.5 * 3.141592653589793 * 40.0
    )
    pl.concat([record, stray]).write_csv(folder / "slow.csv")
    result = calibrate(folder)
    (finding,) = (f for f in result.findings if f.code == "lone-rows")
    assert (finding.subject, finding.size) == ("slow", 1)
    assert result.accelerometers["Qx"].coefficients["K_II"].value == before.value
