"""Questions on a description: gravity and latitude, values without uncertainty."""

import pytest
from campaigns import SMALL, replace_parts, write_and_read_campaign, write_description

from counterspin.campaign.questions import ask_questions
from counterspin.cli import main

#: A campaign without questions.
SURE = replace_parts(
    SMALL,
    ('"1.002 g/g"\ndisp', '"1.002 ± 1e-5 g/g"\ndisp'),
    ('"0.999 g/g"\ndisp', '"0.999 ± 1e-5 g/g"\ndisp'),
)


def collect_questions(folder, text):
    return [(q.code, q.subject) for q in ask_questions(write_and_read_campaign(folder, text))]


def test_complete_campaign_has_no_questions(tmp_path):
    assert collect_questions(tmp_path, SURE) == []


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
        ("9.7803 ± 0.02", "45 deg", True),  # the stated uncertainty covers the difference
    ],
)
def test_gravity_is_checked_against_latitude(tmp_path, gravity, latitude, fits):
    text = replace_parts(
        SURE, ("9.8066 m/s^2", f"{gravity} m/s^2"), ('"45.75 deg"', f'"{latitude}"')
    )
    subjects = collect_questions(tmp_path, text)
    assert subjects == ([] if fits else [("gravity-latitude", "site")])


def test_question_states_range_of_gravity(tmp_path):
    text = replace_parts(SURE, ('"45.75 deg"', '"0.8 deg"'))
    (question,) = ask_questions(write_and_read_campaign(tmp_path, text))
    assert "heights from -500 to 3000 m, gravity is 9.7711 to 9.7819 m/s^2" in question.text


def test_removed_gravity_is_checked_against_latitude(tmp_path):
    for removed, fits in (("9.80665", True), ("9.8061", True), ("9.78033", False)):
        line = f'gravity = "9.8066 m/s^2"\nremoved_gravity = "{removed} m/s^2"'
        text = replace_parts(SURE, ('gravity = "9.8066 m/s^2"', line), ('"45.75 deg"', '"47 deg"'))
        subjects = collect_questions(tmp_path, text)
        assert subjects == ([] if fits else [("gravity-latitude", "site.removed_gravity")])


@pytest.mark.parametrize(
    ("changes", "asks"),
    [
        ([], True),
        ([('"9.8066 ± 1e-4 m/s^2"', '"9.8066 m/s^2"')], False),  # no gravity remains
        (
            [('45.75 deg"', '45.75 deg"\nremoved_gravity = "9.8066 m/s^2"')],
            False,
        ),
        ([('input_axis = "up"', 'input_axis = "east"'), ('"north"\ndisp', '"down"\ndisp')], False),
        ([('displacement = { column = "up_m", unit = "m" }',
           'specific_force = { column = "up_m", unit = "m/s^2" }')], False),
    ],
)  # fmt: skip
def test_remaining_gravity_of_upright_accelerometer(tmp_path, changes, asks):
    upright = (
        '[accelerometers.Qz]\ninput_axis = "up"\npendulous_axis = "north"\n'
        'displacement = { column = "up_m", unit = "m" }\n[noise]\nspecific_force = "1 mg"\n'
    )
    text = replace_parts(
        SURE, ('"9.8066 m/s^2"', '"9.8066 ± 1e-4 m/s^2"'), ("[noise]\n", upright), *changes
    )
    if not any("specific_force = {" in new for _, new in changes):
        text = replace_parts(text, ('specific_force = "1 mg"\n', ""))
    assert collect_questions(tmp_path, text) == ([("removed-gravity", "Qz.K_I")] if asks else [])


OWN_VELOCITY = ('unit = "rad" }\n', 'unit = "rad" }\nreference = "own velocity"\n')
UPRIGHT = (
    '[accelerometers.Qz]\ninput_axis = "up"\npendulous_axis = "north"\n'
    'displacement = { column = "up_m", unit = "m" }\n[noise]\n'
)


def test_unrecorded_axis_of_own_velocity_is_a_question(tmp_path):
    questions = ask_questions(write_and_read_campaign(tmp_path, replace_parts(SURE, OWN_VELOCITY)))
    # An upward velocity error acts towards west through the Earth's rotation.
    assert [(q.code, q.subject) for q in questions] == [("unrecorded-axis", "Qx.K_F")]
    # 2 Omega cos L x 1 mg x 100 s / 2
    assert (
        "An error of 1 mg along one of these directions shifts K_F by 5e-06 g in a run of 100 s"
        in questions[0].text
    )
    whole = replace_parts(SURE, OWN_VELOCITY, ("[noise]\n", UPRIGHT))
    assert collect_questions(tmp_path, whole) == []


def test_own_velocity_has_no_effect_on_recorded_force(tmp_path):
    text = replace_parts(
        SURE,
        OWN_VELOCITY,
        ("displacement = {", "specific_force = {"),
        ('unit = "m" }', 'unit = "m/s^2" }'),
        ('displacement = "0.01 m"', 'specific_force = "1 mg"'),
    )
    (question,) = ask_questions(write_and_read_campaign(tmp_path, text))
    assert question.subject == "records.reference"
    assert "has no effect here" in question.text


def test_values_without_uncertainty_are_questions(tmp_path):
    text = replace_parts(SMALL, ('"1.002 g/g"\ndisp', '"1.002 g/g"\nbias = "0.005 g"\ndisp'))
    priors = '[model.priors]\n"platform.tilt.north" = "0 arcsec"\n'
    text = replace_parts(text, ('assume = "all"\n', f'assume = ["K_I", "platform.*"]\n{priors}'))
    assert collect_questions(tmp_path, text) == [
        ("exact-prior", "Qx.K_F"),
        ("exact-prior", "Qx.K_I"),
        ("exact-prior", "Qy.K_I"),
        ("exact-prior", "platform.tilt.north"),
    ]
    bias, scale_factor, *_ = ask_questions(write_and_read_campaign(tmp_path / "again", text))
    assert bias.text == (
        "Qx.K_F is stated as 0.005 g without an uncertainty, so counterspin uses it with the "
        'default uncertainty. How accurately is it known? Write "0.005 ± U g".'
    )
    assert (
        "so counterspin uses it as exact, because it is listed in model.assume. How accurately"
        in scale_factor.text
    )


def test_simulate_and_plan_warn_and_calibrate_has_finding(tmp_path, capsys):
    text = replace_parts(SURE, ('"45.75 deg"', '"0.8 deg"'))
    assert (
        main(["simulate", str(write_description(tmp_path, text)), "-o", str(tmp_path / "made")])
        == 0
    )
    assert (
        "Warning: Gravity of 9.8066 m/s^2 does not agree with latitude 0.8 deg"
        in capsys.readouterr().out
    )
    assert main(["plan", "--check", str(tmp_path / "made")]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert "Warning: Gravity of 9.8066 m/s^2 does not agree with latitude 0.8 deg" in words
    from counterspin.calibration.calibrate import calibrate

    result = calibrate(tmp_path / "made")
    assert result.state == "reservations"
    assert [finding.code for finding in result.findings] == ["gravity-latitude"]
