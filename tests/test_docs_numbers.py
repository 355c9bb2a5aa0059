"""Numbers in the sentences of the pages are those of the code.

A row has a part of a sentence, with ``{}`` in the place of each number, and what the code has
there. The numbers are read from the page, so that one which changes in one place alone is found,
and so is a sentence that has gone.
"""

import inspect
import math
import re
import tomllib
from importlib.resources import files
from pathlib import Path

import pytest
from prose import agrees_to_last_digit, find_numbers, read_text

import counterspin as cs
from counterspin import errors, workers
from counterspin.application import access_control
from counterspin.calibration import assembly, outcome
from counterspin.calibration.pages import pictures
from counterspin.campaign.field_types import parse_exact
from counterspin.certificates import certificate_text, signers
from counterspin.comparisons import rerun
from counterspin.histories import consistency, page
from counterspin.inference import diagnostics, distributions
from counterspin.inference.distributions import normal_cdf
from counterspin.monitoring import observer
from counterspin.physics import gravity, motion, terms
from counterspin.planning import design, faults, limits, plan_file
from counterspin.records import clock, reading, reduction, run_file, table_files
from counterspin.reproduction import plan as paper
from counterspin.simulation import simulable
from counterspin.studies import description, engine_selection, result, study

DOCS = Path(__file__).parents[1] / "docs"
ARCSEC = math.radians(1.0) / 3600.0
MOTION = terms.MOTION_TERMS
RESULT = cs.read_result(DOCS / "examples" / "three-rate" / "result.json")
DIGITS = len(RESULT.identifier.removeprefix("CS-"))
PLAN = tomllib.loads((files("counterspin.planning") / "starter.toml").read_text("utf-8"))
KNOWN = {
    symbol: float(re.search(r"± (\S+)", text)[1])
    for symbol, text in (PLAN["accelerometers"]["Qx"] | PLAN["model"]["priors"]).items()
    if "±" in text
}


def default_argument(function, name):
    """Return the default value of an argument."""
    return inspect.signature(function).parameters[name].default


ROWS = {
    "campaign": [
        ("/g$, for example {} for a gravity difference of {} m/s²", 1e-4 / 9.80665, 1e-4),
        ("at any height between {} and {} m", *gravity.HEIGHT_RANGE),
        (
            "latitude of {} deg, an accelerometer error of 1 mg changes the perpendicular "
            "displacement by {} m in {} s",
            45.0,
            round(motion.EARTH_RATE * math.sqrt(0.5) * 9.80665e-3 * 400.0**3 / 3.0),
            400.0,
        ),
        ("blocks of at most {} revolution", 1.0 / reduction.BLOCKS_PER_REVOLUTION),
        ("up to {} isolated rows at either end", reduction._MAX_ISOLATED_ROWS),
        ("a gap of at least one revolution and {} rows", reading._ISOLATION_STEPS),
        ("more than {} % empty cells", 100.0 * reading.MAX_EMPTY_FRACTION),
        ("fewer than {} revolutions -", run_file.MIN_REVOLUTIONS),
        ("a gap of more than {} revolutions", clock._MAX_GAP_REVOLUTIONS),
        ("more than {} revolutions, unless", run_file.MAX_REVOLUTIONS),
        (
            "unless the record has {} rows for each",
            1.0 / run_file.EXTRA_REVOLUTIONS_PER_ROW,
        ),
        (
            "a record that is shorter than {} % of this duration",
            100.0 * assembly.MIN_DURATION_FRACTION,
        ),
        ("the Allan deviation is {} B", math.sqrt(2.0 * math.log(2.0) / math.pi)),
        ("exceeds {} times the largest credible size", simulable.MAX_TRUTH_RATIO),
        ("a ripple above harmonic {} -", simulable._MAX_RIPPLE_HARMONIC),
        ("a rate that changes by {} ", simulable._MAX_RATE_CHANGE),
    ],
    "plan": [
        ("highest / {} |", 1.0 / plan_file._MIN_RATE_FRACTION),
        ("each at least {} times the next", design._DISTINCT_RATE_RATIO),
        ("{} µg for K_F", 1e6 * KNOWN["bias"]),
        ("{} arcsec for the tilt of each run", KNOWN["platform.tilt"]),
        ("{} deg/h for the gyro drift", KNOWN["platform.drift"]),
        (
            "{} deg/h/g for the g-sensitivity of the azimuth gyro",
            KNOWN["platform.g_sensitivity.zx"],
        ),
        ("allows a settling time of {} s", float(PLAN["limits"]["settling"].split()[0])),
        ("for each of at most {} runs", PLAN["limits"]["runs"]),
        ("on K_II by a factor of {}", 2.0**4),
        ("higher harmonics ({} arcsec)", MOTION["encoder.harmonic.3.cos"].typical / ARCSEC),
        ("imbalance ({} µm)", 1e6 * MOTION["centrifuge.imbalance.1.cos"].typical),
        ("stretch of the arm ({} per m/s²)", MOTION["centrifuge.stretch"].typical),
        (
            "square of the specific force ({} µg/g²)",
            1e6 * terms.CONDITION_TERMS["K_F.heating"].typical,
        ),
        ("gain from relaxing a limit by {} %", 100.0 * limits.RELAXATION_FRACTION),
        (
            "alone would increase u by {} %. If",
            100.0 * (math.hypot(1.0, faults._TOLERABLE_FRACTION_OF_U) - 1.0),
        ),
    ],
    "study": [
        ("compares {} analyses", len(description._DEFAULT_ANALYSES)),
        (
            "coverage of the {}, {} and {} % intervals",
            *(100.0 * p for p in result.CONFIDENCE_LEVELS),
        ),
        (
            "intervals is between {} and {} %",
            *(100.0 * p for p in result._ACCEPTED_COVERAGE),
        ),
        ("its bias does not exceed {} of the stated u", result._MAX_BIAS_RATIO),
        (
            "mean true values and at {} random draws of these values",
            engine_selection._N_COMPARED_TRIALS,
        ),
        ("an estimate differs by more than {} u", engine_selection._MAX_ESTIMATE_DIFFERENCE),
        ("or u by more than {} %, the study", 100.0 * engine_selection._MAX_U_DIFFERENCE),
        ("by a factor of {} to 1.", math.sqrt(0.5)),
        ("a study that will take {} s or more", study._WARNING_DURATION),
        ("at most {} for each processor core", workers._PROCESSES_PER_CORE),
        ("waits up to {} minutes for the first worker", workers._FIRST_WORKER_TIMEOUT / 60.0),
    ],
    "history": [
        ("the expanded uncertainty ({} %) of the change", 100.0 * distributions.COVERAGE),
        ("per year of {} days", page._DAYS_PER_YEAR),
        ("requires {} or more results. Its limits", consistency.MIN_RESULTS),
        ("moving range divided by {}. The warning", consistency._D2),
        (
            "warning limits are {} standard deviations and the action limits {} standard "
            "deviations",
            consistency.WARNING_SIGMAS,
            consistency.ACTION_SIGMAS,
        ),
        ("by more than {} mean moving ranges", 1.0 + 3.0 * consistency._D3 / consistency._D2),
        ("limits at z = ± {}", page._ACTION_Z),
        ("(`--reliability`, default {})", default_argument(cs.history, "reliability")),
        ("The date must be no more than {} years after the last result", consistency.MAX_YEARS),
        ("a significance level of {} %", 100.0 * diagnostics.SIGNIFICANCE),
        ("neglects correlations below {}.", consistency._NEGLIGIBLE_CORRELATION),
    ],
    "certificate": [
        ("`CS-` and {} digits of the SHA-256", DIGITS),
        ("k comes from Student's t distribution for {} %", 100.0 * distributions.COVERAGE),
        ("smallest expanded uncertainty ({} %)", 100.0 * distributions.COVERAGE),
        ("ellipsoidal {} % coverage region", 100.0 * distributions.COVERAGE),
        ("rounds k to {} decimal places", certificate_text._FACTOR_DECIMALS),
        (
            "minimum key length is {} bits for RSA and {} bits for elliptic curves.",
            signers._MIN_RSA_BITS,
            signers._MIN_CURVE_BITS,
        ),
    ],
    "compare": [("two results agree to within {}", rerun.RELATIVE_TOLERANCE)],
    "monitoring": [
        ("from the nominal rate by more than {} %", 100.0 * assembly.MAX_RATE_DEVIATION),
        ("shorter than {} of the stated duration", assembly.MIN_DURATION_FRACTION),
        (
            "More than {} % of the samples in the record are outliers",
            100.0 * outcome.MAX_OUTLIER_SHARE,
        ),
        ("a run of fewer than {} revolutions", observer.MIN_REVOLUTIONS),
        (
            "{} bytes each: {} columns at {} rows per second take {} MB per hour",
            8,
            4,
            1e3,
            round(8 * 4 * 1e3 * 3600.0 / 1e6),
        ),
        ("limits the fits to {} % of a core", 100.0 * cs.Pace().share),
    ],
    "application": [
        (
            "{} MB for a form and {} GB for an uploaded record",
            access_control.FORM_MAX_BYTES / 1e6,
            access_control.FILE_MAX_BYTES / 1e9,
        ),
    ],
    "harmful-files": [
        (
            "unpack to more than {} MB and to more than {} times their file size",
            table_files._UNPACKED_BYTES / 1e6,
            table_files._UNPACKED_PER_BYTE,
        ),
        ("repeats at most {} characters of a value", errors._MAX_VALUE_LENGTH),
    ],
    "reports": [
        (
            "contain {} % of the values expected for white noise",
            round(100.0 * (2.0 * normal_cdf(pictures._COVERAGE_FACTOR) - 1.0)),
        ),
        ("`CS-` and {} digits of the result's SHA-256 checksum", DIGITS),
    ],
}


@pytest.mark.parametrize(
    ("name", "row"),
    [(name, row) for name, rows in ROWS.items() for row in rows],
    ids=lambda part: part[0] if isinstance(part, tuple) else part,
)
def test_number_in_page_matches_code(name, row):
    sentence, *values = row
    for shown, value in zip(find_numbers(name, sentence), values, strict=True):
        assert agrees_to_last_digit(shown, value), (shown, value)


def test_plan_example_has_time_radius_and_rate_of_paper():
    limits = PLAN["limits"]
    assert "uses the paper's total time, radius and highest rate" in read_text("plan")
    time = paper.N_STROBES * sum(2.0 * math.pi / rate for rate in paper.RATES)
    assert parse_exact(limits["total_time"], "s") == pytest.approx(time)
    assert parse_exact(limits["highest_rate"], "rad/s") == pytest.approx(max(paper.RATES))
    assert parse_exact(PLAN["centrifuge"]["radius"], "m") == paper.RADIUS
