"""Mutations: small changes of bytes, text, trees and tables, some of them hostile.

Everything is drawn from the `random.Random` that is given, so that a case is known by its seed.

- `mutate_bytes`, `mutate_text`: without regard to what it means
- `mutate_tree`: dicts, lists and values, as TOML and JSON have them
- `mutate_sizes`: lengths, rates and numbers of things in such a tree, beyond all bounds
- `mutate_xml`: elements
- `mutate_table`: rows of cells
- `write_toml`: any tree as TOML, right or wrong
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

#: Values that programs stumble over.
HOSTILE: list[Any] = [
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

#: Pieces of text that parsers care for.
TOKENS = [
    *("[", "]", "[[", "]]", "{", "}", "=", '"', "'", '"""', "'''", ",", ".", "#", "\n", "\r", "\t"),
    *("\0", "\ufeff", "\u2028", "\u202e", "\x1b[31m", "±", "+/-", "−", "e", "E", "+", "-", "_"),
    *("0x", "1e999", "nan", "inf", "true", "null", "\\", "\\u0000", "\\ud800", ";", "&", "<", ">"),
    *("<!--", "]]>", "&lt;", "&a;", "%", "^", "/", "*", "(", ")", "99999999999999999999"),
]

#: Bytes that formats count with.
_INTERESTING = (0x00, 0x01, 0x7F, 0x80, 0xFE, 0xFF, 0x20, 0x2C, 0x0A)


def draw_count(rng: Random, most: int = 8) -> int:
    """Return how many mutations are made: mostly one or two."""
    count = 1
    while count < most and rng.random() < 0.45:
        count += 1
    return count


# Bytes and text


def mutate_bytes(rng: Random, content: bytes, near: tuple[int, int] | None = None) -> bytes:
    """Return bytes with a few flips, cuts, copies and foreign numbers, between two places."""
    data = bytearray(content)
    for _ in range(draw_count(rng)):
        if not data:
            return bytes(rng.randbytes(rng.randrange(40)))
        low, high = near or (0, len(data))
        low, high = min(low, len(data) - 1), max(min(high, len(data)), 1)
        place = rng.randrange(low, max(high, low + 1))
        kind = rng.randrange(10)
        if kind < 3:
            data[place] ^= 1 << rng.randrange(8)
        elif kind < 4:
            data[place] = rng.choice(_INTERESTING)
        elif kind < 6:
            width = rng.choice((2, 4, 8))
            value = rng.choice((0, 1, 2**7, 2**15 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, -1))
            value = value + rng.randrange(-2, 3) if rng.random() < 0.5 else value
            order = rng.choice(("little", "big"))
            data[place : place + width] = (value % 2 ** (8 * width)).to_bytes(width, order)
        elif kind == 6:
            del data[place : place + rng.choice((1, 2, 4, 8, 100, 10**6))]
        elif kind == 7:
            length = rng.choice((1, 4, 16, 256, 4096))
            data[place:place] = data[rng.randrange(len(data)) :][:length]
        elif kind == 8:
            length = rng.choice((4, 16, 256))
            data[place : place + length] = rng.randbytes(length)
        else:
            length = rng.choice((4, 64, 1024))
            data[place : place + length] = bytes(length)
    return bytes(data)


def mutate_text(rng: Random, text: str) -> str:
    """Return text with tokens, lines and characters put in, taken out and exchanged."""
    for _ in range(draw_count(rng)):
        lines = text.split("\n")
        place = rng.randrange(len(text) + 1)
        line = rng.randrange(len(lines))
        kind = rng.randrange(9)
        if kind == 0:
            del lines[line]
            text = "\n".join(lines)
        elif kind == 1:
            lines.insert(rng.randrange(len(lines) + 1), lines[line])
            text = "\n".join(lines)
        elif kind == 2:
            other = rng.randrange(len(lines))
            lines[line], lines[other] = lines[other], lines[line]
            text = "\n".join(lines)
        elif kind == 3:
            text = text[:place] + rng.choice(TOKENS) + text[place:]
        elif kind == 4:
            text = text[:place] + text[place + rng.choice((1, 1, 2, 5, 50)) :]
        elif kind == 5:
            count = rng.choice((2, 200, 20000))
            pair = rng.choice(("[]", "{}", "()", '[""]', "  ", *(2 * token for token in TOKENS)))
            half = len(pair) // 2
            text = text[:place] + pair[:half] * count + pair[half:] * count + text[place:]
        elif kind == 6:
            text = _with_other_number(rng, text)
        elif kind == 7:
            text = (
                text[:place]
                + chr(rng.choice((rng.randrange(1, 128), rng.randrange(0x2100))))
                + text[place + 1 :]
            )
        else:
            end = min(len(text), place + rng.randrange(1, 200))
            text = text[:place] + text[rng.randrange(len(text) + 1) :][: end - place] + text[end:]
    return text


_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
_NUMBERS = ("0", "-1", "1e400", "1e-400", "nan", "9" * 30, "1e308", "1e-308", "-0.0", "1e16", "0.1")


def _with_other_number(rng: Random, text: str) -> str:
    found = list(_NUMBER.finditer(text))
    if not found:
        return text
    one = rng.choice(found)
    return text[: one.start()] + _number(rng, one[0]) + text[one.end() :]


def _number(rng: Random, old: str) -> str:
    if rng.random() < 0.5:
        return rng.choice(_NUMBERS)
    try:
        return repr(float(old) * rng.choice((-1.0, 10.0, 1e-3, 1e3, 1e6, 1e12, 1.001, 0.0)))
    except OverflowError:
        return "1"


# Trees


def mutate_tree(rng: Random, tree: Any, others: list[Any]) -> Any:
    """Return a tree with values exchanged, moved, taken out or nested; parts of others come in."""
    tree = copy.deepcopy(tree)
    for _ in range(draw_count(rng)):
        places = list(_places(tree))
        if not places:
            return tree
        holder, key = rng.choice(places)
        kind = rng.randrange(10)
        if kind == 0:
            del holder[key]
        elif kind < 3:
            holder[key] = copy.deepcopy(rng.choice(HOSTILE))
        elif kind < 6:
            holder[key] = _other_value(rng, holder[key])
        elif kind == 6:
            other, there = rng.choice(places)
            holder[key] = copy.deepcopy(other[there]) if there in _keys(other) else None
        elif kind == 7:
            source = rng.choice(others) if others else tree
            other, there = rng.choice(list(_places(source)) or [({"a": 1}, "a")])
            if isinstance(holder, dict):
                holder[str(there)] = copy.deepcopy(other[there])
            else:
                holder.insert(key, copy.deepcopy(other[there]))
        elif kind == 8:
            holder[key] = rng.choice(([holder[key]], {"value": holder[key]}, [holder[key]] * 3))
        elif isinstance(holder, dict):
            holder[_other_key(rng, str(key))] = holder.pop(key)
        else:
            holder.append(copy.deepcopy(holder[key]))
        if rng.random() < 0.003:
            holder, key = rng.choice(list(_places(tree)) or [([0], 0)])
            for _ in range(rng.choice((20, 90))):
                holder[key] = rng.choice(([holder[key]], {"a": holder[key]}))
    return tree


#: Keys whose values say how much there is of something.
_SIZES = (
    *("rate", "duration", "revolutions", "sampling_rate", "start", "stop", "harmonic", "per"),
    *("total_time", "highest_rate", "lowest_rate", "longest_run", "settling", "rates"),
    *("fewest_revolutions", "fewest_rates", "runs", "readings", "positions", "time", "trials"),
)
#: Nothing near to what can just be done: that takes up to a minute.
_EXTREMES = ("1e-300", "1e-30", "1e-12", "1e-9", "1e9", "1e12", "1e15", "1e30", "1e300")


def mutate_sizes(rng: Random, tree: Any) -> Any:
    """Return a tree in which one or two sizes are beyond all bounds, or far below."""
    tree = copy.deepcopy(tree)
    places = [
        (holder, key)
        for holder, key in _places(tree)
        if (key in _SIZES or rng.random() < 0.05) and isinstance(holder[key], str | int | float)
    ]
    for holder, key in rng.sample(places, min(len(places), rng.choice((1, 1, 1, 2)))):
        extreme = rng.choice(_EXTREMES)
        if isinstance(holder[key], str):
            holder[key] = _NUMBER.sub(extreme, holder[key], count=1)
        else:
            value = float(extreme)
            whole = isinstance(holder[key], int) and 1.0 <= value < 1e20
            holder[key] = int(value) if whole else value
    return tree


def _places(tree: Any) -> Any:
    stack = [tree]
    while stack:
        node = stack.pop()
        if isinstance(node, dict | list):
            for key in _keys(node):
                yield node, key
                stack.append(node[key])


def _keys(node: Any) -> Any:
    return list(node) if isinstance(node, dict) else range(len(node))


def _other_key(rng: Random, key: str) -> str:
    return rng.choice(
        (key + "s", key.upper(), key[:-1], "", "a.b", key * 2, "\x1b[1m", "x" * 300, "x" * 100_000)
    )


def _other_value(rng: Random, value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return rng.choice((-value, value + 1, value - 1, value * 1000, float(value), str(value)))
    if isinstance(value, float):
        return value * rng.choice((-1.0, 0.0, 1e-6, 1e3, 1e9, 1e200, float("nan"), 1.0 + 1e-9))
    if isinstance(value, str):
        return mutate_text(rng, value) if rng.random() < 0.6 else _with_other_number(rng, value)
    if isinstance(value, list):
        return rng.choice((value[::-1], value[:-1], value * 2, value[:1], value * 50))
    if isinstance(value, dict):
        keys = list(value)
        rng.shuffle(keys)
        return {key: value[key] for key in keys[: rng.randrange(len(keys) + 1)]}
    return rng.choice(HOSTILE)


def write_json(rng: Random, tree: Any) -> str:
    """Return a tree as JSON, or nearly."""
    return json.dumps(tree, default=str, ensure_ascii=rng.random() < 0.5)


def write_toml(tree: Any) -> str:
    """Return a tree as TOML: all tables in line, so that anything may stand anywhere."""
    if not isinstance(tree, dict):
        return f"value = {_toml(tree)}\n"
    return "".join(f"{json.dumps(str(key))} = {_toml(value)}\n" for key, value in tree.items())


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=True).replace("\\/", "/").replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(k))} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return '""' if value is None else str(value)


# XML


def mutate_xml(rng: Random, whole: etree._Element) -> bytes:
    """Return a document with elements taken out, copied, moved, renamed, or with other contents."""
    root = copy.deepcopy(whole)
    for _ in range(draw_count(rng)):
        elements = [e for e in root.iter() if isinstance(e.tag, str)]
        one = rng.choice(elements)
        parent = one.getparent()
        kind = rng.randrange(8)
        if kind == 0 and parent is not None:
            parent.remove(one)
        elif kind == 1 and parent is not None:
            parent.insert(rng.randrange(len(parent) + 1), copy.deepcopy(one))
        elif kind == 2 and parent is not None:
            to = rng.choice(elements)
            if one not in to.iterancestors() and to is not one:
                to.append(one)
        elif kind == 3:
            one.text = _plain(str(_other_value(rng, one.text or "1")))
        elif kind == 4:
            one.text = _plain(str(rng.choice(HOSTILE)))
        elif kind == 5:
            one.tag = rng.choice(elements).tag
        elif kind == 6 and one.attrib:
            name = rng.choice(list(one.attrib))
            if rng.random() < 0.5:
                del one.attrib[name]
            else:
                one.set(name, _plain(str(rng.choice(HOSTILE))))
        else:
            one.text = _plain(_with_other_number(rng, one.text or "0"))
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8")


def _plain(text: str) -> str:
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
    """Return a table of cells as text, with cells, rows, columns and its form changed."""
    rows = [list(row) for row in rows]
    for _ in range(draw_count(rng)):
        if not rows:
            break
        at = rng.randrange(len(rows))
        row = rows[at]
        kind = rng.randrange(12)
        if kind < 3 and row:
            row[rng.randrange(len(row))] = rng.choice(_CELLS)
        elif kind == 3 and row:
            place = rng.randrange(len(row))
            row[place] = _number(rng, row[place]) if _NUMBER.fullmatch(row[place]) else row[place]
        elif kind == 4:
            del rows[at : at + rng.choice((1, 1, 5, 200))]
        elif kind == 5:
            rows[at:at] = [list(row) for _ in range(rng.choice((1, 1, 20)))]
        elif kind == 6:
            other = rng.randrange(len(rows))
            rows[at], rows[other] = rows[other], rows[at]
        elif kind == 7 and row:
            row.insert(rng.randrange(len(row) + 1), rng.choice(_CELLS))
        elif kind == 8 and row:
            del row[rng.randrange(len(row))]
        elif kind == 9:
            column = rng.randrange(max(map(len, rows)) or 1)
            scale: Callable[[str], str] = rng.choice(
                (
                    lambda _: "",
                    lambda _: "nan",
                    lambda c: c + "e3",
                    lambda c: "-" + c,
                    lambda _: "7",
                )
            )
            begin = rng.choice((0, 1, at))
            for each in rows[begin:]:
                if column < len(each):
                    each[column] = scale(each[column])
        elif kind == 10:
            rows.sort(key=lambda r: rng.random()) if rng.random() < 0.2 else rows[at:].reverse()
        else:
            rows.insert(at, [rng.choice(("# note", "", " ", '"', "#", "a,b,c,d,e,f,g"))])
    separator = rng.choice((",", ",", ",", ";", "\t", "|", " "))
    end = rng.choice(("\n", "\n", "\n", "\r\n", "\r", "\n\n"))
    text = end.join(separator.join(row) for row in rows) + rng.choice((end, end, ""))
    encoding = rng.choice(("utf-8",) * 6 + ("utf-8-sig", "utf-16", "latin-1"))
    content = text.encode(encoding, "replace")
    return mutate_bytes(rng, content) if rng.random() < 0.2 else content
