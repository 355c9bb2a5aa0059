"""What a description is asked about: gravity of another latitude, values without uncertainty."""

import pytest
from campaigns import SMALL, campaign_of, changed, write

from counterspin.campaign.questions import questions
from counterspin.cli import main

#: A campaign of which there is nothing to ask.
SURE = changed(
    SMALL,
    ('"1.002 g/g"\ndisp', '"1.002 ± 1e-5 g/g"\ndisp'),
    ('"0.999 g/g"\ndisp', '"0.999 ± 1e-5 g/g"\ndisp'),
)


def asked(folder, text):
    return [(q.code, q.subject) for q in questions(campaign_of(folder, text))]


def test_nothing_to_ask(tmp_path):
    assert asked(tmp_path, SURE) == []


@pytest.mark.parametrize(
    ("gravity", "latitude", "fits"),
    [
        ("9.8066", "45.75 deg", True),
        ("9.8", "45 deg", True),  # 2000 m high
        ("9.7803", "0 deg", True),
        ("9.8322", "90 deg", True),
        ("9.79", "45 deg", False),  # 5000 m high
        ("9.81", "45 deg", False),
        ("9.8066", "0.8 deg", False),  # 0.8 rad was meant
        ("9.8066", "-45.75 deg", True),
        ("9.8066", "45 deg 45 min N", True),
        ("9.7803 ± 0.02", "45 deg", True),  # it says itself that it is not known
    ],
)
def test_gravity_fits_the_latitude(tmp_path, gravity, latitude, fits):
    text = changed(SURE, ("9.8066 m/s^2", f"{gravity} m/s^2"), ('"45.75 deg"', f'"{latitude}"'))
    found = asked(tmp_path, text)
    assert found == ([] if fits else [("gravity-latitude", "site")])


def test_the_range_is_said(tmp_path):
    text = changed(SURE, ('"45.75 deg"', '"0.8 deg"'))
    (question,) = questions(campaign_of(tmp_path, text))
    assert "from -500 to 3000 m of height, gravity is 9.7711 to 9.7819 m/s^2" in question.text


def test_the_removed_gravity_is_held_to_the_latitude_too(tmp_path):
    for removed, fits in (("9.80665", True), ("9.8061", True), ("9.78033", False)):
        line = f'gravity = "9.8066 m/s^2"\nremoved_gravity = "{removed} m/s^2"'
        text = changed(SURE, ('gravity = "9.8066 m/s^2"', line), ('"45.75 deg"', '"47 deg"'))
        found = asked(tmp_path, text)
        assert found == ([] if fits else [("gravity-latitude", "site.removed_gravity")])


@pytest.mark.parametrize(
    ("changes", "asks"),
    [
        ([], True),
        ([('"9.8066 ± 1e-4 m/s^2"', '"9.8066 m/s^2"')], False),  # left is nothing
        (
            [('45.75 deg"', '45.75 deg"\nremoved_gravity = "9.8066 m/s^2"')],
            False,
        ),
        ([('input_axis = "up"', 'input_axis = "east"'), ('"north"\ndisp', '"down"\ndisp')], False),
        ([('displacement = { column = "up_m", unit = "m" }',
           'specific_force = { column = "up_m", unit = "m/s^2" }')], False),
    ],
)  # fmt: skip
def test_what_is_left_of_gravity_upright(tmp_path, changes, asks):
    upright = (
        '[accelerometers.Qz]\ninput_axis = "up"\npendulous_axis = "north"\n'
        'displacement = { column = "up_m", unit = "m" }\n[noise]\nspecific_force = "1 mg"\n'
    )
    text = changed(
        SURE, ('"9.8066 m/s^2"', '"9.8066 ± 1e-4 m/s^2"'), ("[noise]\n", upright), *changes
    )
    if not any("specific_force = {" in new for _, new in changes):
        text = changed(text, ('specific_force = "1 mg"\n', ""))
    assert asked(tmp_path, text) == ([("removed-gravity", "Qz.K_I")] if asks else [])


OWN_VELOCITY = ('unit = "rad" }\n', 'unit = "rad" }\nreference = "own velocity"\n')
UPRIGHT = (
    '[accelerometers.Qz]\ninput_axis = "up"\npendulous_axis = "north"\n'
    'displacement = { column = "up_m", unit = "m" }\n[noise]\n'
)


def test_what_nobody_recorded_of_the_computers_own_velocity(tmp_path):
    found = questions(campaign_of(tmp_path, changed(SURE, OWN_VELOCITY)))
    # An error upwards acts to the west, as the Earth's rotation points north and up.
    assert [(q.code, q.subject) for q in found] == [("unrecorded-axis", "Qx.K_F")]
    # 2 Omega cos L x 1 mg x 100 s / 2
    assert (
        "an error of 1 mg in such a direction shifts K_F by 5e-06 g in a run of 100 s"
        in found[0].text
    )
    whole = changed(SURE, OWN_VELOCITY, ("[noise]\n", UPRIGHT))
    assert asked(tmp_path, whole) == []


def test_own_velocity_does_nothing_to_a_recorded_force(tmp_path):
    text = changed(
        SURE,
        OWN_VELOCITY,
        ("displacement = {", "specific_force = {"),
        ('unit = "m" }', 'unit = "m/s^2" }'),
        ('displacement = "0.01 m"', 'specific_force = "1 mg"'),
    )
    (found,) = questions(campaign_of(tmp_path, text))
    assert found.subject == "records.reference"
    assert "has no effect here" in found.text


def test_values_without_an_uncertainty(tmp_path):
    text = changed(SMALL, ('"1.002 g/g"\ndisp', '"1.002 g/g"\nbias = "0.005 g"\ndisp'))
    priors = '[model.priors]\n"platform.tilt.north" = "0 arcsec"\n'
    text = changed(text, ('assume = "all"\n', f'assume = ["K_I", "platform.*"]\n{priors}'))
    assert asked(tmp_path, text) == [
        ("exact-prior", "Qx.K_F"),
        ("exact-prior", "Qx.K_I"),
        ("exact-prior", "Qy.K_I"),
        ("exact-prior", "platform.tilt.north"),
    ]
    bias, scale_factor, *_ = questions(campaign_of(tmp_path / "again", text))
    assert bias.text == (
        "Qx.K_F is stated as 0.005 g without an uncertainty, and is therefore used with the "
        'default uncertainty. How well is it known? Write "0.005 ± U g".'
    )
    assert (
        "and is therefore used as exact, because model.assume names it. How well"
        in scale_factor.text
    )


def test_simulate_and_plan_warn_and_calibrate_finds(tmp_path, capsys):
    text = changed(SURE, ('"45.75 deg"', '"0.8 deg"'))
    assert main(["simulate", str(write(tmp_path, text)), "-o", str(tmp_path / "made")]) == 0
    assert (
        "Warning: Gravity 9.8066 m/s^2 does not agree with latitude 0.8 deg"
        in capsys.readouterr().out
    )
    assert main(["plan", "--check", str(tmp_path / "made")]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "Warning: Gravity 9.8066 m/s^2 does not agree with latitude 0.8 deg" in words
    from counterspin.calibration.calibrate import calibrate

    result = calibrate(tmp_path / "made")
    assert result.state == "reservations"
    assert [finding.code for finding in result.findings] == ["gravity-latitude"]
