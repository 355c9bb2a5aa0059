"""Make signed.xml and two certificates of signers: a document that xmlsec1 has signed.

Run from this folder: ``python make_signed.py`` (needs xmlsec1 and cryptography). Nothing here uses
counterspin: the document, of the name space of DCC, is written down below; its signature is made by
xmlsec1, which shares no code with what verifies it. The keys are thrown away, so that what comes
out differs each time, and serves as well.
"""

import pathlib
import subprocess
import tempfile
from datetime import UTC, datetime

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

DSIG = "http://www.w3.org/2000/09/xmldsig#"
C14N = "http://www.w3.org/2006/12/xml-c14n11"
TEMPLATE = f"""<?xml version="1.0" encoding="UTF-8"?>
<dcc:digitalCalibrationCertificate xmlns:dcc="https://ptb.de/dcc" schemaVersion="3.3.0">
 <dcc:administrativeData>
  <dcc:coreData>
   <dcc:uniqueIdentifier>K-2026-0117</dcc:uniqueIdentifier>
   <dcc:issueDate>2026-01-20</dcc:issueDate>
  </dcc:coreData>
 </dcc:administrativeData>
 <ds:Signature xmlns:ds="{DSIG}">
  <ds:SignedInfo>
   <ds:CanonicalizationMethod Algorithm="{C14N}"/>
   <ds:SignatureMethod Algorithm="http://www.w3.org/2001/04/xmldsig-more#rsa-sha256"/>
   <ds:Reference URI="">
    <ds:Transforms>
     <ds:Transform Algorithm="{DSIG}enveloped-signature"/>
     <ds:Transform Algorithm="{C14N}"/>
    </ds:Transforms>
    <ds:DigestMethod Algorithm="http://www.w3.org/2001/04/xmlenc#sha256"/>
    <ds:DigestValue/>
   </ds:Reference>
  </ds:SignedInfo>
  <ds:SignatureValue/>
  <ds:KeyInfo><ds:X509Data><ds:X509Certificate/></ds:X509Data></ds:KeyInfo>
 </ds:Signature>
</dcc:digitalCalibrationCertificate>
"""


def pair(name):
    """Return a key and its self-signed certificate as PEM."""
    key = rsa.generate_private_key(65537, 2048)
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(datetime(2020, 1, 1, tzinfo=UTC))
        .not_valid_after(datetime(2040, 1, 1, tzinfo=UTC))
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return private, certificate.public_bytes(Encoding.PEM)


def main():
    data = pathlib.Path(__file__).parents[2] / "src" / "counterspin" / "validation" / "data"
    folder = data / "signed"
    folder.mkdir(exist_ok=True)
    key, certificate = pair("Reference signer")
    (folder / "signer.pem").write_bytes(certificate)
    (folder / "other.pem").write_bytes(pair("Another signer")[1])
    with tempfile.TemporaryDirectory() as name:
        place = pathlib.Path(name)
        (place / "key.pem").write_bytes(key)
        (place / "template.xml").write_text(TEMPLATE, encoding="utf-8")
        keys = f"{place / 'key.pem'},{folder / 'signer.pem'}"
        words = ["xmlsec1", "--sign", "--privkey-pem", keys, "--output", str(folder / "signed.xml")]
        subprocess.run([*words, str(place / "template.xml")], check=True)


if __name__ == "__main__":
    main()
