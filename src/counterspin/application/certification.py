"""Certificates and reports from the page, and downloads."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import Base64Bytes, BaseModel, ConfigDict, SecretStr

from counterspin.application.desk import Desk, certificate_command
from counterspin.application.folder import OutsideError
from counterspin.campaign.documents import load_document
from counterspin.certificates.issuing import (
    certificate,
    check_certificate,
    check_output_path,
    check_output_paths,
    paired_path,
)
from counterspin.certificates.ledger import checksum_of
from counterspin.certificates.signers import KeyMaterial, PasswordNeededError, Signer, read_signer
from counterspin.errors import CounterspinError, describe_read_error
from counterspin.input import read_file

#: Endings of what may be saved elsewhere: what this program writes.
_WRITTEN_SUFFIXES: Final = (".html", ".json", ".md", ".pdf", ".svg", ".toml", ".xml")


class BroughtFile(BaseModel):
    """An uploaded file that is used for one request, and never written."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True)

    name: str
    content: Base64Bytes

    def read(self) -> KeyMaterial:
        """Return its content, read in the same way as a file of the command line."""
        return KeyMaterial(self.name, self.content)


class Signing(BaseModel):
    """The material for signing a certificate."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True)

    #: PEM or PKCS #12; None: with the command that the server was started with.
    key: BroughtFile | None = None
    certificate: BroughtFile | None = None  #: PEM; None: it is in the file of the key.
    password: SecretStr | None = None  #: Of the key.

    def signer(self, desk: Desk) -> Signer:
        """Return the signer; CounterspinError if key, certificate and password do not fit."""
        if self.key is None:
            if desk.signer is None:
                raise CounterspinError(
                    "This server was started without a signing command; use a key file."
                )
            return replace(desk.signer, sign=partial(_while_others_draw, desk))
        own = None if self.certificate is None else self.certificate.read()
        secret = None if self.password is None else self.password.get_secret_value() or None
        try:
            return read_signer(self.key.read(), own, secret)
        except PasswordNeededError as error:
            raise CounterspinError(f"{self.key.name}: is encrypted; type its password") from error


def _while_others_draw(desk: Desk, data: bytes) -> bytes:
    """Return the signature by the server's command; a person may have to type a PIN first."""
    assert desk.signer is not None
    desk.drawing.release()
    try:
        return desk.signer.sign(data)
    finally:
        desk.drawing.acquire()


def begin_certificate(
    desk: Desk,
    result: str,
    lab: str,
    output: str,
    both: bool = False,
    signing: Signing | None = None,
) -> dict[str, Any]:
    """Issue the certificate of a result; return its identifier and the notes to check.

    both: The other of XML and PDF is written next to it too.
    """
    files = desk.file(result), desk.file(lab)
    place = desk.folder.path(output)
    if both:
        check_output_paths(place)
        desk.folder.path(desk.folder.name(paired_path(place)))
    else:
        check_output_path(place)
    # The ledger, too.
    desk.require_inside(files[1].parent, load_document(files[1]))
    signers: list[Signer] = []

    def read_signing() -> Signer:
        assert signing is not None
        signers.append(signing.signer(desk))
        return signers[0]

    with desk.drawing:
        made = certificate(*files, signer=None if signing is None else read_signing)
        outputs = made.write_both(place) if both else [made.write(place)]
        pages = made.page_images()
    return {
        "identifier": made.identifier,
        "draft": made.draft,
        "accelerometers": made.accelerometers,
        "signed_by": made.signed_by,
        "notes": made.notes,
        "files": [desk.folder.name(place) for place in outputs],
        "checksums": [checksum_of(read_file(place)) for place in outputs],
        "pages": pages,
        "signer": signers[0].name if signers else "",
        "signer_certificate": signers[0].pem if signers else None,
        "command": certificate_command(*files, place, both, _options(desk, signing)),
    }


def check_file(desk: Desk, name: str, certificate: BroughtFile | None = None) -> dict[str, Any]:
    """Read a certificate's file again; return its identifier, checksum and signature.

    certificate: That of the expected signer, PEM; None: the signature is not verified.
    """
    path = desk.file(name)
    with desk.drawing:
        checked = check_certificate(path, cert=None if certificate is None else certificate.read())
    return {
        "identifier": checked.certified.identifier,
        "checksum": checksum_of(read_file(path)),
        "signature": checked.signature,
        "pages": checked.pages,
    }


def _options(desk: Desk, signing: Signing | None) -> dict[str, str]:
    """Return the options of the command line for this signature."""
    if signing is None:
        return {}
    if signing.key is None:
        return dict(desk.signer_options)
    own = {} if signing.certificate is None else {"cert": signing.certificate.name}
    return {"key": signing.key.name} | own


def report_of(desk: Desk, result: str, kind: Literal["html", "md", "pdf"]) -> tuple[str, bytes]:
    """Return a report's file name and content; nothing is written into the folder."""
    from counterspin.reports.publication import report

    found = desk.result(result)
    with desk.drawing:
        made = report(found, "pdf") if kind == "pdf" else report(found, kind).encode()
    return f"{desk.file(result).stem}.{kind}", made


def taken_file(desk: Desk, name: str) -> tuple[str, bytes]:
    """Return a file's name and content; OutsideError for files that are not made here."""
    path: Path = desk.file(name)
    if path.suffix.lower() not in _WRITTEN_SUFFIXES:
        raise OutsideError(f"{name}: only files that counterspin writes can be saved from here")
    try:
        return path.name, read_file(path)
    except OSError as error:
        raise CounterspinError(f"{name}: {describe_read_error(error)}") from error
