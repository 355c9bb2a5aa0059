"""Signers of a certificate: a private key in a file, or a command that uses a device's key."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Sequence
from dataclasses import field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from counterspin.errors import (
    MAX_REASON_LENGTH,
    CounterspinError,
    MissingPackageError,
    describe_read_error,
    install_command,
    read_error_code,
)
from counterspin.frozen import frozen
from counterspin.input import read_file
from counterspin.shell import find_program, join_command, split_command

#: The smallest keys: RSA by NIST SP 800-131A, elliptic curves likewise; bits.
_RSA_BITS: Final = 2048
_CURVE_BITS: Final = 256

#: Timeout of a signing command, s: the user may have to type the PIN of a card.
_COMMAND_SECONDS: Final = 120.0

_MISSING: Final = (
    "signatures require the package cryptography, which is not installed: "
    f"{install_command('signature')}"
)


class KeyFileError(CounterspinError):
    """A key or its certificate cannot be used to sign."""

    code = "unusable-key"


class PasswordNeededError(CounterspinError):
    """The error for an encrypted key without a password."""

    code = "password-needed"


@frozen(eq=False)
class Signer:
    """A person's signature by a private key.

    No part of a key appears in a file or a message.
    """

    certificates: Sequence[Any]  #: X.509: the signer's certificate, followed by its chain if given.
    #: Takes bytes; returns their signature: RSA by PKCS #1 v1.5, or ECDSA in DER; SHA-256.
    sign: Callable[[bytes], bytes] = field(repr=False)

    @property
    def name(self) -> str:
        """Name of the signer, as the certificate states it."""
        text: str = self.certificates[0].subject.rfc4514_string()
        return text[:MAX_REASON_LENGTH]

    @property
    def pem(self) -> str:
        """The signer's certificate as PEM."""
        from cryptography.hazmat.primitives.serialization import Encoding

        text: bytes = self.certificates[0].public_bytes(Encoding.PEM)
        return text.decode("ascii")

    @property
    def public_key(self) -> Any:
        """The public key."""
        return self.certificates[0].public_key()

    @property
    def uses_rsa(self) -> bool:
        """True for an RSA key; else the key is of an elliptic curve."""
        from cryptography.hazmat.primitives.asymmetric.rsa import RSAPublicKey

        return isinstance(self.public_key, RSAPublicKey)


@frozen
class KeyMaterial:
    """Name and content of a file with a key or a certificate."""

    name: str
    content: bytes = field(repr=False)

    def __str__(self) -> str:
        """Return the name of the file."""
        return self.name

    @classmethod
    def read(cls, path: Path | KeyMaterial) -> KeyMaterial:
        """Return the material, read if `path` is one; CounterspinError if it cannot be read."""
        if isinstance(path, KeyMaterial):
            return path
        try:
            return cls(str(path), read_file(path))
        except OSError as error:
            raise CounterspinError(
                f"{path}: {describe_read_error(error)}", code=read_error_code(error)
            ) from error


def read_signer(
    key: Path | KeyMaterial,
    certificate: Path | KeyMaterial | None = None,
    password: str | None = None,
) -> Signer:
    """Read a private key and its certificate.

    key: PEM, or PKCS #12, which includes its certificate.
    certificate: PEM; None: it is in the file of the key.
    """
    key_material = KeyMaterial.read(key)
    _require_cryptography()
    certificate_material = None if certificate is None else KeyMaterial.read(certificate)
    secret = None if password is None else password.encode()
    if b"-----BEGIN " not in key_material.content:
        private, certificates = _read_pkcs12(key_material, secret)
        if certificate_material is not None:
            certificates = certificates_in(certificate_material)
    else:
        private = _read_pem_key(key_material, secret)
        certificates = certificates_in(certificate_material or key_material)
    source = (certificate_material or key_material).name
    if certificates[0].public_key() != private.public_key():
        raise KeyFileError(f"{source} is not the certificate of the key {key_material.name}")
    signer = signer_from_key(private, certificates)
    _check_signer(signer, key_material.name, source)
    return signer


def signer_from_key(key: Any, certificates: Sequence[Any]) -> Signer:
    """Return the signer with a private key of `cryptography`."""
    return Signer(
        certificates, lambda data: bytes(key.sign(data, *_signature_scheme(key.public_key())))
    )


def command_signer(command: str, certificate: Path) -> Signer:
    """Return the signer that signs by a command, with a key in a card, a token or another machine.

    command: Reads the bytes to be signed from standard input, and writes the signature: of RSA by
        PKCS #1 v1.5, of an elliptic curve in DER, each with SHA-256.
    """
    _require_cryptography()
    try:
        words = split_command(command)
    except ValueError as error:
        raise CounterspinError(
            f"`signer`: {command!r} is not a command ({error})", code="wrong-usage"
        ) from error
    if not words:
        raise CounterspinError("`signer`: give the signing command", code="wrong-usage")
    certificates = certificates_in(KeyMaterial.read(certificate))
    signer = Signer(
        certificates, lambda data: _sign_with_command(words, data, certificates[0].public_key())
    )
    _check_signer(signer, str(certificate), str(certificate))
    return signer


def _sign_with_command(words: Sequence[str], data: bytes, public: Any) -> bytes:
    """Return the signature of bytes that a command writes; CounterspinError if it is not valid."""
    from cryptography.exceptions import InvalidSignature

    def failed(why: str) -> CounterspinError:
        return CounterspinError(
            f"the signer's command {join_command(words)} {why}", code="signer-failed"
        )

    try:
        process = subprocess.run(
            [find_program(words[0]), *words[1:]],
            input=data,
            capture_output=True,
            timeout=_COMMAND_SECONDS,
            check=False,
        )
    except OSError as error:
        raise failed(f"cannot be run ({error.strerror})") from error
    except subprocess.TimeoutExpired as error:
        raise failed(f"did not finish within {_COMMAND_SECONDS:g} s") from error
    if process.returncode != 0:
        message = process.stderr.decode("utf-8", "replace").strip()[:MAX_REASON_LENGTH]
        raise failed(
            f"failed with exit status {process.returncode}: {message or 'no reason given'}"
        )
    try:
        public.verify(process.stdout, data, *_signature_scheme(public))
    except InvalidSignature as error:
        raise failed(
            f"wrote {len(process.stdout)} bytes that are not a signature with the key of its "
            f"certificate "
            "(RSA by PKCS #1 v1.5, or ECDSA in DER, of SHA-256, is expected)"
        ) from error
    return process.stdout


def _signature_scheme(public: Any) -> tuple[Any, ...]:
    """Return the signature scheme of a key; empty unless RSA or elliptic curve."""
    from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa
    from cryptography.hazmat.primitives.hashes import SHA256

    if isinstance(public, rsa.RSAPublicKey):
        return padding.PKCS1v15(), SHA256()
    return (ec.ECDSA(SHA256()),) if isinstance(public, ec.EllipticCurvePublicKey) else ()


def certificates_in(file: KeyMaterial) -> list[Any]:
    """Return the X.509 certificates in a PEM file, which must have at least one."""
    _require_cryptography()
    from cryptography.x509 import load_pem_x509_certificates

    try:
        return load_pem_x509_certificates(file.content)
    except ValueError as error:
        raise KeyFileError(f"{file.name} is not an X.509 certificate in PEM format") from error


def _read_pem_key(file: KeyMaterial, password: bytes | None) -> Any:
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        return load_pem_private_key(file.content, password)
    except TypeError as error:
        if password is None:
            raise PasswordNeededError(f"{file.name} is encrypted; give the password") from error
        return _read_pem_key(file, None)  # it is not encrypted
    except (ValueError, UnsupportedAlgorithm) as error:
        if password is not None:
            raise CounterspinError(
                f"{file.name} cannot be read with this password, or is not a private key in PEM "
                "format",
                code="wrong-password",
            ) from error
        raise KeyFileError(f"{file.name} is not a private key in PEM format") from error


def _read_pkcs12(file: KeyMaterial, password: bytes | None) -> tuple[Any, list[Any]]:
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization.pkcs12 import load_pkcs12

    try:
        content = load_pkcs12(file.content, password)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        if not file.content.startswith(b"\x30"):
            raise KeyFileError(
                f"{file.name} is neither a private key in PEM format nor a PKCS #12 file"
            ) from error
        if password is None:
            raise PasswordNeededError(f"{file.name} is encrypted; give the password") from error
        raise CounterspinError(
            f"{file.name} cannot be read with this password, or is not a PKCS #12 file",
            code="wrong-password",
        ) from error
    if content.key is None or content.cert is None:
        raise KeyFileError(f"{file.name} does not contain both a key and its certificate")
    return content.key, [
        content.cert.certificate,
        *(extra.certificate for extra in content.additional_certs),
    ]


def _check_signer(signer: Signer, key: str, certificate: str) -> None:
    """Refuse a signer whose signature would not be valid today."""
    from cryptography.x509 import ExtensionNotFound, KeyUsage

    if not _signature_scheme(signer.public_key):
        raise KeyFileError(f"{key} must be an RSA or an elliptic-curve key")
    min_bits, size = _RSA_BITS if signer.uses_rsa else _CURVE_BITS, signer.public_key.key_size
    if size < min_bits:
        raise KeyFileError(f"{key} has {size} bits; at least {min_bits} are required")
    certificate_of_signer = signer.certificates[0]
    begin, end = (
        certificate_of_signer.not_valid_before_utc,
        certificate_of_signer.not_valid_after_utc,
    )
    if not begin <= datetime.now(UTC) <= end:
        raise KeyFileError(
            f"{certificate} is valid only from {begin:%Y-%m-%d} to {end:%Y-%m-%d}, so it is not "
            "valid today"
        )
    try:
        usage = certificate_of_signer.extensions.get_extension_for_class(KeyUsage).value
    except ExtensionNotFound:
        return
    except ValueError as error:
        raise KeyFileError(f"{certificate}: the extensions are damaged") from error
    if not (usage.digital_signature or usage.content_commitment):
        raise KeyFileError(f"{certificate}: the key is not intended for signatures (key usage)")


def _require_cryptography() -> None:
    try:
        import cryptography  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(_MISSING) from error
