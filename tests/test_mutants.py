"""Every mutant of `make mutants` can be introduced, and one of them is detected."""

import ast
import shutil

import pytest
from mutants.__main__ import REPOSITORY, SOURCE, detect_mutant, mutate_source, read_mutants

MUTATED_PACKAGES = {
    *("physics", "inference", "campaign", "calibration", "certificates", "correction", "records")
}


def test_every_mutant_gives_valid_syntax():
    """After a code change, update mutants/mutants.toml."""
    failures = []
    for mutant in read_mutants():
        try:
            ast.parse(mutate_source(mutant))
        except (ValueError, SyntaxError) as error:
            failures.append(f"{mutant['file']}: {error}")
    assert not failures, "\n".join(failures)


def test_mutants_cover_computing_packages_and_name_tests():
    mutants = read_mutants()
    assert len(mutants) >= 60
    assert len({(mutant["file"], mutant["old"], mutant["new"]) for mutant in mutants}) == len(
        mutants
    )
    assert {mutant["file"].partition("/")[0] for mutant in mutants} >= MUTATED_PACKAGES
    assert all(
        (REPOSITORY / file).is_file() for mutant in mutants for file in mutant.get("tests", ())
    )


def test_missing_old_text_raises_value_error():
    for change in ({"old": "nothing like this"}, {"file": "physics/none.py"}):
        with pytest.raises(ValueError, match="occurs 0 times"):
            mutate_source({**read_mutants()[0], **change})


@pytest.mark.slow
def test_validate_detects_mutant(tmp_path):
    package = tmp_path / "counterspin"
    shutil.copytree(SOURCE, package)
    mutant = next(m for m in read_mutants() if m["file"] == "correction/apply.py")
    (package / mutant["file"]).write_text(mutate_source(mutant), encoding="utf-8")
    assert detect_mutant(mutant, tmp_path, False).startswith("validate: ")
