"""Results, certificates and amendments come into the ledger, with their checksums and reasons."""

import contextlib
import hashlib
import os
import subprocess
import sys
from itertools import count

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from results import remove_seal, result
from signing_keys import write_pair

from certificates import LAB, write_lab
from counterspin import cli
from counterspin.certificates.certificate_reader import read_document
from counterspin.certificates.ledger import verify_ledger

KEPT = LAB.replace('language = "de"', 'ledger = "ledger.jsonl"')


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800000000")  # 2027-01-15
    result().write("r.json")
    write_lab(tmp_path, KEPT)
    return tmp_path


def run(*words):
    return cli.main(["certificate", *words])


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_result_its_certificate_and_the_amendment(desk, capsys):
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    why = ("--amends", "a.xml", "--reason", "The customer has moved.")
    assert run("r.json", "LAB.toml", "-o", "b.pdf", *why) == 0
    found = verify_ledger(desk / "ledger.jsonl").entries
    assert [entry.what for entry in found] == ["result", "certificate", "amendment"]
    assert found[0].of == {"file": "r.json", "sha256": digest(desk / "r.json")}
    assert found[1].of["sha256"] == found[1].of["file_sha256"] == digest(desk / "a.xml")
    assert found[1].of["result"] == digest(desk / "r.json")
    assert found[2].of["file_sha256"] == digest(desk / "b.pdf")
    assert found[2].of["amends"] == found[1].of["identifier"]
    assert (found[2].why, found[2].who) == ("The customer has moved.", "A. Erste")
    assert found[1].when == "2027-01-15T08:00:00Z"
    capsys.readouterr()
    assert cli.main(["ledger", "verify", "ledger.jsonl"]) == 0
    assert found[2].digest in capsys.readouterr().out
    more = ("--who", "B. Zweite", "--why", "once more")
    assert cli.main(["ledger", "add", "ledger.jsonl", "r.json", *more]) == 0
    assert verify_ledger(desk / "ledger.jsonl").entries[3].who == "B. Zweite"


def test_what_cannot_be_entered_is_not_issued(desk, capsys):
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    ledger = desk / "ledger.jsonl"
    ledger.write_bytes(ledger.read_bytes().replace(b"r.json", b"s.json"))
    assert run("r.json", "LAB.toml", "-o", "b.xml") == 1
    assert "entry 1 was altered" in capsys.readouterr().err
    assert cli.main(["ledger", "verify", "ledger.jsonl"]) == 1
    assert run("r.json", "LAB.toml", "-o", "b.xml", "--ledger", "no/ledger.jsonl") == 1
    assert not (desk / "b.xml").exists()


def test_a_draft_is_not_entered(desk):
    assert run("--init", "mine.toml") == 0
    assert run("r.json", "mine.toml", "-o", "draft.xml", "--ledger", "other.jsonl") == 0
    assert not (desk / "other.jsonl").exists()


def test_wrong_words_and_an_unfinished_line_are_told(desk, capsys):
    assert cli.main(["ledger", "add", "ledger.jsonl", "r.json"]) == 2
    assert cli.main(["ledger", "verify", "ledger.jsonl", "r.json"]) == 2
    assert "give only the ledger" in capsys.readouterr().err
    more = ("--who", "B", "--why", "w")
    assert cli.main(["ledger", "add", "ledger.jsonl", "none.json", *more]) == 1
    assert not (desk / "ledger.jsonl").exists()
    assert cli.main(["ledger", "add", "ledger.jsonl", "r.json", *more]) == 0
    with (desk / "ledger.jsonl").open("ab") as file:
        file.write(b'{"number"')
    capsys.readouterr()
    assert cli.main(["ledger", "verify", "ledger.jsonl"]) == 1
    error = capsys.readouterr().err
    assert "entry 1 " in error
    assert " 9 bytes" in error


class KilledError(BaseException):
    """Nothing catches it but the test."""


@pytest.fixture
def killed(monkeypatch):
    """Return a function that runs a command which is killed before it calls a function."""

    def kill(name, *words):
        def die(*_, **__):
            raise KilledError

        with monkeypatch.context() as patched:
            patched.setattr(f"counterspin.certificates.ledger.{name}", die)
            with pytest.raises(KilledError):
                run(*words)

    return kill


@pytest.mark.parametrize("moment", ["write_whole", "_append_entry", "finish"])
def test_a_certificate_that_stands_is_in_its_ledger_wherever_it_was_killed(desk, killed, moment):
    words = ("r.json", "LAB.toml", "-o", "a.xml")
    killed(moment, *words)
    assert not (desk / "a.xml").exists()
    assert run(*words) == 0
    found = verify_ledger(desk / "ledger.jsonl").entries
    assert [entry.what for entry in found] == ["result", "certificate"]
    assert found[1].of["file_sha256"] == digest(desk / "a.xml")
    assert not [path for path in desk.iterdir() if path.name.startswith(".")]


def test_one_entered_on_another_day_is_found_and_told(desk, killed, monkeypatch, capsys):
    words = ("r.json", "LAB.toml", "-o", "a.xml")
    killed("finish", *words)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800086400")  # the day after
    assert run(*words) == 0
    assert "by a command that was then interrupted" in capsys.readouterr().out
    found = verify_ledger(desk / "ledger.jsonl").entries
    assert [entry.of["file_sha256"] for entry in found[1:]] == [digest(desk / "a.xml")]
    assert b"2027-01-15" in (desk / "a.xml").read_bytes()


def test_a_missing_seal_is_entered_with_the_result(desk):
    remove_seal(desk / "r.json")
    words = ("--who", "B. Zweite", "--why", "yearly")
    assert cli.main(["ledger", "add", "ledger.jsonl", "r.json", *words]) == 0
    assert verify_ledger(desk / "ledger.jsonl").entries[0].why == "yearly; the file has no seal"


def test_only_the_issued_file_of_an_entered_certificate_is_amended(desk, capsys):
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    issued = (desk / "a.xml").read_bytes()
    (desk / "a.xml").write_bytes(issued.replace(b"A. Erste", b"A. Zweit"))
    why = ("--amends", "a.xml", "--reason", "The customer has moved.")
    assert run("r.json", "LAB.toml", "-o", "b.xml", *why) == 1
    complaint = " ".join(capsys.readouterr().err.split())
    assert "the file to be amended was changed after it was issued" in complaint
    assert not (desk / "b.xml").exists()
    (desk / "a.xml").write_bytes(issued)
    assert run("r.json", "LAB.toml", "-o", "b.xml", *why) == 0
    amendment = verify_ledger(desk / "ledger.jsonl").entries[-1]
    assert amendment.of["amends_sha256"] == digest(desk / "a.xml")


@pytest.mark.slow
@pytest.mark.parametrize("lab", [KEPT, LAB], ids=["ledger", "no ledger"])
@pytest.mark.parametrize("link", range(1, 6))
def test_both_files_of_an_interrupted_command_are_completed(desk, monkeypatch, lab, link):
    # Killed before each name is given, and repeated on another day, with another signature.
    write_lab(desk, lab)
    key, cert = write_pair(desk / "k", ec.generate_private_key(ec.SECP256R1()))
    words = ("r.json", "LAB.toml", "-o", "a.pdf", "--both", "--key", str(key), "--cert", str(cert))
    with monkeypatch.context() as patched:
        patched.setattr(os, "link", dying(os.link, link))
        with contextlib.suppress(KilledError):
            run(*words)
    whole = [(desk / name).is_file() for name in ("a.xml", "a.pdf")]
    before = (desk / "a.xml").read_bytes() if whole[0] else None
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800086400")  # the day after
    assert run(*words) == (1 if all(whole) else 0)
    assert before in (None, (desk / "a.xml").read_bytes())
    assert read_document(desk / "a.pdf") == (desk / "a.xml").read_bytes()
    for name in ("a.xml", "a.pdf"):
        assert run("--verify", name, "--cert", str(cert)) == 0
    if lab == KEPT:
        found = verify_ledger(desk / "ledger.jsonl").entries[1:]
        assert [e.of["file_sha256"] for e in found] == [
            digest(desk / n) for n in ("a.xml", "a.pdf")
        ]
    assert not [path for path in desk.iterdir() if path.name.startswith(".")]


def dying(function, call):
    """Return a function that raises KilledError at one of its calls."""
    calls = count(1)

    def called(*words):
        if next(calls) == call:
            raise KilledError
        return function(*words)

    return called


def test_the_pdf_of_another_xml_is_not_completed(desk, capsys):
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    words = ("r.json", "LAB.toml", "-o", "a.xml", "--both")
    assert run(*words) == 1
    assert "a.xml exists, but its PDF" in capsys.readouterr().err
    assert not (desk / "a.pdf").exists()


def test_an_identifier_stands_for_one_content(desk, monkeypatch, capsys):
    write_lab(desk, KEPT.replace("[certificate]", '[certificate]\nidentifier = "K 7"'))
    assert run("r.json", "LAB.toml", "-o", "a.xml") == 0
    # The same in another form, and in another place.
    assert run("r.json", "LAB.toml", "-o", "a.pdf") == 0
    assert run("r.json", "LAB.toml", "-o", "b.xml") == 0
    found = verify_ledger(desk / "ledger.jsonl").entries
    assert [entry.of.get("file") for entry in found] == ["r.json", "a.xml", "a.pdf", "b.xml"]
    assert len({entry.of["sha256"] for entry in found[1:]}) == 1
    capsys.readouterr()
    result(serial_number="Q-105").write("r.json", overwrite=True)
    assert run("r.json", "LAB.toml", "-o", "c.xml") == 1
    told = " ".join(capsys.readouterr().err.split())
    assert "already contains certificate K 7 (entry 4), with different content" in told
    assert not (desk / "c.xml").exists()
    assert verify_ledger(desk / "ledger.jsonl").entries == found


def test_two_at_once_make_one_certificate(desk):
    """As two labs' files with one identifier and one output."""
    program = (
        "import sys; from counterspin import cli; sys.stdin.readline()\n"
        "sys.exit(cli.main(['certificate', 'r.json', sys.argv[1], '-o', 'a.xml']))"
    )
    other = KEPT.replace("[certificate]", '[certificate]\nidentifier = "K 7"')
    for name, place in (("one.toml", "Ort"), ("two.toml", "Stadt")):
        (desk / name).write_text(other.replace("Ort", place), encoding="utf-8")
    both = [
        subprocess.Popen(
            [sys.executable, "-c", program, name],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for name in ("one.toml", "two.toml")
    ]
    for process in both:
        process.communicate(b"\n")
    assert sorted(process.returncode for process in both) == [0, 1]
    found = verify_ledger(desk / "ledger.jsonl").entries
    assert [entry.of["file_sha256"] for entry in found[1:]] == [digest(desk / "a.xml")]
