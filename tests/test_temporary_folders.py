"""Temporary folders: removed at the end, and after a process that was killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from counterspin import temporary_folders
from counterspin.application import campaign_files, server
from counterspin.temporary_folders import remove_abandoned_folders, temporary_folder

#: Makes a folder with a file and waits.
WAIT = """
import sys, time
from pathlib import Path
from counterspin.temporary_folders import temporary_folder
with temporary_folder(sys.argv[1], Path(sys.argv[2])) as folder:
    (folder / "part").mkdir()
    (folder / "part" / "record.csv").write_text("1")
    print(folder, flush=True)
    time.sleep(1000)
"""


def make_older(folder):
    """Date the lock of a folder back, as if the folder was made minutes ago."""
    then = time.time() - 100.0
    os.utime(folder / ".lock", (then, then))


@pytest.fixture
def killed(tmp_path):
    """Return a function that makes a folder in a process that is killed."""

    def make(prefix, parent=tmp_path):
        words = [sys.executable, "-c", WAIT, prefix, str(parent)]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
            folder = Path(process.stdout.readline().strip())
            make_older(folder)
            remove_abandoned_folders(prefix, parent)
            assert folder.exists()  # its process lives
            process.send_signal(signal.SIGKILL)
        return folder

    return make


def test_only_the_folder_of_a_killed_process_is_removed(killed, tmp_path):
    folder = killed("ours-")
    others = [
        tmp_path / name for name in ("ours-", "ours-abcdefg", "ours-abcdefgh", "other-abcdefgh")
    ]
    for other in others:
        other.mkdir()
        (other / "file").write_text("")
    for other in (others[0], others[1], others[3]):  # of other names, though they have the file
        (other / ".lock").write_text("")
        make_older(other)
    link = tmp_path / "ours-linkedaa"
    link.symlink_to(others[3])
    with temporary_folder("ours-", tmp_path) as used:
        make_older(used)
        remove_abandoned_folders("ours-", tmp_path)
        assert used.exists()
    assert not folder.exists()
    assert sorted(tmp_path.iterdir()) == sorted([*others, link])


def test_the_next_folder_replaces_those_of_killed_processes(killed, tmp_path):
    left = killed("counterspin-rerun-")
    with temporary_folder("counterspin-rows-", tmp_path):
        assert left.exists()  # another command may have made it
    with temporary_folder("counterspin-rerun-", tmp_path):
        assert not left.exists()


def test_temporary_folders_have_one_maker():
    """What another one makes is not removed after a kill."""
    source = Path(temporary_folders.__file__).parent
    makers = [p.name for p in source.rglob("*.py") if "TemporaryDirectory" in p.read_text("utf-8")]
    assert makers == ["temporary_folders.py"]


def test_a_folder_that_was_just_made_may_not_be_locked_yet(tmp_path):
    folder = tmp_path / "ours-abcdefgh"
    folder.mkdir()
    (folder / ".lock").write_text("")
    remove_abandoned_folders("ours-", tmp_path)
    assert folder.exists()
    make_older(folder)
    remove_abandoned_folders("ours-", tmp_path)
    assert not folder.exists()


def test_a_server_removes_at_its_start_what_killed_servers_left(killed, tmp_path, monkeypatch):
    private, served = tmp_path / "private", tmp_path / "served"
    private.mkdir()
    (served / "below").mkdir(parents=True)
    left = [
        killed(server._PREFIX, private),
        killed(campaign_files.COPY_PREFIX, served / "below"),
        killed(campaign_files._UPLOAD_PREFIX, served),
    ]
    monkeypatch.setattr(server, "_private_folder", lambda: private)
    monkeypatch.setattr(server, "_preload", lambda *_: None)
    seen = []

    class Stopped:
        def run(self, **_):
            seen.extend([path.exists() for path in left])

    monkeypatch.setattr(server, "make_server", lambda *_: Stopped())
    server.serve(served, browser=False, say=lambda _: None)
    assert seen == [False, False, False]
    assert list(private.iterdir()) == []
    assert list(served.iterdir()) == [served / "below"]
