"""Files that appear whole or not at all."""

import os
import stat
import threading
from pathlib import Path

import pytest

from counterspin.errors import CounterspinError
from counterspin.output import make_folder, write_text


def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path):
    target = tmp_path / "result.json"
    for text in ("one", "two"):
        write_text(target, text)
        assert target.read_text() == text
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


def test_a_link_keeps_standing(tmp_path):
    (tmp_path / "kept").mkdir()
    target, link = tmp_path / "kept" / "result.json", tmp_path / "latest.json"
    target.write_text("old")
    link.symlink_to(target)
    write_text(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_a_pipe_is_written_to_and_not_replaced(tmp_path):
    pipe = tmp_path / "pipe.json"
    os.mkfifo(pipe)
    read: list[str] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()), daemon=True)
    reader.start()
    write_text(pipe, "whole")
    reader.join(timeout=10.0)
    assert read == ["whole"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_full_disk_is_told(tmp_path):
    full = tmp_path / "full.json"
    full.symlink_to("/dev/full")
    with pytest.raises(CounterspinError, match=r"full\.json: cannot be written"):
        write_text(full, "x")


def test_a_folder_in_the_way_and_one_that_is_missing(tmp_path):
    for target in (tmp_path, tmp_path / "nowhere" / "result.json"):
        with pytest.raises(CounterspinError, match="cannot be written"):
            write_text(target, "x")
    assert not list(tmp_path.iterdir())
    with pytest.raises(CounterspinError, match=r"^\.: cannot be written, being a folder; "):
        write_text(Path(), "x")


def test_a_file_in_the_place_of_a_folder(tmp_path):
    (tmp_path / "dossier").write_text("mine")
    with pytest.raises(CounterspinError, match=r"dossier is a file, not a folder; name a folder"):
        make_folder(tmp_path / "dossier")
    with pytest.raises(CounterspinError, match=r"cannot be made .* choose another place"):
        make_folder(tmp_path / "dossier" / "deeper")
    assert (tmp_path / "dossier").read_text() == "mine"
