"""Files of the folder and no others; no edit is lost."""

import os
import time
from contextlib import suppress
from threading import Barrier, Thread

import pytest

from counterspin.application import served_folder
from counterspin.application.served_folder import (
    EditConflictError,
    PathForbiddenError,
    ServedFolder,
)
from counterspin.errors import CounterspinError


@pytest.fixture
def served(tmp_path):
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
def test_no_name_leads_out(served, name):
    with pytest.raises(PathForbiddenError):
        served.read(name)
    with pytest.raises(PathForbiddenError):
        served.write(name, "x", "")


def test_no_link_leads_out(served, tmp_path):
    (served.root / "link.toml").symlink_to(tmp_path / "secret.toml")
    (served.root / "up").symlink_to(tmp_path)
    (served.root / "round").symlink_to(served.root / "round")
    for name in ("link.toml", "up/secret.toml", "up", "round"):
        with pytest.raises(PathForbiddenError):
            served.read(name)
        with pytest.raises(PathForbiddenError):
            served.write(name, "x", "")
    assert (tmp_path / "secret.toml").read_text() == "secret = 1"
    assert [path for path, _ in served.folders()] == [served.root, served.root / "a"]


def test_a_link_within_the_folder_is_followed(served):
    (served.root / "b.toml").symlink_to(served.root / "a" / "campaign.toml")
    assert served.read("b.toml").text == "schema = 1\n"


def test_what_is_no_text_or_too_much_is_refused(served):
    (served.root / "a" / "big.toml").write_text("x" * 101)
    (served.root / "a" / "odd.toml").write_bytes(b"\xff\xfe")
    os.mkfifo(served.root / "a" / "pipe.toml")
    with pytest.raises(CounterspinError, match="more than 100 bytes"):
        served.read("a/big.toml", 100)
    with pytest.raises(CounterspinError, match="not UTF-8"):
        served.read("a/odd.toml")
    with pytest.raises(CounterspinError, match="a pipe"):
        served.read("a/pipe.toml")
    with pytest.raises(CounterspinError, match="is not valid text"):
        served.write("a/new.toml", "\ud800", "")


def test_an_edit_of_an_older_version_is_refused_and_told_what_there_is(served):
    first = served.read("a/campaign.toml")
    second = served.write("a/campaign.toml", "schema = 1 # mine\n", first.version)
    with pytest.raises(EditConflictError) as refused:
        served.write("a/campaign.toml", "schema = 1 # theirs\n", first.version)
    assert refused.value.current == second == served.read("a/campaign.toml")
    with pytest.raises(EditConflictError):
        served.write("a/campaign.toml", "x", "")
    third = served.write("a/campaign.toml", "schema = 1 # both\n", second.version)
    assert served.read("a/campaign.toml") == third
    assert [path.name for path in (served.root / "a").iterdir()] == ["campaign.toml"]


def test_of_many_edits_at_once_one_is_taken(served, monkeypatch):
    write = served_folder.write_whole

    def slow(*words, **more):
        time.sleep(0.05)  # in which all others have looked
        write(*words, **more)

    monkeypatch.setattr(served_folder, "write_whole", slow)
    seen = served.read("a/campaign.toml").version
    start, taken = Barrier(8), []

    def edit(text):
        start.wait()
        with suppress(EditConflictError):
            taken.append(served.write("a/campaign.toml", text, seen).text)

    threads = [Thread(target=edit, args=(f"schema = 1 # {n}\n",)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert taken == [served.read("a/campaign.toml").text]


def test_a_write_that_fails_leaves_what_there_was(served, monkeypatch):
    seen = served.read("a/campaign.toml")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", fail)
    with pytest.raises(CounterspinError, match="No space left"):
        served.write("a/campaign.toml", "other", seen.version)
    assert served.read("a/campaign.toml") == seen
    assert [path.name for path in (served.root / "a").iterdir()] == ["campaign.toml"]


def test_messages_name_files_as_the_page_does(served):
    told = served.relative_paths(f"{served.root}{os.sep}a: wrong; {served.root}: too")
    assert told == "a: wrong; this folder: too"
