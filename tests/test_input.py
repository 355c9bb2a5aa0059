"""Files that are read: ordinary ones, and no more of them than is allowed."""

import os
import re

import pytest

from counterspin.input import FileIdentity, open_file, parse_json, read_file


def test_file_is_read_up_to_size_limit(tmp_path):
    file = tmp_path / "a[1]?*.json"
    file.write_bytes(b"x" * 3_000_000)
    assert read_file(file) == b"x" * 3_000_000
    assert read_file(file, 3_000_000) == b"x" * 3_000_000
    with pytest.raises(OSError, match="more than 2999999 bytes"):
        read_file(file, 2_999_999)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files here")
def test_pipe_or_device_raises_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for place, words in (
        (tmp_path, "a folder"),
        (tmp_path / "pipe", "a pipe"),
        ("/dev/zero", "a device"),
    ):
        with pytest.raises(OSError, match=f"this is {words}, not a file"):
            open_file(type(tmp_path)(place))


def test_invalid_file_name_raises(tmp_path):
    with pytest.raises(OSError, match="this is not a valid file name"):
        open_file(tmp_path / "a\0b")


def test_file_identity_follows_content(tmp_path):
    file = tmp_path / "a"
    file.write_bytes(b"one")
    os.utime(file, ns=(1, 1))
    identity = FileIdentity.from_file(file)
    with open_file(file) as stream:
        assert FileIdentity.from_file(stream.fileno()) == identity
    file.touch()
    assert FileIdentity.from_file(file) != identity


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "b": {"c": 2, "c": 2}}', "the key 'c' occurs twice in one object"),
        (r'{"a": 1, "\u0061": 2}', "the key 'a' occurs twice in one object"),
        ("[1, NaN]", "NaN is not a valid number in JSON"),
        ("[-Infinity]", "-Infinity is not a valid number in JSON"),
        ("1" * 5000, "a number has 5000 digits; at most 400 are allowed"),
        ("[" * 100_000, "the document is nested too deeply"),
    ],
)
def test_ambiguous_json_raises(text, words):
    for document in (text, text.encode()):
        with pytest.raises(ValueError, match=words):
            parse_json(document)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1 "b": 2}', "line 1, column 9: a comma or a closing bracket is missing"),
        ('{"a": 1,\n "b" 2}', "line 2, column 6: a colon is missing after the key"),
        ('{"a": 1,\n b: 2}', "line 2, column 2: a key in double quotation marks is missing"),
        ('{"a": ,}', "line 1, column 7: a value is missing, or is not a valid value"),
        ('{"a": maybe}', "line 1, column 7: a value is missing, or is not a valid value"),
        ('{"a": "x\ny"}', "line 1, column 9: a text contains a line break or another control"),
        (r'{"a": "C:\data", "b": 1}', "line 1, column 10: a text contains an invalid escape"),
        ('{"a": 1}\n{"b": 2}', "line 2, column 1: the document ends here, but more text follows"),
    ],
)
def test_invalid_json_raises_with_position(text, words):
    with pytest.raises(ValueError, match=f"^{re.escape(words)}"):
        parse_json(text)


def test_cut_json_is_recognised_at_every_length():
    text = '{"a": [1.5e-3, -2, true, null],\n "text\\u00b1": {"b": "\\n"}}\n'
    for length in range(len(text.rstrip())):
        lines = text[:length].rstrip().split("\n")
        end = f"it ends at line {len(lines)}, column {len(lines[-1])}$"
        with pytest.raises(ValueError, match=f"^the end of the file is missing: {end}"):
            parse_json(text[:length])


def test_valid_json_is_parsed():
    assert parse_json(b'{"a": [1, 2.5, null, -3e400], "b": {"a": true}}') == {
        "a": [1, 2.5, None, -float("inf")],
        "b": {"a": True},
    }
