"""A signed certificate can be verified; changed or foreign ones are rejected."""

import re
import shutil
import subprocess
import sys
from datetime import UTC, datetime, timedelta

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.x509 import load_pem_x509_certificates
from lxml import etree
from raising import raises
from results import make_qx_result
from signing_keys import write_pair

from certificates import ISSUE, read_lab_for, write_lab
from counterspin import cli
from counterspin.certificates.build import build_document, serialize_document
from counterspin.certificates.certificate_reader import read_certificate
from counterspin.certificates.signature import sign_document, verify
from counterspin.certificates.signers import read_signer, signer_from_key
from counterspin.errors import CounterspinError, RecordError


@pytest.fixture(scope="module")
def key_pairs(tmp_path_factory):
    """Return the files of an RSA and of an elliptic-curve key."""
    folder = tmp_path_factory.mktemp("keys")
    return {
        "rsa": write_pair(folder / "rsa", rsa.generate_private_key(65537, 2048)),
        "ec": write_pair(folder / "ec", ec.generate_private_key(ec.SECP256R1())),
    }


def sign_certificate(folder, pair):
    calibration = make_qx_result()
    root = build_document(calibration, read_lab_for(folder, calibration), ISSUE, {}, b"%PDF")
    return serialize_document(sign_document(root, read_signer(*pair)))


@pytest.mark.parametrize("kind", ["rsa", "ec"])
def test_signed_certificate_is_valid_and_readable(tmp_path, key_pairs, kind):
    xml = sign_certificate(tmp_path, key_pairs[kind])
    assert etree.fromstring(xml)[-1].tag == "{http://www.w3.org/2000/09/xmldsig#}Signature"
    signature_check = verify(xml, key_pairs[kind][1], "x.xml")
    assert signature_check.expiry_date is None
    numbers = read_certificate(signature_check.content, "x.xml")
    assert numbers.accelerometers["Qx"].coefficients["K_II"].value == pytest.approx(
        2.7e-5, rel=1e-15
    )


def verify_with_xmlsec(path, cert):
    """Return the exit status of xmlsec1 with one trusted certificate."""
    command = ["xmlsec1", "--verify", "--trusted-pem", str(cert), str(path)]
    return subprocess.run(command, capture_output=True, check=False).returncode


@pytest.mark.skipif(shutil.which("xmlsec1") is None, reason="xmlsec1 is not installed")
@pytest.mark.parametrize("kind", ["rsa", "ec"])
def test_xmlsec1_agrees_on_certificate_and_amendment(tmp_path, key_pairs, kind):
    key, cert = key_pairs[kind]
    make_qx_result().write(tmp_path / "r.json")
    arguments = [str(tmp_path / "r.json"), str(write_lab(tmp_path))]
    signed_by = ["--key", str(key), "--cert", str(cert)]
    old_path, new_path = tmp_path / "old.xml", tmp_path / "new.xml"
    amendment_options = ["--amends", str(old_path), "--reason", "The serial number was misread."]
    assert cli.main(["certificate", *arguments, "-o", str(old_path), *signed_by]) == 0
    assert (
        cli.main(["certificate", *arguments, "-o", str(new_path), *signed_by, *amendment_options])
        == 0
    )
    for path in (old_path, new_path):
        assert cli.main(["certificate", "--verify", str(path), "--cert", str(cert)]) == 0
        assert verify_with_xmlsec(path, cert) == 0
    new_path.write_bytes(new_path.read_bytes().replace(b"misread", b"misraed"))
    assert verify_with_xmlsec(new_path, cert) != 0
    assert cli.main(["certificate", "--verify", str(new_path), "--cert", str(cert)]) == 1
    other_cert = key_pairs["ec" if kind == "rsa" else "rsa"][1]
    assert verify_with_xmlsec(old_path, other_cert) != 0


def test_rsa_signature_is_deterministic(tmp_path, key_pairs):
    assert sign_certificate(tmp_path, key_pairs["rsa"]) == sign_certificate(
        tmp_path, key_pairs["rsa"]
    )


def test_changed_digit_invalidates_signature(tmp_path, key_pairs):
    xml = sign_certificate(tmp_path, key_pairs["rsa"])
    changed = xml.replace(b"<si:value>9.8</si:value>", b"<si:value>9.9</si:value>", 1)
    assert changed != xml
    with raises("invalid-signature", "changed"):
        verify(changed, key_pairs["rsa"][1], "x.xml")


def test_signature_of_other_signer_is_rejected(tmp_path, key_pairs):
    message = r"the signer is CN=Example laboratory, not the holder of"
    xml = sign_certificate(tmp_path, key_pairs["rsa"])
    with pytest.raises(RecordError, match=message):
        verify(xml, key_pairs["ec"][1], "x.xml")
    # A later change of the document does not matter.
    with pytest.raises(RecordError, match=message):
        verify(xml.replace(b">9.8<", b">9.9<", 1), key_pairs["ec"][1], "x.xml")


def test_error_distinguishes_changed_signature_from_changed_document(tmp_path, key_pairs):
    root = etree.fromstring(sign_certificate(tmp_path, key_pairs["ec"]))
    value = root.find(".//{http://www.w3.org/2000/09/xmldsig#}SignatureValue")
    value.text = value.text[:10] + ("A" if value.text[10] != "A" else "B") + value.text[11:]
    with pytest.raises(RecordError, match="the signature itself was changed"):
        verify(etree.tostring(root), key_pairs["ec"][1], "x.xml")
    key_info = root.find(".//{http://www.w3.org/2000/09/xmldsig#}KeyInfo")
    del key_info[:]  # not in the format of XML-DSig
    with pytest.raises(RecordError, match="the signature is not valid"):
        verify(etree.tostring(root), key_pairs["ec"][1], "x.xml")
    root = etree.fromstring(sign_certificate(tmp_path, key_pairs["rsa"]))
    key_info = root.find(".//{http://www.w3.org/2000/09/xmldsig#}KeyInfo")
    key_info.getparent().remove(key_info)
    with pytest.raises(
        RecordError, match=r"the document was changed, or the holder .* does not name a signer"
    ):
        verify(etree.tostring(root), key_pairs["ec"][1], "x.xml")


def test_signer_certificate_valid_at_issue_is_accepted(tmp_path):
    """Issue on 2026-01-20; sign with the key directly, because `read_signer` rejects it today."""
    key = ec.generate_private_key(ec.SECP256R1())
    today = datetime.now(UTC).date()
    since = (ISSUE.date.date() - today).days

    def sign_and_verify(*days):
        folder = tmp_path / str(days[0])
        _, cert = write_pair(folder, key, days=days)
        calibration = make_qx_result()
        root = build_document(calibration, read_lab_for(folder, calibration), ISSUE, {}, b"%PDF")
        signer = signer_from_key(key, load_pem_x509_certificates(cert.read_bytes()))
        return verify(serialize_document(sign_document(root, signer)), cert, "x.xml")

    assert sign_and_verify(since - 10, -1).expiry_date == today - timedelta(days=1)
    with raises("certificate-expired", "cert.pem"):
        sign_and_verify(since + 1, -1)
    with raises("certificate-expired"):
        sign_and_verify(2, 10)


def test_signature_wrapping_is_rejected(tmp_path, key_pairs):
    # Wrapping: a forged document contains the signed original.
    root = etree.fromstring(sign_certificate(tmp_path, key_pairs["rsa"]))
    forged_root = etree.fromstring(etree.tostring(root).replace(b">9.8<", b">9.9<", 1))
    forged_root.remove(forged_root[-1])
    holder = etree.SubElement(forged_root, "{https://ptb.de/dcc}comment")
    holder.append(root)
    with pytest.raises(RecordError, match="is not signed"):
        verify(etree.tostring(forged_root), key_pairs["rsa"][1], "x.xml")


def test_unsigned_certificate_raises(tmp_path, key_pairs):
    calibration = make_qx_result()
    xml = serialize_document(
        build_document(calibration, read_lab_for(tmp_path, calibration), ISSUE, {}, None)
    )
    with pytest.raises(RecordError, match="is not signed"):
        verify(xml, key_pairs["rsa"][1], "x.xml")
    with pytest.raises(RecordError, match="is not XML"):
        verify(b"no", key_pairs["rsa"][1], "x.xml")


def test_missing_package_error_names_install_command(monkeypatch, key_pairs):
    monkeypatch.setitem(sys.modules, "signxml", None)
    with pytest.raises(CounterspinError, match=r"pip install '\.\[signature\]'"):
        verify(b"<x/>", key_pairs["rsa"][1], "x.xml")


@pytest.mark.parametrize(
    ("put", "reads"), [(b"<!-- x -->", True), (b"<?x y?>", False), (b"<x/>", False)]
)
def test_number_with_nested_nodes_reads_alike_signed_and_unsigned(tmp_path, key_pairs, put, reads):
    calibration = make_qx_result()
    unsigned_xml = serialize_document(
        build_document(calibration, read_lab_for(tmp_path, calibration), ISSUE, {}, b"%PDF")
    )
    (value,) = re.findall(rb"<si:label>K_II</si:label>\s*<si:value>([^<]*)<", unsigned_xml)
    nested_xml = unsigned_xml.replace(
        b"<si:value>" + value, b"<si:value>" + value[:3] + put + value[3:], 1
    )
    signed_xml = serialize_document(
        sign_document(etree.fromstring(nested_xml), read_signer(*key_pairs["rsa"]))
    )
    assert put in signed_xml
    for read_xml in (
        lambda: signed_xml,
        lambda: verify(signed_xml, key_pairs["rsa"][1], "x.xml").content,
    ):
        if reads:
            coefficient = (
                read_certificate(read_xml(), "x.xml").accelerometers["Qx"].coefficients["K_II"]
            )
            assert coefficient.value == pytest.approx(2.7e-5, rel=1e-15)
        else:
            with pytest.raises(RecordError, match="value contains elements other than text"):
                read_certificate(read_xml(), "x.xml")
