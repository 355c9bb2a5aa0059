"""A ledger detects all altered bytes and loses no entry."""

import errno
import json
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from counterspin.certificates.ledger import append_entry, open_ledger, verify_ledger
from counterspin.errors import CounterspinError, RecordError

WHEN = "2026-03-01T00:00:00Z"


def append_entries(path, count, first_number=1):
    return [
        append_entry(
            path, "result", {"file": f"r{n}.json"}, who="A. Erste", why="yearly ü", when=WHEN
        )
        for n in range(first_number, first_number + count)
    ]


def altered_entry(path):
    """Return the entry that the error of a ledger names."""
    try:  # pytest.raises takes ten times as long, and there are hundreds of bytes
        verify_ledger(path)
    except RecordError as error:
        return str(error).removeprefix(f"{path}: ")
    return "none"


def test_entries_round_trip_with_hash_of_previous_entry(tmp_path):
    path = tmp_path / "ledger.jsonl"
    entries = append_entries(path, 3)
    ledger = verify_ledger(path)
    assert (list(ledger.entries), ledger.partial_entry) == (entries, b"")
    lines = [json.loads(line) for line in path.read_bytes().splitlines()]
    assert [line["number"] for line in lines] == [1, 2, 3]
    assert lines[0]["previous"] == "0" * 64
    assert [line["previous"] for line in lines[1:]] == [line["hash"] for line in lines[:-1]]
    assert ledger.head == lines[-1]["hash"]


def test_altered_byte_is_detected_with_entry_number(tmp_path):
    path = tmp_path / "ledger.jsonl"
    append_entries(path, 3)
    content = path.read_bytes()
    line_ends = [i for i, byte in enumerate(content) if byte == ord("\n")]
    for offset in range(len(content)):
        changed = bytearray(content)
        changed[offset] ^= 1 << offset % 8  # each bit in its turn
        path.write_bytes(changed)
        number = sum(end < offset for end in line_ends) + 1
        if offset == line_ends[-1]:
            # A line without a line end is a partial entry.
            assert verify_ledger(path).partial_entry
        else:
            assert altered_entry(path).startswith(f"entry {number} ")


def test_removed_moved_or_rewritten_entries_are_detected(tmp_path):
    path = tmp_path / "ledger.jsonl"
    append_entries(path, 4)
    first, second, third, fourth = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first + third + fourth)
    assert altered_entry(path).startswith("entry 2 has the number 3: entries are missing")
    path.write_bytes(first + third + second + fourth)
    assert altered_entry(path).startswith("entry 2 has the number 3")
    # A rewritten entry with a valid hash is detected by the next entry.
    other_path = tmp_path / "other.jsonl"
    append_entries(other_path, 1)
    append_entry(other_path, "result", {"file": "made up"}, who="B", why="", when=WHEN)
    path.write_bytes(first + other_path.read_bytes().splitlines(keepends=True)[1] + third + fourth)
    assert altered_entry(path).startswith("entry 2 was altered after it was written")
    path.write_bytes(second)
    assert altered_entry(path).startswith("entry 1 has the number 2")


@pytest.mark.parametrize("key", ["who", "file"])
def test_entry_with_duplicate_key_is_detected(tmp_path, key):
    path = tmp_path / "ledger.jsonl"
    append_entries(path, 2)
    first, second = path.read_bytes().splitlines(keepends=True)
    name = f'"{key}":'.encode()
    path.write_bytes(first + second.replace(name, name + b'"B",' + name))
    assert altered_entry(path).startswith("entry 2 was changed after it was written")


def test_removed_last_entries_change_head_hash(tmp_path):
    path = tmp_path / "ledger.jsonl"
    append_entries(path, 3)
    complete_ledger = verify_ledger(path)
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:2]))
    shortened_ledger = verify_ledger(path)
    assert shortened_ledger.entries == complete_ledger.entries[:2]
    assert shortened_ledger.head != complete_ledger.head


def test_altered_ledger_is_not_extended(tmp_path):
    path = tmp_path / "ledger.jsonl"
    append_entries(path, 2)
    path.write_bytes(changed := path.read_bytes().replace(b"r1.json", b"r7.json"))
    with pytest.raises(RecordError, match="entry 1 was altered"):
        append_entries(path, 1)
    assert path.read_bytes() == changed


def test_partial_entry_is_preserved_in_next_entry(tmp_path):
    path = tmp_path / "ledger.jsonl"
    entries = append_entries(path, 2)
    content = path.read_bytes()
    start = content.index(b"\n") + 1
    for cut in range(start, len(content)):
        path.write_bytes(content[:cut])
        ledger = verify_ledger(path)
        assert ledger.entries == (entries[0],)
        assert ledger.partial_entry == content[start:cut]
    (new_entry,) = append_entries(path, 1, first_number=9)
    assert (new_entry.number, new_entry.subject["unfinished"].encode()) == (2, content[start:-1])
    assert verify_ledger(path).entries == (entries[0], new_entry)


def test_concurrent_writers_lose_no_entry(tmp_path):
    path = tmp_path / "ledger.jsonl"
    program = (
        "import sys; from pathlib import Path\n"
        "from counterspin.certificates.ledger import append_entry\n"
        "for n in range(10):\n"
        f"    append_entry(Path(sys.argv[1]), 'result', {{'file': sys.argv[2] + str(n)}}, who='a', "
        f"why='b', when='{WHEN}')\n"
    )
    writers = [subprocess.Popen([sys.executable, "-c", program, str(path), name]) for name in "abc"]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    names = [entry.subject["file"] for entry in verify_ledger(path).entries]
    assert sorted(names) == sorted(f"{name}{n}" for name in "abc" for n in range(10))
    for name in "abc":  # each writer in its order
        assert [n for n in names if n[0] == name] == [f"{name}{n}" for n in range(10)]


def test_windows_writer_waits_longer_than_ten_seconds(tmp_path, monkeypatch):
    calls, waited = [], []

    def lock_after_400_attempts(file, mode, count):
        calls.append((mode, os.lseek(file, 0, os.SEEK_CUR), count))
        if mode == "try" and len(calls) <= 400:
            raise OSError(errno.EACCES, "Permission denied")

    system = SimpleNamespace(LK_NBLCK="try", LK_UNLCK="unlock", locking=lock_after_400_attempts)
    monkeypatch.setitem(sys.modules, "msvcrt", system)
    monkeypatch.setattr("time.sleep", waited.append)
    monkeypatch.setattr("sys.platform", "win32")
    path = tmp_path / "ledger.jsonl"
    entries = append_entries(path, 1)
    assert sum(waited) > 15.0
    # A byte beyond any ledger, because Windows blocks reading of a locked byte.
    assert set(calls) == {("try", 0x7FFF0000, 1), ("unlock", 0x7FFF0000, 1)}
    assert calls[-1][0] == "unlock"
    monkeypatch.undo()
    assert verify_ledger(path).entries == tuple(entries)


def test_unwritable_ledger_raises(tmp_path):
    with pytest.raises(CounterspinError, match="the ledger cannot be written"):
        append_entries(tmp_path / "no" / "ledger.jsonl", 1)
    with pytest.raises(RecordError, match="file not found"):
        verify_ledger(tmp_path / "none.jsonl")


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_special_file_raises_without_waiting(tmp_path, kind):
    path = tmp_path / "ledger.jsonl"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    with pytest.raises(CounterspinError, match="the ledger cannot be written"):
        append_entries(path, 1)


def test_locked_ledger_includes_new_entries(tmp_path):
    path = tmp_path / "ledger.jsonl"
    append_entries(path, 1)
    with path.open("ab") as file:
        file.write(b'{"number"')
    with open_ledger(path) as ledger:
        for n in (2, 3):
            ledger.append("result", {"file": f"r{n}.json"}, who="A", why="B", when=WHEN)
        assert [entry.number for entry in ledger.entries] == [1, 2, 3]
    assert verify_ledger(path).entries == ledger.entries
    assert [entry.subject.get("unfinished") for entry in ledger.entries] == [
        None,
        '{"number"',
        None,
    ]
