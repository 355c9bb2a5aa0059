"""Electronic signatures of a certificate: XML signature, and PAdES signature of its pages.

The pages' signature is an incremental update: existing bytes, the conformance with PDF/A-3 and the
attachments do not change.
"""

from __future__ import annotations

import io
from base64 import b64decode
from collections.abc import Coroutine
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, Literal

from counterspin.certificates.schema import NAMESPACES, Element, parse
from counterspin.certificates.signers import KeyMaterial, Signer, certificates_in
from counterspin.errors import (
    MAX_REASON_LENGTH,
    MissingPackageError,
    RecordError,
    install_command,
)
from counterspin.frozen import frozen

_NAMESPACE: Final = "{http://www.w3.org/2000/09/xmldsig#}"
_SIGNATURE: Final = f"{_NAMESPACE}Signature"
#: Certificate of the signer in the document.
_STATED_CERTIFICATE: Final = f"{_SIGNATURE}//{_NAMESPACE}X509Certificate"

_SIGNXML_MISSING: Final = (
    "signatures require the package signxml, which is not installed: "
    f"{install_command('signature')}"
)


@frozen
class SignatureCheck:
    """Content signed by the expected signer."""

    content: bytes  #: The signed part of the document: everything but the signature.
    #: The day on which the signer's certificate expired, after the day of issue; None: it is valid.
    expired: date | None


def sign(root: Element, signer: Signer) -> Element:
    """Return the certificate with its signature as the last element."""
    signxml = _signxml()
    signing = signxml.XMLSigner(
        signature_algorithm="rsa-sha256" if signer.uses_rsa else "ecdsa-sha256"
    )
    return signing.sign(root, key=_SigningKey(signer), cert=list(signer.certificates))


class _SigningKey:
    """A signer as the private key that signxml needs."""

    def __init__(self, signer: Signer) -> None:
        self._signer = signer
        self.key_size = signer.public_key.key_size

    def sign(self, data: bytes, **_: Any) -> bytes:
        """Return the signature of bytes with the scheme that `sign` names."""
        return self._signer.sign(data)


def verify(document: bytes, certificate: Path | KeyMaterial, source: str) -> SignatureCheck:
    """Check that the expected signer signed a certificate, and that it has not changed since.

    A signer's certificate that has expired counts if it was valid on the day of issue, as the
    signed document states it.

    certificate: X.509 certificate of the signer, PEM, from another source: the one in the document
        itself proves nothing.
    """
    _signxml()
    from signxml.exceptions import InvalidDigest

    trusted = certificates_in(KeyMaterial.read(certificate))[0]
    root = parse(document, source, comments=True)  # the signature may cover the comments
    if root.find(_SIGNATURE) is None:
        raise RecordError(f"{source} is not signed", code="invalid-signature")
    try:
        verified = _signed_part(root, trusted.public_key())
    except InvalidDigest as error:
        raise RecordError(
            f"{source}: the signature is not valid, because the document was changed after the "
            f"holder of {certificate} signed it",
            code="invalid-signature",
        ) from error
    except Exception as error:  # any error of signxml, lxml and cryptography
        raise RecordError(
            f"{source}: the signature is not valid: {_describe_signer(root, certificate)}",
            code="invalid-signature",
        ) from error
    covered: Any = verified.signed_xml
    if covered is None or covered.tag != root.tag:
        raise RecordError(
            f"{source}: the signature does not cover the whole document", code="invalid-signature"
        )
    return SignatureCheck(
        bytes(verified.signed_data), _expiry(trusted, _issue_date(covered), certificate, source)
    )


def is_signed(document: bytes, source: str) -> bool:
    """Return whether a certificate has a signature; RecordError if it is not XML."""
    return parse(document, source).find(_SIGNATURE) is not None


def _signed_part(root: Any, key: Any) -> Any:
    """Return the part of a document that a key has signed; raises as signxml if there is none."""
    signxml = _signxml()
    # signxml accepts only certificates that are valid today. The validity of the signer's
    # certificate is checked separately, so signxml gets the key in a temporary certificate.
    wrapper = _make_current_certificate(key)
    # The location matters: a signature deeper in the document could cover other content.
    expected = signxml.SignatureConfiguration(location="./", expect_references=1)
    return signxml.XMLVerifier().verify(root, x509_cert=wrapper, expect_config=expected)


def _make_current_certificate(key: Any) -> Any:
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


def _describe_signer(root: Any, certificate: Path | KeyMaterial) -> str:
    """Describe the signer of a signature that is not the expected signer's."""
    from cryptography.x509 import load_der_x509_certificate
    from signxml.exceptions import InvalidDigest

    try:
        stated = load_der_x509_certificate(b64decode(root.findtext(_STATED_CERTIFICATE)))
    except (TypeError, ValueError):
        return (
            f"the document was changed, or the holder of {certificate} did not sign it; the "
            "document does not name a signer"
        )
    try:
        _signed_part(root, stated.public_key())
    except InvalidDigest:
        pass  # the document was changed after the other signer had signed it
    except Exception:  # any error of signxml and cryptography
        return "the signature itself was changed"
    subject = stated.subject.rfc4514_string()[:MAX_REASON_LENGTH]
    return f"the signer is {subject}, not the holder of {certificate}"


def _issue_date(root: Any) -> date | None:
    """Return the day of issue that a certificate states."""
    text = root.findtext(".//dcc:coreData/dcc:issueDate", namespaces=NAMESPACES)
    try:
        return date.fromisoformat((text or "").strip())
    except ValueError:
        return None


def _expiry(
    trusted: Any, issued: date | None, certificate: Path | KeyMaterial, source: str
) -> date | None:
    """Return the expiry day of the signer's certificate, None if valid; raise if never valid."""
    now = datetime.now(UTC)
    begin, end = trusted.not_valid_before_utc, trusted.not_valid_after_utc
    if begin > now:
        raise RecordError(
            f"{source}: {certificate} is valid only from {begin:%Y-%m-%d}; check the clock",
            code="certificate-expired",
        )
    if now <= end:
        return None
    if issued is None or not begin.date() <= issued <= end.date():
        day = "no day of issue" if issued is None else f"the day of issue {issued}"
        raise RecordError(
            f"{source}: {certificate} was valid from {begin:%Y-%m-%d} to {end:%Y-%m-%d}, but "
            f"the document states {day}, so there is no evidence that the document was signed "
            "within this period",
            code="certificate-expired",
        )
    last_day: date = end.date()
    return last_day


def _signxml() -> Any:
    try:
        import signxml
    except ImportError as error:
        raise MissingPackageError(_SIGNXML_MISSING) from error
    return signxml


#: State of a PDF's signature: absent; valid; pages changed since; of another signer, or damaged.
PdfSignatureStatus = Literal["none", "valid", "changed", "invalid"]

_FIELD: Final = "Signature"
_REASON: Final = "Electronic signature of this certificate"
_MISSING: Final = (
    "signing a PDF requires the package pyHanko, which is not installed: "
    f"{install_command('signature')}"
)


def sign_pages(pages: bytes, signer: Signer, date: datetime) -> bytes:
    """Return a PDF with its signature, which allows no change after it.

    date: Time of signing that the signature states.
    """
    _require_pyhanko()
    from pyhanko.pdf_utils.generic import ArrayObject, ByteStringObject
    from pyhanko.pdf_utils.incremental_writer import IncrementalPdfFileWriter
    from pyhanko.sign.fields import MDPPerm, SigFieldSpec, SigSeedSubFilter
    from pyhanko.sign.signers.cms_embedder import (
        PdfCMSEmbedder,
        SigIOSetup,
        SigMDPSetup,
        SigObjSetup,
    )
    from pyhanko.sign.signers.pdf_byterange import SignatureObject

    class Addition(IncrementalPdfFileWriter):  # type: ignore[misc, unused-ignore]
        """An incremental update that keeps the file's identifier and metadata."""

        @classmethod
        def _handle_id(cls, prev: Any) -> Any:
            # No random bytes: the same certificate gives the same file.
            first = prev.trailer["/ID"][0].original_bytes
            return ArrayObject([ByteStringObject(first), ByteStringObject(_digest(pages)[:16])])

        def _update_meta(self) -> None:
            # Metadata rewritten by pyHanko would not conform to PDF/A.
            pass

    # An object begins on a line of its own (PDF/A-3, 6.1.9).
    pdf_writer = io.BytesIO(pages if pages.endswith(b"\n") else pages + b"\n")
    max_size = replace(signer, sign=lambda _: bytes(_max_signature_size(signer)))
    reserved_size = len(_run_coroutine(_sign_digest(max_size, bytes(32))))
    field = SigFieldSpec(_FIELD, readable_field_name=_REASON)
    embedding = PdfCMSEmbedder(field).write_cms(_FIELD, Addition(pdf_writer))
    next(embedding)
    placeholder = SignatureObject(
        timestamp=date,
        subfilter=SigSeedSubFilter.PADES,
        bytes_reserved=2 * reserved_size,
    )
    permissions = SigMDPSetup("sha256", certify=True, docmdp_perms=MDPPerm.NO_CHANGES)
    embedding.send(SigObjSetup(sig_placeholder=placeholder, mdp_setup=permissions))
    prepared, output = embedding.send(SigIOSetup(md_algorithm="sha256"))
    embedding.send(_run_coroutine(_sign_digest(signer, prepared.document_digest)))
    placeholder_pdf: bytes = output.getvalue()
    return placeholder_pdf


def _max_signature_size(signer: Signer) -> int:
    """Return the largest number of bytes of a signature; signatures by elliptic curves vary."""
    from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature

    size: int = signer.public_key.key_size
    max_integer = (1 << size) - 1
    return size // 8 if signer.uses_rsa else len(encode_dss_signature(max_integer, max_integer))


async def _sign_digest(signer: Signer, digest: bytes) -> bytes:
    """Return the signature of a digest with the certificates of its signer (CMS, CAdES)."""
    from asn1crypto.x509 import Certificate
    from cryptography.hazmat.primitives.serialization import Encoding
    from pyhanko.sign.signers.pdf_cms import Signer as CmsSigner
    from pyhanko_certvalidator.registry import SimpleCertificateStore

    class OfDigests(CmsSigner):  # type: ignore[misc, unused-ignore]
        async def async_sign_raw(
            self,
            data: bytes,
            digest_algorithm: str,
            dry_run: bool = False,  # noqa: ARG002
        ) -> bytes:
            assert digest_algorithm == "sha256"
            return signer.sign(data)

    signing_certificate, *chain = (
        Certificate.load(certificate.public_bytes(Encoding.DER))
        for certificate in signer.certificates
    )
    store: Any = SimpleCertificateStore()  # type: ignore[no-untyped-call, unused-ignore]
    store.register_multiple(chain)
    cms = await OfDigests(signing_cert=signing_certificate, cert_registry=store).async_sign(
        digest, "sha256", use_pades=True
    )
    content: bytes = cms.dump()
    return content


def _run_coroutine(work: Coroutine[Any, Any, bytes]) -> bytes:
    """Return a coroutine's result.

    It runs in a thread if an event loop is active, as in a notebook.
    """
    import asyncio
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()


def verify_pdf_signature(document: bytes, public: bytes) -> PdfSignatureStatus:
    """Return the state of the signature of a PDF's pages.

    public: X.509 certificate of the expected signer, DER. Its validity at the time of signing is
        not checked.
    """
    _require_pyhanko()
    from asn1crypto.x509 import Certificate
    from pyhanko.pdf_utils.reader import PdfFileReader
    from pyhanko.sign.fields import enumerate_sig_fields
    from pyhanko.sign.validation.generic_cms import validate_sig_integrity
    from pyhanko.sign.validation.status import SignatureCoverageLevel

    reader = PdfFileReader(io.BytesIO(document))
    signatures = reader.embedded_signatures
    if not signatures:
        # A signature field exists but cannot be parsed.
        return "invalid" if any(enumerate_sig_fields(reader, filled_status=True)) else "none"
    # The last signature covers all earlier content; content after it is unsigned.
    last = signatures[-1]
    last.compute_integrity_info(skip_diff=True)
    covers_file = last.coverage == SignatureCoverageLevel.ENTIRE_FILE
    # Compare keys, as for the XML: the certificate may have been renewed.
    signer, expected = last.signer_cert, Certificate.load(public)
    if signer.public_key.dump() != expected.public_key.dump():
        return "invalid"
    unchanged, valid = validate_sig_integrity(
        last.signer_info, signer, "data", last.compute_digest()
    )
    if not valid:
        return "invalid"
    return "valid" if unchanged and covers_file else "changed"


def _digest(data: bytes) -> bytes:
    return sha256(data).digest()


def _require_pyhanko() -> None:
    try:
        import pyhanko.sign  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(_MISSING) from error
