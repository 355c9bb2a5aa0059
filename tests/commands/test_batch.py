"""Many campaigns at once: each as if it were alone, and a failing one stops no other."""

import json
from importlib.resources import files

import pytest

from counterspin.cli import main
from counterspin.commands.batch import calibrate_many
from counterspin.commands.calibrate import calibrate
from counterspin.commands.simulate import simulate


def short_plan(seed):
    text = (files("counterspin.commands") / "paper.toml").read_text(encoding="utf-8")
    return text.replace("revolutions = 100", "revolutions = 12").replace(
        "seed = 2", f"seed = {seed}"
    )


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    place = tmp_path_factory.mktemp("batch")
    for name, seed in (("a", 1), ("b", 2)):
        description = place / f"{name}.toml"
        description.write_text(short_plan(seed), encoding="utf-8")
        simulate(description, place / name)
    (place / "broken").mkdir()
    return [place / "a", place / "broken", place / "b"]


@pytest.mark.parametrize("workers", [1, 2])
def test_each_campaign_is_calibrated_as_if_alone(folders, workers):
    first, broken, last = calibrate_many(folders, workers=workers)
    assert first.result == calibrate(folders[0])
    assert last.result == calibrate(folders[2])
    assert first.result != last.result
    assert broken.result is None
    assert "no such file" in broken.error


def test_command_prints_a_summary_and_fails_if_any_failed(folders, tmp_path, capsys):
    kept = tmp_path / "all.json"
    status = main(["calibrate", *map(str, folders), "--json", str(kept)])
    shown = capsys.readouterr()
    assert status == 1
    assert "1 of 3 campaigns could not be calibrated" in shown.err
    assert "2 campaigns calibrated, 1 failed." in shown.out
    assert shown.out.count("Qx") == 2
    campaigns = json.loads(kept.read_text(encoding="utf-8"))["campaigns"]
    assert list(campaigns) == [str(folder) for folder in folders]
    assert "error" in campaigns[str(folders[1])]
    assert main(["calibrate", str(folders[0]), str(folders[2])]) == 0
