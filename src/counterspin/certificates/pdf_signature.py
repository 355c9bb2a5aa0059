"""The signature of a certificate's pages: PAdES (ETSI EN 319 142-1, B-B), beside that of its XML.

It is added to the file as PDF has it, behind all that is there: no byte of the pages changes, and
neither their conformance with PDF/A-3 nor what is attached to them.
"""

from __future__ import annotations

import io
from collections.abc import Coroutine
from dataclasses import replace
from datetime import datetime
from hashlib import sha256
from typing import Any, Final, Literal

from counterspin.certificates.signers import Signer
from counterspin.errors import CounterspinError, installing

#: What the signature of pages is worth: there is none; of the expected signer, and nothing was
#: changed since; the pages were changed since; it is of somebody else, or damaged.
PagesSignature = Literal["none", "valid", "changed", "invalid"]

_FIELD: Final = "Signature"
_WORDS: Final = "Electronic signature of this certificate"
_MISSING: Final = (
    f"signing a PDF needs the package pyHanko, which is not installed: {installing('signature')}"
)


def sign_pages(pages: bytes, signer: Signer, date: datetime) -> bytes:
    """Return a PDF with its signature, which allows no change after it.

    date: What the signature states as the time of signing.
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
        """What is added to a file, which says of itself what it has said before."""

        @classmethod
        def _handle_id(cls, prev: Any) -> Any:
            # In place of random bytes: the same certificate is the same file again.
            first = prev.trailer["/ID"][0].original_bytes
            return ArrayObject([ByteStringObject(first), ByteStringObject(_digest(pages)[:16])])

        def _update_meta(self) -> None:
            # Metadata that pyHanko would write anew conform with PDF/A no longer.
            pass

    # An object begins on a line of its own (PDF/A-3, 6.1.9).
    given = io.BytesIO(pages if pages.endswith(b"\n") else pages + b"\n")
    longest = replace(signer, signed=lambda _: bytes(_longest(signer)))
    room = len(_finished(_cms(longest, bytes(32))))
    field = SigFieldSpec(_FIELD, readable_field_name=_WORDS)
    embedding = PdfCMSEmbedder(field).write_cms(_FIELD, Addition(given))
    next(embedding)
    placeholder = SignatureObject(
        timestamp=date,
        subfilter=SigSeedSubFilter.PADES,
        bytes_reserved=2 * room,
    )
    permissions = SigMDPSetup("sha256", certify=True, docmdp_perms=MDPPerm.NO_CHANGES)
    embedding.send(SigObjSetup(sig_placeholder=placeholder, mdp_setup=permissions))
    prepared, output = embedding.send(SigIOSetup(md_algorithm="sha256"))
    embedding.send(_finished(_cms(signer, prepared.document_digest)))
    made: bytes = output.getvalue()
    return made


def _longest(signer: Signer) -> int:
    """Return how many bytes a signature has at most; those of elliptic curves vary."""
    from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature

    size: int = signer.public.key_size
    most = (1 << size) - 1
    return size // 8 if signer.with_rsa else len(encode_dss_signature(most, most))


async def _cms(signer: Signer, digest: bytes) -> bytes:
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
            return signer.signed(data)

    own, *chain = (Certificate.load(one.public_bytes(Encoding.DER)) for one in signer.certificates)
    store: Any = SimpleCertificateStore()  # type: ignore[no-untyped-call, unused-ignore]
    store.register_multiple(chain)
    made = await OfDigests(signing_cert=own, cert_registry=store).async_sign(
        digest, "sha256", use_pades=True
    )
    content: bytes = made.dump()
    return content


def _finished(work: Coroutine[Any, Any, bytes]) -> bytes:
    """Return what a coroutine returns; in a thread, for a notebook's own has a loop that runs."""
    import asyncio
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()


def pages_signature(document: bytes, public: bytes) -> PagesSignature:
    """Return what the signature of a PDF's pages is worth.

    public: X.509 certificate of the expected signer, DER. Whether it was valid when the pages were
        signed is not judged here.
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
        # One that is not understood was there.
        return "invalid" if any(enumerate_sig_fields(reader, filled_status=True)) else "none"
    # The last covers all before it; what follows is covered by none.
    last = signatures[-1]
    last.compute_integrity_info(skip_diff=True)
    whole = last.coverage == SignatureCoverageLevel.ENTIRE_FILE
    # The key counts, as for the XML: a certificate may have been renewed for it.
    signer, expected = last.signer_cert, Certificate.load(public)
    if signer.public_key.dump() != expected.public_key.dump():
        return "invalid"
    unchanged, theirs = validate_sig_integrity(
        last.signer_info, signer, "data", last.compute_digest()
    )
    if not theirs:
        return "invalid"
    return "valid" if unchanged and whole else "changed"


def _digest(data: bytes) -> bytes:
    return sha256(data).digest()


def _require_pyhanko() -> None:
    try:
        import pyhanko.sign  # noqa: F401
    except ImportError as error:
        raise CounterspinError(_MISSING) from error
