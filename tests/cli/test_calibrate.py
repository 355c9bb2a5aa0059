"""`counterspin calibrate --ledger`: the result file is entered in the ledger."""

import hashlib

import pytest

from counterspin import cli
from counterspin.certificates.ledger import verify_ledger

TUMBLE = """schema = 1
[campaign]
title = "A tumble"
[site]
gravity = "9.8 m/s^2"
latitude = "0 deg"
[accelerometers.A]
input_axis = "up"
pendulous_axis = "east"
[model]
assume = "all"
terms = ["K_F", "K_I"]
[[runs]]
name = "up"
motion = "static"
axes = { input = "up", pendulous = "east" }
reading = "1.0021 ± 2e-6 g"
[[runs]]
name = "down"
motion = "static"
axes = { input = "down", pendulous = "east" }
reading = "-0.9979 ± 2e-6 g"
"""
WHO = ("--who", "A. Erste", "--why", "yearly calibration")


@pytest.fixture
def campaign_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800000000")  # 2027-01-15
    (tmp_path / "campaign.toml").write_text(TUMBLE, encoding="utf-8")
    return tmp_path


def run(*words):
    return cli.main(["calibrate", ".", *words])


def test_result_file_is_entered_in_ledger(campaign_folder, capsys):
    assert run("--json", "r.json", "--ledger", "ledger.jsonl", *WHO) == 0
    shown = capsys.readouterr().out
    (entry,) = verify_ledger(campaign_folder / "ledger.jsonl").entries
    digest = hashlib.sha256((campaign_folder / "r.json").read_bytes()).hexdigest()
    assert entry.subject == {"file": "r.json", "sha256": digest}
    assert (entry.entry_type, entry.who, entry.why) == ("result", "A. Erste", "yearly calibration")
    assert entry.when == "2027-01-15T08:00:00Z"
    assert f"ledger.jsonl: entry 1 is result r.json, hash {entry.digest}." in shown


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (
            ("--ledger", "l.jsonl", *WHO),
            2,
            "--ledger requires --json FILE, --who NAME and --why REASON",
        ),
        (("--json", "r.json", "--ledger", "l.jsonl"), 2, "--who NAME and --why REASON"),
        (
            ("--json", "r.json", "--ledger", "l.jsonl", "--who", " ", "--why", "yearly"),
            2,
            "--who NAME and --why REASON",
        ),
        ((".", "--details"), 2, "--budget and --details accept a single campaign only"),
        (("--json", "r.json", "--who", "B"), 2, "--who and --why require --ledger FILE"),
        (
            (".", "--json", "r.json", "--ledger", "l.jsonl", *WHO),
            2,
            "the result of a single campaign only",
        ),
        (("--json", "r.json", "--ledger", "./r.json", *WHO), 2, "name the same file"),
        (("--json", "r.json", "--ledger", "no/l.jsonl", *WHO), 1, "the folder no does not exist"),
        (("--json", "r.json", "--ledger", "altered.jsonl", *WHO), 1, "entry 1 was altered"),
    ],
)
def test_invalid_ledger_entry_raises_before_calibration(
    campaign_folder, capsys, words, status, message
):
    (campaign_folder / "altered.jsonl").write_text("{}\n")
    before = sorted(campaign_folder.iterdir())
    assert run(*words) == status
    assert message in capsys.readouterr().err
    assert sorted(campaign_folder.iterdir()) == before
