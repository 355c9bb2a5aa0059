"""Numbers in the sentences of the pages are those of the code.

A row has a part of a sentence, with ``{}`` in the place of each number, and what the code has there.
The numbers are read from the page, so that one which changes here or there alone is found, and so is
a sentence that has gone.
"""

import inspect
import math
import re
from pathlib import Path

import pytest

import counterspin as cs
from counterspin import errors, workers
from counterspin.application import guard
from counterspin.calibration import assembly
from counterspin.calibration.pages import full_report
from counterspin.campaign import truth
from counterspin.certificates import build, coverage, signature
from counterspin.comparisons import rerun
from counterspin.histories import control, due, page, shared
from counterspin.inference import conformity, diagnostics
from counterspin.monitoring import observing
from counterspin.physics import gravity, motion, shared_terms
from counterspin.planning import design, plan_file, requirements
from counterspin.records import clock, excel_file, reading, reduction
from counterspin.studies import result, study, surrogate, tally

DOCS = Path(__file__).parents[1] / "docs"
ARCSEC = math.radians(1.0) / 3600.0


def default(function, name):
    """Return what an argument is by default."""
    return inspect.signature(function).parameters[name].default


ROWS = {
    "campaign": [
        ("/g$, {} for {} m/s²", 1e-4 / 9.80665, 1e-4),
        ("no height from {} to {} m has", *gravity.HEIGHTS),
        (
            "latitude of {} deg, 1 mg moves the displacement at right angles to it by {} m in {} s",
            45.0,
            round(motion.EARTH_RATE * math.sqrt(0.5) * 9.80665e-3 * 400.0**3 / 3.0),
            400.0,
        ),
        ("blocks of at most {} revolution", 1.0 / reduction.BLOCKS_PER_REVOLUTION),
        ("Up to {} rows that stand alone", reduction._LONE_ROWS),
        ("a gap of a revolution and of {} rows", reading._LONE_STEPS),
        ("more than {} % empty cells", 100.0 * reading.MOST_EMPTY),
        ("less than {} revolutions, a clock", reading.FEWEST_REVOLUTIONS),
        ("a gap of more than {} revolutions", clock._GAP_REVOLUTIONS),
        ("more than {} revolutions unless", reading.ANY_REVOLUTIONS),
        ("unless there are {} rows for each", 1.0 / reading.FURTHER_REVOLUTIONS_A_ROW),
        ("a record shorter than {} of that", assembly.COMPLETE_PART),
        ("the Allan deviation is {} B", math.sqrt(2.0 * math.log(2.0) / math.pi)),
        ("more than {} times the largest credible size", truth._TRUTH_MARGIN),
        ("a ripple above harmonic {},", truth._MAX_RIPPLE_HARMONIC),
        ("a rate that changes by {}.", truth._MAX_RATE_CHANGE),
    ],
    "plan": [
        ("highest / {} |", 1.0 / plan_file._LOWEST),
        ("each at least {} times the next", design._DIFFERENT),
        ("higher harmonics ({} arcsec)", shared_terms.MOTION_TERMS["encoder.harmonic.3.cos"].typical / ARCSEC),
    ],
}

WORDS = "one two three four five six seven eight nine ten eleven twelve".split()
SPELT = {word: float(value) for value, word in enumerate(WORDS, 1)}
SPELT |= {"half": 0.5, "nine tenths": 0.9}
NUMBER = "|".join([*sorted(SPELT, key=len, reverse=True), r"-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?(?:/\d+)?"])


def value_of(text):
    above, _, below = text.replace(",", "").partition("/")
    return SPELT[text] if text in SPELT else float(above) / float(below or 1.0)


def rounding_of(text):
    """Return half a unit of the last digit; words, fractions and whole numbers are exact."""
    mantissa, _, power = text.partition("e")
    if text in SPELT or "/" in text or not (power or "." in text):
        return 1e-9
    return 0.501 * 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))


@pytest.mark.parametrize(
    ("name", "row"), [(name, row) for name, rows in ROWS.items() for row in rows], ids=lambda part: part[0] if isinstance(part, tuple) else part,
)
def test_number(name, row):
    sentence, *values = row
    text = " ".join((DOCS / f"{name}.md").read_text("utf-8").split())
    pattern = f"({NUMBER})".join(map(re.escape, sentence.split("{}")))
    (found,) = re.finditer(pattern, text)
    for shown, value in zip(found.groups(), values, strict=True):
        assert value_of(shown) == pytest.approx(value, rel=1e-12, abs=rounding_of(shown)), shown
