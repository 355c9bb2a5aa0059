"""Issuing certificates from the page."""

import shlex
import sys
from base64 import b64encode
from dataclasses import replace

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from signing_keys import write_pair, write_pkcs12

from certificates import write_filled_template
from counterspin.certificates.issuing import check_certificate
from counterspin.certificates.lab import write_example
from counterspin.certificates.signers import command_signer, read_signer

SAID = {"result": "three/result.json", "lab": "LAB.toml", "output": "three/certificate.xml"}


@pytest.fixture
def with_lab(page, folder):
    lab = write_example(folder / "LAB.toml")
    # The campaign of the folder assumes nominal values for what it does not state.
    lab.write_text(lab.read_text() + '\n[evidence]\nall = "Type test 4714."\n')
    return page


def test_certificate_is_issued_once_and_can_be_downloaded(with_lab, folder):
    assert with_lab.get("/api/folder").json()["labs"] == ["LAB.toml"]
    body = with_lab.post("/api/certificate", json=SAID).json()
    assert body["accelerometers"] == ["Qx", "Qy"]
    assert body["files"] == ["three/certificate.xml"]
    assert any("values from the template" in note for note in body["notes"])
    certified = check_certificate(folder / "three" / "certificate.xml").numbers
    assert certified.identifier == body["identifier"]
    again = with_lab.post("/api/certificate", json=SAID)
    assert again.status_code == 422
    assert "already exists. It" in again.json()["error"]
    taken = with_lab.get("/api/file", params={"name": "three/certificate.xml"})
    assert taken.content == (folder / "three" / "certificate.xml").read_bytes()
    assert taken.headers["content-disposition"] == "attachment; filename*=UTF-8''certificate.xml"
    assert taken.headers["content-type"] == "application/octet-stream"


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({"lab": "nowhere.toml"}, 404),
        ({"lab": "three/campaign.toml"}, 422),
        ({"result": "three/slow.csv"}, 422),
        ({"output": "three/certificate.docx"}, 422),
        ({"output": "../certificate.xml"}, 403),
    ],
)
def test_failed_certificate_request_writes_no_file(with_lab, folder, change, status):
    before = sorted(folder.rglob("*"))
    assert with_lab.post("/api/certificate", json=SAID | change).status_code == status
    assert sorted(folder.rglob("*")) == before


PASSWORD = "vy secret"


@pytest.fixture
def with_real_lab(page, folder):
    """Return the client of a folder with laboratory data that differ from the template."""
    write_filled_template(folder / "LAB.toml")
    return page


def test_issued_certificate_can_be_amended(with_real_lab, folder):
    lab = {"file": "LAB.toml", "result": "three/result.json"}
    assert with_real_lab.get("/api/lab", params=lab).json()["certificates"] == []
    first = with_real_lab.post("/api/certificate", json=SAID).json()
    listed = with_real_lab.get("/api/lab", params=lab).json()["certificates"]
    assert listed == [{"file": "three/certificate.xml", "identifier": first["identifier"]}]
    request = SAID | {
        "output": "three/certificate-A1.xml",
        "amends": {"file": "three/certificate.xml", "reason": "The date was wrong."},
    }
    second = with_real_lab.post("/api/certificate", json=request).json()
    assert second["identifier"] == f"{first['identifier']}-A1"
    assert "--reason=The date was wrong." in shlex.split(second["command"])
    amended = check_certificate(
        folder / "three" / "certificate-A1.xml", amended_path=folder / "three" / "certificate.xml"
    )
    assert amended.numbers.amended_identifier == first["identifier"]
    request |= {"output": "three/certificate-A2.xml"}
    request["amends"]["reason"] = " "
    assert "`reason`" in str(with_real_lab.post("/api/certificate", json=request).json())


def encode_file(path):
    return {"name": path.name, "content": b64encode(path.read_bytes()).decode()}


@pytest.mark.parametrize("write", [write_pair, write_pkcs12])
def test_uploaded_key_signs_both_files_and_is_not_stored(
    with_real_lab, folder, tmp_path, caplog, capfd, write
):
    key, cert = write(tmp_path / "k", ec.generate_private_key(ec.SECP256R1()), PASSWORD.encode())
    before = set(folder.rglob("*"))
    signing = {"key": encode_file(key), "password": PASSWORD}
    if write is write_pair:
        signing["certificate"] = encode_file(cert)
    response = with_real_lab.post(
        "/api/certificate", json=SAID | {"both": True, "signing": signing}
    )
    assert response.status_code == 200, response.json()
    actual_response = response.json()
    assert actual_response["files"] == ["three/certificate.xml", "three/certificate.pdf"]
    for name in actual_response["files"]:
        assert check_certificate(folder / name, signer_certificate=cert).signature == "valid"
    assert (
        check_certificate(
            folder / actual_response["files"][1], signer_certificate=cert
        ).page_signature
        == "valid"
    )
    # The command names the original files and omits the password.
    own = [f"--cert={cert.name}"] if write is write_pair else []
    assert shlex.split(actual_response["command"])[6:] == ["--both", f"--key={key.name}", *own]
    written = set(folder.rglob("*")) - before
    assert {path.name for path in written} == {"certificate.xml", "certificate.pdf"}
    secrets = [
        PASSWORD.encode(),
        key.read_bytes()[30:90],
        encode_file(key)["content"][40:100].encode(),
    ]
    seen = [path.read_bytes() for path in folder.rglob("*") if path.is_file()]
    seen += [response.content, caplog.text.encode(), "".join(capfd.readouterr()).encode()]
    seen.append(with_real_lab.get("/api/jobs").content)
    assert [secret for secret in secrets for place in seen if secret in place] == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"password": "wrong words"}, "cannot be read with this password"),
        ({"password": None}, "key.p12 is encrypted; enter the password"),
        ({"key": None}, "started without a signing command"),
    ],
)
def test_invalid_key_is_rejected_and_nothing_is_written(
    with_real_lab, folder, tmp_path, change, words
):
    key, _ = write_pkcs12(tmp_path, rsa.generate_private_key(65537, 2048), PASSWORD.encode())
    before = sorted(folder.rglob("*"))
    signing = {"key": encode_file(key), "password": PASSWORD} | change
    response = with_real_lab.post("/api/certificate", json=SAID | {"signing": signing})
    assert response.status_code == 422
    assert words in response.json()["error"]
    assert "wrong words" not in response.text
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("key", [{"name": "k"}, {"name": "k", "content": "no base 64 SECRET"}, 4])
def test_malformed_request_is_not_echoed(with_real_lab, key):
    response = with_real_lab.post("/api/certificate", json=SAID | {"signing": {"key": key}})
    assert response.status_code == 400
    assert "SECRET" not in response.text


def test_template_data_is_rejected_before_key_is_read(with_lab, folder):
    """An invalid key would raise a different error."""
    signing = {"key": {"name": "k", "content": b64encode(b"no key").decode()}}
    response = with_lab.post("/api/certificate", json=SAID | {"signing": signing})
    assert response.status_code == 422
    assert "laboratory.name" in response.json()["error"]
    assert "values from the template" in response.json()["error"]
    assert not (folder / "three" / "certificate.xml").exists()
    # The page shows this before the request.
    lab = with_lab.get("/api/lab", params={"file": "LAB.toml", "result": SAID["result"]}).json()
    missing = {entry["key"] for entry in lab["missing"]}
    assert {"laboratory.name", "item.model", "conditions.temperature"} < missing
    assert lab["signer"] == ""


def test_signer_command_of_server_signs(with_real_lab, folder, app, tmp_path):
    key, cert = write_pair(tmp_path / "k", ec.generate_private_key(ec.SECP256R1()))
    text = (
        "import sys\n"
        "from cryptography.hazmat.primitives.asymmetric import ec\n"
        "from cryptography.hazmat.primitives.hashes import SHA256\n"
        "from cryptography.hazmat.primitives.serialization import load_pem_private_key\n"
        f"key = load_pem_private_key(open({str(key)!r}, 'rb').read(), None)\n"
        "data = sys.stdin.buffer.read()\n"
        "sys.stdout.buffer.write(key.sign(data, ec.ECDSA(SHA256())))\n"
    )
    (tmp_path / "sign.py").write_text(text)
    command = shlex.join([sys.executable, str(tmp_path / "sign.py")])
    app.signer = command_signer(command, cert)
    app.signer_options = {"signer": command, "cert": str(cert)}
    request = {"file": "LAB.toml", "result": SAID["result"]}
    assert with_real_lab.get("/api/lab", params=request).json()["signer"] == "CN=Example laboratory"
    body = with_real_lab.post("/api/certificate", json=SAID | {"signing": {}}).json()
    assert (
        check_certificate(folder / "three/certificate.xml", signer_certificate=cert).signature
        == "valid"
    )
    assert shlex.split(body["command"])[6:] == [f"--signer={command}", f"--cert={cert}"]


def test_plots_are_drawn_while_signer_command_runs(with_real_lab, app, tmp_path):
    """A smart card waits for its PIN."""
    signer = read_signer(*write_pair(tmp_path / "k", ec.generate_private_key(ec.SECP256R1())))
    held = []

    def sign(data):
        held.append(app.drawing.locked())
        return signer.sign(data)

    app.signer = replace(signer, sign=sign)
    request = SAID | {"signing": {}, "both": True}
    assert with_real_lab.post("/api/certificate", json=request).status_code == 200
    assert held == [False, False]  # for the XML and for the pages
    assert not app.drawing.locked()


def test_record_cannot_be_downloaded(page):
    assert page.get("/api/file", params={"name": "three/slow.csv"}).status_code == 403


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "mark"), [("html", b"<!DOCTYPE html>"), ("md", b"# "), ("pdf", b"%PDF")]
)
def test_report_is_downloaded_without_writing_files(page, folder, kind, mark):
    before = sorted(folder.rglob("*"))
    response = page.get("/api/report", params={"name": "three/result.json", "kind": kind})
    assert response.content.startswith(mark)
    assert f"result.{kind}" in response.headers["content-disposition"]
    assert sorted(folder.rglob("*")) == before
