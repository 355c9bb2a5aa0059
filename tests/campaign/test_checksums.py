"""Checksums: correct, computed once, in advance and without delay."""

import hashlib
import os
import sys
import threading
import time
from pathlib import Path

import pytest

from counterspin.__main__ import _prefetch_context
from counterspin.campaign.checksums import (
    _CHECKSUMS_BY_PATH,
    Checksums,
    checksums_of,
    prefetch_campaign,
)
from counterspin.input import open_file

#: Timeout of all waits, s; only a failure reaches it.
BOUND = 300.0


def sha256_of(data):
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def write_description(folder, text='[[runs]]\nrecord = "a.csv"\n'):
    file = folder / "campaign.toml"
    file.write_text(text, "utf-8")
    return file


@pytest.mark.parametrize("size", [0, 1, (1 << 23) - 1, 1 << 23, (1 << 23) + 1, 20_000_000])
def test_checksum_of_any_file_size(tmp_path, size):
    data = os.urandom(min(size, 1000)).ljust(size, b"x")
    (tmp_path / "a.csv").write_bytes(data)
    with Checksums() as checksums:
        assert checksums.checksums([tmp_path / "a.csv"]) == [sha256_of(data)]


@pytest.mark.parametrize("given", [Path, str])
def test_expected_files_are_hashed_in_advance(tmp_path, monkeypatch, given):
    file = write_description(tmp_path)
    (tmp_path / "a.csv").write_bytes(b"before")
    monkeypatch.chdir(tmp_path.parent)
    with Checksums() as checksums:
        checksums.prefetch(given(tmp_path.name))
        limit = time.monotonic() + BOUND
        while not all(future.done() for future in checksums._futures.values()):
            assert time.monotonic() < limit
            time.sleep(0.001)
        (tmp_path / "a.csv").write_bytes(b"after")
        assert checksums.checksums([file, tmp_path / "a.csv"]) == [
            sha256_of(file.read_bytes()),
            sha256_of(b"before"),
        ]


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
def test_invalid_description_still_has_checksum(tmp_path, text):
    file = write_description(tmp_path, text)
    with Checksums() as checksums:
        checksums.prefetch(tmp_path)
        checksums.prefetch(tmp_path / "nowhere")
        assert checksums.checksums([file]) == [sha256_of(text.encode())]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files here")
def test_unreadable_path_has_no_checksum(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with Checksums() as checksums:
        files = [tmp_path, tmp_path / "missing.csv", tmp_path / "pipe.csv"]
        assert checksums.checksums(files) == ["unreadable"] * 3


def test_unrequested_checksum_does_not_delay_exit(tmp_path):
    # A sparse file of 200 GB would take at least a quarter of an hour.
    file = tmp_path / "a.csv"
    with file.open("wb") as stream:
        stream.truncate(200_000_000_000)
    write_description(tmp_path)
    begun = time.monotonic()
    with Checksums() as checksums:
        checksums.prefetch(tmp_path)
        while not checksums._futures[file].running():
            assert time.monotonic() - begun < BOUND
            time.sleep(0.001)
    assert time.monotonic() - begun < BOUND


def test_files_are_hashed_sequentially_until_requested(tmp_path, monkeypatch):
    files = [tmp_path / f"{n}.csv" for n in range(3)]
    for file in files:
        file.write_bytes(b"1")
    begun, may_go_on = [], threading.Event()

    def wait_and_open(path):
        begun.append(path)
        assert may_go_on.wait(BOUND)
        return open_file(path)

    monkeypatch.setattr("counterspin.campaign.checksums.open_file", wait_and_open)
    with Checksums() as checksums:
        try:
            checksums._submit(files)
            wait_until(lambda: len(begun) == 1)
            time.sleep(0.02)
            # The threads start in any order.
            assert len(begun) == 1
            checksums.run_parallel()
            wait_until(lambda: len(begun) == 3)
        finally:
            may_go_on.set()
        assert checksums.checksums(files) == [sha256_of(b"1")] * 3


def wait_until(condition):
    limit = time.monotonic() + BOUND
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.001)


@pytest.fixture
def folder(tmp_path):
    write_description(tmp_path)
    (tmp_path / "a.csv").write_bytes(b"1")
    return tmp_path


def test_early_checksums_are_used_once(folder):
    with prefetch_campaign(f"{folder}/"):
        with checksums_of(folder) as first:
            assert set(first._futures) == {folder / "a.csv", folder / "campaign.toml"}
            (folder / "b.csv").write_bytes(b"2")
            assert first.checksums([folder / "b.csv"]) == [sha256_of(b"2")]
        with checksums_of(folder) as second:
            assert second is not first
    assert first._cancelled.is_set()


@pytest.mark.parametrize("named", ["nowhere", "\0", "x" * 5000])
def test_early_start_ignores_path_without_campaign(named):
    with prefetch_campaign(named), checksums_of(named) as checksums:
        assert not checksums._cancelled.is_set()


def test_interrupt_stops_early_checksums(folder):
    with (
        pytest.raises(KeyboardInterrupt),
        prefetch_campaign(str(folder)),
        checksums_of(folder) as checksums,
    ):
        raise KeyboardInterrupt
    assert checksums._cancelled.is_set()
    with checksums_of(folder) as again:
        assert again is not checksums


@pytest.mark.parametrize(
    ("words", "begins"),
    [
        (["calibrate", "FOLDER"], True),
        (["calibrate", "FOLDER", "--json", "result.json"], True),
        ([], False),
        (["calibrate"], False),
        (["calibrate", "--help"], False),
        (["calibrate", "FOLDER", "FOLDER"], False),
        (["check", "FOLDER"], False),
    ],
)
def test_commands_with_early_checksums(folder, monkeypatch, words, begins):
    words = [str(folder) if word == "FOLDER" else word for word in words]
    monkeypatch.setattr(sys, "argv", ["counterspin", *words])
    with _prefetch_context():
        begun = dict(_CHECKSUMS_BY_PATH)
        with checksums_of(folder) as checksums, checksums_of([]) as others:
            assert begun == ({folder: checksums} if begins else {})
            assert checksums._futures
            assert not others._futures
