"""A signed certificate can be verified, and no other passes for it."""

import sys

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from lxml import etree
from results import result
from signing_keys import write_pair

from certificates import ISSUE, lab_of
from counterspin.certificates.build import certificate, to_bytes
from counterspin.certificates.reading import read_certificate
from counterspin.certificates.signature import read_signer, sign, verify
from counterspin.errors import CounterspinError, RecordError


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    """Return the files of an RSA and of an elliptic-curve key."""
    folder = tmp_path_factory.mktemp("keys")
    return {
        "rsa": write_pair(folder / "rsa", rsa.generate_private_key(65537, 2048)),
        "ec": write_pair(folder / "ec", ec.generate_private_key(ec.SECP256R1())),
    }


def signed(folder, pair):
    given = result()
    root = certificate(given, lab_of(folder, given), ISSUE, {}, b"%PDF")
    return to_bytes(sign(root, read_signer(*pair)))


@pytest.mark.parametrize("kind", ["rsa", "ec"])
def test_a_signed_certificate_verifies_and_reads_back(tmp_path, pairs, kind):
    made = signed(tmp_path, pairs[kind])
    assert etree.fromstring(made)[-1].tag == "{http://www.w3.org/2000/09/xmldsig#}Signature"
    covered = verify(made, pairs[kind][1], "x.xml")
    found = read_certificate(covered, "x.xml")
    assert found.accelerometers["Qx"].coefficients["K_II"].value == pytest.approx(2.7e-5, rel=1e-15)


def test_an_rsa_signature_is_the_same_every_time(tmp_path, pairs):
    assert signed(tmp_path, pairs["rsa"]) == signed(tmp_path, pairs["rsa"])


def test_one_changed_digit_is_noticed(tmp_path, pairs):
    made = signed(tmp_path, pairs["rsa"])
    changed = made.replace(b"<si:value>9.8</si:value>", b"<si:value>9.9</si:value>", 1)
    assert changed != made
    with pytest.raises(RecordError, match=r"x\.xml: the signature is not valid"):
        verify(changed, pairs["rsa"][1], "x.xml")


def test_somebody_else_s_signature_is_noticed(tmp_path, pairs):
    with pytest.raises(RecordError, match="not signed by the holder of"):
        verify(signed(tmp_path, pairs["rsa"]), pairs["ec"][1], "x.xml")


def test_a_signature_of_something_else_in_the_document_does_not_count(tmp_path, pairs):
    # Wrapping: the signed original is kept inside, and a forged one put round it.
    root = etree.fromstring(signed(tmp_path, pairs["rsa"]))
    forged = etree.fromstring(etree.tostring(root).replace(b">9.8<", b">9.9<", 1))
    forged.remove(forged[-1])
    holder = etree.SubElement(forged, "{https://ptb.de/dcc}comment")
    holder.append(root)
    with pytest.raises(RecordError, match="is not signed"):
        verify(etree.tostring(forged), pairs["rsa"][1], "x.xml")


def test_an_unsigned_certificate_is_told(tmp_path, pairs):
    given = result()
    made = to_bytes(certificate(given, lab_of(tmp_path, given), ISSUE, {}, None))
    with pytest.raises(RecordError, match="is not signed"):
        verify(made, pairs["rsa"][1], "x.xml")
    with pytest.raises(RecordError, match="is not XML"):
        verify(b"no", pairs["rsa"][1], "x.xml")


def test_a_key_that_cannot_sign_is_told(tmp_path, pairs):
    key, cert = pairs["rsa"]
    locked, _ = write_pair(tmp_path / "locked", rsa.generate_private_key(65537, 2048), b"secret")
    with pytest.raises(CounterspinError, match="is encrypted; give a key without a passphrase"):
        read_signer(locked, cert)
    odd = write_pair(tmp_path / "odd", ed25519.Ed25519PrivateKey.generate())
    with pytest.raises(CounterspinError, match="must be an RSA or an elliptic-curve key"):
        read_signer(*odd)
    with pytest.raises(CounterspinError, match="is not a private key in PEM form"):
        read_signer(cert, cert)
    with pytest.raises(CounterspinError, match=r"is not an X\.509 certificate in PEM form"):
        read_signer(key, key)
    with pytest.raises(CounterspinError, match="is not the certificate of the key"):
        read_signer(key, pairs["ec"][1])
    with pytest.raises(CounterspinError, match=r"none\.pem: cannot be read"):
        read_signer(tmp_path / "none.pem", cert)


def test_without_the_package_it_is_said_where_it_comes_from(monkeypatch, pairs):
    monkeypatch.setitem(sys.modules, "signxml", None)
    with pytest.raises(CounterspinError, match=r"pip install counterspin\[signature\]"):
        read_signer(*pairs["rsa"])
