"""Certificates, reports and downloads."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final, Literal

from pydantic import Base64Bytes, BaseModel, ConfigDict, SecretStr

from counterspin.application.answers import CheckedFile, Receipt
from counterspin.application.app_state import AppState
from counterspin.application.commands import certificate_command
from counterspin.application.served_folder import PathForbiddenError, RequestError
from counterspin.campaign.documents import load_document
from counterspin.certificates.amendment import Amendment
from counterspin.certificates.issuing import (
    certificate,
    check_certificate,
    check_output_path,
    check_output_paths,
    paired_path,
)
from counterspin.certificates.ledger import sha256_hex
from counterspin.certificates.signers import KeyMaterial, PasswordNeededError, Signer, read_signer
from counterspin.errors import CounterspinError, describe_read_error, read_error_code
from counterspin.input import read_file

#: Suffixes of files that can be downloaded: those that counterspin writes.
_DOWNLOAD_SUFFIXES: Final = (".html", ".json", ".md", ".pdf", ".svg", ".toml", ".xml")


class UploadedFile(BaseModel):
    """An uploaded file that is used for a single request and never written to disk."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True)

    name: str
    content: Base64Bytes

    def to_key_material(self) -> KeyMaterial:
        """Return the content as key material."""
        return KeyMaterial(self.name, self.content)


class Signing(BaseModel):
    """The material for signing a certificate."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True)

    #: PEM or PKCS #12; None: the signing command of the server is used.
    key: UploadedFile | None = None
    certificate: UploadedFile | None = None  #: PEM; None: included in the key file.
    password: SecretStr | None = None  #: Password of the key.

    def signer(self, app: AppState) -> Signer:
        """Return the signer; CounterspinError if key, certificate and password do not match."""
        if self.key is None:
            if app.signer is None:
                raise RequestError(
                    "This server was started without a signing command; use a key file."
                )
            return replace(app.signer, sign=partial(_sign_without_drawing_lock, app))
        material = None if self.certificate is None else self.certificate.to_key_material()
        password = None if self.password is None else self.password.get_secret_value() or None
        try:
            return read_signer(self.key.to_key_material(), material, password)
        except PasswordNeededError as error:
            raise CounterspinError(
                f"{self.key.name} is encrypted; enter the password", code="password-needed"
            ) from error


def _sign_without_drawing_lock(app: AppState, content: bytes) -> bytes:
    """Sign with the server's command, which may wait for a PIN, without holding the lock."""
    assert app.signer is not None
    app.drawing.release()
    try:
        return app.signer.sign(content)
    finally:
        app.drawing.acquire()


class AmendmentRequest(BaseModel):
    """An issued certificate to be replaced, and the reason."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    file: str
    reason: str


def begin_certificate(
    app: AppState,
    result: str,
    lab: str,
    output: str,
    both: bool = False,
    signing: Signing | None = None,
    amends: AmendmentRequest | None = None,
) -> Receipt:
    """Issue the certificate of a result; return its identifier and the notes to check.

    both: Write both XML and PDF.
    amends: The certificate to be replaced; None: a new certificate.
    """
    files = app.file(result), app.file(lab)
    output_path = app.folder.path(output)
    if both:
        check_output_paths(output_path)
        app.folder.path(app.folder.name(paired_path(output_path)))
    else:
        check_output_path(output_path)
    # This also checks the path of the ledger.
    app.require_inside(files[1].parent, load_document(files[1]))
    amendment = None if amends is None else Amendment(app.file(amends.file), amends.reason)
    signers: list[Signer] = []

    def read_signing() -> Signer:
        assert signing is not None
        signers.append(signing.signer(app))
        return signers[0]

    with app.drawing:
        issued_certificate = certificate(
            *files, signer=None if signing is None else read_signing, amends=amendment
        )
        output_paths = (
            issued_certificate.write_both(output_path)
            if both
            else [issued_certificate.write(output_path)]
        )
        pages = issued_certificate.page_images()
    options = _signing_options(app, signing)
    if amendment is not None:
        options |= {"amends": str(amendment.path), "reason": amendment.reason}
    return {
        "identifier": issued_certificate.identifier,
        "draft": issued_certificate.draft,
        "accelerometers": issued_certificate.accelerometers,
        "signed_by": issued_certificate.signed_by,
        "notes": issued_certificate.notes,
        "files": [app.folder.name(target) for target in output_paths],
        "checksums": [sha256_hex(read_file(target)) for target in output_paths],
        "pages": pages,
        "signer": signers[0].name if signers else "",
        "signer_certificate": signers[0].certificate_pem if signers else None,
        "command": certificate_command(*files, output_path, both, options),
    }


def check_file(app: AppState, name: str, certificate: UploadedFile | None = None) -> CheckedFile:
    """Read a certificate file again; return its identifier, checksum and signature.

    certificate: Certificate of the expected signer, PEM; None: the signature is not verified.
    """
    path = app.file(name)
    with app.drawing:
        check = check_certificate(
            path, signer_certificate=None if certificate is None else certificate.to_key_material()
        )
    return {
        "identifier": check.numbers.identifier,
        "checksum": sha256_hex(read_file(path)),
        "signature": check.signature,
        "pages": check.page_signature,
    }


def _signing_options(app: AppState, signing: Signing | None) -> dict[str, str]:
    """Return the options of the command line for a signature."""
    if signing is None:
        return {}
    if signing.key is None:
        return dict(app.signer_options)
    certificate_options = {} if signing.certificate is None else {"cert": signing.certificate.name}
    return {"key": signing.key.name} | certificate_options


def make_report(
    app: AppState, result: str, kind: Literal["html", "md", "pdf"]
) -> tuple[str, bytes]:
    """Return file name and content of a report, without writing a file."""
    from counterspin.reports.publication import report

    calibration = app.result(result)
    with app.drawing:
        content = (
            report(calibration, "pdf") if kind == "pdf" else report(calibration, kind).encode()
        )
    return f"{app.file(result).stem}.{kind}", content


def download_file(app: AppState, name: str) -> tuple[str, bytes]:
    """Return name and content of a file; PathForbiddenError for files of other programs."""
    path: Path = app.file(name)
    if path.suffix.lower() not in _DOWNLOAD_SUFFIXES:
        raise PathForbiddenError(f"{name}: only files that counterspin writes can be downloaded")
    try:
        return path.name, read_file(path)
    except OSError as error:
        raise CounterspinError(
            f"{name}: {describe_read_error(error)}", code=read_error_code(error)
        ) from error
