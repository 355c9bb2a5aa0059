"""Signers: keys in files, with passwords, and signer commands."""

import shlex
import sys
from types import SimpleNamespace

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, padding, rsa
from cryptography.hazmat.primitives.hashes import SHA256
from raising import raises
from signing_keys import write_pair, write_pkcs12

from counterspin.certificates.signers import (
    KeyMaterial,
    PasswordNeededError,
    command_signer,
    read_signer,
)
from counterspin.errors import CounterspinError

SECRET = "vÿ secret"


@pytest.fixture(scope="module")
def keys():
    return {
        "rsa": rsa.generate_private_key(65537, 2048),
        "ec": ec.generate_private_key(ec.SECP256R1()),
    }


def signs_with(signer, key):
    """Return whether a signer uses a key; raise InvalidSignature if not."""
    signature = signer.sign(b"words")
    scheme = (padding.PKCS1v15(), SHA256()) if signer.uses_rsa else (ec.ECDSA(SHA256()),)
    key.public_key().verify(signature, b"words", *scheme)
    return True


@pytest.mark.parametrize("kind", ["rsa", "ec"])
@pytest.mark.parametrize("password", [None, SECRET])
def test_key_is_read_from_pem_and_pkcs12(tmp_path, keys, kind, password):
    secret = password and password.encode()
    pem = read_signer(*write_pair(tmp_path / "pem", keys[kind], secret), password)
    p12, cert = write_pkcs12(tmp_path / "p12", keys[kind], secret)
    assert signs_with(pem, keys[kind])
    for certificate in (None, cert):
        signer = read_signer(p12, certificate, password)
        assert signs_with(signer, keys[kind])
        assert signer.name == "CN=Example laboratory"
    # A certificate may follow its key in one file.
    key, cert = write_pair(tmp_path / "one", keys[kind], secret)
    key_material = KeyMaterial("one.pem", key.read_bytes() + cert.read_bytes())
    assert signs_with(read_signer(key_material, password=password), keys[kind])


def test_unneeded_password_is_ignored(tmp_path, keys):
    assert signs_with(read_signer(*write_pair(tmp_path / "k", keys["ec"]), SECRET), keys["ec"])


@pytest.mark.parametrize("write", [write_pair, write_pkcs12])
def test_password_is_required_and_wrong_password_rejected(tmp_path, keys, write):
    key, cert = write(tmp_path / "k", keys["rsa"], SECRET.encode())
    with pytest.raises(PasswordNeededError, match="is encrypted; give the password"):
        read_signer(key, cert)
    with raises("wrong-password") as error_info:
        read_signer(key, cert, "wrong words")
    assert not isinstance(error_info.value, PasswordNeededError)
    assert "wrong words" not in str(error_info.value)


def test_repr_does_not_contain_key(tmp_path, keys):
    key, cert = write_pair(tmp_path / "k", keys["ec"])
    representations = repr(read_signer(key, cert)) + repr(KeyMaterial.read(key))
    key_line = key.read_text().splitlines()[1]
    assert key_line not in representations
    assert "PRIVATE" not in representations


@pytest.mark.parametrize(
    ("made", "more", "words"),
    [
        (lambda: rsa.generate_private_key(65537, 1024), {}, "1024 bits; at least 2048"),
        (lambda: ec.generate_private_key(ec.SECP192R1()), {}, "192 bits; at least 256"),
        (None, {"days": (-10, -1)}, ", so it is not valid today"),
        (None, {"days": (1, 10)}, ", so it is not valid today"),
        (None, {"usage": "key_agreement"}, "not intended for signatures"),
        (None, {"usage": "content_commitment"}, None),
        (None, {"usage": "digital_signature"}, None),
    ],
)
def test_signer_certificate_is_checked_at_issue(tmp_path, made, more, words):
    key = made() if made else ec.generate_private_key(ec.SECP256R1())
    pair = write_pair(tmp_path / "k", key, **more)
    if words is None:
        assert read_signer(*pair).public_key.key_size == 256
    else:
        with pytest.raises(CounterspinError, match=words):
            read_signer(*pair)


def test_unusable_key_raises(tmp_path, keys):
    key, cert = write_pair(tmp_path / "rsa", keys["rsa"])
    ed25519_key = write_pair(tmp_path / "odd", ed25519.Ed25519PrivateKey.generate())
    with raises("unusable-key", "RSA"):
        read_signer(*ed25519_key)
    with raises("unusable-key", "PEM"):
        read_signer(cert, cert)
    with raises("unusable-key", "X.509", "PEM"):
        read_signer(key, key)
    with raises("unusable-key", "X.509", "PEM"):
        read_signer(key)
    with raises("unusable-key", "PEM", "PKCS #12"):
        read_signer(KeyMaterial("x", b"words"))
    with raises("wrong-password"):
        read_signer(KeyMaterial("x", b"\x30\x82words"), None, "x")
    with raises("unusable-key", "certificate", "key"):
        read_signer(key, write_pair(tmp_path / "ec", keys["ec"])[1])
    with pytest.raises(CounterspinError, match=r"none\.pem: file not found"):
        read_signer(tmp_path / "none.pem", cert)


def write_program(folder, text):
    """Return a command that runs a program."""
    (folder / "sign it.py").write_text(text)
    return shlex.join([sys.executable, str(folder / "sign it.py")])


SIGNS = """
import sys
from cryptography.hazmat.primitives.asymmetric import ec, padding
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import load_pem_private_key
key = load_pem_private_key(open({key!r}, "rb").read(), None)
data = sys.stdin.buffer.read()
way = (ec.ECDSA(SHA256()),) if {curve} else (padding.PKCS1v15(), SHA256())
sys.stdout.buffer.write(key.sign(data, *way))
"""


@pytest.mark.parametrize("kind", ["rsa", "ec"])
def test_signer_command_signs(tmp_path, keys, kind):
    key, cert = write_pair(tmp_path / "k", keys[kind])
    text = SIGNS.format(key=str(key), curve=kind == "ec")
    assert signs_with(command_signer(write_program(tmp_path, text), cert), keys[kind])


def test_windows_command_keeps_backslashes(tmp_path, keys, monkeypatch):
    commands = []
    _, cert = write_pair(tmp_path / "k", keys["ec"])

    def run(command, **_):
        commands.append(command)
        return SimpleNamespace(returncode=1, stderr=b"no card")

    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.setattr("subprocess.run", run)
    signer = command_signer(r'"C:\my tools\sign.exe" --slot 1', cert)
    with raises("signer-failed", '"C:\\my tools\\sign.exe" --slot 1'):
        signer.sign(b"x")
    assert commands == [[r"C:\my tools\sign.exe", "--slot", "1"]]
    with raises("signer-failed", "(program not found in PATH)"):
        command_signer("no-such-signer", cert).sign(b"x")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "import sys; sys.exit('no card in the reader')",
            "failed with exit status 1: no card in the reader",
        ),
        ("import sys; sys.exit(3)", "failed with exit status 3: no reason given"),
        (
            "print('words')",
            "wrote 6 bytes that are not a signature of its certificate's key",
        ),
    ],
)
def test_failed_signer_command_raises(tmp_path, keys, text, words):
    _, cert = write_pair(tmp_path / "k", keys["ec"])
    signer = command_signer(write_program(tmp_path, text), cert)
    with pytest.raises(CounterspinError, match=words):
        signer.sign(b"words")


@pytest.mark.parametrize(
    ("command", "words"),
    [("", "give the signing command"), ("'x", "is not a command"), ("/nowhere/x", "cannot be run")],
)
def test_rejects_invalid_signer_command(tmp_path, keys, command, words):
    _, cert = write_pair(tmp_path / "k", keys["ec"])
    with pytest.raises(CounterspinError, match=words):
        command_signer(command, cert).sign(b"words")
    _, ed25519_cert = write_pair(tmp_path / "odd", ed25519.Ed25519PrivateKey.generate())
    with raises("unusable-key", "RSA"):
        command_signer("sign", ed25519_cert)


def test_missing_package_error_names_install_command(monkeypatch, tmp_path, keys):
    pair = write_pair(tmp_path / "k", keys["ec"])
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(CounterspinError, match=r"pip install '\.\[signature\]'"):
        read_signer(*pair)
