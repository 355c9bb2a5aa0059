"""Numbers in the sentences of the pages: read where they stand, compared with code and results."""

import csv
import json
import math
import re
import runpy
import tomllib
from importlib.resources import files

import numpy as np
import pytest
from campaigns import WITHOUT_QY
from prose import ROOT, agrees_to_last_digit, find_numbers, parse_number, read_text
from scipy.special import stdtrit

import counterspin as cs
from counterspin.calibration import assembly, findings, outcome
from counterspin.calibration.checks import limits, small_angles
from counterspin.calibration.diagnosis import ranking, search
from counterspin.calibration.two_stage import findings as two_stage_findings
from counterspin.campaign import conditions, runs
from counterspin.certificates import build
from counterspin.comparisons import rerun
from counterspin.inference import (
    conformity,
    diagnostics,
    distributions,
    identifiability,
)
from counterspin.inference.distributions import normal_cdf
from counterspin.inference.joint import design_blocks, encoder, mistakes, outlier_rejection
from counterspin.inference.noise import bias_instability, undetected_walk
from counterspin.inference.noise import search as noise_search
from counterspin.physics import angle_error
from counterspin.physics.accelerometer import QX
from counterspin.physics.closed_forms import parabola
from counterspin.physics.motion import EARTH_RATE
from counterspin.physics.observation import columns
from counterspin.physics.terms import CONDITION_TERMS, DEGREE_PER_HOUR, INPUTS, SHARED_TERMS, TERMS
from counterspin.readings import fitted, patterns
from counterspin.readings.entries import MAX_READINGS, MAX_RECORDS
from counterspin.records import column_file, outliers, reduction
from counterspin.reproduction import plan as paper
from counterspin.studies.result import MIN_TRIALS
from counterspin.validation.cases import cases
from counterspin.validation.validate import check_case
from stored_table import DEFAULT_RATES

ARCSEC = math.radians(1.0 / 3600.0)
ENCODER = SHARED_TERMS["encoder.harmonic.1.sin"].typical
ALARMS = 100.0 * diagnostics.FALSE_ALARM_RATE
CAUSES = 100.0 * ranking.FALSE_ALARM_RATE
PLAN = (2.5, 9.8)  #: radius and gravity of the paper's plan


def load_results(file):
    return json.loads((ROOT / file).read_text(encoding="utf-8"))


# What the code decides by, and what follows from formulas -----------------------------------------

#: Page, words of it with {} for the numbers, and these numbers by the code.
NUMBERS = [
    ("README", "report agreement to within {} or", [rerun.RELATIVE_TOLERANCE]),
    (
        "README",
        "{} m after 100 s at one revolution a second, and {} m after 400 s at a quarter of that",
        [
            round(paper.TABLE_1["K_II"] * parabola("K_II", QX, rate, *PLAN) * time**2)
            for rate, time in ((2.0 * math.pi, 100.0), (0.5 * math.pi, 400.0))
        ],
    ),
    *(
        (page, words, [runs.MAX_COMPUTED_ROWS])
        for page, words in (
            ("harmful-files", "are limited to a total of {} rows"),
            ("plan", "a checked campaign may have at most {} rows in total"),
            ("study", "over all runs and accelerometers, is limited to {};"),
        )
    ),
    ("harmful-files", "each run may have at most {} samples.", [runs.MAX_SIMULATED_ROWS]),
    (
        "harmful-files",
        "has at most {} records, one for each run and accelerometer, "
        "and a campaign has at most {} readings.",
        [MAX_RECORDS, MAX_READINGS],
    ),
    ("study", "A verdict requires at least {} trials", [MIN_TRIALS]),
    ("methods", "blocks of at most {} revolution.", [1 / reduction.BLOCKS_PER_REVOLUTION]),
    (
        "methods",
        "of the rms is ±1.96/(4 trials)^½, which is ±{} for 200 trials",
        [1.96 / math.sqrt(800)],
    ),
    ("methods", "of ripple harmonics {} to {}, whether", [1, angle_error.N_UNCERTAIN_HARMONICS]),
    ("methods", "| above {} | an unknown", [encoder._ESTIMATED_NORM_SQUARED]),
    (
        "methods",
        "| {} to {} | held |",
        [encoder._CONSIDERED_NORM_SQUARED, encoder._ESTIMATED_NORM_SQUARED],
    ),
    ("methods", "| below {} | omitted", [encoder._CONSIDERED_NORM_SQUARED]),
    (
        "methods",
        "from zero by more than {} default standard uncertainties, counterspin",
        [limits._MAX_DEFAULT_SDS],
    ),
    ("result", "more than {} default standard uncertainties", [limits._MAX_DEFAULT_SDS]),
    ("methods", "exceeds {} of the noise of one row", [design_blocks._MIN_SINGULAR_VALUE]),
    (
        "methods",
        "With the default of {} ug/g^2 for K_OO of a navigation-grade accelerometer",
        [1e6 * TERMS["K_OO"].typical],
    ),
    ("methods", "its stated uncertainty, or with the default of {} arcsec", [ENCODER / ARCSEC]),
    ("trust", "with a default of {} arcsec each", [ENCODER / ARCSEC]),
    (
        "campaign",
        "assumes a relative rate error of 0 ± {}",
        [INPUTS["records.clock"].typical],
    ),
    (
        "physics",
        "free-running quartz oscillator is typically {} ppm",
        [1e6 * INPUTS["records.clock"].typical],
    ),
    ("physics", "changes the estimate of K_I by {} ppm", [2e6 * INPUTS["records.clock"].typical]),
    ("methods", "twice the log-likelihood by at least {}. If", [noise_search.MIN_LIKELIHOOD_GAIN]),
    (
        "methods",
        "by chance in one of {} cases. The",
        [1 / normal_cdf(-math.sqrt(noise_search.MIN_LIKELIHOOD_GAIN))],
    ),
    ("methods", "likelihood times N^(-{})", [undetected_walk.PRIOR_EXPONENT]),
    ("methods", "a sum of up to {} cosines", [bias_instability._BASIS_SIZE_RANGE[1]]),
    (
        "methods",
        "the other noise is a {} times as large",
        [1 / bias_instability._MIN_RELATIVE_DENSITY],
    ),
    (
        "methods",
        "flicker noise at frequencies above {} half-cycles",
        [bias_instability._BASIS_SIZE_RANGE[1]],
    ),
    ("methods", "false alarm in one of {} good", [1 / diagnostics.SIGNIFICANCE]),
    (
        "methods",
        "reduce the variance of the coefficient's prior by at least {}.",
        [1 - identifiability.MAX_VARIANCE_RATIO],
    ),
    ("methods", "deviate from their neighbours by more than {} standard", [outliers.LIMIT_SDS]),
    (
        "methods",
        "in at most one of a {} complete records",
        [1 / outlier_rejection.EXPECTED_FALSE_ALARMS],
    ),
    ("methods", "the residuals are more than {} the stated noise", [findings.RESIDUAL_RATIO_LIMIT]),
    ("methods", "the accelerometer noise exceeds {} ug/Hz^0.5", [1e6 * findings.MAX_RANDOM_WALK]),
    ("methods", "the others by more than {} standard", [findings.CONTRADICTION_SIGMAS]),
    ("methods", "each shift is below {} times its", [diagnostics.AGREEMENT_FACTOR]),
    (
        "methods",
        "the difference is below {} times its",
        [diagnostics.AGREEMENT_FACTOR],
    ),
    ("diagnosis", "| each record, at {} times, and", [ranking.STEP_COUNT]),
    (
        "diagnosis",
        "velocity must be 1 to within {} %",
        [100 * (mistakes._FULL_CORIOLIS_RANGE[1] - 1)],
    ),
    (
        "diagnosis",
        "values differ by less than {}, or by less than {} % of the gain",
        [ranking._DECISIVE_CHI2, 100 * ranking._DECISIVE_FRACTION],
    ),
    (
        "diagnosis",
        "one of these explanations first, and then up to {} others",
        [search._MAX_RIVALS],
    ),
    ("diagnosis", "and ends after at most {} causes", [search._MAX_CAUSES]),
    ("diagnosis", "effects smaller than {} % of this error", [100 * search._MIN_RELATIVE_SIZE]),
    ("diagnosis", "at most {} % of good campaigns have false findings on priors", [CAUSES]),
    ("diagnosis", "results (`run-disagrees`): {} % of campaigns", [ALARMS]),
    ("diagnosis", "(`noise-differs`): {} % of campaigns, by", [ALARMS]),
    ("diagnosis", "two-stage method: {} % of accelerometers", [ALARMS]),
    (
        "diagnosis",
        "(`lack-of-fit`): {} % of accelerometers; by the two-stage method alone {} %",
        [100 * diagnostics.SIGNIFICANCE, 100 * two_stage_findings._MIN_P],
    ),
    (
        "diagnosis",
        "(`methods-disagree`): {} % of accelerometers",
        [200.0 * normal_cdf(-diagnostics.AGREEMENT_FACTOR)],
    ),
    ("diagnosis", "causes: {} % of campaigns for priors, {} % for all other", [CAUSES, CAUSES]),
    ("diagnosis", "({} or more, rounded)", [fitted.MIN_DOF]),
    ("diagnosis", "sine of 1 to {} times the head's angle", [patterns._N_HARMONICS]),
    (
        "diagnosis",
        "constant of {} or {} times the duration of the series",
        [*patterns._WARM_UP_TIME_CONSTANTS],
    ),
    (
        "diagnosis",
        "explanation whose chi-square is within {} of the minimum",
        [patterns._DECISIVE_CHI2],
    ),
    ("result", "accelerometer is above {} ug/Hz^0.5", [1e6 * findings.MAX_RANDOM_WALK]),
    (
        "result",
        "accelerometers (false alarms in {} % of good campaigns), and by at least {} standard "
        "uncertainties",
        [ALARMS, diagnostics.AGREEMENT_FACTOR],
    ),
    (
        "result",
        "two-stage K_II differs from the joint K_II by more than {} standard",
        [diagnostics.AGREEMENT_FACTOR],
    ),
    ("result", "more than {} % of the samples of a run, or", [100 * outcome.MAX_OUTLIER_SHARE]),
    ("result", "shorter than {} % of the run's", [100 * assembly.MIN_DURATION_FRACTION]),
    ("result", "means infinite or more than {}", [distributions._INFINITE_DOF]),
    (
        "result",
        "with the model | at least {} times the stated noise; beyond {} standard",
        [findings.RESIDUAL_RATIO_LIMIT, findings.CONTRADICTION_SIGMAS],
    ),
    ("conformity", "Student's factor for {} % coverage and", [100 * distributions.COVERAGE]),
    (
        "conformity",
        "U, with a default factor of {} (",
        [conformity.DecisionRule("guarded").guard_factor],
    ),
    ("conformity", "with a probability of at most {} %", [50 * (1 - distributions.COVERAGE)]),
    (
        "conformity",
        "probability `conformance_probability`, which is {} % by",
        [100 * conformity.DecisionRule("probability").needed],
    ),
    (
        "benchmarks",
        "One pass over each chunk of {} rows calculates the smallest and the largest step in time "
        "and in angle, the residuals of {} neighbouring rows",
        [column_file._CHUNK_ROWS, outliers.WINDOW_SAMPLES],
    ),
    ("physics", "the temperature rose linearly by {} K from", [conditions.DEFAULT_WARMING]),
    (
        "physics",
        "{} arcmin is equivalent to an error of ${}$ in K_I",
        [3, 0.5 * (3 * 60 * ARCSEC) ** 2],
    ),
    (
        "physics",
        "below about {} deg/h in a run of $T$ = {} s. At this limit, "
        "the neglected displacement $g d^2 T^4/24$ reaches {} m",
        [
            small_angles._FIRST_ORDER_LIMIT / 400.0**2,
            400,
            9.8 * (0.2 * DEGREE_PER_HOUR) ** 2 * 400.0**4 / 24,
        ],
    ),
    (
        "physics",
        "{} arcsec/g is equivalent to an error of ${}$ g/g² in $K_{II}$",
        [SHARED_TERMS["platform.compliance.zy"].typical / ARCSEC, 0.1 * ARCSEC],
    ),
    (
        "physics",
        "term of {} µg/g² is equivalent to an error of {} µg/g² in $K_{II}$",
        [
            0.1,
            0.1 * parabola("K_F.heating", QX, 3.0, *PLAN) / parabola("K_II", QX, 3.0, *PLAN),
        ],
    ),
    ("physics", "A trend ({} µg/min is typical)", [60e6 * CONDITION_TERMS["K_F.trend"].typical]),
    (
        "physics",
        "At $K_I = {}$, the two definitions of $K_{II}$ differ by {} %",
        [1.002, 100 * (1.002 - 1)],
    ),
    (
        "arm",
        "rotation changes the force by a fraction of {}.",
        [2 * EARTH_RATE * math.sin(math.pi / 4) / math.pi],
    ),
    (
        "arm",
        "an arm stretch of {} per m/s^2 is equivalent to a K_II of {} g/g^2",
        [SHARED_TERMS["centrifuge.stretch"].typical, 9.8 * 4.6e-9],
    ),
]


@pytest.mark.parametrize(
    ("page", "words", "computed"), NUMBERS, ids=[f"{page}: {words}" for page, words, _ in NUMBERS]
)
def test_number_in_text_matches_code(page, words, computed):
    numbers = find_numbers(page, words)
    assert len(numbers) == len(computed)
    for number, size in zip(numbers, computed, strict=True):
        assert agrees_to_last_digit(number, size), (number, size)


def test_number_comparison_detects_wrong_number():
    assert agrees_to_last_digit("2.5", 2.549)
    assert not agrees_to_last_digit("2.5", 2.56)
    assert agrees_to_last_digit("1e-7", 1.1e-7)
    assert not agrees_to_last_digit("1e-7", 1.2e-7)
    assert not agrees_to_last_digit("50", 49.7)
    assert agrees_to_last_digit("three", 3.0)
    assert not agrees_to_last_digit("three", 3.1)
    assert parse_number("1/64") == 0.015625
    with pytest.raises(AssertionError, match="0 times"):
        find_numbers("README", "no such words, {}")


def test_estimating_is_better_than_considering():
    example = ROOT / "docs" / "examples" / "three-rate" / "campaign.toml"
    known = cs.read_campaign(example).change(
        {**WITHOUT_QY, "model": {"assume": "all", "priors": {"platform.tilt": "0 ± 0.5 arcsec"}}}
    )
    named = find_numbers("methods", "tilts that are repeatable to {} arcsec, and no other errors")
    assert named == ["0.5"]
    numbers = find_numbers(
        "methods",
        "are held, u(K_II) is {} g/g^2. If the tilts are estimated with the same prior, "
        "u(K_II) is {} g",
    )
    for number, held in zip(numbers, ([*known.model.considered], ["K_IP"]), strict=True):
        estimated_u = cs.forecast(known.change({"model": {"hold": held}})).u["Qx.K_II"]
        assert agrees_to_last_digit(number, estimated_u)


def test_approximate_ratio_matches_terms():
    (times,) = find_numbers(
        "physics", "At π/2 rad/s, the effect of `yy` is {} times the effect of an equal `zx`"
    )
    k_yy = 0.5 * PLAN[0] * 0.5 * math.pi
    k_zx = abs(parabola("platform.g_sensitivity.zx", QX, 0.5 * math.pi, *PLAN))
    assert k_yy / k_zx == pytest.approx(parse_number(times), rel=0.1)


@pytest.mark.parametrize("angles", [(0.0, 0.0), (90.0, 0.0), (0.0, 90.0), (20.0, 30.0)])
def test_azimuth_compliance_equals_k_oo_in_any_attitude(angles):
    east, up = np.radians(angles)
    about_east = [[1, 0, 0], [0, np.cos(east), -np.sin(east)], [0, np.sin(east), np.cos(east)]]
    about_up = [[np.cos(up), -np.sin(up), 0], [np.sin(up), np.cos(up), 0], [0, 0, 1]]
    site = cs.Site(gravity=9.8, latitude=math.radians(45.0))
    trajectory = cs.Trajectory(cs.Spindle(math.pi), PLAN[0], site)
    times, terms = np.linspace(0.0, 30.0, 31), ["K_OO", "platform.compliance.zy"]
    attitude = np.array(about_up) @ np.array(about_east)
    k_oo, compliance = columns(trajectory, QX, terms, times, attitude=attitude).T
    np.testing.assert_allclose(compliance, k_oo, rtol=1e-12, atol=1e-12)


# Results of long studies --------------------------------------------------------------------------


def largest_shift(row):
    return max(abs(shift) for shift in row["shifts"].values())


@pytest.fixture(scope="module")
def violations():
    return {(row["name"], row["observable"]): row for row in load_results("docs/violations.json")}


def test_displacement_does_not_reveal_named_violations(violations):
    silent = "K_OO", "K_PP", "K_F.heating", "platform.compliance.zy", "platform.tilt.north"
    for name in silent:
        row = violations[name, "displacement"]
        assert largest_shift(row) > 100
        assert (row["state"], row["codes"]) == ("good", [])
    (free_shift,) = find_numbers("violations", "a K_OO of typical size shifts K_II by {} u")
    assert agrees_to_last_digit(
        free_shift, abs(violations["K_OO", "displacement"]["free_shifts"]["K_II"])
    )
    assert violations["delta_O", "displacement"]["codes"] == ["prior-conflict"]
    for name in ("platform.drift.north", "platform.g2_sensitivity.north"):
        assert violations[name, "displacement"]["codes"] == ["term-missing"]


def test_encoder_and_imbalance_effects_match_text(violations):
    rows = {k: row for k, row in violations.items() if k[0].startswith(("encoder", "centrifuge.i"))}
    assert len(rows) == 3 * (8 + 4)
    (most,) = find_numbers(
        "violations", "shift no coefficient by more than {} u in displacement and velocity"
    )
    for (_, observable), row in rows.items():
        if observable == "specific_force":
            assert row["codes"] or largest_shift(row) < 0.1
        else:
            assert largest_shift(row) < parse_number(most)
    # methods.md, of 1e-7 of the rate, and physics.md
    arcsec = abs(violations["encoder.harmonic.1.sin", "specific_force"]["shifts"]["K_II"])
    ripple, times = find_numbers(
        "methods",
        "with a relative amplitude of {}, and that an encoder error masks this variation. The "
        "variation would shift K_II by {}",
    )
    assert parse_number(times) == round(arcsec * parse_number(ripple) / ARCSEC)
    assert arcsec > 200
    for name in ("platform.compliance.zy", "K_F.heating"):
        assert abs(violations[name, "displacement"]["shifts"]["K_II"]) > 200


def test_violation_campaign_matches_description():
    study = runpy.run_path(str(ROOT / "docs" / "violations.py"))
    limits = (
        find_numbers("violations", "every shift of more than {} u"),
        find_numbers("violations", "by {} of its u"),
    )
    (most,), (least,) = limits
    assert agrees_to_last_digit(most, study["SILENT_SHIFT_LIMIT"])
    assert agrees_to_last_digit(least, study["SHOWN_SHIFT_LIMIT"])
    campaign = tomllib.loads(study["describe_campaign"]("velocity", study["FULL_SIZE"]))
    words = "three runs at {}, {} and {} rev/s, with {} revolutions each, sampled at {} Hz "
    words += "at a radius of {} m. "
    words += "The noise per sample is {} m in displacement, {} mm/s in velocity "
    words += "and {} m/s^2 in specific force. "
    words += "The standard uncertainties are {} µg for the bias and {} ppm for the scale factor"
    *rates, turns, sampling, radius, place, speed, force, bias, scale = map(
        parse_number, find_numbers("violations", words)
    )
    assert tuple(rates) == tuple(map(float, DEFAULT_RATES))
    assert (sampling, turns) == (study["FULL_SIZE"].sampling_rate, study["FULL_SIZE"].revolutions)
    assert campaign["centrifuge"]["radius"].startswith(f"{radius} ±")
    assert study["NOISE"] == {
        "displacement": f"{place} m",
        "velocity": f"{speed:.0f}e-3 m/s",
        "specific_force": f"{force:.0e} m/s^2".replace("e-0", "e-"),
    }
    assert f"± {bias:.0f}e-6 g" in campaign["accelerometers"]["Qx"]["bias"]
    assert f"± {scale:.0f}e-6 g/g" in campaign["accelerometers"]["Qx"]["scale_factor"]


def test_intervals_with_estimated_noise_are_conservative():
    rows = [
        row for row in load_results("docs/coverage.json") if row["label"].endswith(", not stated")
    ]
    assert len(rows) > 4
    for row in rows:
        assert sum(row["covered"].values()) / len(row["covered"]) >= 0.95, row["label"]
    for row in rows:
        if row["label"] == "white noise, not stated":
            length = 1.0 / row["normal_rms"]["K_F"]
            assert "about twice as long as necessary" in read_text("methods")
            assert length == pytest.approx(2.0, abs=0.35)


def test_u_matches_scatter_if_noise_is_stated_or_visible():
    (near,) = find_numbers("methods", "1 lies inside the band or at most {} outside it")
    study = runpy.run_path(str(ROOT / "docs" / "coverage.py"))
    rows = [row for row in study["TABLE"].load() if not row.has_hidden_noise]
    assert len(rows) > 10
    for row in rows:
        assert abs(row.normal - 1.0) < row.normal_band + parse_number(near), row


def test_false_alarm_rates_do_not_exceed_stated_rates():
    """Compare the lower end of the 95 % interval of the trials with the stated share."""
    bounds = runpy.run_path(str(ROOT / "docs" / "false_alarms.py"))["proportion_interval"]
    (residuals, _) = find_numbers(
        "diagnosis", "(`lack-of-fit`): {} % of accelerometers; by the two-stage method alone {} %"
    )
    causes = find_numbers("diagnosis", "causes: {} % of campaigns for priors, {} % for all other")
    shares = {
        "`run-disagrees`": find_numbers("diagnosis", "(`run-disagrees`): {} % of campaigns")[0],
        "`noise-differs`": find_numbers("diagnosis", "(`noise-differs`): {} % of campaigns, by")[0],
        "`methods-disagree`": 2
        * parse_number(find_numbers("diagnosis", "(`methods-disagree`): {} % of")[0]),
        "`lack-of-fit`": 2 * parse_number(residuals),
        "a cause": sum(map(parse_number, causes)),
    }
    for row in load_results("docs/false_alarms.json"):
        for label, share in shares.items():
            low, _ = bounds(row["counts"][label], row["trials"])
            assert 100 * low <= float(share), (label, row["label"])


@pytest.fixture(scope="module")
def benchmark_results():
    return {
        table["title"]: {
            row[0]: dict(zip(table["columns"][1:], row[1:], strict=True)) for row in table["rows"]
        }
        for table in load_results("benchmarks/results.json")
    }


def test_start_up_takes_most_of_calibration_time(benchmark_results):
    text = read_text("benchmarks")
    usual = benchmark_results["A typical campaign"]
    start, whole = (usual[name] for name in list(usual)[:4:3])
    assert list(usual)[3] == "counterspin calibrate"
    assert "More than half of the time for a typical campaign is spent on loading" in text
    assert start["fastest (s)"] > 0.5 * whole["fastest (s)"]
    long = benchmark_results["Long records"]
    csv, parquet = (
        {name: row[column] for name, row in long.items()} for column in next(iter(long.values()))
    )
    assert "For a Parquet file, the memory use does not depend on the file length" in text
    assert parquet["calibrate, peak memory (MB)"] < 1.25 * whole["peak MB"]
    assert "less than half of the file size" in text
    more = csv["calibrate, peak memory (MB)"] - whole["peak MB"]
    assert more < 0.5 * csv["three files (MB)"]


def test_overhead_of_two_workers_matches_text(benchmark_results):
    (number,) = find_numbers("benchmarks", "requires about {} s of processor time to start")
    first, second = (
        row["processor (s)"] for row in list(benchmark_results["Whole studies"].values())[1:]
    )
    assert agrees_to_last_digit(number, 0.5 * (second - first))


# What examples, cases and tables of the pages themselves hold -------------------------------------


def test_gain_of_joint_fit_matches_readme():
    (share,) = find_numbers(
        "README", "u(K_II) from the joint fit is {} of u(K_II) from the two-stage"
    )
    (row,) = re.findall(
        r"^K_II +\S+ +\S+ ± (\S+) +\S+ ± (\S+)", (ROOT / "README.md").read_text("utf-8"), re.M
    )
    assert float(row[0]) / float(row[1]) == pytest.approx(parse_number(share), rel=0.1)


def test_certificate_schema_version_matches_readme():
    assert f"(DCC {build.SCHEMA_VERSION})" in read_text("README")


def test_quickstart_truth_matches_starter():
    starter = tomllib.loads((files("counterspin.ingest") / "starter.toml").read_text("utf-8"))
    ((truth, micro),) = re.findall(
        r"value in `\[truth\]` is `(\S+) g/g\^2`, which is (\d+) ug", read_text("quickstart")
    )
    assert starter["truth"]["Qx"]["K_II"] == f"{truth} g/g^2"
    assert float(micro) == pytest.approx(1e6 * float(truth))


def test_integral_accuracy_matches_text():
    (number,) = find_numbers("README", "integrals evaluated to 40 digits to within {}, or")
    assert find_numbers("trust", "agreement to {}, and to") == [number]
    (of_jumps,) = find_numbers("trust", "and to {} for the displacement of K_0_asym")
    for beginning, count, limit in (
        ("integrals, ", 8, number),
        ("integrals with a discontinuity, ", 4, of_jumps),
    ):
        checked = [check_case(case) for case in cases() if case.name.startswith(beginning)]
        assert len(checked) == count
        for case in checked:
            allowed = parse_number(limit) * abs(case.expected) + 1e-12
            assert abs(case.found - case.expected) <= allowed, case.name


def test_reference_value_digits_match_text():
    digits = [
        int(
            re.search(
                r"^mp.dps = (\d+)$", (ROOT / "tests" / "reference" / name).read_text("utf-8"), re.M
            )[1]
        )
        for name in ("make_double_integrals.py", "make_arm_forces.py")
    ]
    assert (
        list(map(parse_number, find_numbers("validation", "in {}-digit and {}-digit arithmetic")))
        == digits
    )
    told_of_trust = [
        *find_numbers("trust", "integrals in {}-digit"),
        *find_numbers("trust", "twice with {} digits"),
    ]
    assert list(map(parse_number, told_of_trust)) == digits


@pytest.mark.parametrize(
    ("words", "begins"),
    [
        ("all {} sets of NIST StRD", "NIST "),
        ("the {} worked examples of JCGM 106", "JCGM 106"),
    ],
)
def test_case_counts_match_page(words, begins):
    assert parse_number(find_numbers("validation", words)[0]) == sum(
        c.name.startswith(begins) for c in cases()
    )


def test_validation_page_lists_all_requirements():
    page = (ROOT / "docs" / "validation.md").read_text("utf-8")
    table = page.partition("## The cases")[2].partition("The cases are stored")[0]
    rows = re.findall(r"^\| ([a-z][\w ]+) \|", table, re.M)[1:]
    assert rows == list(dict.fromkeys(rows))
    assert set(rows) == {case.requirement for case in cases()}


def test_rates_of_arm_example():
    *sizes, last = re.search(
        r"readings at ([\d, ]+) and (\d+) g in both mountings", read_text("arm")
    ).groups()
    sizes = [*sizes[0].split(", "), last]
    text = (files("counterspin.ingest") / "starter_arm.csv").read_text("utf-8")
    names = [row["name"] for row in csv.DictReader(text.splitlines())]
    first = [
        "rest up",
        *(f"{way} {size} g" for size in sizes for way in ("in", "out")),
        "rest down",
    ]
    assert names == [*first, *(f"{name} (repeat)" for name in reversed(first))]


def test_tumble_example_matches_table():
    (count,) = find_numbers("tumble", "a table of {} positions")
    text = (files("counterspin.ingest") / "starter_tumble.csv").read_text("utf-8")
    assert len(list(csv.DictReader(text.splitlines()))) == parse_number(count)
    # The closed form: one over the length of what is left of a column beside the others.
    page = (ROOT / "docs" / "tumble.md").read_text("utf-8")
    for row, cubic in zip(
        re.findall(r"^\| (?:12|24), .*$", page, re.M), (False, True), strict=True
    ):
        first, *cells = (cell.strip() for cell in row.strip("|").split("|"))
        angle = (
            2.0 * math.pi * np.arange(int(first.partition(",")[0])) / int(first.partition(",")[0])
        )
        c, s = np.cos(angle), np.sin(angle)
        columns = [np.ones_like(c), c, s, c * c, c * s, *([c**3] if cubic else [])]
        design = np.column_stack(columns)
        u = np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
        assert [float(cell) for cell in cells if cell] == pytest.approx(list(u), abs=6e-7)
    assert u[1] * math.sqrt(12.0) == pytest.approx(
        parse_number(find_numbers("tumble", "u(K_I) is about {} times as large")[0]), rel=0.1
    )


def test_arm_stretch_resembles_k_ii_in_single_mounting():
    """Check arm.md: f |f| equals K_II in a single mounting and vanishes with both mountings."""
    force = np.linspace(1.0, 20.0, 20)
    for sides, k_ii in (((1.0,), 1.0), ((1.0, -1.0), 0.0)):
        f = np.concatenate([side * force for side in sides])
        fit, *_ = np.linalg.lstsq(np.vander(f, 4, increasing=True), f * np.abs(f), rcond=None)
        assert fit[2] == pytest.approx(k_ii, abs=1e-10)


def test_detectable_effect_with_few_degrees_of_freedom():
    """Check diagnosis.md: the effect that exceeds the limit of F with probability one half."""
    level = 0.5 * diagnostics.SIGNIFICANCE / 20
    seen, *larger = find_numbers(
        "diagnosis",
        "5 degrees of freedom, a pattern of {} standard deviations is detected in half of the "
        "cases. The size of a pattern that is detected in half of the cases increases to {} "
        "standard deviations with 4 degrees of freedom, to {} standard deviations with 3, and to "
        "{} standard deviations with 2. Twelve",
    )
    for freedom, text in zip((5, 4, 3, 2), (seen, *larger), strict=True):
        # Of the residuals' freedom the column itself takes one.
        limit = float(stdtrit(freedom - 1, 1.0 - 0.5 * level))
        assert float(f"{limit:.2g}") == parse_number(text)


def test_residual_of_settling_bias_matches_text():
    """Check diagnosis.md: the residual after fitting start errors, t^2 and harmonics."""
    time, rate, rise = np.arange(0.0, 100.0, 0.02), 2.0 * math.pi, 50e-6
    (g, radius) = (9.8066, 2.5)
    claimed = find_numbers(
        "diagnosis",
        "| displacement | 0.01 m | 10 s | {} | | displacement | 0.01 m | 5 s | {} | "
        "| velocity | 1 mm/s | 3 s | {} | | specific force | 0.1 mm/s² | 1 s | {} |",
    )
    waves = [wave(n * rate * time) for n in (1, 2) for wave in (np.cos, np.sin)]
    for text, (order, noise, takes) in zip(
        claimed,
        ((2, 0.01, 10.0), (2, 0.01, 5.0), (1, 1e-3, 3.0), (0, 1e-4, 1.0)),
        strict=True,
    ):
        power = order + 1  # the ramp and its end, integrated as often
        ramp = time**power - np.maximum(time - takes, 0.0) ** power
        shown = rise * g / takes * ramp / math.factorial(power)
        others = np.stack([*((time / 100.0) ** k for k in range(power)), *waves], axis=1)
        left = shown - others @ np.linalg.lstsq(others, shown, rcond=None)[0]
        assert f"{np.linalg.norm(left) / noise:.2g}" == text
    (largest_shift,) = find_numbers("diagnosis", "increase shifts K_II by {} ug/g^2. If")
    assert f"{1e6 * 2.0 * rise * (g / (radius * rate**2)) ** 2:.2g}" == largest_shift


@pytest.mark.parametrize("page", ["arm", "tumble", "double-turntable"])
def test_term_names_match_ieee_standard(page):
    """Each row of the table names, for each term of ours, its letter in IEEE Std 1293."""
    rows = re.findall(
        r"^\| ([A-Z]_[^|`]+) \| ([^|]+) \|", (ROOT / "docs" / f"{page}.md").read_text("utf-8"), re.M
    )
    named = 0
    for terms, standard in rows:
        for symbol in (
            one for one in terms.split(", ") if TERMS[one].effect.ieee_symbol.startswith("K")
        ):
            assert re.search(rf"\b{TERMS[symbol].effect.ieee_symbol}\b", standard), (
                symbol,
                standard,
            )
            named += 1
    assert named >= 7
