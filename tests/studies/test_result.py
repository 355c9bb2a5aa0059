"""What a study's figures amount to, in words."""

import pytest
from campaigns import SMALL, write_description

from counterspin.reports.blocks import Paragraph
from counterspin.studies.result import MIN_TRIALS, StudyResult
from counterspin.studies.study import study


@pytest.mark.parametrize("trials", [4, MIN_TRIALS - 1])
def test_too_few_trials_have_no_verdict(tmp_path, trials):
    """At 4 trials of 4, of 3 and of 2 the intervals of every analysis hold 95 %, or may."""
    result = study(write_description(tmp_path, SMALL), trials=trials)
    assert {analyse.trustworthy for analyse in result.analyses.values()} == {None}
    first, *numbers = result.verdict
    assert first.startswith(f"{trials} trials are too few for a verdict")
    assert len(numbers) == len(result.analyses)
    assert all("% of the 95 % intervals contain the true value" in line for line in numbers)
    assert "trustworthy" not in " ".join(result.verdict)
    # Kept, read and shown, nothing of it is green.
    result.write(tmp_path / "study.json")
    again = StudyResult.read(tmp_path / "study.json")
    assert again.verdict == result.verdict
    styles = [b.style for b in again.blocks() if isinstance(b, Paragraph)]
    assert "answer" not in styles
    assert styles.count("warning") == 1


def test_interrupted_study_has_verdict_of_completed_trials(tmp_path):
    def stop(done, _):
        if done:
            raise KeyboardInterrupt

    folder = write_description(tmp_path, f'{SMALL}\n[study.analyses.joint]\nmethod = "joint"\n')
    result = study(folder, trials=MIN_TRIALS, engine="full", progress=stop)
    assert not result.complete
    assert result.trials < MIN_TRIALS == result.trials_asked
    assert {analyse.trustworthy for analyse in result.analyses.values()} == {None}
    assert result.verdict[0].startswith(f"{result.trials} trials are too few")


def test_enough_trials_have_verdict(tmp_path):
    result = study(write_description(tmp_path, SMALL), trials=MIN_TRIALS)
    assert None not in {analyse.trustworthy for analyse in result.analyses.values()}
    assert "too few" not in " ".join(result.verdict)
