"""Files that appear whole or not at all."""

import errno
import os
import stat
import threading
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from raising import raises

from counterspin import output
from counterspin.errors import CounterspinError
from counterspin.output import (
    create_partial_file,
    file_mark,
    make_folder,
    marked_file_type,
    write_atomically,
    write_text,
)


def test_file_is_replaced_without_other_files(tmp_path):
    target = tmp_path / "result.json"
    for text in ("one", "two"):
        write_text(target, text, overwrite=True)
        assert target.read_text() == text
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


def test_symbolic_link_is_preserved(tmp_path):
    (tmp_path / "kept").mkdir()
    target, link = tmp_path / "kept" / "result.json", tmp_path / "latest.json"
    target.write_text("old")
    link.symlink_to(target)
    write_text(link, "new", overwrite=True)
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_pipe_is_written_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()), daemon=True)
    reader.start()
    write_text(pipe, "whole")
    reader.join(timeout=300.0)
    assert read == ["whole"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_full_disk_raises(tmp_path):
    full = tmp_path / "full.json"
    full.symlink_to("/dev/full")
    with pytest.raises(CounterspinError, match=r"full\.json cannot be written"):
        write_text(full, "x")


def test_existing_folder_and_missing_folder_raise(tmp_path):
    for target in (tmp_path, tmp_path / "nowhere" / "result.json"):
        with pytest.raises(CounterspinError, match="cannot be written"):
            write_text(target, "x")
    assert not list(tmp_path.iterdir())
    with raises("file-not-writable", ". "):
        write_text(Path(), "x")


def test_file_in_place_of_folder_raises(tmp_path):
    (tmp_path / "dossier").write_text("mine")
    with raises("file-exists", "dossier"):
        make_folder(tmp_path / "dossier")
    with raises("file-not-writable"):
        make_folder(tmp_path / "dossier" / "deeper")
    assert (tmp_path / "dossier").read_text() == "mine"


@pytest.fixture(params=["links", "no links"])
def hard_link_support(request, monkeypatch):
    """Provide a file system with or without hard links."""
    if request.param == "no links":

        def refused(*_):
            raise OSError(errno.EPERM, "Operation not permitted")

        monkeypatch.setattr(os, "link", refused)


def test_concurrently_created_file_is_not_lost(tmp_path, hard_link_support):
    target = tmp_path / "c.xml"

    def write(part):
        target.write_text("somebody else's")
        part.write_text("ours")

    with raises("file-exists", "c.xml"):
        write_atomically(target, write)
    with raises("file-exists", "c.xml", "comparison"):
        write_atomically(target, write, partial(marked_file_type, "a comparison"), overwrite=True)
    assert target.read_text() == "somebody else's"
    target.unlink()
    with raises("file-exists", "c.xml", "comparison"):
        write_atomically(target, write, partial(marked_file_type, "a comparison"), overwrite=True)
    assert target.read_text() == "somebody else's"
    assert [path.name for path in tmp_path.iterdir()] == ["c.xml"]


def test_single_writer_of_same_name_succeeds(tmp_path, hard_link_support):
    start, taken, refused = threading.Barrier(8), [], []

    def write(text):
        start.wait()
        try:
            write_atomically(tmp_path / "c.xml", lambda part: part.write_text(text))
            taken.append(text)
        except CounterspinError:
            refused.append(text)

    threads = [threading.Thread(target=write, args=(str(n),)) for n in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert taken == [(tmp_path / "c.xml").read_text()]
    assert len(refused) == 7
    assert [path.name for path in tmp_path.iterdir()] == ["c.xml"]


@pytest.mark.parametrize(("mask", "mode"), [(0o077, 0o600), (0o027, 0o640), (0o022, 0o644)])
def test_umask_is_respected_and_never_changed(tmp_path, monkeypatch, hard_link_support, mask, mode):
    before = os.umask(mask)
    try:
        # Another thread's files would have the rights of whatever it is meanwhile.
        monkeypatch.setattr(os, "umask", pytest.fail)
        write_text(tmp_path / "a", "x")
    finally:
        monkeypatch.undo()
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == mode


def test_circular_link_raises(tmp_path):
    (tmp_path / "c.xml").symlink_to("c.xml")
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    for name in ("c.xml", "a", "a/deeper.json"):
        with raises("file-not-writable", "circular link"):
            write_text(tmp_path / name, "x", overwrite=True)


@pytest.mark.parametrize("apostrophe", ["'", "&#39;"])
def test_mark_with_apostrophe_is_recognised(tmp_path, apostrophe):
    page = tmp_path / "page.html"
    page.write_text(file_mark("a study's result").replace("'", apostrophe))
    assert marked_file_type("a study's result").recognises(page)
    assert not marked_file_type("a plan's result").recognises(page)


def test_file_with_two_marks_or_none_is_not_recognised(tmp_path):
    page = tmp_path / "page.html"
    report, comparison = marked_file_type("a report"), marked_file_type("a comparison")
    page.write_text(f"<html>{file_mark('a report')}")
    assert (report.recognises(page), comparison.recognises(page)) == (True, False)
    # As if a title were chosen for it.
    page.write_text(f"<html>{file_mark('a report')}<title>{file_mark('a comparison')}")
    assert (report.recognises(page), comparison.recognises(page)) == (False, False)
    page.write_text("<html>")
    assert not report.recognises(page)


# Windows


@pytest.fixture
def windows(monkeypatch):
    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.setattr("time.sleep", lambda _: None)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("CON", "CON is the name of a device"),
        ("nul.json", "nul.json is the name of a device"),
        ("COM1.toml", "COM1.toml is the name of a device"),
        ("LPT¹ .x", "is the name of a device"),
        ("aux/result.json", "aux is the name of a device"),
        ("10:30.csv", "must not contain ':'"),
        ("what?.csv", "must not contain '\\?'"),
        ("result.", "must not end with a dot or a space"),
        ("run 1 /result.json", "must not end with a dot or a space"),
    ],
)
def test_reserved_windows_names_raise(windows, tmp_path, name, reason):
    for act in (make_folder, create_partial_file, lambda path: write_text(path, "x")):
        with pytest.raises(CounterspinError, match=f"{reason}.*; choose another name"):
            act(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_other_names_and_systems_are_accepted(tmp_path, monkeypatch):
    (tmp_path / "x").mkdir()
    names = ("console.json", "com10.json", "nulls", "x/../a.b.json", "µ-1.json")
    write_text(tmp_path / "nul.json", "a name as any other")
    monkeypatch.setattr("sys.platform", "win32")
    for name in names:
        write_text(tmp_path / name, "x")


def test_replacing_waits_for_virus_scanner_on_windows(windows, tmp_path, monkeypatch):
    target, replace, refused = tmp_path / "result.json", Path.replace, []
    target.write_text("old")

    def locked(part, place):
        if len(refused) < 3:
            refused.append(part)
            raise PermissionError(13, "Access is denied")
        return replace(part, place)

    monkeypatch.setattr(Path, "replace", locked)
    write_text(target, "new", overwrite=True)
    assert (target.read_text(), len(refused)) == ("new", 3)
    assert list(tmp_path.iterdir()) == [target]


def test_new_file_waits_for_virus_scanner_on_windows(windows, tmp_path, monkeypatch):
    part, place, refused = tmp_path / "part", tmp_path / "result.json", []
    part.write_text("new")
    rename = Path.rename

    def locked(file, target):
        if len(refused) < 3:
            refused.append(file)
            raise PermissionError(13, "Access is denied")
        return rename(file, target)

    monkeypatch.setattr(Path, "rename", locked)
    monkeypatch.setattr("counterspin.output.os", SimpleNamespace(name="nt"))
    output._rename_exclusively(part, place)
    assert (place.read_text(), len(refused)) == ("new", 3)


def test_failed_removal_of_temporary_file_hides_no_error(tmp_path, monkeypatch):
    def locked(*_, **__):
        raise PermissionError(13, "Access is denied")

    monkeypatch.setattr(Path, "unlink", locked)
    with pytest.raises(ZeroDivisionError):
        write_atomically(tmp_path / "result.json", lambda _: 1 / 0)


def test_file_open_in_other_program_raises_on_windows(windows, tmp_path, monkeypatch):
    target = tmp_path / "result.json"
    target.write_text("old")

    def locked(*_):
        raise PermissionError(13, "The process cannot access the file")

    monkeypatch.setattr(Path, "replace", locked)
    with raises("file-not-writable", "another program"):
        write_text(target, "new", overwrite=True)
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]
