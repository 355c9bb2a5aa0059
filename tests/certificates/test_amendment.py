"""An amended certificate names the replaced certificate and the changes."""

import hashlib

import pytest
from raising import raises
from results import make_coefficient, make_qx_result

from certificates import LAB, find_elements, write_lab
from counterspin import cli
from counterspin.certificates.amendment import AmendedCertificate, Amendment, describe_changes
from counterspin.certificates.certificate_reader import read_certificate
from counterspin.certificates.issuing import certificate, check_certificate
from counterspin.errors import CampaignError, RecordError

CORE = "//dcc:coreData"


@pytest.fixture
def certificate_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1800000000")
    make_qx_result().write("r.json")
    write_lab(tmp_path)
    assert cli.main(["certificate", "r.json", "LAB.toml", "-o", "old.xml"]) == 0
    return tmp_path


def test_amended_certificate_round_trip(certificate_folder, capsys):
    old_xml = (certificate_folder / "old.xml").read_bytes()
    write_lab(certificate_folder, LAB.replace('"0815"', '"0816"'))
    amendment_options = ("--amends", "old.xml", "--reason", "The serial number was misread.")
    assert cli.main(["certificate", "r.json", "LAB.toml", "-o", "new.xml", *amendment_options]) == 0
    new_xml = (certificate_folder / "new.xml").read_bytes()
    name, checksum = read_certificate(old_xml, "").identifier, hashlib.sha256(old_xml).hexdigest()
    assert read_certificate(new_xml, "").identifier == f"{name}-A1"
    replaced = f"{CORE}/dcc:reportAmendedSubstituted"
    assert [element.text for element in find_elements(new_xml, f"{replaced}/*")] == [
        "amended",
        name,
    ]
    previous = f"{CORE}/dcc:previousReport"
    assert [element.text for element in find_elements(new_xml, f"{previous}/*")[1:4]] == [
        name,
        "SHA-256",
        checksum,
    ]
    text = find_elements(new_xml, "//dcc:statement[dcc:name/dcc:content='Amendment']//dcc:content")[
        -1
    ].text
    _, reason, changed = text.splitlines()
    assert reason == "Reason: The serial number was misread."
    assert changed == 'Changed: calibrated item, from "0815" to "0816".'
    # Read back and compared with the replaced certificate.
    capsys.readouterr()
    assert cli.main(["certificate", "--verify", "new.xml", "--amends", "old.xml"]) == 0
    assert (
        f"The document amends and replaces certificate {name}, whose checksum"
        in capsys.readouterr().out
    )
    (certificate_folder / "old.xml").write_bytes(old_xml.replace(b"0815", b"0814"))
    assert cli.main(["certificate", "--verify", "new.xml", "--amends", "old.xml"]) == 1
    assert "amend old.xml" in capsys.readouterr().err
    # And once more.
    repeated_certificate = certificate(
        "r.json", "LAB.toml", amends=Amendment(certificate_folder / "new.xml", "No code.")
    )
    assert repeated_certificate.identifier == f"{name}-A2"


def test_changed_numbers_are_listed(certificate_folder):
    calibration = make_qx_result(
        coefficients={
            "K_F": make_coefficient(0.005, 1e-6, "g") | {"estimated": False},
            "K_II": make_coefficient(2.71e-5, 1e-9, "g/g^2", dof=50.0),
        },
        correlation=None,
    )
    documents = [
        certificate(original, "LAB.toml").xml for original in (make_qx_result(), calibration)
    ]
    changes = describe_changes(*documents)
    assert changes[:2] == [
        "K_F of Qx was 5000.0 ± 2.0 ug and is now not certified.",
        "K_II of Qx was 27.0000 ± 0.0020 ug/g^2 and is now 27.1000 ± 0.0020 ug/g^2.",
    ]
    assert changes[2:] == ['the statement "Undetermined coefficients of accelerometer Qx" is new.']
    assert describe_changes(documents[0], documents[0]) == [
        "The amendment changes only the identifier and the date of issue."
    ]


def test_added_and_removed_statements_are_listed(certificate_folder):
    old_xml = certificate(make_qx_result(), "LAB.toml").xml
    write_lab(
        certificate_folder, LAB.replace('remarks = ["Bemerkung."]', 'customer_data = ["K_I"]')
    )
    assert describe_changes(old_xml, certificate(make_qx_result(), "LAB.toml").xml) == [
        'the statement "Prior information" has changed.',
        'the statement "Remarks" has been removed.',
        'the statement "Data supplied by the customer" is new.',
    ]


def test_rejects_invalid_amendment(certificate_folder, capsys):
    with pytest.raises(CampaignError, match="give the reason"):
        certificate("r.json", "LAB.toml", amends=Amendment(certificate_folder / "old.xml", " "))
    write_lab(certificate_folder, LAB.replace('language = "de"', 'identifier = "7"'))
    certificate("r.json", "LAB.toml").write("seven.xml")
    with raises("duplicate-entry", '"7"'):
        certificate("r.json", "LAB.toml", amends=Amendment(certificate_folder / "seven.xml", "why"))
    with pytest.raises(RecordError, match="does not amend a certificate"):
        check_certificate(
            certificate_folder / "seven.xml", amended_path=certificate_folder / "old.xml"
        )
    assert cli.main(["certificate", "--init", "mine.toml"]) == 0
    certificate("r.json", "mine.toml").write("draft.xml")
    with raises("wrong-amendment"):
        certificate("r.json", "LAB.toml", amends=Amendment(certificate_folder / "draft.xml", "why"))
    arguments = ["certificate", "r.json", "LAB.toml", "-o", "x.xml", "--amends", "old.xml"]
    assert cli.main(arguments) == 2
    assert "--amends OLD.xml and --reason WHY" in capsys.readouterr().err


def test_circular_amendments_are_rejected_without_ledger(certificate_folder):
    for number in range(3):
        write_lab(
            certificate_folder, LAB.replace('language = "de"', f'identifier = "CS 00{number}"')
        )
        amends = Amendment(certificate_folder / f"{number - 1}.xml", "why") if number else None
        certificate("r.json", "LAB.toml", amends=amends).write(f"{number}.xml")
    newest = read_certificate((certificate_folder / "2.xml").read_bytes(), "")
    assert (newest.amended_identifier, newest.replaced_identifiers) == (
        "CS 001",
        ("CS 001", "CS 000"),
    )
    for name in ("CS 000", "cs 000", "CS\u00a0000", "CS 001", "CS000"):
        write_lab(certificate_folder, LAB.replace('language = "de"', f'identifier = "{name}"'))
        with raises("duplicate-entry", "CS 002"):
            certificate("r.json", "LAB.toml", amends=Amendment(certificate_folder / "2.xml", "why"))
    # A circular chain from another program is detected on reading.
    xml = (certificate_folder / "2.xml").read_bytes()
    (certificate_folder / "2.xml").write_bytes(xml.replace(b">CS 002<", b">CS 000<"))
    with pytest.raises(RecordError, match="The amendments are therefore circular"):
        check_certificate(certificate_folder / "2.xml", amended_path=certificate_folder / "1.xml")


def test_amendment_number_is_incremented():
    assert AmendedCertificate("CS-1", "", "").next_identifier() == "CS-1-A1"
    assert AmendedCertificate("CS-1-A9", "", "").next_identifier() == "CS-1-A10"
