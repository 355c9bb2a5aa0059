"""Tables of an arm as laboratories write them, each from the file to a result."""

import math

import numpy as np
import pytest
from workbooks import write_workbook

from counterspin.calibration.calibrate import calibrate
from counterspin.ingest.contents import read_files
from counterspin.ingest.description import make_draft, write_description
from counterspin.ingest.overview import guess_test

EARTH_RATE, GRAVITY, LATITUDE, RADIUS = 7.292115e-5, 9.8073, math.radians(48.2), 0.85
SAID = {"gravity": "9.8073 ± 1e-5", "latitude": "48.2", "radius": "0.85 ± 2e-4 m", "sense": "ccw"}
TRUE = {"K_F": 3e-3, "K_I": 1.0007, "K_II": 40e-6}
LEVELS, NOISE = (1.0, 2.0, 4.0, 7.0, 10.0, 14.0, 20.0), 1e-5
WAYS = {"in": 1.0, "out": -1.0, "up": 1.0, "down": -1.0}
RATES = [math.sqrt(level * GRAVITY / RADIUS) for level in LEVELS]


def centripetal_force(rate):
    """Return the centripetal force, g, with the Earth's rate: the closed form."""
    return RADIUS * (rate**2 + 2.0 * rate * EARTH_RATE * math.sin(LATITUDE)) / GRAVITY


def readings(sensitivity, zero=0.0, *, names=None, times=2, rests=("up", "down"), repeats=1):
    """Return rows of mounting, rate in rad/s and readings; at rest first and last."""
    seed = np.random.default_rng(11)
    at_rest = [(word, 0.0) for word in rests]
    turns = [(word, rate) for word in ("in", "out") for rate in RATES] * times
    rows = []
    for word, rate in [*at_rest, *turns, *at_rest]:
        force = WAYS[word] * (centripetal_force(rate) if rate else 1.0)
        powers = [1.0, force, force**2]
        indicated = float(np.dot(list(TRUE.values()), powers))
        noisy = indicated + NOISE * seed.standard_normal(repeats)
        values = (zero + sensitivity * noisy).tolist()
        rows.append(((names or {}).get(word, word), rate, *values))
    return rows


def rpm(rate):
    return round(rate * 30.0 / math.pi, 6)


def write_lines(path, lines, encoding="utf-8"):
    path.write_text("\n".join(lines) + "\n", encoding=encoding)
    return path


def in_degrees_and_volts(folder):
    """Rows are counted, ways of mounting have names that are no directions, half a supply is 0."""
    names = {"in": "Forward", "out": "Reverse", "up": "IA up", "down": "IA down"}
    rows = enumerate(readings(0.1, 2.5, names=names), 1)
    lines = [f"{n},{way},{math.degrees(w):.5f},{value:.8f}" for n, (way, w, value) in rows]
    return write_lines(folder / "t.csv", ["Test,Mounting,Table rate (deg/s),Output (V)", *lines])


def a_book_with_title_and_units(folder):
    rows = [["Prüfprotokoll Zentrifuge", None, None, "Seite 1"]]
    rows += [["Lage", "Drehzahl", "Spannung"], ["°", "U/min", "mV"]]
    rows += [
        [0 if way == "in" else 180, rpm(w), value] for way, w, value in readings(50.0, rests=())
    ]
    return write_workbook(folder / "t.xlsx", {"Messwerte": rows})


def german_in_hertz(folder):
    names = {"in": "radial innen", "out": "radial außen", "up": "oben", "down": "unten"}
    rows = enumerate(readings(1.25, names=names), 1)
    lines = [f"{n};{way};{w / 2 / math.pi:.8f};{value:.7f};1.25e-5" for n, (way, w, value) in rows]
    head = "Messung;Einbaulage;Drehfrequenz [Hz];Ausgang [mA];Messunsicherheit [mA]"
    return write_lines(
        folder / "t.csv", [head, *(line.replace(".", ",") for line in lines)], "cp1252"
    )


def repeats_in_columns(folder):
    lines = [
        f"{way};{rpm(w)};{a:.7f};{b:.7f};{c:.7f}"
        for way, w, a, b, c in readings(5.0, times=1, repeats=3)
    ]
    head = "Position;n [rpm];Reading 1 [V];Reading 2 [V];Reading 3 [V]"
    return write_lines(folder / "t.csv", [head, *lines])


def times_of_a_revolution(folder):
    names = {"in": "+1", "out": "-1"}
    lines = [
        f"{way}  {2 * math.pi / w if w else 0:.8f}  {value:.7f}"
        for way, w, value in readings(1.0, names=names)
    ]
    return write_lines(folder / "t.txt", ["pos  T_s  U_V", *lines])


def set_and_measured_rates(folder):
    names = {"in": "IA inboard", "out": "IA outboard", "up": "P1", "down": "P2"}
    lines = [
        f"{way},{rpm(w):.0f},{rpm(w)},{'850.0' if w else ''},{value:.7f}"
        for way, w, value in readings(1.25, names=names)
    ]
    head = "Mounting,Set rate (rpm),Measured rate (rpm),Radius (mm),Out mA"
    return write_lines(folder / "t.csv", ["# Centrifuge 2", head, *lines])


TABLES = {
    in_degrees_and_volts: 0.1,
    a_book_with_title_and_units: 50.0,
    german_in_hertz: 1.25,
    repeats_in_columns: 5.0,
    times_of_a_revolution: 1.0,
    set_and_measured_rates: 1.25,
}


def least_squares_u():
    """Return u of K_II by plain least squares; a mounting has a radius and a tilt of its own.

    Where nothing is stated, K_4 is known to 1e-9 g/g^4, and what the centripetal force warms, which
    looks like K_II, to 1e-7 g/g^2.
    """
    force = np.array([centripetal_force(rate) for rate in RATES] * 2)
    line = np.column_stack([np.ones_like(force), force])
    even = np.column_stack([force**2, force**4])
    along = np.hstack([line, 0.0 * line, even])
    against = np.hstack([0.0 * line, line, even])
    known = [0.0, 0.0, 0.0, 0.0, 0.0, 1e9]
    design = np.vstack([along / NOISE, against / NOISE, known])
    return math.hypot(math.sqrt(np.linalg.inv(design.T @ design)[4, 4]), 1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("write", TABLES, ids=lambda write: write.__name__)
def test_calibration_from_file_needs_only_sensitivity(tmp_path, write):
    looks = read_files([write(tmp_path)])
    assert guess_test(looks) == "arm"
    open_questions = make_draft(looks, SAID, "arm").open_questions
    # All but the nominal sensitivity follows from the table.
    assert [question.key.split()[-1] for question in open_questions] == ["sensitivity"]
    draft = make_draft(looks, SAID | {open_questions[0].key: f"{TABLES[write]}"}, "arm")
    write_description(draft, tmp_path / "camp")
    (result,) = calibrate(tmp_path / "camp").accelerometers.values()
    for name, true in TRUE.items():
        estimate = result.coefficients[name]
        assert abs(estimate.value - true) < 4.0 * estimate.u, name
    # Twenty degrees of freedom or more tell the noise to 16 % (1 sigma), beside other parts of u.
    # Repeats are three at half as many settings.
    assert 0.65 < result.coefficients["K_II"].u / least_squares_u() < 1.35
