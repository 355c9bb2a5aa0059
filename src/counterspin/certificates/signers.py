"""Signers of certificates: a private key in a file, or a command that uses a device."""

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

#: Minimum key lengths, bits (RSA: NIST SP 800-131A).
_MIN_RSA_BITS: Final = 2048
_MIN_CURVE_BITS: Final = 256

#: Timeout of a signing command, s, with time to type the PIN of a card.
_COMMAND_TIMEOUT: Final = 120.0

_CRYPTOGRAPHY_MISSING: Final = (
    "signatures require the package cryptography, which is not installed: "
    f"{install_command('signature')}"
)


class KeyFileError(CounterspinError):
    """Error of a key or certificate that cannot be used to sign."""

    code = "unusable-key"


class PasswordNeededError(CounterspinError):
    """Error of an encrypted key without a password."""

    code = "password-needed"


@frozen(eq=False)
class Signer:
    """A person who signs with a private key.

    Keys never appear in files or messages.
    """

    certificates: Sequence[Any]  #: X.509: certificate of the signer, then its chain.
    #: Bytes -> signature with SHA-256: RSA by PKCS #1 v1.5, or ECDSA in DER.
    sign: Callable[[bytes], bytes] = field(repr=False)

    @property
    def name(self) -> str:
        """Name of the signer in the certificate."""
        text: str = self.certificates[0].subject.rfc4514_string()
        return text[:MAX_REASON_LENGTH]

    @property
    def certificate_pem(self) -> str:
        """Certificate of the signer in PEM format."""
        from cryptography.hazmat.primitives.serialization import Encoding

        pem: bytes = self.certificates[0].public_bytes(Encoding.PEM)
        return pem.decode("ascii")

    @property
    def public_key(self) -> Any:
        """Public key of the signer."""
        return self.certificates[0].public_key()

    @property
    def uses_rsa(self) -> bool:
        """True for an RSA key; False for an elliptic-curve key."""
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
        """Read a file, or return material that was already read."""
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

    key: PEM, or PKCS #12 with the certificate.
    certificate: PEM; None: the certificate is in the key file.
    """
    key_material = KeyMaterial.read(key)
    _require_cryptography()
    certificate_material = None if certificate is None else KeyMaterial.read(certificate)
    password_bytes = None if password is None else password.encode()
    if b"-----BEGIN " not in key_material.content:
        private_key, certificates = _read_pkcs12(key_material, password_bytes)
        if certificate_material is not None:
            certificates = read_certificates(certificate_material)
    else:
        private_key = _read_pem_key(key_material, password_bytes)
        certificates = read_certificates(certificate_material or key_material)
    source = (certificate_material or key_material).name
    if certificates[0].public_key() != private_key.public_key():
        raise KeyFileError(f"{source} is not the certificate of the key {key_material.name}")
    signer = signer_from_key(private_key, certificates)
    _check_signer(signer, key_material.name, source)
    return signer


def signer_from_key(key: Any, certificates: Sequence[Any]) -> Signer:
    """Return a signer with a private key of the package `cryptography`."""
    return Signer(
        certificates, lambda data: bytes(key.sign(data, *_signature_scheme(key.public_key())))
    )


def command_signer(command: str, certificate: Path) -> Signer:
    """Return a signer that calls a command, with a key in a card, a token or another machine.

    command: Reads the bytes from standard input and writes the signature with SHA-256: RSA by
        PKCS #1 v1.5, or ECDSA in DER.
    """
    _require_cryptography()
    try:
        arguments = split_command(command)
    except ValueError as error:
        raise CounterspinError(
            f"`signer`: {command!r} is not a command ({error})", code="wrong-usage"
        ) from error
    if not arguments:
        raise CounterspinError("`signer`: give the signing command", code="wrong-usage")
    certificates = read_certificates(KeyMaterial.read(certificate))
    signer = Signer(
        certificates, lambda data: _sign_with_command(arguments, data, certificates[0].public_key())
    )
    _check_signer(signer, str(certificate), str(certificate))
    return signer


def _sign_with_command(arguments: Sequence[str], data: bytes, public_key: Any) -> bytes:
    """Return the signature from a command; CounterspinError if it is not valid."""
    from cryptography.exceptions import InvalidSignature

    def make_error(problem: str) -> CounterspinError:
        return CounterspinError(
            f"the signer's command {join_command(arguments)} {problem}", code="signer-failed"
        )

    try:
        process = subprocess.run(
            [find_program(arguments[0]), *arguments[1:]],
            input=data,
            capture_output=True,
            timeout=_COMMAND_TIMEOUT,
            check=False,
        )
    except OSError as error:
        raise make_error(f"cannot be run ({error.strerror})") from error
    except subprocess.TimeoutExpired as error:
        raise make_error(f"did not finish within {_COMMAND_TIMEOUT:g} s") from error
    if process.returncode != 0:
        message = process.stderr.decode("utf-8", "replace").strip()[:MAX_REASON_LENGTH]
        raise make_error(
            f"failed with exit status {process.returncode}: {message or 'no reason given'}"
        )
    try:
        public_key.verify(process.stdout, data, *_signature_scheme(public_key))
    except InvalidSignature as error:
        raise make_error(
            f"wrote {len(process.stdout)} bytes that are not a signature of its certificate's "
            "key (expected: RSA PKCS #1 v1.5 or DER-encoded ECDSA, both with SHA-256)"
        ) from error
    return process.stdout


def _signature_scheme(public_key: Any) -> tuple[Any, ...]:
    """Return the signature scheme of an RSA or elliptic-curve key; empty for other keys."""
    from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa
    from cryptography.hazmat.primitives.hashes import SHA256

    if isinstance(public_key, rsa.RSAPublicKey):
        return padding.PKCS1v15(), SHA256()
    return (ec.ECDSA(SHA256()),) if isinstance(public_key, ec.EllipticCurvePublicKey) else ()


def read_certificates(key_material: KeyMaterial) -> list[Any]:
    """Return the X.509 certificates in a PEM file, at least one."""
    _require_cryptography()
    from cryptography.x509 import load_pem_x509_certificates

    try:
        return load_pem_x509_certificates(key_material.content)
    except ValueError as error:
        raise KeyFileError(
            f"{key_material.name} is not an X.509 certificate in PEM format"
        ) from error


def _read_pem_key(key_material: KeyMaterial, password: bytes | None) -> Any:
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        return load_pem_private_key(key_material.content, password)
    except TypeError as error:
        if password is None:
            raise PasswordNeededError(
                f"{key_material.name} is encrypted; give the password"
            ) from error
        return _read_pem_key(key_material, None)  # the key is not encrypted
    except (ValueError, UnsupportedAlgorithm) as error:
        if password is not None:
            raise CounterspinError(
                f"{key_material.name} cannot be read with this password, or is not a private key "
                "in PEM format",
                code="wrong-password",
            ) from error
        raise KeyFileError(f"{key_material.name} is not a private key in PEM format") from error


def _read_pkcs12(key_material: KeyMaterial, password: bytes | None) -> tuple[Any, list[Any]]:
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization.pkcs12 import load_pkcs12

    try:
        content = load_pkcs12(key_material.content, password)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        if not key_material.content.startswith(b"\x30"):
            raise KeyFileError(
                f"{key_material.name} is neither a private key in PEM format nor a PKCS #12 file"
            ) from error
        if password is None:
            raise PasswordNeededError(
                f"{key_material.name} is encrypted; give the password"
            ) from error
        raise CounterspinError(
            f"{key_material.name} cannot be read with this password, or is not a PKCS #12 file",
            code="wrong-password",
        ) from error
    if content.key is None or content.cert is None:
        raise KeyFileError(f"{key_material.name} does not contain both a key and its certificate")
    return content.key, [
        content.cert.certificate,
        *(chain_certificate.certificate for chain_certificate in content.additional_certs),
    ]


def _check_signer(signer: Signer, key_name: str, certificate_name: str) -> None:
    """Raise KeyFileError if the signature would not be valid today."""
    from cryptography.x509 import ExtensionNotFound, KeyUsage

    if not _signature_scheme(signer.public_key):
        raise KeyFileError(f"{key_name} must be an RSA or an elliptic-curve key")
    min_bits = _MIN_RSA_BITS if signer.uses_rsa else _MIN_CURVE_BITS
    key_bits = signer.public_key.key_size
    if key_bits < min_bits:
        raise KeyFileError(f"{key_name} has {key_bits} bits; at least {min_bits} are required")
    signer_certificate = signer.certificates[0]
    valid_from = signer_certificate.not_valid_before_utc
    valid_until = signer_certificate.not_valid_after_utc
    if not valid_from <= datetime.now(UTC) <= valid_until:
        raise KeyFileError(
            f"{certificate_name} is valid only from {valid_from:%Y-%m-%d} to "
            f"{valid_until:%Y-%m-%d}, so it is not valid today"
        )
    try:
        key_usage = signer_certificate.extensions.get_extension_for_class(KeyUsage).value
    except ExtensionNotFound:
        return
    except ValueError as error:
        raise KeyFileError(f"{certificate_name}: the extensions are damaged") from error
    if not (key_usage.digital_signature or key_usage.content_commitment):
        raise KeyFileError(
            f"{certificate_name}: the key is not intended for signatures (key usage)"
        )


def _require_cryptography() -> None:
    try:
        import cryptography  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(_CRYPTOGRAPHY_MISSING) from error
