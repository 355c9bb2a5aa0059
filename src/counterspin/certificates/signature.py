"""The electronic signature of a certificate: enveloped XML signature with a key of one's own.

- `Signer`, `read_signer`: the signer's key and certificate
- `sign`: a certificate with its signature
- `verify`: whether a certificate is unchanged since the expected signer signed it
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from counterspin.certificates.elements import Element
from counterspin.errors import CounterspinError, RecordError
from counterspin.input import read_file

_SIGNATURE: Final = "{http://www.w3.org/2000/09/xmldsig#}Signature"

_SIGNXML_MISSING: Final = (
    "signatures need the package signxml, which is not installed; it comes with "
    "`pip install counterspin[signature]`"
)


@dataclass(frozen=True)
class Signer:
    """Who signs.

    Attributes
    ----------
    key
        Private key, RSA or elliptic curve.
    certificates
        X.509: the signer's, followed by its chain if given.
    """

    key: Any
    certificates: list[Any]


def read_signer(key: Path, certificate: Path) -> Signer:
    """Read a private key and the certificate that belongs to it, both PEM.

    Raises
    ------
    CounterspinError
        If signxml is not installed, a file is missing or cannot be used, the key is encrypted or of
        a kind that XML signatures do not support, or key and certificate do not match.
    """
    _signxml()
    from cryptography.hazmat.primitives.asymmetric import ec, rsa
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        private: Any = load_pem_private_key(_read(key), password=None)
    except TypeError as error:
        raise CounterspinError(
            f"{key}: is encrypted; give a key without a passphrase, such as "
            "`openssl pkey -in KEY.pem -out OPEN.pem` writes, and keep it safe"
        ) from error
    except ValueError as error:
        raise CounterspinError(f"{key}: is not a private key in PEM form") from error
    if not isinstance(private, rsa.RSAPrivateKey | ec.EllipticCurvePrivateKey):
        raise CounterspinError(f"{key}: must be an RSA or an elliptic-curve key")
    certificates = _read_certificates(certificate)
    if certificates[0].public_key() != private.public_key():
        raise CounterspinError(f"{certificate}: is not the certificate of the key {key}")
    return Signer(private, certificates)


def sign(root: Element, signer: Signer) -> Element:
    """Return the certificate with its signature as the last element."""
    signxml = _signxml()
    from cryptography.hazmat.primitives.asymmetric import rsa

    method = "rsa-sha256" if isinstance(signer.key, rsa.RSAPrivateKey) else "ecdsa-sha256"
    signing = signxml.XMLSigner(signature_algorithm=method)
    return signing.sign(root, key=signer.key, cert=signer.certificates)


def verify(document: bytes, certificate: Path, source: str) -> bytes:
    """Check that a certificate was signed by the expected signer and not changed since.

    Parameters
    ----------
    document
        The certificate as it was received.
    certificate
        X.509 certificate of the signer, PEM, known from elsewhere: what stands in the document
        itself proves nothing.
    source
        What the document is called in messages.

    Returns
    -------
    bytes
        The signed part of the document: everything but the signature.

    Raises
    ------
    RecordError
        If it is not signed, was changed, or was signed by somebody else.
    CounterspinError
        If signxml is not installed or the certificate cannot be read.
    """
    signxml = _signxml()
    from counterspin.certificates.schema import parse

    trusted = _read_certificates(certificate)[0]
    root = parse(document, source)
    if root.find(_SIGNATURE) is None:
        raise RecordError(f"{source}: is not signed")
    # The place matters: a signature deeper in the document could cover something else.
    expected = signxml.SignatureConfiguration(location="./", expect_references=1)
    try:
        verified = signxml.XMLVerifier().verify(root, x509_cert=trusted, expect_config=expected)
    except (signxml.InvalidSignature, signxml.InvalidInput) as error:
        raise RecordError(
            f"{source}: the signature is not valid: the document was changed after it was signed, "
            f"or was not signed by the holder of {certificate} ({error})"
        ) from error
    covered: Any = verified.signed_xml
    if covered is None or covered.tag != root.tag:
        raise RecordError(f"{source}: the signature does not cover the whole document")
    return bytes(verified.signed_data)


def _signxml() -> Any:
    try:
        import signxml
    except ImportError as error:
        raise CounterspinError(_SIGNXML_MISSING) from error
    return signxml


def _read_certificates(path: Path) -> list[Any]:
    from cryptography.x509 import load_pem_x509_certificates

    try:
        return load_pem_x509_certificates(_read(path))
    except ValueError as error:
        raise CounterspinError(f"{path}: is not an X.509 certificate in PEM form") from error


def _read(path: Path) -> bytes:
    try:
        return read_file(path)
    except OSError as error:
        raise CounterspinError(f"{path}: cannot be read ({error.strerror})") from error
