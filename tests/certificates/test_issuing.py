"""`counterspin certificate` writes one file, whole or not at all, the same every time."""

import base64
import io
import json
import re
import shlex
import shutil
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import pypdf
import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from raising import raises
from results import result, sealed
from signing_keys import write_pair, write_pkcs12

from certificates import LAB, find, write_lab
from counterspin import cli
from counterspin.calibration.findings import judge_result
from counterspin.calibration.result import Result
from counterspin.certificates.certificate_reader import read_certificate, read_document
from counterspin.certificates.issuing import certificate, check_certificate
from counterspin.certificates.signature import sign_pages
from counterspin.certificates.signers import read_signer
from counterspin.errors import CampaignError


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """Work in a folder with a result and a laboratory's file, at a fixed time."""
    monkeypatch.setenv("COLUMNS", "120")  # numbers in one piece
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800000000")  # 2027-01-15
    (tmp_path / "r.json").write_text(result().to_json(), encoding="utf-8")
    write_lab(tmp_path)
    return tmp_path


def command(capsys, *words):
    """Run `counterspin certificate` and return its status, output and complaint."""
    status = cli.main(["certificate", *words])
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def known_by(lab=LAB, given=None):
    """Return the identifier of a certificate for which the laboratory states none."""
    return certificate(given or result(), tomllib.loads(lab)).identifier


def test_the_same_result_gives_the_same_bytes(desk, capsys):
    for name in ("a.xml", "b.xml", "a.pdf", "b.pdf"):
        status, out, err = command(capsys, "r.json", "LAB.toml", "-o", name)
        assert (status, err) == (0, "")
        assert out == f"Wrote {name}: certificate {known_by()} of Qx.\n"
    assert (desk / "a.xml").read_bytes() == (desk / "b.xml").read_bytes()
    assert (desk / "a.pdf").read_bytes() == (desk / "b.pdf").read_bytes()
    assert find((desk / "a.xml").read_bytes(), "//dcc:issueDate")[0].text == "2027-01-15"


def test_a_certificate_without_the_conditions_is_a_draft(desk, capsys):
    write_lab(desk, LAB.partition("[conditions]")[0])
    _, out, _ = command(capsys, "r.json", "LAB.toml", "-o", "a.xml")
    assert "certificate DRAFT-CS-" in out
    assert "conditions.temperature: this entry is missing" in out


def test_the_pdf_holds_the_xml_byte_for_byte(desk, capsys):
    for name in ("c.xml", "c.pdf"):
        assert command(capsys, "r.json", "LAB.toml", "-o", name)[0] == 0
    read = pypdf.PdfReader(io.BytesIO((desk / "c.pdf").read_bytes()))
    ((name, (data,)),) = read.attachments.items()
    assert name == f"{known_by()}.xml"
    assert data == (desk / "c.xml").read_bytes()
    text = "\n".join(page.extract_text() for page in read.pages)
    for words in ("Calibration certificate", "Kalibrierlabor", "0815", "Rückgeführt auf das SI."):
        assert words in text
    assert "27.0000 ± 0.0020 µg/g²" in " ".join(text.split())
    assert "20.50 ± 0.49 °C (U, k = 1.96)" in " ".join(text.split())
    # Every statement of the XML stands on the pages, under the same name.
    names = [e.text for e in find(data, "//dcc:statement/dcc:name/dcc:content")]
    assert {"Measurement uncertainty", "Units", "Metrological traceability", "Remarks"} <= {*names}
    assert [name for name in names if f"\n{name.partition(',')[0]}\n" not in text] == []


def test_the_laboratory_s_specification_goes_before_the_campaign_s(desk, capsys):
    write_lab(desk, LAB + '\n[specification]\nK_II = "abs <= 1e-5 g/g^2"\n')
    assert command(capsys, "r.json", "LAB.toml", "-o", "c.xml")[0] == 0
    made = (desk / "c.xml").read_bytes()
    assert [e.text for e in find(made, "//dcc:statement/dcc:conformity")] == ["fail"]
    # Without it, that of the result counts: up to 5e-5.
    write_lab(desk)
    assert command(capsys, "r.json", "LAB.toml", "-o", "d.xml")[0] == 0
    made = (desk / "d.xml").read_bytes()
    assert [e.text for e in find(made, "//dcc:statement/dcc:conformity")] == ["pass"]


def test_a_signed_certificate_is_verified_and_says_that_it_is_signed(desk, capsys):
    key, cert = map(str, write_pair(desk / "k", ec.generate_private_key(ec.SECP256R1())))
    signing = ("--key", key, "--cert", cert)
    assert command(capsys, "r.json", "LAB.toml", "-o", "c.xml", *signing)[0] == 0
    made = (desk / "c.xml").read_bytes()
    assert find(made, "//dcc:cryptElectronicSignature")[0].text == "true"
    status, out, _ = command(capsys, "--verify", "c.xml", "--cert", cert)
    assert status == 0
    assert "27.0000 ± 0.0020 ug/g^2" in out
    assert out.endswith("The signature is valid.\n")
    (desk / "d.xml").write_bytes(made.replace(b">9.8<", b">9.9<", 1))
    status, out, err = command(capsys, "--verify", "d.xml", "--cert", cert)
    assert (status, out) == (1, "")
    assert "d.xml: the signature is not valid" in err
    status, out, _ = command(capsys, "--verify", "c.xml")
    assert status == 0
    assert out.endswith(
        "the signature was not checked. To check the signature, give --cert CERT.pem.\n"
    )


def test_the_xml_of_a_pdf_is_verified(desk, capsys):
    key, cert = map(str, write_pair(desk / "k", ec.generate_private_key(ec.SECP256R1())))
    assert command(capsys, "r.json", "LAB.toml", "-o", "plain.xml")[0] == 0
    assert command(capsys, "--verify", "plain.xml")[1].endswith("The document is not signed.\n")
    signing = ("--key", key, "--cert", cert)
    assert command(capsys, "r.json", "LAB.toml", "-o", "c.pdf", *signing)[0] == 0
    status, out, _ = command(capsys, "--verify", "c.pdf", "--cert", cert)
    assert status == 0
    assert "27.0000 ± 0.0020 ug/g^2" in out
    pages = "The pages carry a valid signature of the same signer.\n"
    assert out.endswith(f"The signature is valid.\n{pages}")
    assert "The visible pages were not checked" in command(capsys, "--verify", "c.pdf")[1]
    # Pages that show something else, and those of nobody or somebody else, with the same XML.
    made = (desk / "c.pdf").read_bytes()
    place = made.index(b"/StructParents") + 4
    (desk / "d.pdf").write_bytes(made[:place] + b"X" + made[place + 1 :])
    status, out, err = command(capsys, "--verify", "d.pdf", "--cert", cert)
    assert (status, out) == (1, "")
    assert "pages were changed" in err
    plain = made[: made.index(b"%%EOF") + 5]
    (desk / "e.pdf").write_bytes(plain)
    told = command(capsys, "--verify", "e.pdf", "--cert", cert)
    assert told[0] == 0
    assert told[1].endswith("The visible pages are not signed.\n")
    other = read_signer(*write_pair(desk / "o", ec.generate_private_key(ec.SECP256R1())))
    (desk / "f.pdf").write_bytes(sign_pages(plain, other, datetime.now(UTC)))
    status, out, err = command(capsys, "--verify", "f.pdf", "--cert", cert)
    assert (status, out) == (1, "")
    assert "pages were not signed" in err
    # What is attached counts, whatever the pages show.
    writer = pypdf.PdfWriter(clone_from="c.pdf")
    writer.add_attachment("second.xml", b"<a/>")
    writer.write("two.pdf")
    assert "there are 2 XML files attached" in command(capsys, "--verify", "two.pdf")[2]
    writer = pypdf.PdfWriter()
    writer.add_blank_page(10, 10)
    writer.write("none.pdf")
    assert "there is no XML file attached" in command(capsys, "--verify", "none.pdf")[2]
    (desk / "no.pdf").write_bytes(b"%PDF-1.7 no")
    assert "no.pdf is not a PDF, or is damaged" in command(capsys, "--verify", "no.pdf")[2]


def test_xml_and_pdf_are_of_one_signature(desk, capsys):
    key, cert = map(str, write_pair(desk / "k", ec.generate_private_key(ec.SECP256R1())))
    ledgered = write_lab(desk, LAB.replace('language = "de"', 'ledger = "l.jsonl"'))
    signing = ("--key", key, "--cert", cert)
    given = ("r.json", str(ledgered), "--both", *signing)
    status, out, _ = command(capsys, *given, "-o", "c.pdf")
    assert status == 0
    assert out.startswith("Wrote c.pdf and c.xml: certificate CS-")
    assert read_document(desk / "c.pdf") == (desk / "c.xml").read_bytes()
    assert check_certificate(desk / "c.pdf", cert=Path(cert)).pages == "valid"
    # Neither is written where the other cannot be.
    (desk / "d.pdf").touch()
    assert command(capsys, *given, "-o", "d.xml")[0] == 1
    assert not (desk / "d.xml").exists()


@pytest.mark.parametrize("terminal", [True, False])
def test_a_password_is_asked_for_once_all_else_is_right(desk, capsys, monkeypatch, terminal):
    key, cert = write_pkcs12(desk / "k", ec.generate_private_key(ec.SECP256R1()), b"vy secret")
    asked = []

    def ask(words):
        asked.append(words)
        return "vy secret"

    stdin = io.StringIO("vy secret\n")
    stdin.isatty = lambda: terminal
    monkeypatch.setattr("sys.stdin", stdin)
    monkeypatch.setattr("counterspin.cli.certificate.getpass", ask)
    assert command(capsys, "--init", "mine.toml")[0] == 0
    assert command(capsys, "r.json", "mine.toml", "-o", "d.xml", "--key", str(key))[0] == 2
    assert (asked, stdin.tell()) == ([], 0)
    status, out, err = command(capsys, "r.json", "LAB.toml", "-o", "c.xml", "--key", str(key))
    assert (status, err) == (0, "")
    assert asked == ([f"Password of {key}: "] if terminal else [])
    assert "secret" not in out
    assert check_certificate(desk / "c.xml", cert=cert).signature == "valid"


def test_a_command_signs_in_place_of_a_key(desk, capsys):
    key, cert = write_pair(desk / "k", rsa.generate_private_key(65537, 2048))
    way = f"openssl dgst -sha256 -sign {shlex.quote(str(key))}"
    signing = ("--signer", way, "--cert", str(cert))
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    assert command(capsys, "r.json", "LAB.toml", "-o", "c.pdf", *signing)[0] == 0
    checked = check_certificate(desk / "c.pdf", cert=cert)
    assert (checked.signature, checked.pages) == ("valid", "valid")


def test_only_those_chosen_are_certified(desk, capsys):
    given = json.loads((desk / "r.json").read_text())
    given["accelerometers"]["Qy"] = given["accelerometers"]["Qx"]
    (desk / "r.json").write_text(sealed(given))
    write_lab(desk, LAB.replace('language = "de"', 'accelerometers = ["Qy"]'))
    status, out, _ = command(capsys, "r.json", "LAB.toml", "-o", "c.xml")
    assert status == 0
    assert out.endswith("are not certified (see certificate.accelerometers): Qx.\n")
    assert list(read_certificate((desk / "c.xml").read_bytes(), "").accelerometers) == ["Qy"]


def test_a_day_of_issue_before_the_end_is_told(desk, capsys, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    _, out, _ = command(capsys, "r.json", "LAB.toml", "-o", "c.xml")
    assert "The day of issue, 2023-11-14, is earlier than certificate.end, 2026-01-14." in out


def test_the_example_gives_a_draft_that_nobody_signs(desk, capsys):
    assert command(capsys, "--init", "mine.toml")[0] == 0
    status, out, _ = command(capsys, "r.json", "mine.toml", "-o", "c.pdf")
    assert status == 0
    assert "This document is a draft" in out
    assert "certificate.begin, certificate.end, certificate.traceability, laboratory.name" in out
    assert "item.model, item.serial_number, persons[0].name" in out
    pages = [page.extract_text() for page in pypdf.PdfReader(desk / "c.pdf").pages]
    assert all("DRAFT, not a calibration certificate DRAFT-CS-" in page for page in pages)
    made = certificate(desk / "r.json", desk / "mine.toml").xml
    assert find(made, "//dcc:uniqueIdentifier")[0].text.startswith("DRAFT-CS-")
    draft = find(made, "//dcc:statement[dcc:name/dcc:content='Draft']/dcc:declaration/dcc:content")
    assert draft[0].text.startswith("DRAFT. ")
    assert [
        e.text for e in find(made, "//dcc:statement[dcc:name/dcc:content='Draft']/dcc:valid")
    ] == ["false"]
    key, cert = map(str, write_pair(desk / "k", ec.generate_private_key(ec.SECP256R1())))
    signing = ("--key", key, "--cert", cert)
    status, _, err = command(capsys, "r.json", "mine.toml", "-o", "d.xml", *signing)
    assert status == 2
    assert "certificate.traceability, laboratory.name" in err
    assert "values of the template" in err
    # Before anything is signed: nobody is asked for a key.
    with pytest.raises(CampaignError, match="values of the template"):
        certificate(desk / "r.json", desk / "mine.toml", signer=lambda: pytest.fail("asked"))


CONTRADICTED = {"rms": 0.08, "unit": "m", "dof": 100.0, "chi2": 6400.0, "lack_of_fit_p": 0.0}


def test_a_contradicted_result_is_certified_for_a_reason_only(desk, capsys):
    for reason, status in ((None, 1), ("known play of the arm", 0)):
        found = judge_result(result(residual=CONTRADICTED), reason)
        found.write(desk / "r.json", overwrite=True)
        got, _, err = command(capsys, "r.json", "LAB.toml", "-o", "c.pdf")
        assert got == status
        assert ("Qx: The residuals are 8" in err) == bool(status)
        assert (desk / "c.pdf").exists() == (status == 0)
    assert command(capsys, "r.json", "LAB.toml", "-o", "c.xml")[0] == 0
    comment = find((desk / "c.xml").read_bytes(), "/*/dcc:comment")[0]
    assert "The misfit was accepted for this reason: known play of the arm" in "".join(
        comment.itertext()
    )
    text = "".join(page.extract_text() for page in pypdf.PdfReader(desk / "c.pdf").pages)
    assert (
        " ".join(text.split()).count(
            "The misfit was accepted for this reason: known play of the arm"
        )
        == 1
    )


def test_a_reason_may_be_given_with_the_certificate(desk, capsys):
    judge_result(result(residual=CONTRADICTED)).write(desk / "r.json", overwrite=True)
    status, _, err = command(capsys, "r.json", "LAB.toml", "-o", "c.xml", "--accept-misfit", " ")
    assert (status, "--accept-misfit: " in err) == (2, True)
    why = ("--accept-misfit", "known play of the arm")
    assert command(capsys, "r.json", "LAB.toml", "-o", "c.xml", *why)[0] == 0
    made = (desk / "c.xml").read_bytes()
    name = "Misfit of the result"
    (said,) = find(
        made, f"//dcc:statement[dcc:name/dcc:content='{name}']/dcc:declaration/dcc:content"
    )
    assert said.text.startswith("The result failed the quality checks. Qx: The residuals are 8")
    assert said.text.endswith("The misfit was accepted for this reason: known play of the arm")
    judge_result(result()).write(desk / "r.json", overwrite=True)
    status, _, err = command(capsys, "r.json", "LAB.toml", "-o", "d.xml", *why)
    assert (status, "do not contradict this result" in err) == (2, True)


@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        (
            ("r.json", "LAB.toml", "-o", "c.txt"),
            2,
            "c.txt: end the name of the file in .xml or .pdf",
        ),
        (("r.json", "LAB.toml"), 2, "-o FILE.xml"),
        ((), 2, "--init LAB.toml"),
        (("r.json", "LAB.toml", "-o", "c.xml", "--cert", "k.pem"), 2, "give --key or --signer"),
        (
            ("r.json", "LAB.toml", "-o", "c.xml", "--signer", "x"),
            2,
            "give both --signer and --cert",
        ),
        (
            ("r.json", "LAB.toml", "-o", "c.xml", "--signer", "x", "--key", "k.pem"),
            2,
            "give --key or --signer, not both",
        ),
        (("none.json", "LAB.toml", "-o", "c.xml"), 1, "none.json: file not found"),
        (("LAB.toml", "LAB.toml", "-o", "c.xml"), 1, "not a result file"),
        (("printed.json", "LAB.toml", "-o", "c.xml"), 1, "printed.json: this result was computed"),
        (("newer.json", "LAB.toml", "-o", "c.xml"), 1, "update counterspin"),
        (("r.json", "LAB.toml", "-o", "no/c.xml"), 1, "cannot be written"),
        (("r.json", "LAB.toml", "-o", "c.xml", "--schema", "no"), 1, "file not found"),
        (("--verify", "none.xml"), 1, "none.xml: file not found"),
        (("--verify", "r.json"), 1, "is not XML"),
    ],
)
def test_a_mistake_leaves_nothing_behind(desk, capsys, words, status, told):
    printed = result().model_copy(update={"model": "as-printed"})
    (desk / "printed.json").write_text(printed.to_json(), encoding="utf-8")
    (desk / "newer.json").write_text('{"schema": 3}', encoding="utf-8")
    before = sorted(desk.iterdir())
    got, out, err = command(capsys, *words)
    assert (got, out) == (status, "")
    assert told in err
    assert sorted(desk.iterdir()) == before


def test_objects_give_the_certificate_of_their_files(desk, capsys):
    for name in ("a.xml", "a.pdf"):
        assert command(capsys, "r.json", "LAB.toml", "-o", name)[0] == 0
    made = certificate(result(), tomllib.loads(LAB))
    assert made.xml == (desk / "a.xml").read_bytes()
    assert made.pdf() == (desk / "a.pdf").read_bytes()
    assert (made.identifier, made.accelerometers) == (known_by(), ["Qx"])
    assert made.write("b.xml").read_bytes() == made.xml
    with raises("file-exists"):
        made.write(desk / "b.xml")
    with raises("wrong-file-ending", ".xml", ".pdf"):
        made.write("b.txt")


def test_mistakes_of_objects_are_told_by_their_keys():
    lab = tomllib.loads(LAB)
    del lab["item"]
    with raises("missing-key", "item.name:"):
        certificate(result(), lab)
    with raises("as-printed"):
        certificate(result().model_copy(update={"model": "as-printed"}), tomllib.loads(LAB))


def test_the_default_identifier_follows_from_the_bytes_and_the_laboratory_s_data(desk):
    own = known_by()
    assert own == known_by("# a remark\n" + LAB)
    assert own != known_by(LAB.replace("Kunde", "Kundin"))
    assert own != known_by(LAB, result(serial_number="Q-105"))
    # Another version writes other bytes of the same result; those that were read count.
    text = (desk / "r.json").read_text(encoding="utf-8")
    (desk / "r.json").write_text(text.replace("\n ", "\n  "), encoding="utf-8")
    earlier = certificate("r.json", tomllib.loads(LAB))
    assert earlier.identifier != own
    assert earlier.identifier == certificate(Result.read("r.json"), tomllib.loads(LAB)).identifier


def test_a_result_without_a_seal_is_certified_for_a_stated_reason_only(desk, capsys):
    text = re.sub(r'"seal": .*,', "", (desk / "r.json").read_text(encoding="utf-8"))
    # An earlier schema, stated by hand, is no way around it.
    for schema in ('"schema": 2', '"schema": 1'):
        (desk / "r.json").write_text(text.replace('"schema": 2', schema), encoding="utf-8")
        status, _, complaint = command(capsys, "r.json", "LAB.toml", "-o", "a.xml")
        assert status == 1
        assert "r.json: the file has no seal" in complaint
        assert "state in --accept-unsealed why" in " ".join(complaint.split())
    (desk / "r.json").write_text(text, encoding="utf-8")
    reason = ("--accept-unsealed", "Compared with the printed report.")
    for name in ("a.xml", "a.pdf"):
        assert command(capsys, "r.json", "LAB.toml", "-o", name, *reason)[0] == 0
    said = "was accepted for this reason: Compared with the printed report."
    assert said.encode() in (desk / "a.xml").read_bytes()
    pages = "".join(page.extract_text() for page in pypdf.PdfReader(desk / "a.pdf").pages)
    assert said in " ".join(pages.split())
    # Attached is the file itself.
    (data,) = find((desk / "a.xml").read_bytes(), "//dcc:dataBase64")[:1]
    assert base64.b64decode(data.text) == text.encode()
    result().write(desk / "r.json", overwrite=True)
    status, _, complaint = command(capsys, "r.json", "LAB.toml", "-o", "b.xml", *reason)
    assert status == 1
    assert "the file has a valid seal; omit --accept-unsealed" in " ".join(complaint.split())
