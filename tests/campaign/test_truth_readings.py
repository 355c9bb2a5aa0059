"""True values of readings: units and errors."""

import pytest
from campaigns import write_and_read_campaign
from raising import raises
from reading_descriptions import ACCELEROMETER, format_arm_run, format_rest_run, format_site

from counterspin.campaign.accelerometers import TRUTH_TABLES
from counterspin.campaign.truth import TruthSettings
from counterspin.errors import CampaignError
from counterspin.simulation.simulable import reading_problems

RUN = format_arm_run("in", "9 rad/s", "? ± 2e-6 mA", pendulous="up", mounting="in")
BASE = format_site("1 m") + ACCELEROMETER + RUN


def read_truth(folder, text):
    return write_and_read_campaign(folder, BASE + text).simulation.truth


def test_coefficients_may_be_in_output_unit(tmp_path):
    truth = read_truth(
        tmp_path,
        '[truth.A]\nbias = "2.5 uA"\nscale_factor = "1.2506 mA/g"\nK_II = "1.9e-8 A/g^2"\n'
        'K_III = "2e-6 g/g^3"\ndelta_O = "1 mrad"\n',
    )
    assert truth.coefficients["A"] == pytest.approx(
        {"K_F": 2e-3, "K_I": 1.00048, "K_II": 1.52e-5, "K_III": 2e-6, "delta_O": 1e-3}, rel=1e-14
    )


def test_noise_of_readings_is_separate_from_noise_of_records(tmp_path):
    truth = read_truth(tmp_path, '[truth.A]\n[truth.noise]\nreading = "5 nA"\n')
    assert truth.reading_noise == {"A": pytest.approx(4e-6)}
    assert truth.noise.specific_force == 0.0


def test_stretch_may_be_in_machine_or_centrifuge_table(tmp_path):
    for table in (
        '[truth.machine]\n"centrifuge.',
        '[truth.machine.centrifuge]\n"',
        '[truth.centrifuge]\n"',
    ):
        truth = read_truth(tmp_path, f'[truth.A]\n{table}stretch" = "4.6e-9 s^2/m"\n')
        assert truth.machine == {"centrifuge.stretch": 4.6e-9}


SLIPS = {
    "[truth.machine]\n'centrifuge.radius.out' = '1 mm'": "truth.machine.",
    "[truth.machine]\n'centrifuge.dropp' = '1 rad s^2'": 'did you mean "centrifuge.droop"?',
    "[truth.machine]\n'K_F.trend' = '1e-9 g/s'": "write it in [truth.NAME]",
    "[truth.machine]\n'centrifuge.stretch' = '1e-9 m'": "centrifuge.stretch",
    "[truth.machine]\n'centrifuge.stretch' = '1e-9 s^2/m'\n"
    "[truth.centrifuge]\nstretch = '1e-9 s^2/m'": "is also in [truth.centrifuge]; keep only",
    "[truth]\nmachine = 3": "truth.machine: must be a table",
    "[truth.A]\nbias = '1 uA'\nK_F = '1 ug'": "truth.A.bias: duplicates K_F; keep one",
    "[truth.A]\nK_I = '1.2 ± 0.1 mA/g'": "truth.A.K_I",
    "[truth.platform]\ntilt = { nort = '1 arcsec' }": (
        'truth.platform.tilt.nort: unknown key; did you mean "north"?'
    ),
    "[truth.noise]\nreading = '1 uV'": "truth.noise.reading: 'uV' cannot be converted to mA",
    "[truth.noise]\nreading = '-1 uA'": "a standard deviation cannot be negative",
    "[truth.noise]\nreading = { B = '1 uA' }": 'no accelerometer is named "B"',
}


@pytest.mark.parametrize("slip", SLIPS)
def test_error_in_truth_names_key(tmp_path, slip):
    with pytest.raises(CampaignError) as caught:
        read_truth(tmp_path, slip + "\n")
    assert any(SLIPS[slip] in line for line in caught.value.problems), caught.value.problems


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (RUN + "truth = { tilt = { north = '1 arcsec' } }\n", "contains the tilt of a platform"),
        (RUN + "truth = { drift = '1 m' }\n", "runs[0].truth.drift: "),
        (
            format_rest_run("up", "level", "? ± 1 uA", "truth = { rate_error = 1e-3 }\n"),
            "does not rotate",
        ),
    ],
)
def test_error_in_truth_of_run_is_reported(tmp_path, run, message):
    with pytest.raises(CampaignError) as caught:
        write_and_read_campaign(tmp_path, format_site("1 m") + ACCELEROMETER + run + "[truth.A]\n")
    (line,) = caught.value.problems
    assert message in line


def test_reading_without_truth_requires_value(tmp_path):
    with raises("missing-value", "runs[0].reading:", '(run "in")'):
        write_and_read_campaign(tmp_path, BASE)


def test_rejects_simulation_without_noise_or_with_incredible_truth(tmp_path):
    def list_problems(text, base=BASE):
        return reading_problems(write_and_read_campaign(tmp_path, base + text))

    assert list_problems("[truth.A]\n") == []
    (line,) = list_problems("[truth.A]\n", BASE.replace(" ± 2e-6", ""))
    assert line.startswith('truth.noise.reading: missing; "in" has no stated uncertainty')
    (line,) = list_problems('[truth.machine]\n"centrifuge.droop" = "0.1 rad s^2"\n')
    assert "5 times the largest credible size, 0.001 rad s^2" in line
    at_rest = 'name = "rest"\nmotion = "static"\nattitude = "level"\nrecord = "r.csv"\n'
    column = 'specific_force = { column = "mA", unit = "mA" }\n[[runs]]\n'
    text = BASE.replace("[[runs]]\n", f"{column}{at_rest}[[runs]]\n")
    (line,) = list_problems('[truth.A]\n[records]\ntime = { column = "t", unit = "s" }\n', text)
    assert line == 'run "rest": simulating a record at rest requires a duration'


def test_reserved_table_names_match_truth_settings():
    assert set(TRUTH_TABLES) == set(TruthSettings.model_fields)
