"""Numbers in sentences of the documentation."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]

_NUMBER_WORDS = {
    word: float(size)
    for size, word in enumerate(
        ["zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"]
    )
} | {"eleven": 11.0, "twelve": 12.0, "sixteen": 16.0, "twenty": 20.0, "fifty": 50.0}
_NUMBER_WORDS |= {"twice": 2.0, "fourth": 4.0, "hundred": 100.0, "thousand": 1000.0}
_NUMBER_WORDS |= {
    "half": 0.5,
    "nine tenths": 0.9,
    "a fifth": 0.2,
    "a tenth": 0.1,
    "a twentieth": 0.05,
}

_NUMBER = "|".join(
    [*sorted(_NUMBER_WORDS, key=len, reverse=True), r"-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?(?:/\d+)?"]
)


def read_text(page: str) -> str:
    """Return the text of `README` or a page of docs/, with line breaks as spaces.

    A power of ten in a formula is written as 1e-3 is.
    """
    path = ROOT / "README.md" if page == "README" else ROOT / "docs" / f"{page}.md"
    text = re.sub(r"\\times10\^\{(-?\d+)\}", r"e\1", path.read_text(encoding="utf-8"))
    return " ".join(text.split())


def find_numbers(page: str, sentence: str) -> list[str]:
    """Return the numbers in place of ``{}`` in a part of a sentence."""
    pattern = f"({_NUMBER})".join(map(re.escape, sentence.split("{}")))
    matches = list(re.finditer(pattern, read_text(page)))
    assert len(matches) == 1, f"{page}.md has it {len(matches)} times: {sentence}"
    return list(matches[0].groups())


def parse_number(number: str) -> float:
    """Return the value of a number as it is written."""
    numerator, _, denominator = number.replace(",", "").partition("/")
    return (
        _NUMBER_WORDS[number]
        if number in _NUMBER_WORDS
        else float(numerator) / float(denominator or 1.0)
    )


def agrees_to_last_digit(number: str, computed: float) -> bool:
    """Return whether a number equals the computed value to its last digit.

    Words, fractions and whole numbers are exact; none is off by more than an eighth.
    """
    mantissa, _, power = number.partition("e")
    tolerance = 1e-9
    if number not in _NUMBER_WORDS and "/" not in number and (power or "." in number):
        tolerance = 0.501 * 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    difference = abs(parse_number(number) - computed)
    return difference <= max(min(tolerance, 0.125 * abs(computed)), 1e-12 * abs(computed))
