"""Streams whose encoding lacks characters, as consoles and pipes on Windows."""

import io
import json
import os
import subprocess
import sys

import pytest

from counterspin.characters import install_substitution
from counterspin.schemas import make_schema


@pytest.mark.parametrize(
    ("encoding", "shown"),
    [
        ("utf-8", "1 ± 2 µg, 10⁻⁵ − × ≤ 測"),
        ("cp1252", "1 ± 2 µg, 10^-5 - × ? ?"),
        ("cp437", "1 ± 2 µg, 10^-5 - x ≤ ?"),
        ("cp932", "1 ± 2 ug, 10^-5 \uff0d × ? 測"),
        ("ascii", "1 +/- 2 ug, 10^-5 - x ? ?"),
    ],
)
def test_stream_substitutes_unencodable_characters(encoding, shown):
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding=encoding, newline="\n")
    install_substitution(stream)
    print("1 ± 2 µg, 10⁻⁵ − × ≤ 測", end="", file=stream, flush=True)
    assert raw.getvalue().decode(encoding) == shown


def test_closed_stream_and_stream_without_encoding_are_unchanged():
    install_substitution(None)
    install_substitution(io.StringIO())


@pytest.mark.slow
@pytest.mark.parametrize("words", [("schema", "campaign"), ("apply", "--help")])
def test_commands_write_in_any_encoding(words):
    for encoding in ("cp1252", "ascii"):
        done = subprocess.run(
            [sys.executable, "-m", "counterspin", *words],
            env=os.environ | {"PYTHONIOENCODING": f"{encoding}:strict"},
            capture_output=True,
            check=True,
        )
        assert done.stderr == b""
        if words[0] == "schema":
            assert json.loads(done.stdout.decode("utf-8")) == make_schema("campaign")
