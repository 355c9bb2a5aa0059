"""The signature of a certificate's pages: appended, and invalid after any change."""

import io
import os
import re
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pypdf
import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import Encoding
from signing_keys import write_pair

from counterspin.certificates.signature import sign_pages, verify_pdf_signature
from counterspin.certificates.signers import read_signer
from counterspin.errors import CounterspinError

#: PDF/A-3a and PDF/UA-1, with the XML attached.
PAGES = Path(__file__).parents[2] / "docs/examples/three-rate/certificate.pdf"
DATE = datetime(2026, 3, 9, 10, 30, tzinfo=UTC)
KEYS = {
    "rsa": lambda: rsa.generate_private_key(65537, 2048),
    "ec": lambda: ec.generate_private_key(ec.SECP256R1()),
    "long ec": lambda: ec.generate_private_key(ec.SECP521R1()),
}


@pytest.fixture(scope="module")
def signers(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    return {kind: read_signer(*write_pair(folder / kind, KEYS[kind]())) for kind in KEYS}


@pytest.fixture(scope="module")
def signed_pages(signers):
    return {kind: sign_pages(PAGES.read_bytes(), signer, DATE) for kind, signer in signers.items()}


def public_certificate(signer):
    return signer.certificates[0].public_bytes(Encoding.DER)


@pytest.mark.parametrize("kind", KEYS)
def test_signature_is_valid_for_its_signer_only(signers, signed_pages, kind):
    assert verify_pdf_signature(signed_pages[kind], public_certificate(signers[kind])) == "valid"
    for other_kind in set(KEYS) - {kind}:
        assert (
            verify_pdf_signature(signed_pages[kind], public_certificate(signers[other_kind]))
            == "invalid"
        )
    assert verify_pdf_signature(PAGES.read_bytes(), public_certificate(signers[kind])) == "none"


def signed_ranges(pdf):
    """Return the byte ranges of a file that are signed."""
    reader = pypdf.PdfReader(io.BytesIO(pdf))
    return [int(n) for n in reader.pages[0]["/Annots"][0]["/V"]["/ByteRange"]]


def test_changed_byte_is_detected(signers, signed_pages):
    """A byte of the pages, metadata or signature, and appended bytes."""
    pdf, of = signed_pages["ec"], public_certificate(signers["ec"])
    for mark in (b"/StructTreeRoot", b"<pdfaid:part>3", b"20260309"):
        offset = pdf.rindex(mark) + len(mark) - 1
        changed = pdf[:offset] + bytes([pdf[offset] ^ 1]) + pdf[offset + 1 :]
        assert verify_pdf_signature(changed, of) == "changed", mark
    assert verify_pdf_signature(pdf + b"\n% more\n", of) == "changed"
    assert verify_pdf_signature(pdf.replace(b"/SubFilter", b"/SubFiltre"), of) == "invalid"
    _, start, end, _ = signed_ranges(pdf)
    offset = start + len(pdf[start : end - 1].rstrip(b"0")) - 20
    changed = (
        pdf[:offset] + (b"1" if pdf[offset : offset + 1] != b"1" else b"2") + pdf[offset + 1 :]
    )
    assert verify_pdf_signature(changed, of) == "invalid"


def test_incremental_update_is_reported_as_changed(signers, signed_pages):
    """PDF allows incremental updates after the signature."""
    writer = pypdf.PdfWriter(io.BytesIO(signed_pages["ec"]), incremental=True)
    writer.add_metadata({"/Title": "Another certificate"})
    out = io.BytesIO()
    writer.write(out)
    assert out.getvalue().startswith(signed_pages["ec"])
    assert verify_pdf_signature(out.getvalue(), public_certificate(signers["ec"])) == "changed"


def test_second_signature_of_other_signer_invalidates_first(signers, signed_pages, tmp_path):
    from pyhanko.pdf_utils.incremental_writer import IncrementalPdfFileWriter
    from pyhanko.sign import signers as theirs
    from pyhanko.sign.signers import PdfSignatureMetadata

    key, cert = write_pair(tmp_path / "k", KEYS["ec"]())
    other_signer = theirs.SimpleSigner.load(str(key), str(cert))
    unsigned_pdf = IncrementalPdfFileWriter(io.BytesIO(PAGES.read_bytes()))
    signed_once = theirs.sign_pdf(unsigned_pdf, PdfSignatureMetadata(field_name="A"), other_signer)
    writer = IncrementalPdfFileWriter(signed_once)
    signed_twice = theirs.sign_pdf(
        writer, PdfSignatureMetadata(field_name="B"), other_signer
    ).getvalue()
    assert verify_pdf_signature(signed_twice, public_certificate(signers["ec"])) == "invalid"
    assert verify_pdf_signature(signed_twice, public_certificate(read_signer(key, cert))) == "valid"


@pytest.mark.parametrize("kind", KEYS)
def test_signing_preserves_pages_metadata_and_attachments(signed_pages, kind):
    """The signed file starts with the unsigned file and still conforms to PDF/A and PDF/UA."""
    unsigned_pdf, signed_pdf = PAGES.read_bytes(), signed_pages[kind]
    assert signed_pdf.startswith(unsigned_pdf)
    # PDF/A-3, 6.1.9: objects start on a new line.
    assert re.match(rb"\n\d+ 0 obj\n", signed_pdf[len(unsigned_pdf) :])
    old_reader, new_reader = (
        pypdf.PdfReader(io.BytesIO(unsigned_pdf)),
        pypdf.PdfReader(io.BytesIO(signed_pdf)),
    )
    roots = [reader.trailer["/Root"] for reader in (old_reader, new_reader)]
    assert set(roots[1]) - set(roots[0]) == {"/AcroForm", "/Perms"}
    assert roots[1]["/Metadata"].get_data() == roots[0]["/Metadata"].get_data()
    assert dict(new_reader.metadata) == dict(old_reader.metadata)
    assert {k: [bytes(v) for v in vs] for k, vs in new_reader.attachments.items()} == {
        k: [bytes(v) for v in vs] for k, vs in old_reader.attachments.items()
    }
    assert [page.extract_text() for page in new_reader.pages] == [
        old_page.extract_text() for old_page in old_reader.pages
    ]
    (widget,) = new_reader.pages[0]["/Annots"]
    # PDF/A-3, 6.3.2: the annotation is printed and not hidden; 6.3.3: it has no appearance.
    flags = widget.get_object()["/F"]
    assert flags & 4
    assert not flags & (1 | 2 | 32 | 256)
    assert widget.get_object()["/Rect"] == [0, 0, 0, 0]
    # PDF/UA-1, 7.18.1 and 7.18.3: alternative text and tab order.
    assert widget.get_object()["/TU"] == "Electronic signature of this certificate"
    assert new_reader.pages[0]["/Tabs"] == "/S"
    assert roots[1]["/AcroForm"].get("/NeedAppearances") is None
    # PAdES: a CAdES signature, and a certified document that permits no change.
    value = widget.get_object()["/V"]
    assert value["/SubFilter"] == "/ETSI.CAdES.detached"
    assert value["/M"] == "D:20260309103000Z"
    assert value["/Reference"][0]["/TransformParams"]["/P"] == 1
    first, length, second, rest = value["/ByteRange"]
    assert (first, second + rest) == (0, len(signed_pdf))
    assert signed_pdf[length : length + 1] == b"<"
    assert signed_pdf[second - 1 : second] == b">"


@pytest.mark.skipif(shutil.which("verapdf") is None, reason="veraPDF is not installed")
@pytest.mark.parametrize("flavour", ["3a", "ua1"])
def test_verapdf_reports_no_error(tmp_path, signed_pages, flavour):
    (tmp_path / "c.pdf").write_bytes(signed_pages["ec"])
    command = ["verapdf", "--flavour", flavour, "--format", "text", str(tmp_path / "c.pdf")]
    output = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    assert output.startswith("PASS"), output


def test_rsa_signature_of_pages_is_deterministic(signers, signed_pages):
    assert sign_pages(PAGES.read_bytes(), signers["rsa"], DATE) == signed_pages["rsa"]


def test_key_signs_once(signers):
    """A smart card requests its PIN for each signature."""
    from dataclasses import replace

    requests = []

    def sign(data):
        requests.append(data)
        return signers["ec"].sign(data)

    sign_pages(PAGES.read_bytes(), replace(signers["ec"], sign=sign), DATE)
    assert len(requests) == 1


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
@pytest.mark.parametrize("kind", KEYS)
def test_openssl_verifies_signature_of_whole_file(tmp_path, signed_pages, kind):
    """The signature covers all bytes except its own."""

    def verify_with_openssl(content):
        match = re.search(rb"/ByteRange *\[ *(\d+) +(\d+) +(\d+) +(\d+)", content)
        first, length, second, last_length = map(int, match.groups())
        assert (first, second + last_length) == (0, len(content))
        (tmp_path / "covered").write_bytes(content[:length] + content[second:])
        # The hexadecimal digits between < and > are padded with zeros.
        padded_signature = bytes.fromhex(content[length + 1 : second - 1].decode("ascii"))
        size = int.from_bytes(padded_signature[2:4], "big") + 4
        (tmp_path / "signature").write_bytes(padded_signature[:size])
        command = ["openssl", "cms", "-verify", "-binary", "-inform", "DER", "-noverify"]
        command += ["-in", str(tmp_path / "signature"), "-content", str(tmp_path / "covered")]
        command += ["-purpose", "any", "-out", os.devnull]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0

    assert verify_with_openssl(signed_pages[kind])
    offset = signed_pages[kind].index(b"/StructTreeRoot") + 4
    assert not verify_with_openssl(
        signed_pages[kind][:offset] + b"X" + signed_pages[kind][offset + 1 :]
    )


@pytest.mark.skipif(shutil.which("pdfsig") is None, reason="pdfsig (poppler) is not installed")
@pytest.mark.parametrize("kind", KEYS)
def test_poppler_verifies_signature(tmp_path, signed_pages, kind):
    """Poppler has no trust root and reports this separately from the signature."""

    def run_pdfsig(content):
        path = tmp_path / "c.pdf"
        path.write_bytes(content)
        command = ["pdfsig", "-nocert", str(path)]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout

    report = run_pdfsig(signed_pages[kind])
    assert "Signature Type: ETSI.CAdES.detached" in report
    assert "Total document signed" in report
    assert "Signature Validation: Signature is Valid." in report
    offset = signed_pages[kind].index(b"/StructTreeRoot") + 4
    changed = signed_pages[kind][:offset] + b"X" + signed_pages[kind][offset + 1 :]
    assert "Signature is Valid." not in run_pdfsig(changed)


def test_missing_package_error_names_install_command(monkeypatch, signers):
    monkeypatch.setitem(sys.modules, "pyhanko.sign", None)
    with pytest.raises(CounterspinError, match=r"pip install '\.\[signature\]'"):
        sign_pages(PAGES.read_bytes(), signers["ec"], DATE)
