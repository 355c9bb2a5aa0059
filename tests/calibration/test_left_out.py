"""The second uncertainty: what it would be if the model considered what it leaves out."""

import math

import pytest
from campaigns import SMALL, changed, write
from results import coefficient, result

from counterspin.calibration.calibrate import calibrate
from counterspin.calibration.left_out import decisive
from counterspin.calibration.pages.sections import sections
from counterspin.campaign.simulation import simulate
from counterspin.physics.terms import INPUTS, term

EXACT_INPUTS = (
    ('gravity = "9.8066 m/s^2"', 'gravity = "9.8066 ± 1e-4 m/s^2"'),
    ('latitude = "45.75 deg"', f'latitude = "45.75 ± {math.degrees(5e-6)!r} deg"'),
    ('radius = "2.5 m"', 'radius = "2.5 ± 1e-5 m"'),
)


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    folder = tmp_path_factory.mktemp("left-out")
    simulate(write(folder, SMALL, "plan.toml"), folder / "records")
    return folder / "records"


def again(records, folder, text, method):
    for record in records.glob("*.csv"):
        (folder / record.name).write_bytes(record.read_bytes())
    return calibrate(write(folder, text).parent, method=method)


def considering(left_out):
    """Return the description that considers all of that at its typical size."""
    terms = [symbol for symbol in left_out if symbol not in INPUTS]
    # The scale factor is stated where the accelerometer is.
    priors = [
        f'"{s}" = "{term(s).nominal!r} ± {term(s).typical!r} {term(s).unit}"'
        for s in terms
        if s != "K_I"
    ]
    model = (
        f'[model]\nterms = ["K_F", "K_II", "K_III"]\nconsidered = {terms!r}\n[model.priors]'
    ).replace("'", '"')
    text = changed(
        SMALL,
        *EXACT_INPUTS,
        ('"1.002 g/g"\ndisp', '"1.002 ± 1e-4 g/g"\ndisp'),
        ('"0.999 g/g"\ndisp', '"0.999 ± 1e-4 g/g"\ndisp'),
        ("[noise]\n", "\n".join([model, *priors, "", "[noise]\n"])),
    )
    # What is left out is reckoned as if the runs followed each other, ever warmer by 1 K in all.
    for name, start in (("slow", 0), ("middle", 80), ("fast", 120)):
        record = f'record = "{name}.csv"\n'
        when = f'time = "{start} s"\ntemperature = "{20.0 + start / 120.0!r} degC"\n'
        text = changed(text, (record, record + when))
    # The delay of the angle is an input of the records.
    angle = 'angle = { column = "angle_rad", unit = "rad" }'
    return changed(text, (angle, angle + '\ntiming_offset = "0 ± 1e-5 s"'))


@pytest.mark.parametrize("method", ["joint", "two-stage"])
def test_it_is_the_uncertainty_of_a_model_that_considers_all_of_it(records, tmp_path, method):
    plain = calibrate(records, method=method)
    left_out = plain.accelerometers["Qx"].left_out
    assert {"K_OO", "delta_O", "platform.tilt.north", "centrifuge.radius"} <= set(left_out)
    assert "K_I" in left_out  # stated as exact
    # The other accelerometer's own terms are those of its own axes.
    both = dict.fromkeys([*left_out, *plain.accelerometers["Qy"].left_out])
    if method == "two-stage":
        both.pop("K_III")  # asked for; that it is not known is no prior
    full = again(records, tmp_path, considering(both), method)
    compared = 0
    for name, accelerometer in plain.accelerometers.items():
        for symbol, c in accelerometer.coefficients.items():
            if not c.estimated or c.u_typical is None:
                continue
            compared += 1
            considered = full.accelerometers[name].coefficients[symbol]
            u = considered.u
            if method == "two-stage":
                unknown = accelerometer.left_out["K_III"]
                u = math.hypot(u, unknown.moves[symbol] * unknown.typical)
            assert c.u_typical == pytest.approx(u, rel=0.03), (name, symbol)
            assert c.u_typical > c.u
    assert compared == (6 if method == "joint" else 4)


def test_a_campaign_s_own_sizes_count(records, tmp_path):
    model = (
        '[model]\ntypical = { K_OO = "1e-8 g/g^2", "platform.drift" = "1e-5 deg/h" }\n\n[noise]\n'
    )
    small = again(records, tmp_path, changed(SMALL, ("[noise]\n", model)), "joint")
    usual = calibrate(records)
    one, other = (found.accelerometers["Qx"] for found in (small, usual))
    assert one.left_out["K_OO"].typical == 1e-8
    assert one.coefficients["K_II"].u == other.coefficients["K_II"].u
    assert one.coefficients["K_II"].u_typical < 0.3 * other.coefficients["K_II"].u_typical


@pytest.mark.parametrize("method", ["joint", "two-stage"])
def test_sizes_go_by_the_grade_of_the_accelerometer(records, tmp_path, method):
    text = changed(SMALL, ('input_axis = "north"', 'input_axis = "north"\ngrade = "tactical"'))
    result = again(records, tmp_path, text, method)
    for name, grade in (("Qx", "navigation"), ("Qy", "tactical")):
        left_out = result.accelerometers[name].left_out
        for symbol in ("K_OO", "delta_O", "platform.tilt.up"):
            if symbol in left_out:
                assert left_out[symbol].typical == term(symbol).sizes(grade).typical
        assert "K_OO" in left_out


def test_inputs_that_state_an_uncertainty_are_not_left_out(records, tmp_path):
    text = changed(SMALL, EXACT_INPUTS[0])
    found = again(records, tmp_path, text, "joint").accelerometers["Qx"]
    assert "site.gravity" not in found.left_out
    assert "centrifuge.radius" in found.left_out


def omitted(sensitivity, **more):
    return {"sensitivity": sensitivity, "unit": "g/g^2", **more}


def test_what_decides_is_named_by_coefficient():
    known = {
        "K_F": coefficient(0.005, 1e-6, "g"),
        "K_II": coefficient(2.7e-5, 1e-9, "g/g^2", u_typical=2e-6),
    }
    left_out = {
        "K_OO": omitted(1.0, typical=2e-6, moves={"K_II": 1.0, "K_F": 0.0}),
        "K_PP": omitted(0.0, typical=2e-6, moves={"K_II": 0.0, "K_F": -1.0}),
        "K_IP": omitted(4e-4, typical=2e-6, moves={"K_II": 4e-4, "K_F": 1e-3}),
    }
    found = result(coefficients=known, left_out=left_out).accelerometers["Qx"]
    assert {name: [e.symbol for e in own] for name, own in decisive(found).items()} == {
        "K_II": ["K_OO"],
        "K_F": ["K_PP"],
    }
    words = [block.text for block in sections(result(coefficients=known, left_out=left_out))[:5]]
    assert words[1].endswith("; ± 2.0 ug/g^2 with what the model leaves out at typical sizes")
    assert words[3].startswith("Qx is good if what its model leaves out is nothing: ")
    assert words[3].endswith(
        "typical sizes would move K_II by 2 ug/g^2 (K_OO, 2 ug/g^2); K_F by 2 ug (K_PP, 2 ug/g^2)."
    )


def test_old_results_are_judged_by_today_s_sizes():
    found = result(left_out={"K_OO": omitted(-1.0)}).accelerometers["Qx"]
    ((effect,),) = decisive(found).values()
    assert (effect.symbol, effect.size, effect.shift) == ("K_OO", 2e-6, 2e-6)
