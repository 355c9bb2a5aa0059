"""`init --from`: from a recorder's files to a result, by command."""

import io

import pytest

from counterspin.calibration.result import Result
from counterspin.cli import main
from exports import EXPORTS, campaign_folder, write_records

PLACE = ["--answer", "gravity=9.8066 m/s^2", "--answer", "latitude=45.75 deg"]
ANSWERED = [*PLACE, "--answer", "radius=2.5 m"]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return campaign_folder(tmp_path_factory.mktemp("exports"))


def result_of(folder):
    assert main(["calibrate", str(folder), "--json", str(folder / "result.json")]) == 0
    return Result.read(folder / "result.json").accelerometers["Qx"].coefficients["K_II"]


@pytest.fixture(scope="module")
def reference(plain, tmp_path_factory):
    """Return what the plain records give with the same knowledge."""
    folder = tmp_path_factory.mktemp("plain")
    files = [str(plain / f"{name}.csv") for name in ("slow", "fast")]
    words = ["--answer", "sense=counterclockwise"]
    assert main(["init", str(folder), "--from", *files, "--yes", *ANSWERED, *words]) == 0
    return result_of(folder)


@pytest.mark.parametrize("name", ["labview", "tdms", "clockwise from north", "pulse"])
def test_from_exports_to_a_result(tmp_path, plain, reference, name, capsys):
    files = write_records(plain, tmp_path / "files", EXPORTS[name])
    sense = "clockwise" if "clockwise" in name else "counterclockwise"
    words = ["--yes", *ANSWERED, "--answer", f"sense={sense}"]
    folder = tmp_path / "campaign"
    assert main(["init", str(folder), "--from", *map(str, files), *words]) == 0
    said = capsys.readouterr().out
    assert "Guessed from the files:" in said
    assert f"counterspin calibrate {folder}" in said
    text = (folder / "campaign.toml").read_text(encoding="utf-8")
    assert "# - pendulous axes: down" in text
    found = result_of(folder)
    assert abs(found.value - reference.value) < 0.01 * reference.u


def test_what_is_not_known_is_told_or_asked(tmp_path, plain, monkeypatch, capsys):
    words = ["init", str(tmp_path), "--from", str(plain / "slow.csv"), *PLACE]
    assert main([*words, "--yes"]) == 2
    told = capsys.readouterr().err
    assert 'Say it with --answer, such as "radius=2.5' in told
    assert "sense: In which sense does the angle grow" in told
    assert not (tmp_path / "campaign.toml").exists()
    assert main(words) == 2  # nobody is there to be asked

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr("sys.stdin", Terminal("2,5 kg\n2,5\nleft\ncw\n"))
    assert main(words) == 0
    told = capsys.readouterr().out
    assert "unknown unit 'kg'" in told
    assert "'left' is none of counterclockwise, clockwise. Once more:" in told
    assert 'sense = "clockwise"' in (tmp_path / "campaign.toml").read_text(encoding="utf-8")
    monkeypatch.setattr("sys.stdin", Terminal(""))
    assert main(["init", str(tmp_path / "b"), *words[2:]]) == 1
    assert "no answer came" in capsys.readouterr().err


def test_words_that_make_no_sense(tmp_path, plain, capsys):
    assert main(["init", str(tmp_path), "--yes"]) == 2
    assert "--from FILE" in capsys.readouterr().err
    words = ["init", str(tmp_path), "--from", str(plain / "slow.csv"), "--answer", "radius"]
    assert main(words) == 2
    assert "no KEY=VALUE" in capsys.readouterr().err
