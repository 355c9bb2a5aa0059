"""The electronic signature of a certificate: enveloped XML signature with a key of one's own."""

from __future__ import annotations

from base64 import b64decode
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, Final

from counterspin.certificates.elements import NAMESPACES, Element
from counterspin.certificates.schema import parse
from counterspin.certificates.signers import KeyFile, Signer, certificates_in
from counterspin.errors import REASON_LENGTH, CounterspinError, RecordError, installing
from counterspin.frozen import frozen

_NAMESPACE: Final = "{http://www.w3.org/2000/09/xmldsig#}"
_SIGNATURE: Final = f"{_NAMESPACE}Signature"
#: What the document says of its signer.
_STATED: Final = f"{_SIGNATURE}//{_NAMESPACE}X509Certificate"

_SIGNXML_MISSING: Final = (
    f"signatures need the package signxml, which is not installed: {installing('signature')}"
)


@frozen
class SignatureCheck:
    """What the expected signer has signed."""

    content: bytes  #: The signed part of the document: everything but the signature.
    #: The day on which the signer's certificate expired, after the day of issue; None: it is valid.
    expired: date | None


def sign(root: Element, signer: Signer) -> Element:
    """Return the certificate with its signature as the last element."""
    signxml = _signxml()
    signing = signxml.XMLSigner(
        signature_algorithm="rsa-sha256" if signer.with_rsa else "ecdsa-sha256"
    )
    return signing.sign(root, key=_Key(signer), cert=list(signer.certificates))


class _Key:
    """A signer as the private key that signxml asks."""

    def __init__(self, signer: Signer) -> None:
        self._signer = signer
        self.key_size = signer.public.key_size

    def sign(self, data: bytes, **_: Any) -> bytes:
        """Return the signature of bytes, by the method that `sign` names."""
        return self._signer.signed(data)


def verify(document: bytes, certificate: Path, source: str) -> SignatureCheck:
    """Check that a certificate was signed by the expected signer and not changed since.

    A signer's certificate that has expired counts as long as it was valid on the day of issue. That
    day is what the signed document says of itself.

    certificate: X.509 certificate of the signer, PEM, known from elsewhere: what stands in the
        document itself proves nothing.
    """
    _signxml()
    from signxml.exceptions import InvalidDigest

    trusted = certificates_in(KeyFile.read(certificate))[0]
    root = parse(document, source, comments=True)  # it may cover them after all
    if root.find(_SIGNATURE) is None:
        raise RecordError(f"{source}: is not signed")
    try:
        verified = _verified(root, trusted.public_key())
    except InvalidDigest as error:
        raise RecordError(
            f"{source}: the signature is not valid: the document was changed after the holder of "
            f"{certificate} had signed it"
        ) from error
    except Exception as error:  # whatever signxml, lxml and cryptography raise
        raise RecordError(
            f"{source}: the signature is not valid: {_whose(root, certificate)}"
        ) from error
    covered: Any = verified.signed_xml
    if covered is None or covered.tag != root.tag:
        raise RecordError(f"{source}: the signature does not cover the whole document")
    return SignatureCheck(
        bytes(verified.signed_data), _expired(trusted, _issued(covered), certificate, source)
    )


def is_signed(document: bytes, source: str) -> bool:
    """Return whether a certificate has a signature; RecordError if it is not XML."""
    return parse(document, source).find(_SIGNATURE) is not None


def _verified(root: Any, key: Any) -> Any:
    """Return what a key has signed of a document; raises what signxml raises if it has not."""
    signxml = _signxml()
    # signxml takes certificates that are valid today. Whether the signer's was valid when it
    # mattered is judged here, so that signxml gets the key in a certificate of the day.
    wrapped = _certificate_of_today(key)
    # The place matters: a signature deeper in the document could cover something else.
    expected = signxml.SignatureConfiguration(location="./", expect_references=1)
    return signxml.XMLVerifier().verify(root, x509_cert=wrapped, expect_config=expected)


def _certificate_of_today(key: Any) -> Any:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "signer")])
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key)
        .serial_number(1)
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .sign(ec.generate_private_key(ec.SECP256R1()), hashes.SHA256())
    )


def _whose(root: Any, certificate: Path) -> str:
    """Say whose signature it is that is not of the expected signer."""
    from cryptography.x509 import load_der_x509_certificate
    from signxml.exceptions import InvalidDigest

    try:
        stated = load_der_x509_certificate(b64decode(root.findtext(_STATED)))
    except (TypeError, ValueError):
        return f"it was changed, or not signed by the holder of {certificate}; it names no signer"
    try:
        _verified(root, stated.public_key())
    except InvalidDigest:
        pass  # the document was changed after the other signer had signed it
    except Exception:  # whatever signxml and cryptography raise
        return "the signature itself was changed"
    subject = stated.subject.rfc4514_string()[:REASON_LENGTH]
    return f"it is that of another signer ({subject}), not of the holder of {certificate}"


def _issued(root: Any) -> date | None:
    """Return the day of issue that a certificate states."""
    text = root.findtext(".//dcc:coreData/dcc:issueDate", namespaces=NAMESPACES)
    try:
        return date.fromisoformat((text or "").strip())
    except ValueError:
        return None


def _expired(trusted: Any, issued: date | None, certificate: Path, source: str) -> date | None:
    """Return when the signer's certificate expired, None if it has not; raises if it never was."""
    now = datetime.now(UTC)
    begin, end = trusted.not_valid_before_utc, trusted.not_valid_after_utc
    if begin > now:
        raise RecordError(
            f"{source}: {certificate} is valid from {begin:%Y-%m-%d} only; check the clock"
        )
    if now <= end:
        return None
    if issued is None or not begin.date() <= issued <= end.date():
        day = "no day of issue" if issued is None else f"the day of issue {issued}"
        raise RecordError(
            f"{source}: {certificate} was valid from {begin:%Y-%m-%d} to {end:%Y-%m-%d}, and the "
            f"document states {day}: nothing shows that it was signed during that time"
        )
    last: date = end.date()
    return last


def _signxml() -> Any:
    try:
        import signxml
    except ImportError as error:
        raise CounterspinError(_SIGNXML_MISSING) from error
    return signxml
