"""Electronic signatures of a certificate: XML signature, and PAdES signature of the pages.

The signature of the pages is an incremental update: existing bytes, PDF/A-3 conformance and
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

from counterspin.certificates.schema import NAMESPACES, Element, parse_xml
from counterspin.certificates.signers import KeyMaterial, Signer, read_certificates
from counterspin.errors import MAX_REASON_LENGTH, MissingPackageError, RecordError, install_command
from counterspin.frozen import frozen

_XMLDSIG_NAMESPACE: Final = "{http://www.w3.org/2000/09/xmldsig#}"
_SIGNATURE_TAG: Final = f"{_XMLDSIG_NAMESPACE}Signature"
#: Certificate of the signer in the document.
_CERTIFICATE_PATH: Final = f"{_SIGNATURE_TAG}//{_XMLDSIG_NAMESPACE}X509Certificate"

_SIGNXML_MISSING: Final = (
    "signatures require the package signxml, which is not installed: "
    f"{install_command('signature')}"
)


@frozen
class SignatureCheck:
    """Content signed by the expected signer."""

    content: bytes  #: Signed part of the document: everything except the signature.
    #: Day on which the signer certificate expired, after the day of issue; None: valid.
    expiry_date: date | None


def sign_document(root: Element, signer: Signer) -> Element:
    """Sign a certificate; the signature is the last element."""
    signxml = _import_signxml()
    xml_signer = signxml.XMLSigner(
        signature_algorithm="rsa-sha256" if signer.uses_rsa else "ecdsa-sha256"
    )
    return xml_signer.sign(root, key=_SigningKey(signer), cert=list(signer.certificates))


class _SigningKey:
    """Adapter of a signer to the private-key interface of signxml."""

    def __init__(self, signer: Signer) -> None:
        self._signer = signer
        self.key_size = signer.public_key.key_size

    def sign(self, data: bytes, **_: Any) -> bytes:
        """Return the signature of bytes."""
        return self._signer.sign(data)


def verify(document: bytes, certificate: Path | KeyMaterial, source: str) -> SignatureCheck:
    """Verify that the expected signer signed a certificate and that it was not changed.

    An expired signer certificate is accepted if it was valid on the signed day of issue.

    certificate: X.509 certificate of the signer, PEM, from a trusted source; the certificate in the
        document is not evidence.
    """
    _import_signxml()
    from signxml.exceptions import InvalidDigest

    signer_certificate = read_certificates(KeyMaterial.read(certificate))[0]
    root = parse_xml(document, source, keep_comments=True)  # the signature may cover the comments
    if root.find(_SIGNATURE_TAG) is None:
        raise RecordError(f"{source} is not signed", code="invalid-signature")
    try:
        verification = _verify_with_key(root, signer_certificate.public_key())
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
    signed_root: Any = verification.signed_xml
    if signed_root is None or signed_root.tag != root.tag:
        raise RecordError(
            f"{source}: the signature does not cover the whole document", code="invalid-signature"
        )
    return SignatureCheck(
        bytes(verification.signed_data),
        _expiry_date(signer_certificate, _read_issue_date(signed_root), certificate, source),
    )


def is_signed(document: bytes, source: str) -> bool:
    """Return whether a certificate has a signature; RecordError if it is not XML."""
    return parse_xml(document, source).find(_SIGNATURE_TAG) is not None


def _verify_with_key(root: Any, key: Any) -> Any:
    """Verify a document with a key; return the result of signxml, or raise its errors."""
    signxml = _import_signxml()
    # signxml accepts only certificates that are valid today. The validity of the signer's
    # certificate is checked separately, so the key is passed in a temporary certificate.
    self_signed_certificate = _make_self_signed_certificate(key)
    # The location matters: a signature deeper in the document could cover other content.
    configuration = signxml.SignatureConfiguration(location="./", expect_references=1)
    return signxml.XMLVerifier().verify(
        root, x509_cert=self_signed_certificate, expect_config=configuration
    )


def _make_self_signed_certificate(key: Any) -> Any:
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
    """Describe the signer of a document that the expected signer did not sign."""
    from cryptography.x509 import load_der_x509_certificate
    from signxml.exceptions import InvalidDigest

    try:
        stated_certificate = load_der_x509_certificate(b64decode(root.findtext(_CERTIFICATE_PATH)))
    except (TypeError, ValueError):
        return (
            f"the document was changed, or the holder of {certificate} did not sign it; the "
            "document does not name a signer"
        )
    try:
        _verify_with_key(root, stated_certificate.public_key())
    except InvalidDigest:
        pass  # the document was changed after the other signer had signed it
    except Exception:  # any error of signxml and cryptography
        return "the signature itself was changed"
    subject = stated_certificate.subject.rfc4514_string()[:MAX_REASON_LENGTH]
    return f"the signer is {subject}, not the holder of {certificate}"


def _read_issue_date(root: Any) -> date | None:
    """Return the day of issue in a certificate; None without one."""
    text = root.findtext(".//dcc:coreData/dcc:issueDate", namespaces=NAMESPACES)
    try:
        return date.fromisoformat((text or "").strip())
    except ValueError:
        return None


def _expiry_date(
    signer_certificate: Any, issue_date: date | None, certificate: Path | KeyMaterial, source: str
) -> date | None:
    """Return the expiry day of the signer certificate; None if it is valid today.

    RecordError if the certificate is not yet valid or was not valid on the day of issue.
    """
    now = datetime.now(UTC)
    valid_from = signer_certificate.not_valid_before_utc
    valid_until = signer_certificate.not_valid_after_utc
    if valid_from > now:
        raise RecordError(
            f"{source}: {certificate} is valid only from {valid_from:%Y-%m-%d}; check the clock",
            code="certificate-expired",
        )
    if now <= valid_until:
        return None
    if issue_date is None or not valid_from.date() <= issue_date <= valid_until.date():
        day_text = "no day of issue" if issue_date is None else f"the day of issue {issue_date}"
        raise RecordError(
            f"{source}: {certificate} was valid from {valid_from:%Y-%m-%d} to "
            f"{valid_until:%Y-%m-%d}, but the document states {day_text}, so there is no evidence "
            "that the document was signed within this period",
            code="certificate-expired",
        )
    last_day: date = valid_until.date()
    return last_day


def _import_signxml() -> Any:
    try:
        import signxml
    except ImportError as error:
        raise MissingPackageError(_SIGNXML_MISSING) from error
    return signxml


#: State of the signature of a PDF: absent; valid; pages changed; another signer, or damaged.
PdfSignatureStatus = Literal["none", "valid", "changed", "invalid"]

_FIELD_NAME: Final = "Signature"
_FIELD_LABEL: Final = "Electronic signature of this certificate"
_PYHANKO_MISSING: Final = (
    "signing a PDF requires the package pyHanko, which is not installed: "
    f"{install_command('signature')}"
)


def sign_pages(pdf: bytes, signer: Signer, date: datetime) -> bytes:
    """Sign a PDF; the signature permits no later changes.

    date: Time of signing in the signature.
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

    class IncrementalUpdate(IncrementalPdfFileWriter):  # type: ignore[misc, unused-ignore]
        """An incremental update that keeps identifier and metadata of the file."""

        @classmethod
        def _handle_id(cls, prev: Any) -> Any:
            # Without random bytes, the same certificate gives the same file.
            first_id = prev.trailer["/ID"][0].original_bytes
            return ArrayObject([ByteStringObject(first_id), ByteStringObject(_sha256(pdf)[:16])])

        def _update_meta(self) -> None:
            # Metadata rewritten by pyHanko would not conform to PDF/A.
            pass

    # An object begins on a new line (PDF/A-3, 6.1.9).
    pdf_buffer = io.BytesIO(pdf if pdf.endswith(b"\n") else pdf + b"\n")
    dummy_signer = replace(signer, sign=lambda _: bytes(_max_signature_size(signer)))
    reserved_size = len(_run_coroutine(_sign_digest(dummy_signer, bytes(32))))
    field_spec = SigFieldSpec(_FIELD_NAME, readable_field_name=_FIELD_LABEL)
    embedder = PdfCMSEmbedder(field_spec).write_cms(_FIELD_NAME, IncrementalUpdate(pdf_buffer))
    next(embedder)
    placeholder = SignatureObject(
        timestamp=date, subfilter=SigSeedSubFilter.PADES, bytes_reserved=2 * reserved_size
    )
    permissions = SigMDPSetup("sha256", certify=True, docmdp_perms=MDPPerm.NO_CHANGES)
    embedder.send(SigObjSetup(sig_placeholder=placeholder, mdp_setup=permissions))
    prepared_digest, signed_buffer = embedder.send(SigIOSetup(md_algorithm="sha256"))
    embedder.send(_run_coroutine(_sign_digest(signer, prepared_digest.document_digest)))
    signed_pdf: bytes = signed_buffer.getvalue()
    return signed_pdf


def _max_signature_size(signer: Signer) -> int:
    """Return the maximum number of bytes of a signature; the length of ECDSA varies."""
    from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature

    key_bits: int = signer.public_key.key_size
    max_integer = (1 << key_bits) - 1
    return key_bits // 8 if signer.uses_rsa else len(encode_dss_signature(max_integer, max_integer))


async def _sign_digest(signer: Signer, digest: bytes) -> bytes:
    """Return the CMS signature (CAdES) of a digest with the certificates of the signer."""
    from asn1crypto.x509 import Certificate
    from cryptography.hazmat.primitives.serialization import Encoding
    from pyhanko.sign.signers.pdf_cms import Signer as CmsSigner
    from pyhanko_certvalidator.registry import SimpleCertificateStore

    class DigestSigner(CmsSigner):  # type: ignore[misc, unused-ignore]
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
    certificate_store: Any = SimpleCertificateStore()  # type: ignore[no-untyped-call, unused-ignore]
    certificate_store.register_multiple(chain)
    cms = await DigestSigner(
        signing_cert=signing_certificate, cert_registry=certificate_store
    ).async_sign(digest, "sha256", use_pades=True)
    content: bytes = cms.dump()
    return content


def _run_coroutine(coroutine: Coroutine[Any, Any, bytes]) -> bytes:
    """Run a coroutine and return its result.

    A thread is used because an event loop may be active, as in a notebook.
    """
    import asyncio
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, coroutine).result()


def verify_pdf_signature(document: bytes, signer_certificate: bytes) -> PdfSignatureStatus:
    """Verify the signature of the pages of a PDF; return its state.

    signer_certificate: X.509 certificate of the expected signer, DER. Its validity at the time of
        signing is not checked.
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
    last_signature = signatures[-1]
    last_signature.compute_integrity_info(skip_diff=True)
    covers_whole_file = last_signature.coverage == SignatureCoverageLevel.ENTIRE_FILE
    # Compare keys, as for the XML: the certificate may have been renewed.
    actual_certificate = last_signature.signer_cert
    expected_certificate = Certificate.load(signer_certificate)
    if actual_certificate.public_key.dump() != expected_certificate.public_key.dump():
        return "invalid"
    is_unchanged, is_valid = validate_sig_integrity(
        last_signature.signer_info, actual_certificate, "data", last_signature.compute_digest()
    )
    if not is_valid:
        return "invalid"
    return "valid" if is_unchanged and covers_whole_file else "changed"


def _sha256(data: bytes) -> bytes:
    return sha256(data).digest()


def _require_pyhanko() -> None:
    try:
        import pyhanko.sign  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(_PYHANKO_MISSING) from error
