"""Checksums: right, taken once, early, and never in the way."""

import hashlib
import os
import time
from pathlib import Path

import pytest

from counterspin.campaign.checksums import Checksums


def of(data):
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def described(folder, text='[[runs]]\nrecord = "a.csv"\n'):
    file = folder / "campaign.toml"
    file.write_text(text, "utf-8")
    return file


@pytest.mark.parametrize("size", [0, 1, (1 << 23) - 1, 1 << 23, (1 << 23) + 1, 20_000_000])
def test_files_of_any_size(tmp_path, size):
    data = os.urandom(min(size, 1000)).ljust(size, b"x")
    (tmp_path / "a.csv").write_bytes(data)
    with Checksums() as checksums:
        assert checksums.of([tmp_path / "a.csv"]) == [of(data)]


@pytest.mark.parametrize("given", [Path, str])
def test_expected_files_are_taken_before_they_are_asked_for(tmp_path, monkeypatch, given):
    file = described(tmp_path)
    (tmp_path / "a.csv").write_bytes(b"before")
    monkeypatch.chdir(tmp_path.parent)
    with Checksums() as checksums:
        checksums.expect(given(tmp_path.name))
        limit = time.monotonic() + 30
        while not all(taken.done() for taken in checksums._taken.values()):
            assert time.monotonic() < limit
            time.sleep(0.001)
        (tmp_path / "a.csv").write_bytes(b"after")
        assert checksums.of([file, tmp_path / "a.csv"]) == [of(file.read_bytes()), of(b"before")]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "runs = 3",
        "runs = [1]",
        "runs = [[1]]",
        "[[runs]]",
        "[[runs]]\nrecord = 5",
        "no TOML",
        "[[runs]",
        "\0",
    ],
)
def test_what_is_wrong_with_a_description_is_for_others_to_say(tmp_path, text):
    file = described(tmp_path, text)
    with Checksums() as checksums:
        checksums.expect(tmp_path)
        checksums.expect(tmp_path / "nowhere")
        assert checksums.of([file]) == [of(text.encode())]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files here")
def test_what_is_no_file_has_no_checksum(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with Checksums() as checksums:
        files = [tmp_path, tmp_path / "missing.csv", tmp_path / "pipe.csv"]
        assert checksums.of(files) == ["unreadable"] * 3


def test_nobody_waits_for_a_checksum_that_is_not_asked_for(tmp_path):
    # A file with a hole of 200 GB would take minutes.
    file = tmp_path / "a.csv"
    with file.open("wb") as stream:
        stream.truncate(200_000_000_000)
    described(tmp_path)
    begun = time.monotonic()
    with Checksums() as checksums:
        checksums.expect(tmp_path)
        while not checksums._taken[file].running():
            assert time.monotonic() - begun < 20
            time.sleep(0.001)
    assert time.monotonic() - begun < 20
