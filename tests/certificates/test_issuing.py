"""`counterspin certificate` writes one reproducible file, completely or not at all."""

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
from results import make_qx_result, seal_document
from signing_keys import write_pair, write_pkcs12

from certificates import LAB, find_elements, write_lab
from counterspin import cli
from counterspin.calibration.findings import judge_result
from counterspin.calibration.result import Result
from counterspin.certificates.certificate_reader import read_certificate, read_document
from counterspin.certificates.issuing import certificate, check_certificate
from counterspin.certificates.signature import sign_pages
from counterspin.certificates.signers import read_signer
from counterspin.errors import CampaignError


@pytest.fixture
def certificate_folder(tmp_path, monkeypatch):
    """Work at a fixed time in a folder with a result and laboratory data."""
    monkeypatch.setenv("COLUMNS", "120")  # numbers without line breaks
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800000000")  # 2027-01-15
    (tmp_path / "r.json").write_text(make_qx_result().to_json(), encoding="utf-8")
    write_lab(tmp_path)
    return tmp_path


def run_certificate(capsys, *arguments):
    """Run `counterspin certificate` and return its status, output and error message."""
    status = cli.main(["certificate", *arguments])
    printed = capsys.readouterr()
    return status, printed.out, printed.err


def default_identifier(lab=LAB, calibration=None):
    """Return the identifier of a certificate without a stated identifier."""
    return certificate(calibration or make_qx_result(), tomllib.loads(lab)).identifier


def test_certificate_is_reproducible(certificate_folder, capsys):
    for name in ("a.xml", "b.xml", "a.pdf", "b.pdf"):
        status, out, err = run_certificate(capsys, "r.json", "LAB.toml", "-o", name)
        assert (status, err) == (0, "")
        assert out == f"Wrote {name}: certificate {default_identifier()} of Qx.\n"
    assert (certificate_folder / "a.xml").read_bytes() == (
        certificate_folder / "b.xml"
    ).read_bytes()
    assert (certificate_folder / "a.pdf").read_bytes() == (
        certificate_folder / "b.pdf"
    ).read_bytes()
    assert (
        find_elements((certificate_folder / "a.xml").read_bytes(), "//dcc:issueDate")[0].text
        == "2027-01-15"
    )


def test_certificate_without_conditions_is_draft(certificate_folder, capsys):
    write_lab(certificate_folder, LAB.partition("[conditions]")[0])
    _, out, _ = run_certificate(capsys, "r.json", "LAB.toml", "-o", "a.xml")
    assert "certificate DRAFT-CS-" in out
    assert "conditions.temperature: this entry is missing" in out


def test_pdf_contains_identical_xml(certificate_folder, capsys):
    for name in ("c.xml", "c.pdf"):
        assert run_certificate(capsys, "r.json", "LAB.toml", "-o", name)[0] == 0
    reader = pypdf.PdfReader(io.BytesIO((certificate_folder / "c.pdf").read_bytes()))
    ((name, (data,)),) = reader.attachments.items()
    assert name == f"{default_identifier()}.xml"
    assert data == (certificate_folder / "c.xml").read_bytes()
    text = "\n".join(page.extract_text() for page in reader.pages)
    for phrase in ("Calibration certificate", "Kalibrierlabor", "0815", "Rückgeführt auf das SI."):
        assert phrase in text
    assert "27.0000 ± 0.0020 µg/g²" in " ".join(text.split())
    assert "20.50 ± 0.49 °C (U, k = 1.96)" in " ".join(text.split())
    # The pages contain all statements of the XML under the same name.
    names = [
        element.text for element in find_elements(data, "//dcc:statement/dcc:name/dcc:content")
    ]
    assert {"Measurement uncertainty", "Units", "Metrological traceability", "Remarks"} <= {*names}
    assert [name for name in names if f"\n{name.partition(',')[0]}\n" not in text] == []


def test_laboratory_specification_overrides_campaign(certificate_folder, capsys):
    write_lab(certificate_folder, LAB + '\n[specification]\nK_II = "abs <= 1e-5 g/g^2"\n')
    assert run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.xml")[0] == 0
    xml = (certificate_folder / "c.xml").read_bytes()
    assert [element.text for element in find_elements(xml, "//dcc:statement/dcc:conformity")] == [
        "fail"
    ]
    # Otherwise the specification of the result applies: up to 5e-5.
    write_lab(certificate_folder)
    assert run_certificate(capsys, "r.json", "LAB.toml", "-o", "d.xml")[0] == 0
    xml = (certificate_folder / "d.xml").read_bytes()
    assert [element.text for element in find_elements(xml, "//dcc:statement/dcc:conformity")] == [
        "pass"
    ]


def test_signed_certificate_is_verified(certificate_folder, capsys):
    key, cert = map(
        str, write_pair(certificate_folder / "k", ec.generate_private_key(ec.SECP256R1()))
    )
    signing = ("--key", key, "--cert", cert)
    assert run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.xml", *signing)[0] == 0
    xml = (certificate_folder / "c.xml").read_bytes()
    assert find_elements(xml, "//dcc:cryptElectronicSignature")[0].text == "true"
    status, out, _ = run_certificate(capsys, "--verify", "c.xml", "--cert", cert)
    assert status == 0
    assert "27.0000 ± 0.0020 ug/g^2" in out
    assert out.endswith("The signature is valid.\n")
    (certificate_folder / "d.xml").write_bytes(xml.replace(b">9.8<", b">9.9<", 1))
    status, out, err = run_certificate(capsys, "--verify", "d.xml", "--cert", cert)
    assert (status, out) == (1, "")
    assert "d.xml: the signature is not valid" in err
    status, out, _ = run_certificate(capsys, "--verify", "c.xml")
    assert status == 0
    assert out.endswith(
        "the signature was not checked. To check the signature, give --cert CERT.pem.\n"
    )


def test_verify_reads_xml_in_pdf(certificate_folder, capsys):
    key, cert = map(
        str, write_pair(certificate_folder / "k", ec.generate_private_key(ec.SECP256R1()))
    )
    assert run_certificate(capsys, "r.json", "LAB.toml", "-o", "plain.xml")[0] == 0
    assert run_certificate(capsys, "--verify", "plain.xml")[1].endswith(
        "The document is not signed.\n"
    )
    signing = ("--key", key, "--cert", cert)
    assert run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.pdf", *signing)[0] == 0
    status, out, _ = run_certificate(capsys, "--verify", "c.pdf", "--cert", cert)
    assert status == 0
    assert "27.0000 ± 0.0020 ug/g^2" in out
    pages = "The pages bear a valid signature by the same signer.\n"
    assert out.endswith(f"The signature is valid.\n{pages}")
    assert "The visible pages were not checked" in run_certificate(capsys, "--verify", "c.pdf")[1]
    # Changed pages, unsigned pages and pages of another signer, with the same XML.
    pdf = (certificate_folder / "c.pdf").read_bytes()
    offset = pdf.index(b"/StructParents") + 4
    (certificate_folder / "d.pdf").write_bytes(pdf[:offset] + b"X" + pdf[offset + 1 :])
    status, out, err = run_certificate(capsys, "--verify", "d.pdf", "--cert", cert)
    assert (status, out) == (1, "")
    assert "pages were changed" in err
    unsigned_pdf = pdf[: pdf.index(b"%%EOF") + 5]
    (certificate_folder / "e.pdf").write_bytes(unsigned_pdf)
    outcome = run_certificate(capsys, "--verify", "e.pdf", "--cert", cert)
    assert outcome[0] == 0
    assert outcome[1].endswith("The visible pages are not signed.\n")
    other_signer = read_signer(
        *write_pair(certificate_folder / "o", ec.generate_private_key(ec.SECP256R1()))
    )
    (certificate_folder / "f.pdf").write_bytes(
        sign_pages(unsigned_pdf, other_signer, datetime.now(UTC))
    )
    status, out, err = run_certificate(capsys, "--verify", "f.pdf", "--cert", cert)
    assert (status, out) == (1, "")
    assert "but not the pages" in err
    # The attached XML is verified, whatever the pages show.
    writer = pypdf.PdfWriter(clone_from="c.pdf")
    writer.add_attachment("second.xml", b"<a/>")
    writer.write("two.pdf")
    assert "2 XML files are attached" in run_certificate(capsys, "--verify", "two.pdf")[2]
    writer = pypdf.PdfWriter()
    writer.add_blank_page(10, 10)
    writer.write("none.pdf")
    assert "no XML file is attached" in run_certificate(capsys, "--verify", "none.pdf")[2]
    (certificate_folder / "no.pdf").write_bytes(b"%PDF-1.7 no")
    assert (
        "no.pdf is not a PDF, or it is damaged" in run_certificate(capsys, "--verify", "no.pdf")[2]
    )


def test_xml_and_pdf_have_same_signature(certificate_folder, capsys):
    key, cert = map(
        str, write_pair(certificate_folder / "k", ec.generate_private_key(ec.SECP256R1()))
    )
    ledgered = write_lab(certificate_folder, LAB.replace('language = "de"', 'ledger = "l.jsonl"'))
    signing = ("--key", key, "--cert", cert)
    arguments = ("r.json", str(ledgered), "--both", *signing)
    status, out, _ = run_certificate(capsys, *arguments, "-o", "c.pdf")
    assert status == 0
    assert out.startswith("Wrote c.pdf and c.xml: certificate CS-")
    assert (
        read_document(certificate_folder / "c.pdf") == (certificate_folder / "c.xml").read_bytes()
    )
    assert (
        check_certificate(
            certificate_folder / "c.pdf", signer_certificate=Path(cert)
        ).page_signature
        == "valid"
    )
    # If one file cannot be written, neither is.
    (certificate_folder / "d.pdf").touch()
    assert run_certificate(capsys, *arguments, "-o", "d.xml")[0] == 1
    assert not (certificate_folder / "d.xml").exists()


@pytest.mark.parametrize("terminal", [True, False])
def test_password_is_requested_after_all_other_checks(
    certificate_folder, capsys, monkeypatch, terminal
):
    key, cert = write_pkcs12(
        certificate_folder / "k", ec.generate_private_key(ec.SECP256R1()), b"vy secret"
    )
    prompts = []

    def enter_password(prompt):
        prompts.append(prompt)
        return "vy secret"

    stdin = io.StringIO("vy secret\n")
    stdin.isatty = lambda: terminal
    monkeypatch.setattr("sys.stdin", stdin)
    monkeypatch.setattr("counterspin.cli.certificate.getpass", enter_password)
    assert run_certificate(capsys, "--init", "mine.toml")[0] == 0
    assert run_certificate(capsys, "r.json", "mine.toml", "-o", "d.xml", "--key", str(key))[0] == 2
    assert (prompts, stdin.tell()) == ([], 0)
    status, out, err = run_certificate(
        capsys, "r.json", "LAB.toml", "-o", "c.xml", "--key", str(key)
    )
    assert (status, err) == (0, "")
    assert prompts == ([f"Password of {key}: "] if terminal else [])
    assert "secret" not in out
    assert (
        check_certificate(certificate_folder / "c.xml", signer_certificate=cert).signature
        == "valid"
    )


def test_signer_command_replaces_key(certificate_folder, capsys):
    key, cert = write_pair(certificate_folder / "k", rsa.generate_private_key(65537, 2048))
    command = f"openssl dgst -sha256 -sign {shlex.quote(str(key))}"
    signing = ("--signer", command, "--cert", str(cert))
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    assert run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.pdf", *signing)[0] == 0
    checked = check_certificate(certificate_folder / "c.pdf", signer_certificate=cert)
    assert (checked.signature, checked.page_signature) == ("valid", "valid")


def test_only_selected_accelerometers_are_certified(certificate_folder, capsys):
    document = json.loads((certificate_folder / "r.json").read_text())
    document["accelerometers"]["Qy"] = document["accelerometers"]["Qx"]
    (certificate_folder / "r.json").write_text(seal_document(document))
    write_lab(certificate_folder, LAB.replace('language = "de"', 'accelerometers = ["Qy"]'))
    status, out, _ = run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.xml")
    assert status == 0
    assert out.endswith("are not certified (see certificate.accelerometers): Qx.\n")
    assert list(
        read_certificate((certificate_folder / "c.xml").read_bytes(), "").accelerometers
    ) == ["Qy"]


def test_issue_date_before_end_is_reported(certificate_folder, capsys, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    _, out, _ = run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.xml")
    assert "The date of issue, 2023-11-14, is earlier than certificate.end, 2026-01-14." in out


def test_future_issue_and_equipment_due_during_calibration_are_reported(
    certificate_folder, capsys, monkeypatch
):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1770000000")  # 2026-02-02
    for issued, due, key in (
        ("2026-02-03", "2026-01-14", None),
        ("2026-02-04", "2026-01-13", "end, 2026-01-14"),
        ("2026-02-04", "2026-01-11", "begin, 2026-01-12"),
    ):
        text = LAB.replace('language = "de"', f"issued = {issued}")
        write_lab(certificate_folder, f'{text}[[equipment]]\nname = "clock"\ndue = {due}\n')
        status, out, _ = run_certificate(capsys, "r.json", "LAB.toml", "-o", f"{due}.xml")
        assert status == 0
        is_future = f"certificate.issued, {issued}, is in the future." in out
        assert is_future is (issued == "2026-02-04")
        assert ("was due on" in out) is (key is not None)
        assert key is None or f"was due on {due}, earlier than certificate.{key}." in out


@pytest.mark.parametrize(
    ("date", "is_outside"),
    [
        ("2026-01-11", True),
        ("2026-01-12T09:00:00+09:00", False),
        ("2026-01-15", True),
        ("spring 2026", False),
        (None, False),
    ],
)
def test_campaign_date_outside_calibration_is_reported(
    certificate_folder, capsys, date, is_outside
):
    document = json.loads((certificate_folder / "r.json").read_text())
    document["details"] = {} if date is None else {"date": date}
    (certificate_folder / "r.json").write_text(seal_document(document))
    status, out, _ = run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.xml")
    assert status == 0
    words = f"The date of the campaign, {date}, is not between certificate.begin, 2026-01-12, and"
    assert (words in out) is is_outside
    assert "The date of the campaign" not in out or is_outside


def test_characters_without_glyph_are_reported(certificate_folder, capsys, monkeypatch):
    monkeypatch.setattr(
        "counterspin.reports.pdf.find_missing_glyphs", lambda text: "王" * text.count("王")
    )
    for name, is_missing in (("王", True), ("A. Erste", False)):
        write_lab(certificate_folder, LAB.replace("A. Erste", name))
        status, out, _ = run_certificate(capsys, "r.json", "LAB.toml", "-o", f"{is_missing}.xml")
        assert status == 0
        assert ("have no glyphs for 王, so the pages show squares" in out) is is_missing


def test_template_draft_cannot_be_signed(certificate_folder, capsys):
    assert run_certificate(capsys, "--init", "mine.toml")[0] == 0
    status, out, _ = run_certificate(capsys, "r.json", "mine.toml", "-o", "c.pdf")
    assert status == 0
    assert "This document is a draft" in out
    assert "certificate.begin, certificate.end, certificate.traceability, laboratory.name" in out
    assert "item.model, item.serial_number, persons[0].name" in out
    pages = [page.extract_text() for page in pypdf.PdfReader(certificate_folder / "c.pdf").pages]
    assert all("DRAFT, not a calibration certificate DRAFT-CS-" in page for page in pages)
    xml = certificate(certificate_folder / "r.json", certificate_folder / "mine.toml").xml
    assert find_elements(xml, "//dcc:uniqueIdentifier")[0].text.startswith("DRAFT-CS-")
    draft = find_elements(
        xml, "//dcc:statement[dcc:name/dcc:content='Draft']/dcc:declaration/dcc:content"
    )
    assert draft[0].text.startswith("DRAFT. ")
    assert [
        element.text
        for element in find_elements(xml, "//dcc:statement[dcc:name/dcc:content='Draft']/dcc:valid")
    ] == ["false"]
    key, cert = map(
        str, write_pair(certificate_folder / "k", ec.generate_private_key(ec.SECP256R1()))
    )
    signing = ("--key", key, "--cert", cert)
    status, _, err = run_certificate(capsys, "r.json", "mine.toml", "-o", "d.xml", *signing)
    assert status == 2
    assert "certificate.traceability, laboratory.name" in err
    assert "values from the template" in err
    # The check precedes signing: no key is requested.
    with pytest.raises(CampaignError, match="values from the template"):
        certificate(
            certificate_folder / "r.json",
            certificate_folder / "mine.toml",
            signer=lambda: pytest.fail("asked"),
        )


CONTRADICTED = {"rms": 0.08, "unit": "m", "dof": 100.0, "chi2": 6400.0, "lack_of_fit_p": 0.0}


def test_contradicted_result_requires_reason(certificate_folder, capsys):
    for reason, status in ((None, 1), ("known play of the arm", 0)):
        calibration = judge_result(make_qx_result(residual=CONTRADICTED), reason)
        calibration.write(certificate_folder / "r.json", overwrite=True)
        got, _, err = run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.pdf")
        assert got == status
        assert ("Qx: The residuals are 8" in err) == bool(status)
        assert (certificate_folder / "c.pdf").exists() == (status == 0)
    assert run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.xml")[0] == 0
    comment = find_elements((certificate_folder / "c.xml").read_bytes(), "/*/dcc:comment")[0]
    assert "The misfit was accepted for this reason: known play of the arm" in "".join(
        comment.itertext()
    )
    text = "".join(
        page.extract_text() for page in pypdf.PdfReader(certificate_folder / "c.pdf").pages
    )
    assert (
        " ".join(text.split()).count(
            "The misfit was accepted for this reason: known play of the arm"
        )
        == 1
    )


def test_certificate_command_accepts_reason(certificate_folder, capsys):
    judge_result(make_qx_result(residual=CONTRADICTED)).write(
        certificate_folder / "r.json", overwrite=True
    )
    status, _, err = run_certificate(
        capsys, "r.json", "LAB.toml", "-o", "c.xml", "--accept-misfit", " "
    )
    assert (status, "--accept-misfit: " in err) == (2, True)
    misfit_options = ("--accept-misfit", "known play of the arm")
    assert run_certificate(capsys, "r.json", "LAB.toml", "-o", "c.xml", *misfit_options)[0] == 0
    xml = (certificate_folder / "c.xml").read_bytes()
    name = "Accepted misfit"
    (declaration,) = find_elements(
        xml, f"//dcc:statement[dcc:name/dcc:content='{name}']/dcc:declaration/dcc:content"
    )
    assert declaration.text.startswith(
        "The result failed the quality checks. Qx: The residuals are 8"
    )
    assert declaration.text.endswith(
        "The misfit was accepted for this reason: known play of the arm"
    )
    judge_result(make_qx_result()).write(certificate_folder / "r.json", overwrite=True)
    status, _, err = run_certificate(capsys, "r.json", "LAB.toml", "-o", "d.xml", *misfit_options)
    assert (status, "do not contradict this result" in err) == (2, True)


@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        (
            ("r.json", "LAB.toml", "-o", "c.txt"),
            2,
            "c.txt: the file name must end in .xml or .pdf",
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
def test_failed_command_leaves_no_file(certificate_folder, capsys, words, status, told):
    printed = make_qx_result().model_copy(update={"model": "as-printed"})
    (certificate_folder / "printed.json").write_text(printed.to_json(), encoding="utf-8")
    (certificate_folder / "newer.json").write_text('{"schema": 3}', encoding="utf-8")
    files_before = sorted(certificate_folder.iterdir())
    got, out, err = run_certificate(capsys, *words)
    assert (got, out) == (status, "")
    assert told in err
    assert sorted(certificate_folder.iterdir()) == files_before


def test_objects_and_files_give_same_certificate(certificate_folder, capsys):
    for name in ("a.xml", "a.pdf"):
        assert run_certificate(capsys, "r.json", "LAB.toml", "-o", name)[0] == 0
    issued = certificate(make_qx_result(), tomllib.loads(LAB))
    assert issued.xml == (certificate_folder / "a.xml").read_bytes()
    assert issued.pdf() == (certificate_folder / "a.pdf").read_bytes()
    assert (issued.identifier, issued.accelerometers) == (default_identifier(), ["Qx"])
    assert issued.write("b.xml").read_bytes() == issued.xml
    with raises("file-exists"):
        issued.write(certificate_folder / "b.xml")
    with raises("wrong-file-ending", ".xml", ".pdf"):
        issued.write("b.txt")


def test_errors_of_objects_name_keys():
    lab = tomllib.loads(LAB)
    del lab["item"]
    with raises("missing-key", "item.name:"):
        certificate(make_qx_result(), lab)
    with raises("as-printed"):
        certificate(make_qx_result().model_copy(update={"model": "as-printed"}), tomllib.loads(LAB))


def test_default_identifier_depends_on_result_and_laboratory_data(certificate_folder):
    identifier = default_identifier()
    assert identifier == default_identifier("# a remark\n" + LAB)
    assert identifier != default_identifier(LAB.replace("Kunde", "Kundin"))
    assert identifier != default_identifier(LAB, make_qx_result(serial_number="Q-105"))
    # Another version writes other bytes of the same result; the bytes read are used.
    text = (certificate_folder / "r.json").read_text(encoding="utf-8")
    (certificate_folder / "r.json").write_text(text.replace("\n ", "\n  "), encoding="utf-8")
    earlier = certificate("r.json", tomllib.loads(LAB))
    assert earlier.identifier != identifier
    assert earlier.identifier == certificate(Result.read("r.json"), tomllib.loads(LAB)).identifier


def test_result_without_seal_requires_reason(certificate_folder, capsys):
    text = re.sub(r'"seal": .*,', "", (certificate_folder / "r.json").read_text(encoding="utf-8"))
    # Stating an earlier schema by hand does not avoid the check.
    for schema in ('"schema": 2', '"schema": 1'):
        (certificate_folder / "r.json").write_text(
            text.replace('"schema": 2', schema), encoding="utf-8"
        )
        status, _, message = run_certificate(capsys, "r.json", "LAB.toml", "-o", "a.xml")
        assert status == 1
        assert "r.json: the file has no seal" in message
        assert "state in --accept-unsealed why" in " ".join(message.split())
    (certificate_folder / "r.json").write_text(text, encoding="utf-8")
    reason = ("--accept-unsealed", "Compared with the printed report.")
    for name in ("a.xml", "a.pdf"):
        assert run_certificate(capsys, "r.json", "LAB.toml", "-o", name, *reason)[0] == 0
    statement_text = "was accepted for this reason: Compared with the printed report."
    assert statement_text.encode() in (certificate_folder / "a.xml").read_bytes()
    pages = "".join(
        page.extract_text() for page in pypdf.PdfReader(certificate_folder / "a.pdf").pages
    )
    assert statement_text in " ".join(pages.split())
    # The file itself is attached.
    (data,) = find_elements((certificate_folder / "a.xml").read_bytes(), "//dcc:dataBase64")[:1]
    assert base64.b64decode(data.text) == text.encode()
    make_qx_result().write(certificate_folder / "r.json", overwrite=True)
    status, _, message = run_certificate(capsys, "r.json", "LAB.toml", "-o", "b.xml", *reason)
    assert status == 1
    assert "the file has a valid seal; omit --accept-unsealed" in " ".join(message.split())
