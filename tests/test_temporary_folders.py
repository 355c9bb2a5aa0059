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


def backdate_lock(folder):
    """Backdate the lock of a folder by minutes."""
    then = time.time() - 100.0
    os.utime(folder / ".lock", (then, then))


@pytest.fixture
def make_abandoned_folder(tmp_path):
    """Return a function that makes a folder in a process that is killed."""

    def make(prefix, parent=tmp_path):
        words = [sys.executable, "-c", WAIT, prefix, str(parent)]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
            folder = Path(process.stdout.readline().strip())
            backdate_lock(folder)
            remove_abandoned_folders(prefix, parent)
            assert folder.exists()  # its process lives
            process.send_signal(signal.SIGKILL)
        return folder

    return make


def test_only_folder_of_killed_process_is_removed(make_abandoned_folder, tmp_path):
    folder = make_abandoned_folder("ours-")
    others = [
        tmp_path / name for name in ("ours-", "ours-abcdefg", "ours-abcdefgh", "other-abcdefgh")
    ]
    for other in others:
        other.mkdir()
        (other / "file").write_text("")
    for other in (others[0], others[1], others[3]):  # of other names, though they have the file
        (other / ".lock").write_text("")
        backdate_lock(other)
    link = tmp_path / "ours-linkedaa"
    link.symlink_to(others[3])
    with temporary_folder("ours-", tmp_path) as used:
        backdate_lock(used)
        remove_abandoned_folders("ours-", tmp_path)
        assert used.exists()
    assert not folder.exists()
    assert sorted(tmp_path.iterdir()) == sorted([*others, link])


def test_new_folder_removes_folders_of_killed_processes(make_abandoned_folder, tmp_path):
    left = make_abandoned_folder("counterspin-rerun-")
    with temporary_folder("counterspin-rows-", tmp_path):
        assert left.exists()  # another command may have made it
    with temporary_folder("counterspin-rerun-", tmp_path):
        assert not left.exists()


def test_temporary_folders_are_created_in_single_module():
    """Folders created elsewhere would remain after a kill."""
    source = Path(temporary_folders.__file__).parent
    makers = [p.name for p in source.rglob("*.py") if "TemporaryDirectory" in p.read_text("utf-8")]
    assert makers == ["temporary_folders.py"]


def test_new_folder_without_lock_is_not_removed(tmp_path):
    folder = tmp_path / "ours-abcdefgh"
    folder.mkdir()
    (folder / ".lock").write_text("")
    remove_abandoned_folders("ours-", tmp_path)
    assert folder.exists()
    backdate_lock(folder)
    remove_abandoned_folders("ours-", tmp_path)
    assert not folder.exists()


def test_server_start_removes_folders_of_killed_servers(
    make_abandoned_folder, tmp_path, monkeypatch
):
    private, served = tmp_path / "private", tmp_path / "served"
    private.mkdir()
    (served / "below").mkdir(parents=True)
    left = [
        make_abandoned_folder(server._FOLDER_PREFIX, private),
        make_abandoned_folder(campaign_files.COPY_PREFIX, served / "below"),
        make_abandoned_folder(campaign_files._UPLOAD_PREFIX, served),
    ]
    monkeypatch.setattr(server, "_private_folder", lambda: private)
    monkeypatch.setattr(server, "_preload_modules", lambda *_: None)
    seen = []

    class Stopped:
        def run(self, **_):
            seen.extend([path.exists() for path in left])

    monkeypatch.setattr(server, "make_server", lambda *_: Stopped())
    server.serve(served, browser=False, print_line=lambda _: None)
    assert seen == [False, False, False]
    assert list(private.iterdir()) == []
    assert list(served.iterdir()) == [served / "below"]
