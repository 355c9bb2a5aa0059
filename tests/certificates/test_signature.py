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
    given = make_qx_result()
    root = build_document(given, read_lab_for(folder, given), ISSUE, {}, b"%PDF")
    return serialize_document(sign_document(root, read_signer(*pair)))


@pytest.mark.parametrize("kind", ["rsa", "ec"])
def test_signed_certificate_is_valid_and_readable(tmp_path, key_pairs, kind):
    xml = sign_certificate(tmp_path, key_pairs[kind])
    assert etree.fromstring(xml)[-1].tag == "{http://www.w3.org/2000/09/xmldsig#}Signature"
    covered = verify(xml, key_pairs[kind][1], "x.xml")
    assert covered.expiry_date is None
    found = read_certificate(covered.content, "x.xml")
    assert found.accelerometers["Qx"].coefficients["K_II"].value == pytest.approx(2.7e-5, rel=1e-15)


def verify_with_xmlsec(path, cert):
    """Return the exit status of xmlsec1 with one trusted certificate."""
    words = ["xmlsec1", "--verify", "--trusted-pem", str(cert), str(path)]
    return subprocess.run(words, capture_output=True, check=False).returncode


@pytest.mark.skipif(shutil.which("xmlsec1") is None, reason="xmlsec1 is not installed")
@pytest.mark.parametrize("kind", ["rsa", "ec"])
def test_xmlsec1_agrees_on_certificate_and_amendment(tmp_path, key_pairs, kind):
    key, cert = key_pairs[kind]
    make_qx_result().write(tmp_path / "r.json")
    given = [str(tmp_path / "r.json"), str(write_lab(tmp_path))]
    signed_by = ["--key", str(key), "--cert", str(cert)]
    old, new = tmp_path / "old.xml", tmp_path / "new.xml"
    why = ["--amends", str(old), "--reason", "The serial number was misread."]
    assert cli.main(["certificate", *given, "-o", str(old), *signed_by]) == 0
    assert cli.main(["certificate", *given, "-o", str(new), *signed_by, *why]) == 0
    for made in (old, new):
        assert cli.main(["certificate", "--verify", str(made), "--cert", str(cert)]) == 0
        assert verify_with_xmlsec(made, cert) == 0
    new.write_bytes(new.read_bytes().replace(b"misread", b"misraed"))
    assert verify_with_xmlsec(new, cert) != 0
    assert cli.main(["certificate", "--verify", str(new), "--cert", str(cert)]) == 1
    other = key_pairs["ec" if kind == "rsa" else "rsa"][1]
    assert verify_with_xmlsec(old, other) != 0


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
    other = r"the signer is CN=Example laboratory, not the holder of"
    xml = sign_certificate(tmp_path, key_pairs["rsa"])
    with pytest.raises(RecordError, match=other):
        verify(xml, key_pairs["ec"][1], "x.xml")
    # A later change of the document does not matter.
    with pytest.raises(RecordError, match=other):
        verify(xml.replace(b">9.8<", b">9.9<", 1), key_pairs["ec"][1], "x.xml")


def test_error_distinguishes_changed_signature_from_changed_document(tmp_path, key_pairs):
    root = etree.fromstring(sign_certificate(tmp_path, key_pairs["ec"]))
    value = root.find(".//{http://www.w3.org/2000/09/xmldsig#}SignatureValue")
    value.text = value.text[:10] + ("A" if value.text[10] != "A" else "B") + value.text[11:]
    with pytest.raises(RecordError, match="the signature itself was changed"):
        verify(etree.tostring(root), key_pairs["ec"][1], "x.xml")
    stated = root.find(".//{http://www.w3.org/2000/09/xmldsig#}KeyInfo")
    del stated[:]  # not in the format of XML-DSig
    with pytest.raises(RecordError, match="the signature is not valid"):
        verify(etree.tostring(root), key_pairs["ec"][1], "x.xml")
    root = etree.fromstring(sign_certificate(tmp_path, key_pairs["rsa"]))
    stated = root.find(".//{http://www.w3.org/2000/09/xmldsig#}KeyInfo")
    stated.getparent().remove(stated)
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
        given = make_qx_result()
        root = build_document(given, read_lab_for(folder, given), ISSUE, {}, b"%PDF")
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
    forged = etree.fromstring(etree.tostring(root).replace(b">9.8<", b">9.9<", 1))
    forged.remove(forged[-1])
    holder = etree.SubElement(forged, "{https://ptb.de/dcc}comment")
    holder.append(root)
    with pytest.raises(RecordError, match="is not signed"):
        verify(etree.tostring(forged), key_pairs["rsa"][1], "x.xml")


def test_unsigned_certificate_raises(tmp_path, key_pairs):
    given = make_qx_result()
    made = serialize_document(build_document(given, read_lab_for(tmp_path, given), ISSUE, {}, None))
    with pytest.raises(RecordError, match="is not signed"):
        verify(made, key_pairs["rsa"][1], "x.xml")
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
    given = make_qx_result()
    plain = serialize_document(
        build_document(given, read_lab_for(tmp_path, given), ISSUE, {}, b"%PDF")
    )
    (value,) = re.findall(rb"<si:label>K_II</si:label>\s*<si:value>([^<]*)<", plain)
    spoilt = plain.replace(b"<si:value>" + value, b"<si:value>" + value[:3] + put + value[3:], 1)
    made = serialize_document(
        sign_document(etree.fromstring(spoilt), read_signer(*key_pairs["rsa"]))
    )
    assert put in made
    for read in (lambda: made, lambda: verify(made, key_pairs["rsa"][1], "x.xml").content):
        if reads:
            coefficient = (
                read_certificate(read(), "x.xml").accelerometers["Qx"].coefficients["K_II"]
            )
            assert coefficient.value == pytest.approx(2.7e-5, rel=1e-15)
        else:
            with pytest.raises(RecordError, match="value contains elements other than text"):
                read_certificate(read(), "x.xml")
