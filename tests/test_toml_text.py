"""TOML text: parsed with bounded time and memory."""

import re
import tracemalloc
from pathlib import Path

import pytest

import counterspin
from counterspin.toml_text import NestingError, parse_toml

PACKAGE = Path(counterspin.__file__).parent

#: Keys and values that would take much more memory than their text.
BOMBS = {
    "key": "seed = 1\n" + "a." * 40_000 + "a = 1\n",
    "key with blanks": "seed = 1\na" + " . a" * 40_000 + " = 1\n",
    "quoted key": 'seed = 1\n"a"' + '."a"' * 40_000 + " = 1\n",
    "key in single quotation marks": "seed = 1\n'a'" + ".'a'" * 40_000 + " = 1\n",
    "key of an inline table": "seed = 1\nx = { " + "a." * 40_000 + "a = 1 }\n",
    "header": "seed = 1\n[" + "a." * 40_000 + "a]\n",
    "header of a list": "seed = 1\n[[" + "a." * 40_000 + "a]]\n",
    "key after a comment with a quotation mark": "# it's\n" + "a." * 40_000 + "a = 1\n",
    "key after a string": 'x = "\'"\n' + "a." * 40_000 + "a = 1\n",
    "key after an escaped mark": r'x = "\""' + "\n" + "a." * 40_000 + "a = 1\n",
    "lists": "seed = 1\nx = " + "[" * 40_000 + "]" * 40_000 + "\n",
    "lists without an end": "seed = 1\nx = " + "[" * 40_000 + "\n",
    "inline tables": "seed = 1\nx = " + "{a = " * 40_000 + "\n",
}


@pytest.mark.parametrize("text", BOMBS.values(), ids=BOMBS)
def test_deeply_nested_text_raises_before_parsing(text):
    tracemalloc.start()
    with pytest.raises(NestingError) as raised:
        parse_toml(text)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()
    assert raised.value.line == 2


def test_nesting_counts_keys_and_brackets():
    # Each is allowed by itself: 10 levels of brackets whose keys have 10 parts.
    key = ".".join("abcdefghij")
    with pytest.raises(NestingError, match="nested too deeply"):
        parse_toml("x = " + f"{{ {key} = " * 10 + "1" + " }" * 10)


@pytest.mark.slow
def test_too_many_keys_and_values_raise():
    for text in ("x = [" + "1," * 600_000 + "]", "k = 1\n" * 600_000, "[[a]]\n" * 300_000):
        with pytest.raises(NestingError, match="more than 500000 keys and values"):
            parse_toml(text)
    runs = "".join(
        f'[[runs]]\nname = "r{n}"\nrate = "5 rad/s"\nmotion = "static"\n'
        f'attitude = {{ angle = "{n} deg", about = ["0", "0", "1"] }}\n'
        f'reading = {{ A = "1.5 mA", B = "2.5 mA" }}\ntime = "{n} s"\n'
        for n in range(10_000)
    )
    assert len(parse_toml(runs)["runs"]) == 10_000


@pytest.mark.parametrize(
    "text",
    [
        "a = '''" + "." * 100 + "[" * 100 + "''''\n" + 'b = """' + '"[." ' * 100 + '"""""\n',
        'a = "' + ".[{" * 100 + '" # ' + "." * 100 + "\nb = '" + "[" * 100 + "'\n",
        'a = """\\' + '""" ' + "." * 100 + '"""\n',
        'a = ["' + '", "'.join(["1.5"] * 100) + '"]\nb = [' + "1.5, 2.5," * 100 + "]\n",
        "\n".join(f"a.b.c.k{n}.d = 1" for n in range(100)),
    ],
)
def test_dots_and_brackets_in_strings_and_comments_are_ignored(text):
    assert parse_toml(text)


@pytest.mark.parametrize("text", ['"\\"' * 100_000, 'a = """' + '\\"' * 100_000, "'" * 300_000])
def test_unterminated_string_raises(text):
    with pytest.raises(ValueError, match=r"at line 1|at end of document"):
        parse_toml(text)


def test_toml_is_parsed_only_in_toml_text():
    sources = {path.name: path.read_text("utf-8") for path in PACKAGE.rglob("*.py")}
    parsers = {name for name, text in sources.items() if re.search(r"tomllib\.loads?\(", text)}
    assert parsers == {"toml_text.py"}
