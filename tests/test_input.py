"""Files that are read: ordinary ones, and no more of them than is allowed."""

import os

import pytest

from counterspin.input import FileIdentity, open_file, parse_json, read_file


def test_a_file_is_read_whole_up_to_a_size(tmp_path):
    file = tmp_path / "a[1]?*.json"
    file.write_bytes(b"x" * 3_000_000)
    assert read_file(file) == b"x" * 3_000_000
    assert read_file(file, 3_000_000) == b"x" * 3_000_000
    with pytest.raises(OSError, match="more than 2999999 bytes"):
        read_file(file, 2_999_999)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files here")
def test_what_is_no_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for place, words in (
        (tmp_path, "a folder"),
        (tmp_path / "pipe", "a pipe"),
        ("/dev/zero", "a device"),
    ):
        with pytest.raises(OSError, match=f"this is {words}, not a file"):
            open_file(type(tmp_path)(place))


def test_names_that_no_file_can_have(tmp_path):
    with pytest.raises(OSError, match="this is not a valid file name"):
        open_file(tmp_path / "a\0b")


def test_an_identity_is_of_the_content(tmp_path):
    file = tmp_path / "a"
    file.write_bytes(b"one")
    os.utime(file, ns=(1, 1))
    identity = FileIdentity.of(file)
    with open_file(file) as stream:
        assert FileIdentity.of(stream.fileno()) == identity
    file.touch()
    assert FileIdentity.of(file) != identity


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
def test_json_that_programs_read_differently_is_refused(text, words):
    for document in (text, text.encode()):
        with pytest.raises(ValueError, match=words):
            parse_json(document)


def test_other_json_is_read():
    assert parse_json(b'{"a": [1, 2.5, null, -3e400], "b": {"a": true}}') == {
        "a": [1, 2.5, None, -float("inf")],
        "b": {"a": True},
    }
