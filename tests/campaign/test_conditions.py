"""RunConditions of runs in a campaign: what is read, and what the model's slopes need."""

import pytest
from campaigns import SMALL, campaign_of, changed, without

from counterspin.campaign.conditions import conditions_of, origin_of
from counterspin.errors import CampaignError
from counterspin.physics.effects import RunConditions

#: To which a test adds a model of its own.
BARE = without(SMALL, "model")

STATED = {
    "slow": ("21 degC", "90 s"),
    "middle": ("296.15 K", "11.5 min"),
    "fast": ("22 degC", "-30 s"),
}


def with_conditions(text, keys=("temperature", "time"), runs=STATED):
    for name in runs:
        lines = dict(zip(("temperature", "time"), STATED[name], strict=True))
        added = "".join(f'{key} = "{lines[key]}"\n' for key in keys)
        text = changed(text, (f'record = "{name}.csv"\n', f'record = "{name}.csv"\n{added}'))
    return text


def model(terms="", hold="", priors=""):
    return (
        f'[model]\nassume = "all"\nterms = ["K_F", "K_I", "K_II"{terms}]\nhold = [{hold}]\n'
        f"[model.priors]\n{priors}\n"
    )


def problems(folder, text):
    with pytest.raises(CampaignError) as caught:
        campaign_of(folder, text)
    return list(caught.value.problems)


def test_conditions_count_from_the_first_run_and_the_reference(tmp_path):
    campaign = campaign_of(tmp_path, with_conditions(SMALL))
    found = conditions_of(campaign)
    assert found["slow"].start == 120.0
    assert found["middle"].start == 720.0
    assert found["fast"].start == 0.0
    # Without a reference, the mean of what was recorded is one.
    assert [found[name].warmth for name in STATED] == pytest.approx([-1.0, 1.0, 0.0])
    text = changed(
        with_conditions(SMALL),
        ('radius = "2.5 m"', 'radius = "2.5 m"\nreference_temperature = "20 degC"'),
    )
    campaign = campaign_of(tmp_path, text)
    assert origin_of(campaign).temperature == pytest.approx(293.15)
    assert conditions_of(campaign)["slow"].warmth == pytest.approx(1.0)


def test_runs_without_a_time_follow_each_other(tmp_path):
    campaign = campaign_of(tmp_path, SMALL)
    lengths = {"slow": 81.0, "middle": 41.0}
    starts = [c.start for c in conditions_of(campaign, lengths).values()]
    assert starts == [0.0, 81.0, 122.0]
    # Twenty revolutions at a quarter and at half a revolution a second.
    assert [c.start for c in conditions_of(campaign).values()] == pytest.approx([0.0, 80.0, 120.0])


def test_where_nobody_took_a_temperature_it_rises_by_a_kelvin_from_run_to_run(tmp_path):
    warmths = [c.warmth for c in conditions_of(campaign_of(tmp_path, SMALL)).values()]
    assert warmths == [-0.5, 0.0, 0.5]
    before, _, after = SMALL.partition("[[runs]]")
    one = f"{before}[[runs]]{after.partition('[[runs]]')[0]}{after[after.index('[simulation]') :]}"
    alone = campaign_of(tmp_path / "one", one)
    assert list(conditions_of(alone).values()) == [RunConditions(0.0, 0.0)]


def test_slopes_need_the_conditions_of_every_run(tmp_path):
    text = with_conditions(BARE, runs=("slow",)) + model(', "K_F.trend", "K_I.temperature"')
    assert problems(tmp_path, text) == [
        f"runs[{place}].{key}: is missing: {symbol} is in the model; write {key} = {example}, "
        f'or the like (run "{name}")'
        for key, symbol, example in (
            ("temperature", "K_I.temperature", '"23.4 degC"'),
            ("time", "K_F.trend", '"12 min"'),
        )
        for place, name in ((1, "middle"), (2, "fast"))
    ]


def test_times_of_some_runs_only(tmp_path):
    (found,) = problems(tmp_path, with_conditions(SMALL, keys=("time",), runs=("slow", "fast")))
    assert found.startswith("runs[1].time: is missing: other runs state theirs; write time = ")


def test_a_slope_at_one_temperature_needs_a_reference(tmp_path):
    text = with_conditions(BARE).replace("296.15 K", "21 degC").replace("22 degC", "21 degC")
    (problem,) = problems(tmp_path, text + model(', "K_F.temperature"'))
    assert problem.startswith("centrifuge.reference_temperature: is missing")


@pytest.mark.parametrize("stated", ["23 C", "warm", "", "23 °C ± 1 °C"])
def test_a_reference_that_is_no_temperature_is_told(stated, tmp_path):
    text = changed(SMALL, ('"2.5 m"', f'"2.5 m"\nreference_temperature = "{stated}"'))
    (told,) = problems(tmp_path, text)
    assert told.startswith("centrifuge.reference_temperature: ")
    if stated:
        assert f"'{stated}' is not a temperature" in told


def test_heating_is_never_asked_for(tmp_path):
    (problem,) = problems(tmp_path, BARE + model(', "K_F.heating"'))
    assert '"K_F.heating" cannot be told from K_II' in problem
    known = '"K_F.heating" = "0 ± 0.1 ug/g^2"'
    for hold in ("", '"K_F.heating"'):
        campaign = campaign_of(tmp_path, BARE + model(hold=hold, priors=known))
        for accelerometer in campaign.accelerometers.values():
            assert accelerometer.priors["K_F.heating"].u == pytest.approx(1e-7)
    (problem,) = problems(tmp_path, BARE + model(hold='"K_F.heating"'))
    assert "there is no prior for Qx, Qy" in problem


def test_a_prior_of_one_accelerometer_s_slope(tmp_path):
    priors = '"K_F.trend" = "0 ± 1e-9 g/s"\n"Qy.K_F.trend" = "1e-9 ± 2e-9 g/s"'
    text = with_conditions(BARE) + model(', "K_F.trend"', priors=priors)
    campaign = campaign_of(tmp_path, text)
    known = {name: a.priors["K_F.trend"] for name, a in campaign.accelerometers.items()}
    assert (known["Qx"].value, known["Qx"].u) == (0.0, 1e-9)
    assert (known["Qy"].value, known["Qy"].u) == (1e-9, 2e-9)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('temperature = "21"', "'21' is not a temperature"),
        ('time = "12"', "has no unit"),
        ("temprature = 1", 'did you mean "temperature"'),
    ],
)
def test_slips(line, message, tmp_path):
    text = changed(SMALL, ('record = "fast.csv"\n', f'record = "fast.csv"\n{line}\n'))
    assert any(message in problem for problem in problems(tmp_path, text))
