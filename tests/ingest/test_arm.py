"""From a table of readings on an arm to a description."""

import math

import numpy as np
import pytest
from raising import raises
from scipy.stats import chi2
from workbooks import write_workbook

from counterspin.calibration.calibrate import calibrate
from counterspin.campaign.description import read_campaign
from counterspin.errors import CampaignError
from counterspin.ingest.arm import make_arm_draft
from counterspin.ingest.contents import read_files
from counterspin.ingest.description import make_draft, write_description
from counterspin.ingest.overview import guess_test

EARTH_RATE, GRAVITY, LATITUDE = 7.292115e-5, 9.8066, math.radians(45.75)
PLACE = {"gravity": "9.8066", "latitude": "45.75"}
SAID = PLACE | {"radius": "1,0 ± 1e-3", "sense": "cw"}
TRUE = {"K_F": 2e-3, "K_I": 1.0004, "K_II": 15e-6}
RPM = (30.0, 42.0, 67.0, 95.0, 116.0, 134.0)
NOISE = 2e-6  # mA


def centripetal_force(rpm, radius=1.0):
    """Return the centripetal force of an arm that turns clockwise, g: the closed form."""
    w = -rpm * 2.0 * math.pi / 60.0
    return radius * (w**2 + 2.0 * w * EARTH_RATE * math.sin(LATITUDE)) / GRAVITY


def simulate_reading(force, seed=None, heated=0.0):
    """Return what is read at a specific force along the input axis, mA, with noise of a seed."""
    noise = NOISE * seed.standard_normal() if seed else 0.0
    indicated = TRUE["K_F"] + TRUE["K_I"] * force + TRUE["K_II"] * force**2 + heated
    return 1.25 * indicated + noise


def make_rows(*, inward="in", outward="out", up="up", down="down"):
    """Return rows of mounting, rpm and mA."""
    rows = [[up, 0.0, simulate_reading(1.0)], [down, 0.0, simulate_reading(-1.0)]] * 2
    for rpm in RPM * 2:
        rows += [
            [inward, rpm, simulate_reading(centripetal_force(rpm))],
            [outward, rpm, simulate_reading(-centripetal_force(rpm))],
        ]
    return rows


def write_table(path, rows, head="side,n_rpm,out_mA"):
    lines = [head, *(",".join(str(cell) for cell in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def draft_arm(path, **answers):
    return make_arm_draft(read_files([path]), SAID | {"out_mA sensitivity": "1,25"} | answers)


def test_german_table_is_understood(tmp_path):
    rows = make_rows(inward="innen", outward="außen", up="oben", down="unten")
    lines = ["Prüfstand 3", "Nr;Lage;Drehzahl;Signal", ";;1/min;mA"]
    lines += [
        ";".join([str(n), *(str(c).replace(".", ",") for c in row)]) for n, row in enumerate(rows)
    ]
    path = tmp_path / "arm.csv"
    path.write_text("\n".join(lines) + "\n", encoding="latin-1")
    looks = read_files([path])
    assert guess_test(looks) == "arm"
    draft = make_draft(looks, SAID | {"Signal sensitivity": "1,25"}, "arm")
    assert draft.open_questions == []
    assert "4 readings at rest (rate 0)" in draft.statements
    document = draft.make_document(tmp_path / "camp")
    assert list(document)[2:] == ["site", "centrifuge", "accelerometers", "readings", "model"]
    horizontal, vertical = {"pendulous": "up"}, {"pendulous": "outward"}
    assert document["readings"] == {
        "file": "../arm.csv",
        "decimal": ",",
        "columns": {"rate": "Drehzahl", "mounting": "Lage", "reading": {"A": "Signal"}},
        "motion": "arm",
        "rate_unit": "1/min",
        "sense": "clockwise",
        "mountings": {
            "oben": {"input": "up"} | vertical,
            "unten": {"input": "down"} | vertical,
            "innen": {"input": "inward"} | horizontal,
            "außen": {"input": "outward"} | horizontal,
        },
    }
    campaign = read_campaign(write_description(draft, tmp_path / "camp"))
    assert [reading.rate for reading in campaign.readings[:5]] == [0.0] * 4 + [
        pytest.approx(-math.pi)
    ]


def test_workbook_with_radii_and_names_is_understood(tmp_path):
    radii = {"inside": 1000.0, "outside": 900.0}
    rows = [["Run", "Side", "Speed", "Radius", "Output", "u", "Temp"]]
    rows += [[None, None, "rad/s", "mm", "V", "V", "degC"]]
    for n, (word, radius) in enumerate(radii.items()):
        force = (1.0 - 2.0 * n) * centripetal_force(60.0, radius / 1e3)
        rows.append([f"no {n}", word, -2.0 * math.pi, radius, simulate_reading(force), 2e-6, 23.0])
    rows += [["rest", "up", 0.0, None, simulate_reading(1.0), 2e-6, 23.0]]
    path = write_workbook(tmp_path / "t.xlsx", {"Notes": [["hello"]], "Data": rows})
    looks = read_files([path])
    assert guess_test(looks) == "arm"
    answers = PLACE | {"sense": "ccw", "inside radius": "1.0002 ± 1e-4 m"}
    arm_draft = make_arm_draft(looks, answers | {"Output sensitivity": "1.25"})
    assert arm_draft.open_questions == []
    document = arm_draft.make_document(tmp_path)
    assert document["centrifuge"] == {"radius": "1.0002 ± 1e-4 m"}
    assert document["model"] == {
        "priors": {
            "centrifuge.radius.inside": "1.0002 ± 1e-4 m",
            "centrifuge.radius.outside": "0.9 m",
        }
    }
    assert document["readings"]["columns"] == {
        "rate": "Speed",
        "mounting": "Side",
        "reading": {"A": "Output"},
        "u": {"A": "u"},
        "name": "Run",
        "temperature": "Temp",
    }
    assert "sense" not in document["readings"]


def test_readings_determine_axes_of_unnamed_mountings(tmp_path):
    """The mountings read plus and minus the acceleration; the reading at rest is 1 g."""
    path = write_table(tmp_path / "t.csv", [["", *row[1:]] for row in make_rows(inward="")[::2]])
    arm = draft_arm(path)
    guesses = {question.key: question.guess for question in arm.questions}
    assert guesses["axis"] == "inward"
    assert guesses["axis at rest"] == "up"
    # K_I, and what K_II adds to the readings of one side.
    assert "The data suggest about 1.251 mA/g." in next(
        question.text for question in arm.questions if "sensitivity" in question.key
    )
    readings = arm.make_document(tmp_path)["readings"]
    assert readings["axes"] == {"input": "inward", "pendulous": "up"}
    assert readings["axes_at_rest"] == {"input": "up", "pendulous": "outward"}
    path = write_table(tmp_path / "ab.csv", make_rows(inward="A", outward="B"))
    guesses = {question.key: question.guess for question in draft_arm(path).questions}
    assert (guesses["A axis"], guesses["B axis"]) == ("inward", "outward")
    path = write_table(
        tmp_path / "level.csv", [*make_rows()[4:], ["x", 134.0, simulate_reading(0.0)]]
    )
    guesses = {question.key: question.guess for question in draft_arm(path).questions}
    assert guesses["x axis"] is None


def test_forward_and_backward_are_mountings_along_radius(tmp_path):
    path = write_table(tmp_path / "t.csv", make_rows(inward="forward", outward="backward"))
    arm = draft_arm(path)
    guesses = {question.key: question.guess for question in arm.questions}
    assert (guesses["forward axis"], guesses["backward axis"]) == ("inward", "outward")
    assert "mounting 'forward': input axis inward, according to the readings" in arm.statements


def test_readings_at_rest_determine_axes(tmp_path):
    rows = [*make_rows(up="P1", down="P2"), ["P3", 0.0, simulate_reading(0.0)]]
    guesses = {q.key: q.guess for q in draft_arm(write_table(tmp_path / "t.csv", rows)).questions}
    assert [guesses[f"P{n} axis"] for n in (1, 2, 3)] == ["up", "down", "forward"]


def test_sense_column_is_used(tmp_path):
    """No sense is requested; the Earth's rate increases one sense and decreases the other."""
    rows = [[word, "cw" if rpm else "", rpm, value] for word, rpm, value in make_rows()]
    against = [["in", "ccw", rpm, simulate_reading(-centripetal_force(-rpm))] for rpm in RPM]
    path = write_table(tmp_path / "b.csv", [*rows, *against], "side,Direction,n_rpm,out_mA")
    answers = {**SAID, "out_mA sensitivity": "1.25"}
    del answers["sense"]
    arm_draft = make_arm_draft(read_files([path]), answers)
    assert arm_draft.open_questions == []
    assert arm_draft.make_document(tmp_path)["readings"]["columns"]["sense"] == "Direction"
    assert "sense" not in arm_draft.make_document(tmp_path)["readings"]
    campaign = read_campaign(write_description(arm_draft, tmp_path / "camp"))
    signs = [math.copysign(1.0, reading.rate) for reading in campaign.readings if reading.rate]
    assert signs == [-1.0] * 24 + [1.0] * 6


def test_coarse_rate_is_reported(tmp_path):
    rows = [["in", 30.0, 1.0], ["out", 67.0, -1.0]]
    text = " ".join(draft_arm(write_table(tmp_path / "t.csv", rows)).statements)
    assert (
        "column 'n_rpm' has so few digits that a change in the last digit changes the "
        "acceleration by 7 %" in text
    )
    rows[0][1] = 30.00012
    assert "few digits" not in " ".join(draft_arm(write_table(tmp_path / "f.csv", rows)).statements)


def test_time_column_requires_more_readings_at_rest(tmp_path):
    """Without drift, two readings at rest per position suffice; with drift one is missing."""
    rows = [[n, *row] for n, row in enumerate(make_rows())]
    for drift, rest_rows in ((True, rows[:2] + rows[3:]), (False, rows)):
        path = write_table(tmp_path / "t.csv", rest_rows, "time_s,side,n_rpm,out_mA")
        assert [q.key for q in draft_arm(path).open_questions] == (["u"] if drift else [])


def test_output_zero_is_found(tmp_path):
    rows = [[*row[:2], round(2.5 + 0.1 * row[2], 7)] for row in make_rows(up="", down="")[::2]]
    arm = draft_arm(write_table(tmp_path / "t.csv", rows, "side,n_rpm,out_V"))
    guesses = {question.key: question.guess for question in arm.questions}
    assert guesses["axis at rest"] == "up"
    assert guesses["out_V zero"] == "2.5 V"
    assert "The data suggest about 0.1251 V/g." in " ".join(
        question.text for question in arm.questions
    )


def test_mounting_name_contradicting_readings_is_reported(tmp_path):
    path = write_table(tmp_path / "t.csv", make_rows(inward="out", outward="in"))
    text = "mounting 'out': outward according to the name, but inward according to the readings"
    text += " if the sensitivity is positive"
    assert text in draft_arm(path).statements


@pytest.mark.parametrize(
    ("pendulous", "along"),
    [
        ("up", ["up", "up", "up", "up"]),
        ("down", ["down", "down", "down", "down"]),
        ("forward", ["forward", "outward", "backward", "inward"]),
        ("backward", ["backward", "inward", "forward", "outward"]),
    ],
)
def test_pendulous_axis_rotates_with_input_axis(tmp_path, pendulous, along):
    words = ["in", "tangential", "out", "backward"]
    rows = [[word, 30.0, value] for word, value in zip(words, [1.0, 0.0, -1.0, 0.0], strict=True)]
    path = write_table(tmp_path / "t.csv", rows)
    arm = draft_arm(path, u="2e-6", **{"pendulous axis": pendulous})
    mountings = arm.make_document(tmp_path)["readings"]["mountings"]
    assert [mountings[word]["pendulous"] for word in words] == along
    # Turned about up, all are the same instrument: the output axes are as the input axes are.
    readings = read_campaign(write_description(arm, tmp_path / "camp")).readings
    upward = [reading.axes.matrix[:, 2] for reading in readings]
    assert np.allclose(upward, upward[0])
    assert [round(float(np.linalg.det(reading.axes.matrix))) for reading in readings] == [
        1,
        1,
        1,
        1,
    ]


#: Rates in each mounting, how often each, mountings, readings at rest in each position -> whether
#: they show their noise.
@pytest.mark.parametrize(
    ("rates", "times", "sides", "rests", "shown"),
    [
        (6, 1, 1, 2, True),
        (5, 1, 1, 2, False),
        (5, 1, 2, 2, True),
        (4, 1, 2, 2, False),
        (4, 2, 2, 2, True),
        (6, 1, 2, 0, True),
        (6, 2, 2, 1, False),
    ],
)
def test_too_few_readings_require_u(tmp_path, rates, times, sides, rests, shown):
    seed = np.random.default_rng(1)
    rows = [
        [word, 0.0, simulate_reading(f, seed)] for word, f in [("up", 1.0), ("down", -1.0)] * rests
    ]
    for rpm in np.repeat(np.linspace(30.0, 130.0, rates), times).tolist():
        rows += [["in", rpm, simulate_reading(centripetal_force(rpm), seed)]]
        rows += [["out", rpm, simulate_reading(-centripetal_force(rpm), seed)]] * (sides - 1)
    arm = draft_arm(write_table(tmp_path / "t.csv", rows))
    assert [question.key for question in arm.open_questions] == ([] if shown else ["u"])
    if shown:
        write_description(arm, tmp_path / "camp")
        calibrate(tmp_path / "camp")  # which refuses readings that are too few
        return
    assert arm.open_questions[0].text.endswith(
        "The noise cannot be estimated from so few readings."
    )
    arm = draft_arm(tmp_path / "t.csv", u="2e-6")
    campaign = read_campaign(write_description(arm, tmp_path / "camp"))
    assert [reading.u for reading in campaign.readings] == pytest.approx([2e-6 / 1.25] * len(rows))


@pytest.mark.parametrize(
    ("head", "number", "unit"),
    [
        ("side,period_s,out_mA", lambda rpm: 60.0 / rpm, "s"),
        ("side,omega_rad_s,out_mA", lambda rpm: rpm * math.pi / 30.0, "rad/s"),
        ("side,Drehrate_deg_s,out_mA", lambda rpm: 6.0 * rpm, "deg/s"),
    ],
)
def test_rate_formats_return_same_campaign(tmp_path, head, number, unit):
    rows = [[word, number(rpm) if rpm else 0.0, value] for word, rpm, value in make_rows()]
    looks = read_files([write_table(tmp_path / "t.csv", rows, head)])
    assert guess_test(looks) == "arm"
    arm_draft = make_arm_draft(looks, SAID | {"out_mA sensitivity": "1.25"})
    assert arm_draft.make_document(tmp_path)["readings"]["rate_unit"] == unit
    assert "The data suggest about 1.25 mA/g." in " ".join(q.text for q in arm_draft.questions)
    campaign = read_campaign(write_description(arm_draft, tmp_path / "camp"))
    rates = [reading.rate for reading in campaign.readings if reading.rate]
    assert rates == pytest.approx([-rpm * math.pi / 30.0 for _, rpm, _ in make_rows() if rpm])


def test_invalid_arm_table_raises(tmp_path):
    path = write_table(tmp_path / "t.csv", make_rows())
    with raises("wrong-usage", "name a single file"):
        make_draft(read_files([path, path]), {}, "arm")
    rows = [["in", 30.0 + n, 1.0 + n, simulate_reading(centripetal_force(30.0))] for n in range(2)]
    path = write_table(tmp_path / "r.csv", rows, "side,n_rpm,radius_m,out_mA")
    answers = PLACE | {"sense": "cw", "out_mA sensitivity": "1.25", "u": "2e-6"}
    with pytest.raises(CampaignError, match=r"a mounting have 2 different radii \(in\)"):
        make_arm_draft(read_files([path]), answers).make_document(tmp_path)
    rows = [*make_rows()[:5], ["in", "", simulate_reading(centripetal_force(42.0))]]
    arm = draft_arm(write_table(tmp_path / "e.csv", rows), u="2e-6")
    with raises("missing-value", "line 7", "write 0"):
        write_description(arm, tmp_path / "camp")


def simulate_unstated_terms(force, warmth, sizes):
    """Return the contribution of asymmetries, K_5, K_OQ and temperature slopes, g."""
    of_bias, of_scale, fifth, odd, bias_slope, scale_slope = sizes
    asymmetries = 0.5 * (of_bias * math.copysign(1.0, force) + of_scale * abs(force))
    slopes = (bias_slope + scale_slope * force) * warmth
    return asymmetries + fifth * force**5 + odd * force * abs(force) + slopes


@pytest.mark.slow
def test_estimates_scatter_by_u(tmp_path):
    """Draw the truth from the stated priors, otherwise from the default priors."""
    trials, z = 8, []
    for trial in range(trials):
        seed = np.random.default_rng(trial)
        radius = {
            "in": 1.0 + 1e-3 * seed.standard_normal(),
            "out": 1.0 + 1e-3 * seed.standard_normal(),
        }
        tilt = {word: 5e-5 * seed.standard_normal() for word in radius}
        heating = 1e-7 * seed.standard_normal()
        sizes = np.array([5e-6, 1e-5, 1e-8, 1e-6, 5e-6, 1e-4]) * seed.standard_normal(6)
        warmth = iter(np.linspace(-0.5, 0.5, 4 + 4 * len(RPM)).tolist())
        rows = [
            [
                word,
                0.0,
                simulate_reading(f, seed, simulate_unstated_terms(f, next(warmth), sizes)),
                NOISE,
            ]
            for word, f in [("up", 1.0), ("down", -1.0)] * 2
        ]
        for rpm in RPM * 2:
            for word, sign in (("in", 1.0), ("out", -1.0)):
                force = centripetal_force(rpm, radius[word])
                more = heating * force**2 + simulate_unstated_terms(
                    sign * force, next(warmth), sizes
                )
                value = simulate_reading(sign * force + tilt[word], seed, more)
                rows.append([word, rpm, value, NOISE])
        path = write_table(tmp_path / f"{trial}.csv", rows, "side,n_rpm,out_mA,u_mA")
        write_description(draft_arm(path), tmp_path / f"c{trial}")
        coefficients = calibrate(tmp_path / f"c{trial}").accelerometers["A"].coefficients
        z.append(
            [
                (coefficients[name].value - true) / coefficients[name].u
                for name, true in TRUE.items()
            ]
        )
    squares = np.sum(np.square(z), axis=0)
    assert (squares > chi2.ppf(1e-4, trials)).all()
    assert (squares < chi2.ppf(1.0 - 1e-4, trials)).all()


def test_wrong_sense_does_not_fit(tmp_path):
    """The Earth's rate adds 2 w Omega sin(latitude) R: 3e-4 g of difference at 14 rad/s."""
    rows = [[*row, NOISE] for row in make_rows()]
    path = write_table(tmp_path / "t.csv", rows, "side,n_rpm,out_mA,u_mA")
    write_description(draft_arm(path), tmp_path / "right")
    write_description(draft_arm(path, sense="ccw"), tmp_path / "wrong")
    assert calibrate(tmp_path / "right").accelerometers["A"].residual.rms < 1e-8
    # The radii and the terms with default priors leave nearly half of the noise: 0.496 of it.
    assert calibrate(tmp_path / "wrong").accelerometers["A"].residual.rms > 0.49 * NOISE / 1.25


LEVELS = [1.0, 2.0, 5.0, 10.0, 15.0]


def test_accelerations_at_positions_are_tumble(tmp_path):
    rows = [(angle, 20.0 * math.cos(math.radians(angle))) for angle in range(0, 360, 30)]
    lines = [f"{angle},{value:.6f},{value / 8.0:.6f}" for angle, value in rows]
    path = tmp_path / "t.csv"
    path.write_text("\n".join(["Position (deg),acc (m/s^2),Output (V)", *lines]) + "\n")
    assert guess_test(read_files([path])) == "tumble"
