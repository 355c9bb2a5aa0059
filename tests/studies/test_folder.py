"""A study's folder: nothing in it is lost to a slip, and what is damaged is done again."""

import json
import shutil
import zipfile
from contextlib import suppress
from importlib.resources import files

import numpy as np
import polars as pl
import pytest
from raising import raises

from counterspin.cli import main
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.output import write_whole
from counterspin.studies import batch_runner
from counterspin.studies import study as study_module
from counterspin.studies.folder import StudyFolder
from counterspin.studies.study import study

PAPER = (files("counterspin.reproduction") / "paper.toml").read_text(encoding="utf-8")
STUDY = '[study]\nseed = 3\n[study.analyses.exact]\nmethod = "two-stage"\nsigma = "residuals"\n'
TRIALS = 40_000  # five batches


def stop(done, _):
    if done >= 16_000:
        raise KeyboardInterrupt


@pytest.fixture(scope="module", autouse=True)
def one_batch_a_task():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch_runner, "_TASK_DURATION", 0.0)
        yield


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "campaign.toml").write_text(PAPER + STUDY, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def whole(campaign, tmp_path_factory):
    """The study without an interruption: result and trials."""
    out = tmp_path_factory.mktemp("whole") / "out"
    result = study(campaign, trials=TRIALS, output=StudyFolder(out, keep_trials=True))
    return result, pl.read_parquet(out / "trials.parquet")


@pytest.fixture(scope="module")
def interrupted(campaign, tmp_path_factory):
    out = tmp_path_factory.mktemp("interrupted") / "out"
    result = study(
        campaign, trials=TRIALS, output=StudyFolder(out, keep_trials=True), progress=stop
    )
    assert 0 < result.trials < TRIALS
    return out


@pytest.fixture
def begun(interrupted, tmp_path):
    """A folder with a study that was begun, to be damaged."""
    return shutil.copytree(interrupted, tmp_path / "out")


def resumed(campaign, folder):
    """Resume the study; returns the trials that did not have to be done again."""
    kept = []
    result = study(
        campaign,
        trials=TRIALS,
        output=StudyFolder(folder, keep_trials=True, resume=True),
        progress=lambda done, _: kept.append(done),
    )
    return result, pl.read_parquet(folder / "trials.parquet"), kept[0]


def assert_whole(outcome, whole):
    assert outcome[0] == whole[0]
    assert outcome[1].equals(whole[1])


# Kills


class KilledError(BaseException):
    pass


@pytest.mark.parametrize("writes", [1, 2])
def test_a_study_killed_while_it_saves_goes_on(campaign, tmp_path, monkeypatch, whole, writes):
    written = []

    def write(path, content, **more):
        if len(written) == writes:
            raise KilledError
        written.append(path)
        write_whole(path, content, **more)

    monkeypatch.setattr("counterspin.studies.folder.write_whole", write)
    with pytest.raises(KilledError):
        study(campaign, trials=TRIALS, output=StudyFolder(tmp_path / "out", keep_trials=True))
    monkeypatch.undo()
    assert_whole(resumed(campaign, tmp_path / "out"), whole)


# Damage


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 0.999])
def test_progress_that_is_cut_short_is_told_and_the_study_done_anew(campaign, begun, whole, share):
    file = begun / "progress.npz"
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.warns(CounterspinWarning, match=r"progress\.npz is damaged"):
        outcome = resumed(campaign, begun)
    assert outcome[2] == 0
    assert_whole(outcome, whole)


@pytest.mark.slow
def test_flipped_bits_in_the_progress_are_never_taken_over(campaign, interrupted, tmp_path, whole):
    generator = np.random.default_rng(7)
    content = (interrupted / "progress.npz").read_bytes()
    for trial in range(12):
        folder = shutil.copytree(interrupted, tmp_path / str(trial))
        damaged = bytearray(content)
        damaged[generator.integers(len(content))] ^= 1 << generator.integers(8)
        (folder / "progress.npz").write_bytes(damaged)
        # Told, refused as another study's, or harmless: never taken over.
        with suppress(CounterspinWarning, CounterspinError):
            assert_whole(resumed(campaign, folder), whole)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {"done": np.ones(7)},
        {"done": np.ones(3, dtype=bool)},
        {"sums": np.zeros((1, 2, 3))},
        {"sums": np.full((2, 2, 70), np.nan)},
        {"sums": np.full((2, 2, 70), 1e303)},
        {"trials": np.array("many")},
        {"sums": np.array(["a", None], dtype=object)},
    ],
)
def test_progress_that_does_not_fit_is_told(campaign, begun, whole, change):
    with np.load(begun / "progress.npz") as kept:
        arrays = dict(kept) | change
    np.savez(begun / "progress.npz", **arrays)
    with pytest.warns(CounterspinWarning, match="starts again from the beginning"):
        outcome = resumed(campaign, begun)
    assert_whole(outcome, whole)


def test_parts_that_are_damaged_missing_or_of_another_study_are_done_again(
    campaign, begun, whole, tmp_path
):
    parts = sorted((begun / "progress").iterdir())
    assert len(parts) >= 2
    other = tmp_path / "other"
    study(
        campaign,
        trials=TRIALS,
        seed=4,
        output=StudyFolder(other, keep_trials=True),
        progress=stop,
    )
    shutil.copy(other / "progress" / parts[0].name, parts[0])
    with zipfile.ZipFile(parts[1]) as archive:
        place = archive.getinfo("values.npy").header_offset + 400
    damaged = bytearray(parts[1].read_bytes())
    damaged[place] ^= 1
    parts[1].write_bytes(damaged)
    lost = 2
    for part in parts[2:]:
        part.unlink()
        lost += 1
    with pytest.warns(CounterspinWarning, match=rf"{lost} of {len(parts)} files are missing, dam"):
        outcome = resumed(campaign, begun)
    assert outcome[2] == 0
    assert_whole(outcome, whole)


def test_what_is_whole_is_not_done_again(campaign, begun, whole):
    outcome = resumed(campaign, begun)
    assert outcome[2] >= 16_000
    assert_whole(outcome, whole)
    assert sorted(path.name for path in begun.iterdir()) == ["study.json", "trials.parquet"]


# Nothing is lost


def test_begun_study_is_not_begun_anew_by_a_slip(campaign, begun, whole, capsys):
    (begun / "study.json").unlink()
    before = {path: path.read_bytes() for path in begun.rglob("*") if path.is_file()}
    with raises("study-unfinished"):
        study(campaign, trials=TRIALS, output=begun)
    assert main(["study", str(campaign), "-o", str(begun)]) == 1
    assert "discard it with --overwrite" in " ".join(capsys.readouterr().err.split())
    assert {path: path.read_bytes() for path in begun.rglob("*") if path.is_file()} == before
    folder = StudyFolder(begun, overwrite=True)
    assert study(campaign, trials=TRIALS, output=folder) == whole[0]
    assert {path.name for path in begun.iterdir()} <= {"study.json", "trials.parquet"}


def test_earlier_result_is_replaced_only_if_that_is_asked_for(campaign, tmp_path):
    out = tmp_path / "out"
    study(campaign, trials=100, output=out)
    before = (out / "study.json").read_bytes()
    with pytest.raises(CounterspinError, match="exists; choose another file"):
        study(campaign, trials=200, output=out)
    assert (out / "study.json").read_bytes() == before
    study(campaign, trials=200, output=StudyFolder(out, overwrite=True))
    assert json.loads((out / "study.json").read_bytes())["trials"] == 200


@pytest.mark.parametrize("name", ["study.json", "trials.parquet", "z.svg", "coverage.svg"])
def test_files_of_somebody_else_are_not_replaced(campaign, tmp_path, name):
    (tmp_path / name).write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(CounterspinError, match="is not"):
            study(campaign, trials=100, output=StudyFolder(tmp_path, overwrite=overwrite))
    assert (tmp_path / name).read_text() == "mine"


def test_trials_of_somebody_else_beside_a_study_are_not_replaced(campaign, tmp_path):
    folder = StudyFolder(tmp_path, keep_trials=True, overwrite=True)
    for _ in range(2):
        study(campaign, trials=100, output=folder)
    trials = tmp_path / "trials.parquet"
    for mine in (b"mine", pl.DataFrame({"time_s": [0.0]}).write_parquet):
        trials.write_bytes(mine) if isinstance(mine, bytes) else mine(trials)
        before = trials.read_bytes()
        with raises("file-exists", "trials.parquet"):
            study(campaign, trials=100, output=folder)
        assert trials.read_bytes() == before


@pytest.mark.parametrize("name", ["z.svg", "bias-platform.svg"])
def test_a_study_is_not_gone_on_with_over_somebody_elses_figure(campaign, begun, name):
    (begun / name).write_text("mine")
    with raises("file-exists", "figure of a study"):
        resumed(campaign, begun)
    assert (begun / name).read_text() == "mine"


def test_options_of_the_folder_need_one(campaign, capsys):
    for option in ("--keep-trials", "--resume"):
        assert main(["study", str(campaign), option]) == 1
        assert f"{option} needs the folder " in capsys.readouterr().err


# Patience


def test_study_that_takes_long_says_so_first(campaign, monkeypatch, capsys):
    monkeypatch.setattr(study_module, "expected_duration", lambda engine, trials: 0.8 * trials)
    said = []
    monkeypatch.setattr(study_module, "run_batches", lambda *_, **__: said.append(1) or 1 / 0)
    with (
        pytest.warns(CounterspinWarning, match=r"40000 trials will take about 9 h"),
        pytest.raises(ZeroDivisionError),
    ):
        study(campaign, trials=40_000)
    main(["study", str(campaign), "--trials", "40000"])
    error = " ".join(capsys.readouterr().err.split())
    assert "40000 trials will take about 9 h" in error
    assert all(option in error for option in ("--trials", "--workers", "--cluster"))
    with (
        pytest.warns(CounterspinWarning, match=r"2000 trials will take about 27 min"),
        pytest.raises(ZeroDivisionError),
    ):
        study(campaign, trials=2000)
    with pytest.raises(ZeroDivisionError):
        study(campaign, trials=30)  # 24 s: no warning
