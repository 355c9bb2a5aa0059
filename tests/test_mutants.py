"""The errors that `make mutants` plants are there to be planted, and one of them is seen."""

import ast
import shutil

import pytest
from mutants.__main__ import REPOSITORY, SOURCE, mutants, planted, seen_by

ROOMS = {"physics", "inference", "campaign", "calibration", "certificates", "correction", "records"}


def test_every_mutant_can_be_planted():
    """After a code change, update mutants/mutants.toml."""
    wrong = []
    for mutant in mutants():
        try:
            ast.parse(planted(mutant))
        except (ValueError, SyntaxError) as error:
            wrong.append(f"{mutant['file']}: {error}")
    assert not wrong, "\n".join(wrong)


def test_mutants_cover_computing_packages_and_name_tests():
    listed = mutants()
    assert len(listed) >= 60
    assert len({(one["file"], one["old"], one["new"]) for one in listed}) == len(listed)
    assert {one["file"].partition("/")[0] for one in listed} >= ROOMS
    assert all((REPOSITORY / test).is_file() for one in listed for test in one.get("tests", ()))


def test_planting_missing_line_raises():
    for change in ({"old": "nothing like this"}, {"file": "physics/none.py"}):
        with pytest.raises(ValueError, match="stands there 0 times"):
            planted({**mutants()[0], **change})


@pytest.mark.slow
def test_validate_detects_mutant(tmp_path):
    copy = tmp_path / "counterspin"
    shutil.copytree(SOURCE, copy)
    mutant = next(
        actual_mutant
        for actual_mutant in mutants()
        if actual_mutant["file"] == "correction/apply.py"
    )
    (copy / mutant["file"]).write_text(planted(mutant), encoding="utf-8")
    assert seen_by(mutant, tmp_path, False).startswith("validate: ")
