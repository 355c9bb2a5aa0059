"""Poses beside an arm and beside known attitudes: one fit of all of them."""

import math

import numpy as np
import pytest

import counterspin as cs
import triads

SQUARES = {"X": 700e-6, "Y": -400e-6, "Z": 1200e-6}
ASKED = 'terms = ["K_F", "K_I", "K_II", "delta_O", "delta_P"]\n'

#: Radii of the proof masses and asymmetries; their default priors of 1 mm and of consumer grade
#: would leave 100 and 70 ug/g^2 to K_II.
MEASURED = '[model.priors]\n"K_I_asym" = "0 ± 1e-4 g/g"\n' + "".join(
    f'"centrifuge.radius.{name}.{name}-{side}" = "1 ± 1e-5 m"\n'
    for name in triads.NAMES
    for side in ("inward", "outward")
)


def _truth():
    rows, bias = triads.ROWS, triads.BIAS
    linear = {
        "X": "",
        "Y": f'delta_P = "{-rows[1, 0]} rad"\n',
        "Z": f'delta_O = "{rows[2, 0]} rad"\ndelta_P = "{-rows[2, 1]} rad"\n',
    }
    return "".join(
        f'[truth.{name}]\nK_F = "{bias[k]} g"\nK_I = "{rows[k, k]} g/g"\n'
        f'K_II = "{SQUARES[name]} g/g^2"\n{linear[name]}'
        for k, name in enumerate(triads.NAMES)
    )


def _poses(count):
    values = ", ".join(f'{name} = "? ± 0.2 mg"' for name in triads.NAMES)
    return "".join(
        f'[[runs]]\nname = "p{k}"\nmotion = "static"\nattitude = "unknown"\n'
        f"reading = {{ {values} }}\n"
        for k in range(count)
    )


def _arm():
    return "".join(
        f'[[runs]]\nname = "{name} {side} {force}"\nmotion = "arm"\n'
        f'rate = "{math.sqrt(9.81 * force)} rad/s"\nmounting = "{name}-{side}"\n'
        f'axes = {{ input = "{side}", pendulous = "up" }}\nreading = {{ {name} = "? ± 0.2 mg" }}\n'
        for name in triads.NAMES
        for side in ("inward", "outward")
        for force in (2, 5, 10)
    )


def _calibrated(folder, runs, model, more=""):
    folder.mkdir()
    text = triads.format_description(f'centrifuge = {{ radius = "1 ± 1e-5 m" }}\n{more}', model)
    (folder / "campaign.toml").write_text(text + runs + _truth() + "[simulation]\nseed = 12\n")
    cs.simulate(folder, folder / "made")
    return cs.calibrate(folder / "made")


def test_arm_determines_second_order_terms_of_triad(tmp_path):
    result = _calibrated(tmp_path / "both", _poses(24) + _arm(), ASKED + MEASURED)
    alone = _calibrated(tmp_path / "poses", _poses(24), ASKED)
    for name, true in SQUARES.items():
        coefficient = result.coefficient(f"{name}.K_II")
        assert abs(coefficient.value - true) < 4.0 * coefficient.u
        # Poses alone leave them open beside what nothing states.
        assert coefficient.u < 3e-5 < 0.1 * alone.coefficient(f"{name}.K_II").u
        assert {kind.kind for kind in result.accelerometers[name].kinds} == {"arm", "poses"}
    for k, name in enumerate(triads.NAMES):
        offset, plain = (r.triad.parameters[f"offset.{name}"] for r in (result, alone))
        assert abs(offset.value - triads.BIAS[k]) < 4.0 * offset.u
        assert offset.u < 0.5 * plain.u
    # Where the arm's mountings tell how the triad stands, every misalignment is an unknown.
    assert {"delta_O", "delta_P"} <= set(result.accelerometers["X"].coefficients)
    assert not {"delta_O", "delta_P"} & set(alone.accelerometers["X"].coefficients)


def test_known_attitude_determines_rotation_of_triad(tmp_path):
    """One known attitude determines the rotation of the triad, but not its shape."""
    model = 'terms = ["K_F", "K_I", "delta_O", "delta_P"]\nassume = ["all"]'
    along = triads.draw_directions(30, np.random.default_rng(3))
    values = triads.compute_indications(along)
    description = triads.format_description(model=model)
    alone = cs.calibrate(
        triads.write_pose_campaign(tmp_path / "a", values, u=3e-4, description=description)
    )
    # The same sensor, turned in its case by a milliradian about up, and read level and on a side.
    angle = 1e-3
    turn = np.array([[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0]])
    turn = np.vstack([turn, [0, 0, 1]])
    rows = triads.ROWS @ turn
    known = "".join(
        f'[[runs]]\nname = "{name}"\nmotion = "static"\nattitude = {attitude}\nreading = {{ '
        + ", ".join(
            f'{own} = "{value!r} ± 3e-4 g"'
            for own, value in zip("XYZ", (rows @ up + triads.BIAS).tolist(), strict=True)
        )
        + " }\n"
        for name, attitude, up in (
            ("level", '"level"', np.array([0.0, 0.0, 1.0])),
            ("east", '{ x = "up", y = "north" }', np.array([1.0, 0.0, 0.0])),
            ("north", '{ x = "east", y = "up" }', np.array([0.0, 1.0, 0.0])),
        )
    )
    both = cs.calibrate(
        triads.write_pose_campaign(tmp_path / "b", values, u=3e-4, description=description + known)
    )
    for name, c in alone.triad.parameters.items():
        assert both.triad.parameters[name].value == pytest.approx(c.value, abs=1e-6)
        assert both.triad.parameters[name].u <= c.u
    # X's input axis lies a milliradian towards north: K_I times that along its pendulous axis.
    coefficient = both.coefficient("X.delta_O")
    assert coefficient.value == pytest.approx(angle * triads.ROWS[0, 0], abs=1e-5)
    assert both.state == "good"
