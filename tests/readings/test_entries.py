"""Readings in a campaign: both ways to write them give the same; each slip is one message."""

import math

import numpy as np
import pytest
from reading_descriptions import ACCELEROMETER, format_arm_run, format_rest_run, format_site

from counterspin.campaign.description import read_campaign
from counterspin.campaign.quantity import Quantity
from counterspin.errors import CampaignError

HEAD = format_site() + ACCELEROMETER
ARM = """[centrifuge]
radius = "1.0 ± 1e-3 m"
"""
RUN = format_rest_run("tumble 30", "30 ± 0.001 deg about north", "1.082532 ± 2e-6 mA")
WARM = 'temperature = "23.4 degC"\n'
ON_ARM = format_arm_run(
    "in", "9.9 rad/s", "12.5 ± 2e-6 mA", pendulous="up", mounting="in", more=WARM
)


def read(folder, text):
    (folder / "campaign.toml").write_text(text, encoding="utf-8")
    return read_campaign(folder)


def read_problems(folder, text):
    with pytest.raises(CampaignError) as caught:
        read(folder, text)
    return caught.value.problems


def test_run_with_reading_is_converted_to_g(tmp_path):
    (reading,) = read(tmp_path, HEAD + RUN).readings
    assert reading.value == pytest.approx(1.082532 / 1.25)
    assert reading.u == pytest.approx(2e-6 / 1.25)
    assert reading.u_head == pytest.approx(math.radians(0.001))
    assert reading.head == (0.0, 1.0, 0.0)
    # About north, up turns towards east.
    np.testing.assert_allclose(reading.axes.axes[0], [0.5, 0.0, math.sqrt(0.75)], atol=1e-12)


@pytest.mark.parametrize(("unit", "scale"), [("g", 1.0), ("mg", 1e-3)])
def test_output_in_g_needs_no_sensitivity(tmp_path, unit, scale):
    output = f'output = {{ unit = "{unit}" }}\nsensitivity_prior = "{1.01 / scale} {unit}/g"\n'
    head = HEAD.replace('output = { unit = "mA", sensitivity = "1.25 mA/g" }\n', output)
    campaign = read(tmp_path, head + RUN.replace("mA", unit))
    assert campaign.readings[0].value == pytest.approx(1.082532 * scale, rel=1e-15)
    assert campaign.accelerometers["A"].priors["K_I"].value == pytest.approx(1.01, rel=1e-15)


def test_accelerometer_error_causes_no_errors_of_readings(tmp_path):
    wrong = HEAD.replace('input_axis = "up"', 'input_axis = "upp"')
    assert wrong != HEAD
    (problem,) = read_problems(tmp_path, wrong + RUN)
    assert problem.startswith("accelerometers.A.input_axis: unknown direction")
    unknown = HEAD.replace('sensitivity = "1.25 mA/g"', 'sensitivty = "1.25 mA/g"')
    problem = read_problems(tmp_path, unknown + RUN)
    assert all(one.startswith("accelerometers.A.output.") for one in problem)
    # What its output is in holds whatever else is wrong: the reading's own mistake is told too.
    both = read_problems(tmp_path, wrong + RUN.replace("1.082532 ± 2e-6 mA", "1.08 V"))
    assert both[1] == "runs[0].reading: 'V' cannot be converted to mA; use mA (run \"tumble 30\")"


def test_reading_error_causes_no_unused_prior_error(tmp_path):
    radius = '"centrifuge.radius.in" = "0 ± 1e-5 m"\n'
    known = f"[model.priors]\n{radius}[truth.machine]\n{radius.replace(' ± 1e-5', '')}"
    read(tmp_path, HEAD + ARM + known + ON_ARM)
    (problem,) = read_problems(
        tmp_path, HEAD + ARM + known + ON_ARM.replace("9.9 rad/s", "9.9 rad")
    )
    assert problem.startswith("runs[0].rate: ")
    other = known.replace("radius.in", "radius.out")
    problem = read_problems(tmp_path, HEAD + ARM + other + ON_ARM)
    assert [one.partition(": ")[2][:24] for one in problem] == ['no reading depends on "c'] * 2


def test_output_zero_is_subtracted_from_reading(tmp_path):
    """A loop of 4 mA to 20 mA: reading less zero, over the sensitivity."""
    head = HEAD.replace('"1.25 mA/g" }', '"1.25 mA/g", zero = "4 mA" }')
    reading = RUN.replace("1.082532", "5.082532")
    (read_one,) = read(tmp_path, head + reading).readings
    assert read_one.value == pytest.approx(1.082532 / 1.25, rel=1e-12)
    assert read_one.u == pytest.approx(2e-6 / 1.25, rel=1e-12)
    output = read(tmp_path, head + reading).accelerometers["A"].output
    assert output.from_g(output.to_g(4.7)) == pytest.approx(4.7, rel=1e-15)


def test_output_zero_applies_to_records(tmp_path):
    head = HEAD.replace('"1.25 mA/g" }', '"1.25 mA/g", zero = "4 mA" }')
    records = '[records]\ntime = { column = "t", unit = "s" }\n'
    run = RUN.replace('reading = "1.082532 ± 2e-6 mA"', 'record = "rest.csv"')
    for unit, times in (("mA", 1.0), ("uA", 1e3)):
        recorded = f'specific_force = {{ column = "I", unit = "{unit}" }}\n'
        channel = read(tmp_path, head + recorded + records + run).accelerometers["A"].force
        # At 4 mA and 1.25 mA more: nothing, and one g.
        force = np.array([4.0, 5.25]) * times * channel.factor + channel.offset
        np.testing.assert_allclose(force, [0.0, 9.8], atol=1e-12)
    # A column in m/s^2 has its zero where it is zero.
    recorded = 'specific_force = { column = "f", unit = "m/s^2" }\n'
    channel = read(tmp_path, head + recorded + records + run).accelerometers["A"].force
    assert channel.offset == 0.0


def test_only_records_on_arm_require_centrifuge(tmp_path):
    recorded = 'specific_force = { column = "mA", unit = "mA" }\n'
    records = '[records]\ntime = { column = "t", unit = "s" }\n'
    run = RUN.replace('reading = "1.082532 ± 2e-6 mA"', 'record = "rest.csv"')
    campaign = read(tmp_path, HEAD + recorded + records + run)
    assert campaign.readings[0].record == tmp_path / "rest.csv"
    turning = ON_ARM.replace('reading = "12.5 ± 2e-6 mA"', 'record = "in.csv"')
    assert read_problems(tmp_path, HEAD + recorded + records + turning) == (
        "centrifuge: is missing",
    )


def test_run_on_arm_has_rate_mounting_and_temperature(tmp_path):
    reading = read(tmp_path, HEAD + ARM + RUN + ON_ARM).readings[1]
    assert (reading.motion, reading.rate, reading.mounting) == ("arm", 9.9, "in")
    assert reading.axes.axes[:2] == ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert reading.temperature == pytest.approx((296.55,))


def test_reading_without_uncertainty_has_no_u(tmp_path):
    (reading,) = read(tmp_path, HEAD + RUN.replace(" ± 2e-6", "")).readings
    assert reading.u is None


SLIPS = {
    "a static run with a rate": (
        HEAD + RUN + 'rate = "1 rad/s"\n',
        "runs[0].rate: a static run has no rotation",
    ),
    "an arm without a rate": (
        HEAD + ARM + ON_ARM.replace('rate = "9.9 rad/s"\n', ""),
        "runs[0].rate: is missing",
    ),
    "an arm without axes": (
        HEAD + ARM + ON_ARM.replace("axes", "# axes"),
        "runs[0]: a run on an arm has no attitude",
    ),
    "another unit": (
        HEAD + RUN.replace("2e-6 mA", "2e-6 V"),
        "runs[0].reading: 'V' cannot be converted to mA",
    ),
    "a position that is missing": (
        HEAD + RUN.replace("attitude", "# attitude"),
        "runs[0].attitude: is missing: a reading at rest requires a position",
    ),
    "a sensitivity of another unit": (
        HEAD.replace("1.25 mA/g", "1.25 V/g") + RUN,
        "accelerometers.A.output.sensitivity:",
    ),
    "a zero of another unit": (
        HEAD.replace('"1.25 mA/g" }', '"1.25 mA/g", zero = "4 V" }') + RUN,
        "accelerometers.A.output.zero: 'V' cannot be converted to mA",
    ),
    "an output without a sensitivity": (
        HEAD.replace(', sensitivity = "1.25 mA/g"', "") + RUN,
        'accelerometers.A.output.sensitivity: is missing; give the nominal output, such as "1.25 '
        'mA/g"',
    ),
    "an acceleration without a sensitivity": (
        HEAD.replace('unit = "mA", sensitivity = "1.25 mA/g"', 'unit = "m/s^2"'),
        'is missing; give the nominal output, such as "9.80665 m/s^2/g"',
    ),
    "no centrifuge": (HEAD + ON_ARM, "centrifuge: is missing"),
    "no reading": (
        HEAD + RUN.replace("reading =", "# reading ="),
        "runs[0]: give either reading or record",
    ),
    "a direction of another frame": (
        HEAD + ARM + ON_ARM.replace("inward", "east"),
        'runs[0]: unknown direction "east" for this motion',
    ),
    "no such file": (
        HEAD + '[readings]\nfile = "none.csv"\ncolumns = { reading = "mA" }\n',
        "none.csv: file not found",
    ),
    "a term that no reading shows": (
        HEAD + '[model]\nassume = "all"\nterms = ["K_F", "centrifuge.droop"]\n' + RUN,
        'no reading depends on "centrifuge.droop"',
    ),
    "the zero of a head where no reading has one": (
        HEAD
        + '[model.priors]\n"head.zero" = "0 ± 1 arcsec"\n'
        + RUN.replace("30 ± 0.001 deg about north", "level"),
        'no reading depends on "head.zero"',
    ),
    "a mounting that is not there": (
        HEAD + ARM + '[model]\nassume = "all"\nterms = ["K_F", "centrifuge.radius.inn"]\n' + ON_ARM,
        'did you mean "centrifuge.radius.in"?',
    ),
    "held without a prior": (
        HEAD + '[model]\nassume = "all"\nterms = ["K_F"]\nhold = ["head.zero"]\n' + RUN,
        'model.hold: "head.zero" is held, but no prior is stated for the machine; '
        'add "head.zero" = "VALUE ± U rad" to [model.priors]',
    ),
    "a head of no angle": (
        HEAD + RUN.replace("30 ± 0.001 deg about north", "level") + 'head = "30 deg"\n',
        (
            "runs[0].head: requires an attitude that is a rotation about an axis, such as attitude "
            '= "30 deg about north"'
        ),
    ),
    "a number alone, of an output": (
        HEAD + RUN.replace('"1.082532 ± 2e-6 mA"', "1.082532"),
        'runs[0].reading: has no unit; write the quantity as text, such as "1.082532 mA"',
    ),
    "a key of records": (
        HEAD + RUN + 'start = "2 s"\n',
        "runs[0].start: applies to a run with a record of a double turntable; omit it",
    ),
    "records of a record whose mean is a reading": (
        HEAD
        + RUN.replace('reading = "1.082532 ± 2e-6 mA"', 'record = "a.csv"')
        + 'records = { delimiter = ";" }\n',
        "runs[0].records: applies to a run with a record of a double turntable; omit it. "
        "[records] applies to all records on the arm and at rest: all of them must have "
        "the same columns and units",
    ),
    "an attitude of no words": (
        HEAD + RUN.replace("30 ± 0.001 deg about north", ""),
        "runs[0].attitude: is not an attitude",
    ),
    "no temperature": (
        HEAD + RUN + 'temperature = "warm"\n',
        "runs[0].temperature: 'warm' is not a temperature",
    ),
}


def test_overloaded_meter_raises(tmp_path):
    for text in (RUN.replace("1.082532 ± 2e-6", "9.9E+37"), RUN.replace("1.082532", "1e9")):
        (problem,) = read_problems(tmp_path, HEAD + text)
        assert problem.startswith("runs[0].reading: is ")
        assert "g for A, which is impossible; check the sensitivity" in problem


@pytest.mark.parametrize("slip", SLIPS)
def test_invalid_entry_raises_with_key(tmp_path, slip):
    text, message = SLIPS[slip]
    assert any(message in line for line in read_problems(tmp_path, text)), read_problems(
        tmp_path, text
    )


def test_repeats_have_mean_and_scatter(tmp_path):
    several = 'reading = ["1.0 mA", "1.1 mA", "1.3 mA"]'
    run = RUN.replace('reading = "1.082532 ± 2e-6 mA"', several)
    (reading,) = read(tmp_path, HEAD + run).readings
    assert reading.value == pytest.approx(3.4 / 3 / 1.25)
    assert (reading.u, reading.repeats) == (None, 3)
    assert reading.scatter == pytest.approx(np.var([0.8, 0.88, 1.04]) * 3)


TURNTABLE = """[records]
time = { column = "t", unit = "s" }
[[runs]]
name = "turntable"
rate = "6.0 rad/s"
record = "turntable.csv"
[[runs]]
name = "in"
motion = "arm"
rate = "9.9 rad/s"
axes = { input = "inward", pendulous = "up" }
record = "in.csv"
"""


def test_arm_records_have_specific_force_column(tmp_path):
    displacement = 'displacement = { column = "m", unit = "m" }\n'
    force = 'specific_force = { column = "i", unit = "mA" }\n'
    campaign = read(tmp_path, HEAD + displacement + force + ARM + TURNTABLE)
    a = campaign.accelerometers["A"]
    assert (a.observable, a.channel.name, a.force.name) == ("displacement", "m", "i")
    assert a.force.factor == pytest.approx(9.8 / 1.25)
    (line,) = read_problems(tmp_path, HEAD + displacement + ARM + TURNTABLE)
    assert "has no specific_force; this key is required for records on an arm or at rest" in line


def test_path_errors_are_considered_beside_static_readings(tmp_path):
    """The records show them, though no reading does; both axes of a tilt have one prior."""
    displacement = 'displacement = { column = "m", unit = "m" }\n'
    more = 'stretch = "0 ± 5e-9 s^2/m"\naxis_tilt = "0 ± 5 arcsec"\n'
    turntable = TURNTABLE.split('[[runs]]\nname = "in"', maxsplit=1)[0]
    model = '[model]\nassume = "all"\nterms = ["K_F", "K_I", "K_II", "centrifuge.stretch"]\n'
    asked = read(tmp_path, HEAD + displacement + ARM + more + model + turntable + RUN).model
    assert asked.terms == ("K_F", "K_I", "K_II", "centrifuge.stretch")
    assert asked.priors["centrifuge.stretch"] == Quantity(0.0, 5e-9, "s^2/m")
    assert asked.considered == ()
    known = asked.priors["centrifuge.axis_tilt.east"]
    assert known.u == pytest.approx(math.radians(5 / 3600))
    terms = model.replace("stretch", "axis_tilt")
    asked = read(tmp_path, HEAD + ARM + more + terms + ON_ARM).model
    assert asked.terms[3:] == ("centrifuge.axis_tilt.east", "centrifuge.axis_tilt.north")


# Positions that are set by hand

SET = '[fixture]\nposition = "0 ± 0.5 deg"\n'
FACES = (
    format_rest_run("up", "level", "1 ± 2e-6 mA")
    + format_rest_run("up again", "360 deg about north", "1 ± 2e-6 mA")
    + format_rest_run("half over", "90 deg about north", "0 ± 2e-6 mA")
    + format_rest_run("elsewhere", "level", "1 ± 2e-6 mA", 'mounting = "m"\n')
)


def test_readings_of_same_attitude_and_mounting_share_position(tmp_path):
    campaign = read(tmp_path, HEAD + SET + FACES)
    assert [reading.position for reading in campaign.readings] == ["1", "1", "2", "3"]
    symbols = [f"fixture.position.{k}.{axis}" for axis in ("east", "north") for k in (1, 2, 3)]
    assert {s for s in campaign.model.priors if "position" in s} == set(symbols)
    assert {campaign.model.priors[s].u for s in symbols} == {math.radians(0.5)}


def test_accelerometers_of_same_body_share_positions(tmp_path):
    other = ACCELEROMETER.replace("accelerometers.A", "accelerometers.B")
    text = HEAD + other.replace('"west"', '"north"') + SET
    for name, attitude in (("up", "level"), ("over", "90 deg about north")):
        run = format_rest_run(name, attitude, "X")
        text += run.replace('"X"', '{ A = "1 ± 1e-6 mA", B = "1 ± 1e-6 mA" }')
    assert [(r.accelerometer, r.position) for r in read(tmp_path, text).readings] == [
        ("A", "1"),
        ("B", "1"),
        ("A", "2"),
        ("B", "2"),
    ]


def test_positions_without_stated_error_are_unnamed(tmp_path):
    campaign = read(tmp_path, HEAD + FACES)
    assert {reading.position for reading in campaign.readings} == {""}
    assert not any("position" in symbol for symbol in campaign.model.priors)


def test_prior_of_single_position_takes_precedence(tmp_path):
    known = '[model.priors]\n"fixture.position.2.north" = "3 ± 1 arcmin"\n'
    priors = read(tmp_path, HEAD + SET + known + FACES).model.priors
    assert priors["fixture.position.2.north"].value == pytest.approx(math.radians(0.05))
    assert priors["fixture.position.2.east"].u == math.radians(0.5)


@pytest.mark.parametrize("error", ["1 ± 0.5 deg", "0.5 deg", "0 deg"])
def test_positioning_error_requires_zero_value_and_positive_u(tmp_path, error):
    (line,) = read_problems(tmp_path, HEAD + SET.replace("0 ± 0.5 deg", error) + FACES)
    assert line.startswith("fixture.position: ")


def test_all_errors_of_run_are_reported_together(tmp_path):
    wrong = RUN.replace("mA", "V").replace("about north", "about nort")
    problems = read_problems(tmp_path, HEAD + wrong + 'rate = "1 rad/s"\nu = 3\n')
    assert [line.partition(":")[0] for line in problems] == [
        "runs[0].attitude",
        "runs[0].reading",
        "runs[0].rate",
        "runs[0].u",
    ]
    # What hangs on a wrong key is not told: how it moves says whether it needs a rate.
    problems = read_problems(tmp_path, HEAD + RUN.replace('"static"', '"statc"'))
    assert [line.partition(":")[0] for line in problems if "runs" in line] == ["runs[0].motion"]
