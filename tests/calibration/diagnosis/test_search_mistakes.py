"""Deliberate mistakes are named or rejected as stated in the documentation table."""

import math
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from campaigns import PLACE, format_runs, replace_parts, write_description
from mistaken_campaigns import (
    ANGLE,
    CORRECT_DESCRIPTION,
    EAST,
    NOISE,
    NORTH,
    TIME,
    Mistake,
    add_values,
    delay_angle,
    detrend_column,
    exchange_records,
    make_mistaken_campaign,
    make_records,
    make_step,
    multiply_column,
    swap_columns,
)

from counterspin import calibrate
from counterspin.calibration.diagnosis import search
from counterspin.errors import CounterspinError
from counterspin.inference.joint.estimation import reestimate
from counterspin.simulation.simulate import simulate

PAGE = Path(__file__).parents[3] / "docs" / "diagnosis.md"
RADIUS = 'radius = "2.5 m"'
BIAS = 'bias = "0.0050321 ± 2e-6 g"'
SCALE = 'scale_factor = "1.0019743 ± 5e-6 g/g"'
K_II = 'K_II = "2.7e-5 g/g^2"'
TILT = '"platform.tilt" = "0 ± 0.5 arcsec"'


def drifting_bias(size):
    """Return the displacement due to a bias that grows by `size` g over a record."""
    return lambda t: size * 9.8066 * t**3 / (6.0 * t[-1])


def settling_bias(size, part):
    """Return the displacement due to a bias that grows by `size` g in the first part."""

    def settle(t):
        end = part * t[-1]
        return size * 9.8066 * (t**3 - np.maximum(t - end, 0.0) ** 3) / (6.0 * end)

    return settle


def warming_bias(rate):
    """Return the displacement due to a bias that grows by `rate` g/s."""
    return lambda t: rate * 9.8066 * t**3 / 6.0


MISTAKES = (
    Mistake(
        "radius of 2.6 m instead of 2.5 m",
        "wrong-input centrifuge.radius",
        description=((RADIUS, 'radius = "2.6 m"'),),
    ),
    Mistake(
        "radius of 2.6 m instead of 2.5 m",
        "wrong-input centrifuge.radius",
        description=((RADIUS, 'radius = "2.6 m"'),),
        estimated=True,
    ),
    Mistake(
        "radius of 2.502 ± 0.0001 m instead of 2.5 m",
        "wrong-input centrifuge.radius",
        description=((RADIUS, 'radius = "2.502 ± 1e-4 m"'),),
    ),
    Mistake(
        "radius of 2.5 cm instead of 2.5 m",
        "ratio of m and cm: check the unit of the column",
        description=((RADIUS, 'radius = "2.5 cm"'),),
        state="",
    ),
    Mistake(
        "displacement of one accelerometer in mm instead of m",
        "ratio of m and mm: check the unit of the column",
        records=multiply_column(None, EAST, 1e3),
        state="",
    ),
    Mistake(
        "scale error of 0.5 % in the records of one accelerometer",
        "wrong-scale Qx",
        records=multiply_column(None, EAST, 1.005),
    ),
    Mistake(
        "scale error of 0.2 % in one record",
        "wrong-scale middle.Qx",
        records=multiply_column("middle", EAST, 1.002),
    ),
    Mistake(
        "scale error of 0.2 % in one record",
        "wrong-scale middle.Qx",
        records=multiply_column("middle", EAST, 1.002),
        estimated=True,
    ),
    Mistake(
        "zero of the angle wrong by 1 deg",
        "wrong-angle records.angle",
        records=add_values(None, ANGLE, lambda t: math.radians(1.0)),
    ),
    Mistake(
        "zero of the angle wrong by 10 deg",
        "wrong-angle records.angle",
        records=add_values(None, ANGLE, lambda t: math.radians(10.0)),
    ),
    Mistake(
        "zero of the angle wrong by 90 deg",
        "is rotated by 90 degrees relative to the input axis",
        records=add_values(None, ANGLE, lambda t: math.radians(90.0)),
        state="",
    ),
    Mistake(
        "zero of the angle wrong by 1 deg in one run",
        "wrong-angle fast",
        records=add_values("fast", ANGLE, lambda t: math.radians(1.0)),
        state="reservations",
    ),
    Mistake(
        "angle with the opposite sense",
        "The angle changes in the opposite sense",
        records=multiply_column(None, ANGLE, -1.0),
        state="",
    ),
    Mistake(
        "angle sampled 5 ms after the displacement",
        "wrong-input records.timing_offset",
        records=delay_angle(0.005),
    ),
    Mistake(
        "a parabola removed from every record of one accelerometer",
        "a parabola was removed from column 'east_m' (Qx) before the file was written",
        description=(("bias", "# bias"),),
        records=detrend_column(EAST),
        state="",
    ),
    Mistake(
        "columns of the two accelerometers interchanged",
        "check the input axis, its sign, and the assignment of the columns",
        records=swap_columns,
        state="",
    ),
    Mistake(
        "wrong sign in the record of one accelerometer",
        "check the input axis, its sign, and the assignment of the columns",
        records=multiply_column(None, NORTH, -1.0),
        state="",
    ),
    Mistake(
        "records of two runs interchanged",
        "rate",
        records=exchange_records("slow", "fast"),
        state="",
    ),
    Mistake(
        "bias wrong by 10 times its u",
        "prior-conflict Qx.K_F",
        description=((BIAS, 'bias = "0.0050521 ± 2e-6 g"'),),
    ),
    Mistake(
        "bias in mg instead of g",
        "prior-conflict Qx.K_F",
        description=((BIAS, 'bias = "5.0321e-6 ± 2e-9 g"'),),
    ),
    Mistake(
        "bias in m/s^2 instead of g",
        "prior-conflict Qx.K_F",
        description=((BIAS, 'bias = "0.049348 ± 2e-5 g"'),),
    ),
    Mistake(
        "wrong sign of the bias",
        "prior-conflict Qx.K_F",
        description=((BIAS, 'bias = "-0.0050321 ± 2e-6 g"'),),
    ),
    Mistake(
        "scale factor wrong by 0.1 %",
        "prior-conflict Qx.K_I",
        description=((SCALE, 'scale_factor = "1.0029743 ± 5e-6 g/g"'),),
    ),
    Mistake(
        "tilt of 6 arcsec in every run, stated as 0 ± 0.5 arcsec",
        "prior-conflict platform.tilt",
        description=((TILT, '"platform.tilt" = "6 ± 0.5 arcsec"'),),
    ),
    Mistake(
        "a jump of 5 cm in one record",
        "jump middle.Qx",
        records=add_values("middle", EAST, make_step(0.05, 0.4)),
    ),
    Mistake(
        "a jump of 5 cm in one record",
        "jump middle.Qx",
        records=add_values("middle", EAST, make_step(0.05, 0.4)),
        estimated=True,
        state="reservations",
    ),
    Mistake(
        "a drift in the second half of one record, 10 cm at the end",
        "jump slow.Qx",
        records=add_values("slow", EAST, lambda t: 0.2 * np.maximum(t / t[-1] - 0.5, 0.0)),
    ),
    Mistake(
        "a slowly varying error of 20 cm in one record",
        "prior-conflict middle.platform.tilt.north",
        records=add_values("middle", EAST, lambda t: 0.2 * (t / t[-1]) ** 2),
    ),
    Mistake(
        "a slowly varying error of 20 cm in one record",
        "prior-conflict middle.platform.tilt.north",
        records=add_values("middle", EAST, lambda t: 0.2 * (t / t[-1]) ** 2),
        estimated=True,
    ),
    Mistake(
        "a bias drift of 50 ug in one record",
        "bias-drifts middle.Qx",
        records=add_values("middle", EAST, drifting_bias(50e-6)),
    ),
    Mistake(
        "a bias drift of 50 ug in one record",
        "bias-drifts middle.Qx",
        records=add_values("middle", EAST, drifting_bias(50e-6)),
        estimated=True,
        state="reservations",
    ),
    *(
        Mistake(
            "a bias increase of 500 ug in the first quarter of the fastest record",
            "bias-drifts fast.Qx",
            records=add_values("fast", EAST, settling_bias(500e-6, 0.25)),
            estimated=estimated,
        )
        for estimated in (False, True)
    ),
    Mistake(
        "a bend over the whole length of a record, 20 cm in the middle",
        "jump fast.Qx",
        records=add_values("fast", EAST, lambda t: 0.2 * np.sin(np.pi * t / t[-1])),
        estimated=True,
    ),
    Mistake(
        "a slowly varying error of 20 cm in one record, proportional to t^3",
        "bias-drifts fast.Qx",
        records=add_values("fast", EAST, lambda t: 0.2 * (t / t[-1]) ** 3),
        estimated=True,
    ),
    Mistake(
        "a K_III of 2e-5 g/g^3 omitted from the model",
        "term-missing Qx.K_III",
        truth=((K_II, f'{K_II}\nK_III = "2e-5 g/g^3"'),),
        state="reservations",
    ),
    Mistake(
        "stated noise half the actual noise",
        "wrong-noise Qx",
        description=((NOISE, NOISE.replace("0.01", "0.005")),),
        state="reservations",
    ),
    Mistake(
        "stated noise twice the actual noise",
        "wrong-noise Qy",
        description=((NOISE, NOISE.replace("0.01", "0.02")),),
        state="reservations",
    ),
    Mistake(
        "gravity of 9.7066 m/s^2 instead of 9.8066 m/s^2",
        "wrong-input site.gravity",
        description=(('gravity = "9.8066 m/s^2"', 'gravity = "9.7066 m/s^2"'),),
    ),
    Mistake(
        "clock fast by 0.2 %",
        "prior-conflict platform.tilt",
        records=multiply_column(None, TIME, 1.002),
    ),
    Mistake(
        "time in ms instead of s",
        "Is the time column in seconds rather than milliseconds?",
        description=(('column = "time_s", unit = "s"', 'column = "time_s", unit = "ms"'),),
        state="",
    ),
    Mistake(
        "angle in deg instead of rad",
        "Is the angle column in radians?",
        description=(('"angle_rad", unit = "rad"', '"angle_rad", unit = "deg"'),),
        state="",
    ),
    Mistake(
        "a run with the opposite sense of rotation",
        "reverse the sign of the rate",
        description=(('rate = "1 rev/s"', 'rate = "-1 rev/s"'),),
        state="",
    ),
    Mistake(
        "rate of 1.2 rev/s instead of 1 rev/s for one run",
        "check the stated rate and the units of the record",
        description=(('rate = "1 rev/s"', 'rate = "1.2 rev/s"'),),
        state="",
    ),
    Mistake(
        "a K_III of 2e-4 g/g^3, twice the credible size, omitted from the model",
        "term-missing Qx.K_III",
        truth=((K_II, f'{K_II}\nK_III = "2e-4 g/g^3"'),),
        state="reservations",
    ),
    Mistake(
        "scale error of 1.5 % in the fastest record, similar in effect to such a K_III",
        "wrong-scale fast.Qx",
        records=multiply_column("fast", EAST, 0.985),
    ),
    Mistake(
        "a jump of 2 cm in one record",
        "jump slow.Qy",
        records=add_values("slow", NORTH, make_step(0.02, 0.7)),
        state="reservations",
    ),
)


def table_row(mistake):
    """Return the documentation table row of a mistake."""
    noise = "estimated" if mistake.estimated else "given"
    if not mistake.state:
        return f'| {mistake.words} | {noise} | refused: "{mistake.says}" |'
    return f"| {mistake.words} | {noise} | {mistake.state}: `{mistake.says.replace(' ', '` `')}` |"


def test_documentation_table_matches_mistakes():
    page = PAGE.read_text(encoding="utf-8")
    table = page[page.index("| error | noise |") :].split("\n\n")[0].splitlines()
    assert table[2:] == [table_row(mistake) for mistake in MISTAKES]
    assert len(MISTAKES) >= 25


def mistake_id(mistake):
    return mistake.words + (", noise estimated" if mistake.estimated else "")


@pytest.fixture(scope="module")
def sound_records(tmp_path_factory):
    return make_records(tmp_path_factory.mktemp("sound"))


@pytest.mark.parametrize("estimated", [False, True])
def test_sound_campaign_is_good(sound_records, tmp_path, estimated):
    result = calibrate(
        make_mistaken_campaign(tmp_path, Mistake("", "", estimated=estimated), sound_records)
    )
    assert (result.state, result.findings) == ("good", [])


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MISTAKES, ids=mistake_id)
def test_mistake_is_named(mistake, sound_records, tmp_path):
    records = make_records(tmp_path / "other", *mistake.truth) if mistake.truth else sound_records
    folder = make_mistaken_campaign(tmp_path / "mistaken", mistake, records)
    if not mistake.state:
        with pytest.raises(CounterspinError) as refused:
            calibrate(folder)
        assert mistake.says in " ".join(str(refused.value).split())
        return
    result = calibrate(folder)
    first = result.findings[0]
    assert f"{first.code} {first.subject}" == mistake.says
    assert result.state == mistake.state


ONE_READING = """
[[runs]]
name = "at rest"
motion = "static"
attitude = "0 deg about north"
reading = { Qx = "0.0050321 ± 1e-5 g", Qy = "-0.003 ± 1e-5 g" }
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "mistake",
    [
        Mistake("", "wrong-scale middle.Qx", records=multiply_column("middle", EAST, 1.002)),
        Mistake("", "jump slow.Qy", records=add_values("slow", NORTH, make_step(0.02, 0.7))),
        Mistake(
            "",
            "wrong-angle records.angle",
            records=add_values(None, ANGLE, lambda t: math.radians(1.0)),
        ),
        Mistake("", "wrong-noise Qx", description=(('"0.01 m"\n', '"0.004 m"\n'),)),
        Mistake("", ""),
    ],
    ids=["scale", "jump", "angle", "noise", "none"],
)
def test_mistake_in_record_is_named_with_readings(mistake, sound_records, tmp_path):
    folder = make_mistaken_campaign(tmp_path, mistake, sound_records)
    text = (folder / "campaign.toml").read_text(encoding="utf-8")
    at = text.index("[simulation]") if "[simulation]" in text else len(text)
    (folder / "campaign.toml").write_text(text[:at] + ONE_READING + text[at:], encoding="utf-8")
    result = calibrate(folder)
    first = [f"{finding.code} {finding.subject}" for finding in result.findings][:1]
    assert first == [mistake.says] * bool(mistake.says)


def test_readings_remain_in_fit_while_noise_is_estimated_again(
    sound_records, tmp_path, monkeypatch
):
    mistake = Mistake(
        "", "", records=multiply_column("middle", EAST, 1.002), description=((NOISE, "\n"),)
    )
    folder = make_mistaken_campaign(tmp_path, mistake, sound_records)
    text = (folder / "campaign.toml").read_text(encoding="utf-8")
    at = text.index("[simulation]") if "[simulation]" in text else len(text)
    (folder / "campaign.toml").write_text(text[:at] + ONE_READING + text[at:], encoding="utf-8")
    again = []

    def record_request(before, fit, requests):
        again.append((fit, reestimate(before, fit, requests)))
        return again[-1][1]

    monkeypatch.setattr(search, "reestimate", record_request)
    calibrate(folder)
    assert again
    for fit, after in again:
        assert len(fit.observations) > len(fit.design_blocks)
        assert after.fit.observations == fit.observations


def test_common_bias_drift_is_named_with_platform_drift(sound_records, tmp_path):
    """Both grow with t^3: 5e-7 g/s is 300 typical bias drifts or 11 typical platform drifts."""
    mistake = Mistake("", "", records=add_values(None, EAST, warming_bias(5e-7)))
    (finding,) = calibrate(make_mistaken_campaign(tmp_path, mistake, sound_records)).findings
    assert (finding.subject, finding.contradicts) == ("platform.drift.north", True)
    assert "Qx" in finding.as_well
    assert "bias drift of Qx" in finding.text


@pytest.mark.slow
@pytest.mark.parametrize(("observable", "unit"), [("velocity", "m/s"), ("specific_force", "m/s^2")])
@pytest.mark.parametrize(("fast", "alone"), [(1e-4, False), (-1e-4, True)])
def test_clock_error_is_named_with_equivalent_causes(observable, unit, fast, alone, tmp_path):
    """A relative error e is equivalent to -2 e of the radius, or of one scale factor.

    Among equivalent causes, stated inputs come first.
    """
    text = re.sub(r"start_.*\n", "", CORRECT_DESCRIPTION).replace('"0.01 m"', f'"1e-4 {unit}"')
    text = text.replace("displacement =", f"{observable} =").replace(' "m" }', f' "{unit}" }}')
    if alone:
        text = re.sub(r"\[(accelerometers|truth)\.Qy\](\n[a-zK].*)+", "", text)
    simulate(write_description(tmp_path / "true", text), tmp_path / "made")
    for record in (tmp_path / "made").glob("*.csv"):
        rows = np.loadtxt(record, delimiter=",", skiprows=1)
        rows[:, TIME] *= 1.0 + fast
        head = record.read_text("utf-8").partition("\n")[0]
        np.savetxt(record, rows, delimiter=",", header=head, comments="", fmt="%.15g")
    first = calibrate(write_description(tmp_path / "made", text).parent).findings[0]
    named = [first.subject, *first.as_well]
    if alone:
        assert {"records.clock", "centrifuge.radius", "Qx.K_I", "Qx"} <= {*named[:4]}
        assert "would explain the records equally well: " in first.text
        assert "recorder clock error" in first.text
    else:
        assert named == ["records.clock", "centrifuge.radius"]
        assert "x 1e-4 instead" in first.text or "x 1e-5 instead" in first.text


VELOCITIES = f"""{PLACE}
[accelerometers.Qx]
input_axis = "east"
pendulous_axis = "down"
bias = "0.005 ± 2e-6 g"
scale_factor = "1.002 ± 5e-6 g/g"
velocity = {{ column = "east", unit = "m/s" }}

[noise]
velocity = "1e-3 m/s"

{format_runs("slow", "middle", "fast")}
[simulation]
sampling_rate = "20 Hz"
revolutions = 30
seed = 2

[truth.Qx]
K_F = "0.005 g"
K_I = "1.002 g/g"
K_II = "2e-5 g/g^2"
K_III = "3e-6 g/g^3"
"""


@pytest.mark.parametrize(("ppm", "way"), [(1000.0, "fell"), (-1000.0, "rose")])
def test_frequency_response_is_named_before_stretch(tmp_path, ppm, way):
    """The gain varies with the square of the rate; the equivalent stretch is 200 typical sizes."""
    simulate(write_description(tmp_path, VELOCITIES), tmp_path / "made")
    for run, part in (("slow", 0.25), ("middle", 0.5), ("fast", 1.0)):
        file = tmp_path / "made" / f"{run}.csv"
        head, *lines = file.read_text().splitlines()
        rows = np.array([[float(cell) for cell in line.split(",")] for line in lines])
        names = head.split(",")
        angle, east = (
            next(k for k, s in enumerate(names) if s.startswith(w)) for w in ("ang", "e")
        )
        waves = np.column_stack([np.cos(rows[:, angle]), np.sin(rows[:, angle])])
        slow = np.vander(rows[:, 0] / rows[-1, 0], 4)
        both = np.linalg.lstsq(np.column_stack([waves, slow]), rows[:, east], rcond=None)[0]
        rows[:, east] -= 1e-6 * ppm * part**2 * (waves @ both[:2])
        written = [",".join(map(repr, row)) for row in rows.tolist()]
        file.write_text("\n".join([head, *written]) + "\n")
    first = calibrate(tmp_path / "made").findings[0]
    assert (first.code, first.subject) == ("frequency-response", "Qx")
    match = re.search(
        rf"gain {way} .* of \(?([\d.]+) ± ([\d.]+)\)?( x 1e3)? ppm at 1 Hz", first.text
    )
    size, u = (float(x) * (1e3 if match.group(3) else 1.0) for x in match.groups()[:2])
    assert abs(size - 1000.0) < 4.0 * u
    assert u < 100.0


def calibrate_force(folder, symbol, value, assume=""):
    """Calibrate specific-force records of an accelerometer with an additional term."""
    text = replace_parts(
        VELOCITIES,
        ("[noise]", f"[model]\n{assume}\n[noise]"),
        ("velocity = {", "specific_force = {"),
        ('"m/s" }', '"m/s^2" }'),
        ('velocity = "1e-3 m/s"', 'specific_force = "1e-4 m/s^2"'),
    )
    simulate(write_description(folder, f'{text}{symbol} = "{value}"\n'), folder / "made")
    return calibrate(folder / "made")


ODD = [("K_5", "1e-8 g/g^5"), ("K_I_asym", "2e-5 g/g")]


@pytest.mark.parametrize(("symbol", "value"), [*ODD, ("K_0_asym", "4e-5 g")])
def test_wrongly_assumed_asymmetry_or_fifth_order_is_named(tmp_path, symbol, value):
    """The finding does not name K_OQ, K_4, a stretch or a latitude."""
    first = calibrate_force(tmp_path, symbol, value, f'assume = ["{symbol}"]\n').findings[0]
    assert (first.code, first.subject) == ("term-missing", f"Qx.{symbol}")


@pytest.mark.parametrize(("symbol", "value"), [*ODD, ("K_0_asym", "1e-5 g")])
def test_uncertainty_covers_typical_asymmetry_or_fifth_order(tmp_path, symbol, value):
    result = calibrate_force(tmp_path, symbol, value)
    assert (result.state, result.findings) == ("good", [])
    for name, true in {"K_F": 5e-3, "K_I": 1.002, "K_II": 2e-5}.items():
        c = result[f"Qx.{name}"]
        assert abs(c.value - true) < 3.0 * c.u


def calibrate_few_force_rows(folder, *changes, gain=1.0):
    """Calibrate specific-force records with few rows, and with another gain in the fast run."""
    text = replace_parts(
        VELOCITIES,
        ("velocity = {", "specific_force = {"),
        ('"m/s" }', '"m/s^2" }'),
        ('velocity = "1e-3 m/s"', 'specific_force = "1e-4 m/s^2"'),
    )
    text = f'{text}\n[truth.noise]\nspecific_force = "1e-4 m/s^2"\nangle = "1e-6 rad"\n'
    text = re.sub('sampling_rate = ".*?"', 'sampling_rate = "12 Hz"', text)
    simulate(write_description(folder, text), folder / "made")
    record = folder / "made" / "fast.csv"
    table = pl.read_csv(record)
    table.with_columns(pl.col("east") * gain).write_csv(record)
    stated = (folder / "made" / "campaign.toml").read_text()
    return calibrate(write_description(folder / "made", replace_parts(stated, *changes)).parent)


def find_k_iii_shift(result):
    k_iii = result.accelerometers["Qx"].coefficients["K_III"]
    return (k_iii.value - 3e-6) / k_iii.u  # quoted in the changelog


def test_gain_of_one_run_does_not_pass_as_ripple(tmp_path):
    """K_III, K_5 and the ripples absorb it, the ripples beyond the noise of the angle."""
    (tmp_path / "right").mkdir()
    (tmp_path / "wrong").mkdir()
    assert calibrate_few_force_rows(tmp_path / "right").findings == []
    wrong = calibrate_few_force_rows(tmp_path / "wrong", gain=1.0 + 5e-5)
    assert wrong.state == "contradicted"
    assert "scale of the record of Qx in fast" in wrong.findings[0].text
    assert find_k_iii_shift(wrong) == pytest.approx(17.0, abs=0.5)


def test_wrong_sign_of_latitude_is_named(tmp_path):
    wrong = calibrate_few_force_rows(tmp_path, ('"45.75 deg"', '"-45.75 deg"'))
    assert wrong.state == "contradicted"
    finding = wrong.findings[0]
    assert (finding.code, finding.subject) == ("wrong-input", "site.latitude")
    assert "with a latitude of 45.75 deg instead of the stated -45.75 deg" in finding.text
    assert find_k_iii_shift(wrong) == pytest.approx(11.0, abs=0.5)
