"""Verification of installed files against the hashes of RECORD."""

import base64
import hashlib
from pathlib import Path
from types import SimpleNamespace

import pytest

import counterspin
from counterspin.validation import validate as validating
from counterspin.validation.validate import inspect_installation, validate, verify_files


def make_record(folder):
    lines = ["counterspin-9.dist-info/RECORD,,"]
    for path in sorted(folder.rglob("*.py")):
        digest = hashlib.sha256(path.read_bytes()).digest()
        text = base64.urlsafe_b64encode(digest).rstrip(b"=").decode()
        name = path.relative_to(folder).as_posix()
        lines.append(f"counterspin/{name},sha256={text},{path.stat().st_size}")
    return "\n".join(lines)


def test_altered_and_missing_files_are_named(tmp_path):
    for name in ("a.py", "b.py", "c.py"):
        (tmp_path / name).write_text(f"# {name}\n")
    record = make_record(tmp_path)
    assert verify_files(record, tmp_path)[1:] == ([], [])
    assert set(verify_files(record, tmp_path)[0]) == {"a.py", "b.py", "c.py"}
    (tmp_path / "b.py").write_text("# b.py \n")
    (tmp_path / "c.py").unlink()
    assert verify_files(record, tmp_path)[1:] == (["b.py"], ["c.py"])


@pytest.mark.parametrize("editable", [True, False])
def test_missing_file_is_reported_except_for_editable_install(editable, monkeypatch, tmp_path):
    site = tmp_path if editable else Path(counterspin.__file__).parents[1]
    delivered = SimpleNamespace(
        requires=[],
        read_text=lambda name: "counterspin/application/documentation/gone.md,sha256=AAAA,1",
        locate_file=lambda name: site / name,
    )
    monkeypatch.setattr(validating.metadata, "distribution", lambda name: delivered)
    missing = [] if editable else ["application/documentation/gone.md"]
    assert inspect_installation().missing == missing


def test_installation_lists_files_and_packages():
    installation = inspect_installation()
    assert installation.files > 300
    assert "numpy" in installation.packages
    assert installation.environment["python"]
    assert installation.checksum == inspect_installation().checksum


def test_altered_installation_fails(monkeypatch, tmp_path, capsys):
    from counterspin.cli import main

    altered = inspect_installation().model_copy(update={"altered": ["errors.py"], "recorded": 400})
    monkeypatch.setattr(validating, "inspect_installation", lambda: altered)
    dossier = validate(chosen=[])
    assert not dossier.passed
    assert "errors.py" in repr(dossier)
    monkeypatch.setattr(validating, "cases", lambda: ())
    assert main(["validate", "-o", str(tmp_path / "d")]) == 1
    assert "missing: errors.py; " in capsys.readouterr().err
