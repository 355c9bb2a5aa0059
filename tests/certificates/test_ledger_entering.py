"""Entries of results, certificates and amendments in the ledger."""

import contextlib
import hashlib
import os
import subprocess
import sys
from itertools import count

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from results import make_qx_result, remove_seal
from signing_keys import write_pair

from certificates import LAB, write_lab
from counterspin import cli
from counterspin.certificates.certificate_reader import read_document
from counterspin.certificates.ledger import verify_ledger

KEPT = LAB.replace('language = "de"', 'ledger = "ledger.jsonl"')


@pytest.fixture
def ledger_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800000000")  # 2027-01-15
    make_qx_result().write("r.json")
    write_lab(tmp_path, KEPT)
    return tmp_path


def run(*arguments):
    return cli.main(["certificate", *arguments])


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_result_certificate_and_amendment_are_entered(ledger_folder, capsys):
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    amendment_options = ("--amends", "a.xml", "--reason", "The customer has moved.")
    assert run("r.json", "LAB.toml", "-o", "b.pdf", *amendment_options) == 0
    entries = verify_ledger(ledger_folder / "ledger.jsonl").entries
    assert [entry.entry_type for entry in entries] == ["result", "certificate", "amendment"]
    assert entries[0].subject == {"file": "r.json", "sha256": digest(ledger_folder / "r.json")}
    assert (
        entries[1].subject["sha256"]
        == entries[1].subject["file_sha256"]
        == digest(ledger_folder / "a.xml")
    )
    assert entries[1].subject["result"] == digest(ledger_folder / "r.json")
    assert entries[2].subject["file_sha256"] == digest(ledger_folder / "b.pdf")
    assert entries[2].subject["amends"] == entries[1].subject["identifier"]
    assert (entries[2].why, entries[2].who) == ("The customer has moved.", "A. Erste")
    assert entries[1].when == "2027-01-15T08:00:00Z"
    capsys.readouterr()
    assert cli.main(["ledger", "verify", "ledger.jsonl"]) == 0
    assert entries[2].digest in capsys.readouterr().out
    entry_options = ("--who", "B. Zweite", "--why", "once more")
    assert cli.main(["ledger", "add", "ledger.jsonl", "r.json", *entry_options]) == 0
    assert verify_ledger(ledger_folder / "ledger.jsonl").entries[3].who == "B. Zweite"


def test_certificate_is_not_issued_if_ledger_is_invalid(ledger_folder, capsys):
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    ledger = ledger_folder / "ledger.jsonl"
    ledger.write_bytes(ledger.read_bytes().replace(b"r.json", b"s.json"))
    assert run("r.json", "LAB.toml", "-o", "b.xml") == 1
    assert "entry 1 was altered" in capsys.readouterr().err
    assert cli.main(["ledger", "verify", "ledger.jsonl"]) == 1
    assert run("r.json", "LAB.toml", "-o", "b.xml", "--ledger", "no/ledger.jsonl") == 1
    assert not (ledger_folder / "b.xml").exists()


def test_draft_is_not_entered(ledger_folder):
    assert run("--init", "mine.toml") == 0
    assert run("r.json", "mine.toml", "-o", "draft.xml", "--ledger", "other.jsonl") == 0
    assert not (ledger_folder / "other.jsonl").exists()


def test_wrong_usage_and_partial_entry_are_reported(ledger_folder, capsys):
    assert cli.main(["ledger", "add", "ledger.jsonl", "r.json"]) == 2
    assert cli.main(["ledger", "verify", "ledger.jsonl", "r.json"]) == 2
    assert "verify does not accept result files" in capsys.readouterr().err
    entry_options = ("--who", "B", "--why", "w")
    assert cli.main(["ledger", "add", "ledger.jsonl", "none.json", *entry_options]) == 1
    assert not (ledger_folder / "ledger.jsonl").exists()
    assert cli.main(["ledger", "add", "ledger.jsonl", "r.json", *entry_options]) == 0
    with (ledger_folder / "ledger.jsonl").open("ab") as file:
        file.write(b'{"number"')
    capsys.readouterr()
    assert cli.main(["ledger", "verify", "ledger.jsonl"]) == 1
    error = capsys.readouterr().err
    assert "entry 1 " in error
    assert " 9 bytes" in error


class KilledError(BaseException):
    """An exception that only the test catches."""


@pytest.fixture
def run_killed(monkeypatch):
    """Return a function that runs a command and kills it before a function call."""

    def kill(name, *arguments):
        def raise_killed(*_, **__):
            raise KilledError

        with monkeypatch.context() as patched:
            patched.setattr(f"counterspin.certificates.ledger.{name}", raise_killed)
            with pytest.raises(KilledError):
                run(*arguments)

    return kill


@pytest.mark.parametrize(
    "moment", ["write_atomically", "_append_certificate_entry", "move_into_place"]
)
def test_killed_command_leaves_no_certificate_without_entry(ledger_folder, run_killed, moment):
    arguments = ("r.json", "LAB.toml", "-o", "a.xml")
    run_killed(moment, *arguments)
    assert not (ledger_folder / "a.xml").exists()
    assert run(*arguments) == 0
    entries = verify_ledger(ledger_folder / "ledger.jsonl").entries
    assert [entry.entry_type for entry in entries] == ["result", "certificate"]
    assert entries[1].subject["file_sha256"] == digest(ledger_folder / "a.xml")
    assert not [path for path in ledger_folder.iterdir() if path.name.startswith(".")]


def test_interrupted_certificate_is_completed_on_later_day(
    ledger_folder, run_killed, monkeypatch, capsys
):
    arguments = ("r.json", "LAB.toml", "-o", "a.xml")
    run_killed("move_into_place", *arguments)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800086400")  # the day after
    assert run(*arguments) == 0
    output = capsys.readouterr().out
    assert "but was then interrupted" in output
    assert "the certificate of that entry (number 2)" in " ".join(output.split())
    entries = verify_ledger(ledger_folder / "ledger.jsonl").entries
    assert [entry.subject["file_sha256"] for entry in entries[1:]] == [
        digest(ledger_folder / "a.xml")
    ]
    assert b"2027-01-15" in (ledger_folder / "a.xml").read_bytes()


def test_missing_seal_is_entered_with_result(ledger_folder):
    remove_seal(ledger_folder / "r.json")
    entry_options = ("--who", "B. Zweite", "--why", "yearly")
    assert cli.main(["ledger", "add", "ledger.jsonl", "r.json", *entry_options]) == 0
    assert (
        verify_ledger(ledger_folder / "ledger.jsonl").entries[0].why
        == "yearly; the file has no seal"
    )


def test_changed_file_of_entered_certificate_cannot_be_amended(ledger_folder, capsys):
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    issued = (ledger_folder / "a.xml").read_bytes()
    (ledger_folder / "a.xml").write_bytes(issued.replace(b"A. Erste", b"A. Zweit"))
    amendment_options = ("--amends", "a.xml", "--reason", "The customer has moved.")
    assert run("r.json", "LAB.toml", "-o", "b.xml", *amendment_options) == 1
    message = " ".join(capsys.readouterr().err.split())
    assert "the file to be amended was changed after it was issued" in message
    assert not (ledger_folder / "b.xml").exists()
    (ledger_folder / "a.xml").write_bytes(issued)
    assert run("r.json", "LAB.toml", "-o", "b.xml", *amendment_options) == 0
    amendment = verify_ledger(ledger_folder / "ledger.jsonl").entries[-1]
    assert amendment.subject["amends_sha256"] == digest(ledger_folder / "a.xml")


@pytest.mark.slow
@pytest.mark.parametrize("lab", [KEPT, LAB], ids=["ledger", "no ledger"])
@pytest.mark.parametrize("link", range(1, 6))
def test_interrupted_command_completes_both_files(ledger_folder, monkeypatch, lab, link):
    # Killed before each file is named, and repeated later with another signature.
    write_lab(ledger_folder, lab)
    key, cert = write_pair(ledger_folder / "k", ec.generate_private_key(ec.SECP256R1()))
    arguments = (
        "r.json",
        "LAB.toml",
        "-o",
        "a.pdf",
        "--both",
        "--key",
        str(key),
        "--cert",
        str(cert),
    )
    with monkeypatch.context() as patched:
        patched.setattr(os, "link", kill_at_call(os.link, link))
        with contextlib.suppress(KilledError):
            run(*arguments)
    files_exist = [(ledger_folder / name).is_file() for name in ("a.xml", "a.pdf")]
    xml_before = (ledger_folder / "a.xml").read_bytes() if files_exist[0] else None
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800086400")  # the day after
    assert run(*arguments) == (1 if all(files_exist) else 0)
    assert xml_before in (None, (ledger_folder / "a.xml").read_bytes())
    assert read_document(ledger_folder / "a.pdf") == (ledger_folder / "a.xml").read_bytes()
    for name in ("a.xml", "a.pdf"):
        assert run("--verify", name, "--cert", str(cert)) == 0
    if lab == KEPT:
        entries = verify_ledger(ledger_folder / "ledger.jsonl").entries[1:]
        assert [entry.subject["file_sha256"] for entry in entries] == [
            digest(ledger_folder / n) for n in ("a.xml", "a.pdf")
        ]
    assert not [path for path in ledger_folder.iterdir() if path.name.startswith(".")]


def kill_at_call(function, call):
    """Return a function that raises KilledError at a given call."""
    calls = count(1)

    def count_call(*words):
        if next(calls) == call:
            raise KilledError
        return function(*words)

    return count_call


def test_pdf_of_other_xml_is_not_completed(ledger_folder, capsys):
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    arguments = ("r.json", "LAB.toml", "-o", "a.xml", "--both")
    assert run(*arguments) == 1
    assert "a.xml already exists, and no interrupted command left a PDF" in capsys.readouterr().err
    assert not (ledger_folder / "a.pdf").exists()


def test_identifier_is_unique_per_content(ledger_folder, monkeypatch, capsys):
    write_lab(ledger_folder, KEPT.replace("[certificate]", '[certificate]\nidentifier = "K 7"'))
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    # The same content as another file type, and under another name.
    assert run("r.json", "LAB.toml", "-o", "a.pdf") == 0
    assert run("r.json", "LAB.toml", "-o", "b.xml") == 0
    entries = verify_ledger(ledger_folder / "ledger.jsonl").entries
    assert [entry.subject.get("file") for entry in entries] == ["r.json", "a.xml", "a.pdf", "b.xml"]
    assert len({entry.subject["sha256"] for entry in entries[1:]}) == 1
    capsys.readouterr()
    make_qx_result(serial_number="Q-105").write("r.json", overwrite=True)
    assert run("r.json", "LAB.toml", "-o", "c.xml") == 1
    error = " ".join(capsys.readouterr().err.split())
    assert "already contains certificate K 7 (entry 4) with different content" in error
    assert not (ledger_folder / "c.xml").exists()
    assert verify_ledger(ledger_folder / "ledger.jsonl").entries == entries


def test_concurrent_commands_issue_one_certificate(ledger_folder):
    """Two laboratory files with the same identifier and output."""
    program = (
        "import sys; from counterspin import cli; sys.stdin.readline()\n"
        "sys.exit(cli.main(['certificate', 'r.json', sys.argv[1], '-o', 'a.xml']))"
    )
    lab_text = KEPT.replace("[certificate]", '[certificate]\nidentifier = "K 7"')
    for name, city in (("one.toml", "Ort"), ("two.toml", "Stadt")):
        (ledger_folder / name).write_text(lab_text.replace("Ort", city), encoding="utf-8")
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", program, name],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for name in ("one.toml", "two.toml")
    ]
    for process in processes:
        process.communicate(b"\n")
    assert sorted(process.returncode for process in processes) == [0, 1]
    entries = verify_ledger(ledger_folder / "ledger.jsonl").entries
    assert [entry.subject["file_sha256"] for entry in entries[1:]] == [
        digest(ledger_folder / "a.xml")
    ]
