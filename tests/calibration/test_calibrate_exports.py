"""The result is independent of the export format of the recorder."""

import pytest
from exports import EXPORTS, simulate_campaign, write_export

from counterspin.calibration.result import Result
from counterspin.cli import main


@pytest.fixture(scope="module")
def plain_folder(tmp_path_factory):
    return simulate_campaign(tmp_path_factory.mktemp("exports"))


def read_result(folder):
    assert main(["calibrate", str(folder), "--json", str(folder / "result.json")]) == 0
    return Result.read(folder / "result.json")


@pytest.fixture(scope="module")
def reference(plain_folder):
    return read_result(plain_folder).accelerometers["Qx"].coefficients["K_II"]


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPORTS)
def test_result_is_independent_of_export_format(tmp_path, plain_folder, reference, name):
    write_export(plain_folder, tmp_path / "lab", EXPORTS[name])
    coefficient = read_result(tmp_path / "lab").accelerometers["Qx"].coefficients["K_II"]
    assert abs(coefficient.value - reference.value) < 0.01 * reference.u
    assert coefficient.u == pytest.approx(reference.u, rel=1e-3)


def test_without_option_is_equivalent_to_skip(tmp_path, plain_folder, capsys):
    saved = tmp_path / "without.json"
    words = ["calibrate", str(plain_folder), "--without", "slow"]
    assert main([*words, "--json", str(saved)]) in (0, 1)
    result = Result.read(saved)
    assert list(result.runs) == ["fast"]
    assert result.provenance.options == ["--without=slow"]
    assert result.provenance.in_memory == {}
    assert set(result.provenance.inputs) == {"campaign.toml", "fast.csv"}
    assert "Omitted on request: slow." in result.warnings
    text = (plain_folder / "campaign.toml").read_text(encoding="utf-8")
    (tmp_path / "campaign.toml").write_text(
        text.replace('name = "slow"', 'name = "slow"\nskip = true'), encoding="utf-8"
    )
    (tmp_path / "fast.csv").write_bytes((plain_folder / "fast.csv").read_bytes())
    again = read_result(tmp_path)
    assert again.accelerometers["Qx"].coefficients == result.accelerometers["Qx"].coefficients
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["solw"], '--without: no run is named "solw"; the runs are "slow", "fast"'),
        (
            ["slow", "fast"],
            '--without: no run would remain; the runs are "slow", "fast"',
        ),
    ],
)
def test_invalid_without_option_names_run(plain_folder, capsys, words, message):
    options = [word for name in words for word in ("--without", name)]
    assert main(["calibrate", str(plain_folder), *options]) == 2
    shown = " ".join(capsys.readouterr().err.split())
    assert f"{plain_folder / 'campaign.toml'}: {message}" in shown
    assert "in memory" not in shown


def test_error_after_exclusion_names_excluded_run(plain_folder, tmp_path, capsys):
    text = (plain_folder / "campaign.toml").read_text(encoding="utf-8")
    for name, warmth in (("slow", "20 degC"), ("fast", "23 degC")):
        text = text.replace(f'name = "{name}"', f'name = "{name}"\ntemperature = "{warmth}"')
    text += '[model]\nassume = "all"\nterms = ["K_F", "K_I", "K_II", "K_F.temperature"]\n'
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    assert main(["calibrate", str(tmp_path), "--without", "slow"]) == 2
    shown = " ".join(capsys.readouterr().err.split())
    assert '--without: with "slow" omitted, centrifuge.reference_temperature: is missing' in shown
