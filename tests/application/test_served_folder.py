"""The served folder: only its files are accessible, and no edit is lost."""

import os
import time
from contextlib import suppress
from threading import Barrier, Thread

import pytest
from raising import raises

from counterspin.application import served_folder
from counterspin.application.served_folder import (
    EditConflictError,
    PathForbiddenError,
    ServedFolder,
)
from counterspin.errors import CounterspinError


@pytest.fixture
def inner_folder(tmp_path):
    (tmp_path / "secret.toml").write_text("secret = 1")
    (tmp_path / "inside" / "a").mkdir(parents=True)
    (tmp_path / "inside" / "a" / "campaign.toml").write_text("schema = 1\n")
    return ServedFolder(tmp_path / "inside")


@pytest.mark.parametrize(
    "name",
    [
        "../secret.toml",
        "a/../../secret.toml",
        "a/..",
        "..",
        "./a/campaign.toml/..",
        "/etc/hostname",
        "//etc/hostname",
        "..\\secret.toml",
        "C:/secret.toml",
        "a/.hidden",
        ".git/config",
        "a/campaign.toml\0",
        "a/con. ",
        "a/dot.",
        "a/" * 2000 + "x",
    ],
)
def test_path_outside_folder_is_rejected(inner_folder, name):
    with pytest.raises(PathForbiddenError):
        inner_folder.read(name)
    with pytest.raises(PathForbiddenError):
        inner_folder.write(name, "x", "")


def test_symlink_out_of_folder_is_rejected(inner_folder, tmp_path):
    (inner_folder.root / "link.toml").symlink_to(tmp_path / "secret.toml")
    (inner_folder.root / "up").symlink_to(tmp_path)
    (inner_folder.root / "round").symlink_to(inner_folder.root / "round")
    for name in ("link.toml", "up/secret.toml", "up", "round"):
        with pytest.raises(PathForbiddenError):
            inner_folder.read(name)
        with pytest.raises(PathForbiddenError):
            inner_folder.write(name, "x", "")
    assert (tmp_path / "secret.toml").read_text() == "secret = 1"
    assert [path for path, _ in inner_folder.folders()] == [
        inner_folder.root,
        inner_folder.root / "a",
    ]


def test_symlink_within_folder_is_followed(inner_folder):
    (inner_folder.root / "b.toml").symlink_to(inner_folder.root / "a" / "campaign.toml")
    assert inner_folder.read("b.toml").text == "schema = 1\n"


def test_rejects_binary_oversized_or_special_file(inner_folder):
    (inner_folder.root / "a" / "big.toml").write_text("x" * 101)
    (inner_folder.root / "a" / "odd.toml").write_bytes(b"\xff\xfe")
    os.mkfifo(inner_folder.root / "a" / "pipe.toml")
    with pytest.raises(CounterspinError, match="more than 100 bytes"):
        inner_folder.read("a/big.toml", 100)
    with pytest.raises(CounterspinError, match="not UTF-8"):
        inner_folder.read("a/odd.toml")
    with pytest.raises(CounterspinError, match="a pipe"):
        inner_folder.read("a/pipe.toml")
    with pytest.raises(CounterspinError, match="is not valid text"):
        inner_folder.write("a/new.toml", "\ud800", "")


def test_edit_of_old_version_raises_conflict_with_current_text(inner_folder):
    first = inner_folder.read("a/campaign.toml")
    second = inner_folder.write("a/campaign.toml", "schema = 1 # mine\n", first.version)
    with pytest.raises(EditConflictError) as refused:
        inner_folder.write("a/campaign.toml", "schema = 1 # theirs\n", first.version)
    assert refused.value.current == second == inner_folder.read("a/campaign.toml")
    with pytest.raises(EditConflictError):
        inner_folder.write("a/campaign.toml", "x", "")
    third = inner_folder.write("a/campaign.toml", "schema = 1 # both\n", second.version)
    assert inner_folder.read("a/campaign.toml") == third
    assert [path.name for path in (inner_folder.root / "a").iterdir()] == ["campaign.toml"]


def test_one_of_many_concurrent_edits_succeeds(inner_folder, monkeypatch):
    write = served_folder.write_atomically

    def write_slowly(*words, **more):
        time.sleep(0.05)  # long enough for all other edits to read
        write(*words, **more)

    monkeypatch.setattr(served_folder, "write_atomically", write_slowly)
    seen = inner_folder.read("a/campaign.toml").version
    start, taken = Barrier(8), []

    def edit(text):
        start.wait()
        with suppress(EditConflictError):
            taken.append(inner_folder.write("a/campaign.toml", text, seen).text)

    threads = [Thread(target=edit, args=(f"schema = 1 # {n}\n",)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert taken == [inner_folder.read("a/campaign.toml").text]


def test_failed_write_keeps_previous_file(inner_folder, monkeypatch):
    seen = inner_folder.read("a/campaign.toml")

    def raise_no_space(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", raise_no_space)
    with pytest.raises(CounterspinError, match="No space left"):
        inner_folder.write("a/campaign.toml", "other", seen.version)
    assert inner_folder.read("a/campaign.toml") == seen
    assert [path.name for path in (inner_folder.root / "a").iterdir()] == ["campaign.toml"]


def test_messages_use_paths_relative_to_folder(inner_folder):
    relative_paths = inner_folder.relative_paths(
        f"{inner_folder.root}{os.sep}a: wrong; {inner_folder.root}: too"
    )
    assert relative_paths == "a: wrong; this folder: too"


def test_removed_root_is_reported_and_not_created_again(inner_folder):
    inner_folder.root.rename(inner_folder.root.with_name("elsewhere"))
    with raises("not-found", "the folder inside no longer exists"):
        list(inner_folder.folders())
    with raises("not-found", "the folder inside no longer exists"):
        inner_folder.write("a/campaign.toml", "x", "")
    assert not inner_folder.root.exists()
