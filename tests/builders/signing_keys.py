"""Key pairs for tests of signatures."""

from datetime import UTC, datetime, timedelta

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ed25519
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
)
from cryptography.hazmat.primitives.serialization.pkcs12 import serialize_key_and_certificates
from cryptography.x509.oid import NameOID

#: What a certificate may say that its key is for.
_USAGES = (
    "digital_signature",
    "content_commitment",
    "key_encipherment",
    "data_encipherment",
    "key_agreement",
    "key_cert_sign",
    "crl_sign",
    "encipher_only",
    "decipher_only",
)


def write_pair(folder, key, password=None, *, days=(-1, 365), usage=None, common_name=None):
    """Write a key and its self-signed certificate.

    `days` from today is it valid; of `usage`, a name such as "key_encipherment", is the key.
    """
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name or "Example laboratory")])
    now = datetime.now(UTC)
    algorithm = None if isinstance(key, ed25519.Ed25519PrivateKey) else hashes.SHA256()
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now + timedelta(days=days[0]))
        .not_valid_after(now + timedelta(days=days[1]))
    )
    if usage is not None:
        key_usage = dict.fromkeys(_USAGES, False) | {usage: True}
        certificate = certificate.add_extension(x509.KeyUsage(**key_usage), critical=True)
    certificate = certificate.sign(key, algorithm)
    folder.mkdir(exist_ok=True)
    encryption = BestAvailableEncryption(password) if password else NoEncryption()
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption)
    (folder / "key.pem").write_bytes(private)
    (folder / "cert.pem").write_bytes(certificate.public_bytes(Encoding.PEM))
    return folder / "key.pem", folder / "cert.pem"


def write_pkcs12(folder, key, password=None):
    """Write a key and its self-signed certificate into a single file."""
    _, cert = write_pair(folder, key)
    certificate = x509.load_pem_x509_certificate(cert.read_bytes())
    encryption = BestAvailableEncryption(password) if password else NoEncryption()
    container = serialize_key_and_certificates(b"laboratory", key, certificate, None, encryption)
    (folder / "key.p12").write_bytes(container)
    return folder / "key.p12", cert
