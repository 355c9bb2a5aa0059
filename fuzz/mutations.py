"""Mutations of bytes, text, trees and tables, some with hostile values.

All randomness comes from the `random.Random` argument, so that its seed determines the case.

- `mutate_bytes`, `mutate_text`: mutate content without regard to its structure
- `mutate_tree`: mutate dicts, lists and values of TOML or JSON
- `mutate_sizes`: replace durations, rates and counts in such a tree by extreme ones
- `mutate_xml`: mutate elements
- `mutate_table`: mutate rows of cells
- `write_toml`: write any tree as TOML, valid or not
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable
from datetime import date
from random import Random
from typing import Any

from lxml import etree

#: Values that often cause errors.
HOSTILE_VALUES: list[Any] = [
    "",
    " ",
    "0",
    "-0",
    "nan",
    "inf",
    "1e400",
    "1e308 m",
    "1e-320 rad/s",
    "10^400",
    "2.5 meter ± 1e-5 m",
    "1 ± -1 m",
    "1 ± nan m",
    "1e9999999999 g",
    "9" * 5000,
    "9" * 400 + " m",
    "1 m^99999999",
    "1/0 m",
    "m",
    "±",
    "1 +/- 2 +/- 3",
    "5 %",
    "-5 %",
    "1 rev/s",
    "1 ppm",
    "1e-6 rev/s",
    "1e-30 rev/s",
    "1e12 rev/s",
    "1e12 Hz",
    "1e12 s",
    "1e-12 s",
    "x" * 70000,
    "\x1b[2J\x1b]0;owned\x07",
    "\u202eevil\u2066",
    "\x85\x9b31m",
    "ﬀＡ１",
    "../../../../etc/passwd",
    "/dev/zero",
    "/dev/null",
    "/dev/stdin",
    "a" * 300,
    "run[1]*?.csv",
    "con",
    "east",
    "up",
    "level",
    "K_II",
    "K_F",
    "platform.drift.north",
    "{{ 7 * 7 }}",
    "</script><script>alert(1)</script>",
    "#eval(1)",
    "%s%n",
    "=1+1",
    True,
    False,
    0,
    -1,
    1,
    2**31,
    2**63 - 1,
    -(2**63),
    10**9,
    10**15,
    10**18,
    1e12,
    0.0,
    -0.0,
    1.0,
    -1.0,
    5e-324,
    1e-30,
    1e30,
    1.7976931348623157e308,
    float("inf"),
    float("-inf"),
    float("nan"),
    date(1, 1, 1),
    date(9999, 12, 31),
    [],
    {},
    [[]],
    [{}],
    [None],
    {"": ""},
    [0.0] * 3,
    [1.0, 0.0, 0.0],
    ["up", "west"],
]

#: Text with a meaning for parsers.
TOKENS = [
    *("[", "]", "[[", "]]", "{", "}", "=", '"', "'", '"""', "'''", ",", ".", "#", "\n", "\r", "\t"),
    *("\0", "\ufeff", "\u2028", "\u202e", "\x1b[31m", "±", "+/-", "−", "e", "E", "+", "-", "_"),
    *("0x", "1e999", "nan", "inf", "true", "null", "\\", "\\u0000", "\\ud800", ";", "&", "<", ">"),
    *("<!--", "]]>", "&lt;", "&a;", "%", "^", "/", "*", "(", ")", "99999999999999999999"),
]

#: Bytes at the boundaries of types and encodings, and separators.
_BOUNDARY_BYTES = (0x00, 0x01, 0x7F, 0x80, 0xFE, 0xFF, 0x20, 0x2C, 0x0A)


def draw_count(rng: Random, max_count: int = 8) -> int:
    """Return a random number of mutations, mostly one or two."""
    count = 1
    while count < max_count and rng.random() < 0.45:
        count += 1
    return count


# Bytes and text


def mutate_bytes(rng: Random, content: bytes, byte_range: tuple[int, int] | None = None) -> bytes:
    """Return bytes with a few flips, deletions, copies and other numbers, in a byte range."""
    data = bytearray(content)
    for _ in range(draw_count(rng)):
        if not data:
            return bytes(rng.randbytes(rng.randrange(40)))
        low, high = byte_range or (0, len(data))
        low, high = min(low, len(data) - 1), max(min(high, len(data)), 1)
        position = rng.randrange(low, max(high, low + 1))
        mutation = rng.randrange(10)
        if mutation < 3:
            data[position] ^= 1 << rng.randrange(8)
        elif mutation < 4:
            data[position] = rng.choice(_BOUNDARY_BYTES)
        elif mutation < 6:
            width = rng.choice((2, 4, 8))
            value = rng.choice((0, 1, 2**7, 2**15 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, -1))
            value = value + rng.randrange(-2, 3) if rng.random() < 0.5 else value
            byte_order = rng.choice(("little", "big"))
            data[position : position + width] = (value % 2 ** (8 * width)).to_bytes(
                width, byte_order
            )
        elif mutation == 6:
            del data[position : position + rng.choice((1, 2, 4, 8, 100, 10**6))]
        elif mutation == 7:
            length = rng.choice((1, 4, 16, 256, 4096))
            data[position:position] = data[rng.randrange(len(data)) :][:length]
        elif mutation == 8:
            length = rng.choice((4, 16, 256))
            data[position : position + length] = rng.randbytes(length)
        else:
            length = rng.choice((4, 64, 1024))
            data[position : position + length] = bytes(length)
    return bytes(data)


def mutate_text(rng: Random, text: str) -> str:
    """Return text with tokens, lines and characters inserted, deleted and exchanged."""
    for _ in range(draw_count(rng)):
        lines = text.split("\n")
        position = rng.randrange(len(text) + 1)
        index = rng.randrange(len(lines))
        mutation = rng.randrange(9)
        if mutation == 0:
            del lines[index]
            text = "\n".join(lines)
        elif mutation == 1:
            lines.insert(rng.randrange(len(lines) + 1), lines[index])
            text = "\n".join(lines)
        elif mutation == 2:
            other_index = rng.randrange(len(lines))
            lines[index], lines[other_index] = lines[other_index], lines[index]
            text = "\n".join(lines)
        elif mutation == 3:
            text = text[:position] + rng.choice(TOKENS) + text[position:]
        elif mutation == 4:
            text = text[:position] + text[position + rng.choice((1, 1, 2, 5, 50)) :]
        elif mutation == 5:
            count = rng.choice((2, 200, 20000))
            pair = rng.choice(("[]", "{}", "()", '[""]', "  ", *(2 * token for token in TOKENS)))
            half_length = len(pair) // 2
            text = (
                text[:position]
                + pair[:half_length] * count
                + pair[half_length:] * count
                + text[position:]
            )
        elif mutation == 6:
            text = _replace_number(rng, text)
        elif mutation == 7:
            text = (
                text[:position]
                + chr(rng.choice((rng.randrange(1, 128), rng.randrange(0x2100))))
                + text[position + 1 :]
            )
        else:
            end = min(len(text), position + rng.randrange(1, 200))
            text = (
                text[:position]
                + text[rng.randrange(len(text) + 1) :][: end - position]
                + text[end:]
            )
    return text


_NUMBER_PATTERN = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
_NUMBERS = ("0", "-1", "1e400", "1e-400", "nan", "9" * 30, "1e308", "1e-308", "-0.0", "1e16", "0.1")


def _replace_number(rng: Random, text: str) -> str:
    matches = list(_NUMBER_PATTERN.finditer(text))
    if not matches:
        return text
    match = rng.choice(matches)
    return text[: match.start()] + _draw_number(rng, match[0]) + text[match.end() :]


def _draw_number(rng: Random, number: str) -> str:
    if rng.random() < 0.5:
        return rng.choice(_NUMBERS)
    try:
        return repr(float(number) * rng.choice((-1.0, 10.0, 1e-3, 1e3, 1e6, 1e12, 1.001, 0.0)))
    except OverflowError:
        return "1"


# Trees


def mutate_tree(rng: Random, tree: Any, donors: list[Any]) -> Any:
    """Return a tree with values changed, moved, deleted, nested, or copied from the donors."""
    tree = copy.deepcopy(tree)
    for _ in range(draw_count(rng)):
        entries = list(_list_entries(tree))
        if not entries:
            return tree
        container, key = rng.choice(entries)
        mutation = rng.randrange(10)
        if mutation == 0:
            del container[key]
        elif mutation < 3:
            container[key] = copy.deepcopy(rng.choice(HOSTILE_VALUES))
        elif mutation < 6:
            container[key] = _mutate_value(rng, container[key])
        elif mutation == 6:
            other_container, other_key = rng.choice(entries)
            container[key] = (
                copy.deepcopy(other_container[other_key])
                if other_key in _list_keys(other_container)
                else None
            )
        elif mutation == 7:
            source = rng.choice(donors) if donors else tree
            other_container, other_key = rng.choice(
                list(_list_entries(source)) or [({"a": 1}, "a")]
            )
            if isinstance(container, dict):
                container[str(other_key)] = copy.deepcopy(other_container[other_key])
            else:
                container.insert(key, copy.deepcopy(other_container[other_key]))
        elif mutation == 8:
            container[key] = rng.choice(
                ([container[key]], {"value": container[key]}, [container[key]] * 3)
            )
        elif isinstance(container, dict):
            container[_mutate_key(rng, str(key))] = container.pop(key)
        else:
            container.append(copy.deepcopy(container[key]))
        if rng.random() < 0.003:
            container, key = rng.choice(list(_list_entries(tree)) or [([0], 0)])
            for _ in range(rng.choice((20, 90))):
                container[key] = rng.choice(([container[key]], {"a": container[key]}))
    return tree


#: Keys of sizes: rates, durations and counts.
_SIZE_KEYS = (
    *("rate", "duration", "revolutions", "sampling_rate", "start", "stop", "harmonic", "per"),
    *("total_time", "highest_rate", "lowest_rate", "longest_run", "settling", "rates"),
    *("fewest_revolutions", "fewest_rates", "runs", "readings", "positions", "time", "trials"),
)
#: Extreme values; large feasible sizes are excluded, because they take up to a minute.
_EXTREMES = ("1e-300", "1e-30", "1e-12", "1e-9", "1e9", "1e12", "1e15", "1e30", "1e300")


def mutate_sizes(rng: Random, tree: Any) -> Any:
    """Return a tree with one or two sizes replaced by extreme values."""
    tree = copy.deepcopy(tree)
    entries = [
        (holder, key)
        for holder, key in _list_entries(tree)
        if (key in _SIZE_KEYS or rng.random() < 0.05) and isinstance(holder[key], str | int | float)
    ]
    for container, key in rng.sample(entries, min(len(entries), rng.choice((1, 1, 1, 2)))):
        extreme = rng.choice(_EXTREMES)
        if isinstance(container[key], str):
            container[key] = _NUMBER_PATTERN.sub(extreme, container[key], count=1)
        else:
            value = float(extreme)
            is_integer = isinstance(container[key], int) and 1.0 <= value < 1e20
            container[key] = int(value) if is_integer else value
    return tree


def _list_entries(tree: Any) -> Any:
    pending = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, dict | list):
            for key in _list_keys(node):
                yield node, key
                pending.append(node[key])


def _list_keys(node: Any) -> Any:
    return list(node) if isinstance(node, dict) else range(len(node))


def _mutate_key(rng: Random, key: str) -> str:
    return rng.choice(
        (key + "s", key.upper(), key[:-1], "", "a.b", key * 2, "\x1b[1m", "x" * 300, "x" * 100_000)
    )


def _mutate_value(rng: Random, value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return rng.choice((-value, value + 1, value - 1, value * 1000, float(value), str(value)))
    if isinstance(value, float):
        return value * rng.choice((-1.0, 0.0, 1e-6, 1e3, 1e9, 1e200, float("nan"), 1.0 + 1e-9))
    if isinstance(value, str):
        return mutate_text(rng, value) if rng.random() < 0.6 else _replace_number(rng, value)
    if isinstance(value, list):
        return rng.choice((value[::-1], value[:-1], value * 2, value[:1], value * 50))
    if isinstance(value, dict):
        keys = list(value)
        rng.shuffle(keys)
        return {key: value[key] for key in keys[: rng.randrange(len(keys) + 1)]}
    return rng.choice(HOSTILE_VALUES)


def write_json(rng: Random, tree: Any) -> str:
    """Return a tree as JSON; values such as NaN make it invalid."""
    return json.dumps(tree, default=str, ensure_ascii=rng.random() < 0.5)


def write_toml(tree: Any) -> str:
    """Return a tree as TOML with inline tables, so that any nesting is possible."""
    if not isinstance(tree, dict):
        return f"value = {_format_toml_value(tree)}\n"
    return "".join(
        f"{json.dumps(str(key))} = {_format_toml_value(value)}\n" for key, value in tree.items()
    )


def _format_toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=True).replace("\\/", "/").replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return (
            "{"
            + ", ".join(f"{json.dumps(str(k))} = {_format_toml_value(v)}" for k, v in value.items())
            + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(map(_format_toml_value, value)) + "]"
    return '""' if value is None else str(value)


# XML


def mutate_xml(rng: Random, document: etree._Element) -> bytes:
    """Return a document with elements deleted, copied, moved, renamed or changed."""
    root = copy.deepcopy(document)
    for _ in range(draw_count(rng)):
        elements = [e for e in root.iter() if isinstance(e.tag, str)]
        element = rng.choice(elements)
        parent = element.getparent()
        mutation = rng.randrange(8)
        if mutation == 0 and parent is not None:
            parent.remove(element)
        elif mutation == 1 and parent is not None:
            parent.insert(rng.randrange(len(parent) + 1), copy.deepcopy(element))
        elif mutation == 2 and parent is not None:
            new_parent = rng.choice(elements)
            if element not in new_parent.iterancestors() and new_parent is not element:
                new_parent.append(element)
        elif mutation == 3:
            element.text = _remove_control_characters(str(_mutate_value(rng, element.text or "1")))
        elif mutation == 4:
            element.text = _remove_control_characters(str(rng.choice(HOSTILE_VALUES)))
        elif mutation == 5:
            element.tag = rng.choice(elements).tag
        elif mutation == 6 and element.attrib:
            name = rng.choice(list(element.attrib))
            if rng.random() < 0.5:
                del element.attrib[name]
            else:
                element.set(name, _remove_control_characters(str(rng.choice(HOSTILE_VALUES))))
        else:
            element.text = _remove_control_characters(_replace_number(rng, element.text or "0"))
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8")


def _remove_control_characters(text: str) -> str:
    return re.sub(r"[^\t\n\x20-\ud7ff\ue000-\ufffd]", "", text)


# Tables

_CELLS = (
    *(
        "",
        " ",
        "nan",
        "NaN",
        "inf",
        "-inf",
        "1e400",
        "1e308",
        "-1e308",
        "1e-320",
        "0",
        "x",
        '"',
        '""',
    ),
    *("1,5", "1 000", "0x10", "1_0", "--1", "1e", "\0", "\x1b[31m", "#", "true", "2026-01-01", "١"),
    *("9" * 400, "9" * 20000, "=1+1", "1.0\r", '"1\n2"'),
)


def mutate_table(rng: Random, rows: list[list[str]]) -> bytes:
    """Return a mutated table as text: other cells, rows, columns, separators and encoding."""
    rows = [list(row) for row in rows]
    for _ in range(draw_count(rng)):
        if not rows:
            break
        index = rng.randrange(len(rows))
        row = rows[index]
        mutation = rng.randrange(12)
        if mutation < 3 and row:
            row[rng.randrange(len(row))] = rng.choice(_CELLS)
        elif mutation == 3 and row:
            cell_index = rng.randrange(len(row))
            row[cell_index] = (
                _draw_number(rng, row[cell_index])
                if _NUMBER_PATTERN.fullmatch(row[cell_index])
                else row[cell_index]
            )
        elif mutation == 4:
            del rows[index : index + rng.choice((1, 1, 5, 200))]
        elif mutation == 5:
            rows[index:index] = [list(row) for _ in range(rng.choice((1, 1, 20)))]
        elif mutation == 6:
            other_index = rng.randrange(len(rows))
            rows[index], rows[other_index] = rows[other_index], rows[index]
        elif mutation == 7 and row:
            row.insert(rng.randrange(len(row) + 1), rng.choice(_CELLS))
        elif mutation == 8 and row:
            del row[rng.randrange(len(row))]
        elif mutation == 9:
            column = rng.randrange(max(map(len, rows)) or 1)
            change: Callable[[str], str] = rng.choice(
                (
                    lambda _: "",
                    lambda _: "nan",
                    lambda c: c + "e3",
                    lambda c: "-" + c,
                    lambda _: "7",
                )
            )
            start = rng.choice((0, 1, index))
            for mutated_row in rows[start:]:
                if column < len(mutated_row):
                    mutated_row[column] = change(mutated_row[column])
        elif mutation == 10:
            rows.sort(key=lambda r: rng.random()) if rng.random() < 0.2 else rows[index:].reverse()
        else:
            rows.insert(index, [rng.choice(("# note", "", " ", '"', "#", "a,b,c,d,e,f,g"))])
    separator = rng.choice((",", ",", ",", ";", "\t", "|", " "))
    line_end = rng.choice(("\n", "\n", "\n", "\r\n", "\r", "\n\n"))
    text = line_end.join(separator.join(row) for row in rows) + rng.choice((line_end, line_end, ""))
    encoding = rng.choice(("utf-8",) * 6 + ("utf-8-sig", "utf-16", "latin-1"))
    content = text.encode(encoding, "replace")
    return mutate_bytes(rng, content) if rng.random() < 0.2 else content
