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
from counterspin.output import write_atomically
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
def single_batch_tasks():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch_runner, "_TASK_DURATION", 0.0)
        yield


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "campaign.toml").write_text(PAPER + STUDY, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def uninterrupted_study(campaign, tmp_path_factory):
    """Return result and trials of the uninterrupted study."""
    out = tmp_path_factory.mktemp("whole") / "out"
    result = study(campaign, trials=TRIALS, output=StudyFolder(out, keep_trials=True))
    return result, pl.read_parquet(out / "trials.parquet")


@pytest.fixture(scope="module")
def interrupted_folder(campaign, tmp_path_factory):
    out = tmp_path_factory.mktemp("interrupted") / "out"
    result = study(
        campaign, trials=TRIALS, output=StudyFolder(out, keep_trials=True), progress=stop
    )
    assert 0 < result.trials < TRIALS
    return out


@pytest.fixture
def unfinished_folder(interrupted_folder, tmp_path):
    """Return a copy of the folder of an unfinished study that tests may damage."""
    return shutil.copytree(interrupted_folder, tmp_path / "out")


def resume_study(campaign, folder):
    """Resume the study; returns the trials that did not have to be done again."""
    kept = []
    result = study(
        campaign,
        trials=TRIALS,
        output=StudyFolder(folder, keep_trials=True, resume=True),
        progress=lambda done, _: kept.append(done),
    )
    return result, pl.read_parquet(folder / "trials.parquet"), kept[0]


def assert_complete(outcome, uninterrupted_study):
    assert outcome[0] == uninterrupted_study[0]
    assert outcome[1].equals(uninterrupted_study[1])


# Kills


class KilledError(BaseException):
    pass


@pytest.mark.parametrize("writes", [1, 2])
def test_study_killed_during_save_resumes(
    campaign, tmp_path, monkeypatch, uninterrupted_study, writes
):
    written = []

    def write(path, content, **more):
        if len(written) == writes:
            raise KilledError
        written.append(path)
        write_atomically(path, content, **more)

    monkeypatch.setattr("counterspin.studies.folder.write_atomically", write)
    with pytest.raises(KilledError):
        study(campaign, trials=TRIALS, output=StudyFolder(tmp_path / "out", keep_trials=True))
    monkeypatch.undo()
    assert_complete(resume_study(campaign, tmp_path / "out"), uninterrupted_study)


# Damage


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 0.999])
def test_truncated_progress_restarts_study(campaign, unfinished_folder, uninterrupted_study, share):
    file = unfinished_folder / "progress.npz"
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.warns(CounterspinWarning, match=r"progress\.npz is damaged"):
        outcome = resume_study(campaign, unfinished_folder)
    assert outcome[2] == 0
    assert_complete(outcome, uninterrupted_study)


@pytest.mark.slow
def test_corrupted_progress_is_never_used(
    campaign, interrupted_folder, tmp_path, uninterrupted_study
):
    generator = np.random.default_rng(7)
    content = (interrupted_folder / "progress.npz").read_bytes()
    for trial in range(12):
        folder = shutil.copytree(interrupted_folder, tmp_path / str(trial))
        damaged = bytearray(content)
        damaged[generator.integers(len(content))] ^= 1 << generator.integers(8)
        (folder / "progress.npz").write_bytes(damaged)
        # Told, refused as another study's, or harmless: never taken over.
        with suppress(CounterspinWarning, CounterspinError):
            assert_complete(resume_study(campaign, folder), uninterrupted_study)


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
def test_inconsistent_progress_is_reported(
    campaign, unfinished_folder, uninterrupted_study, change
):
    with np.load(unfinished_folder / "progress.npz") as kept:
        arrays = dict(kept) | change
    np.savez(unfinished_folder / "progress.npz", **arrays)
    with pytest.warns(CounterspinWarning, match="starts again from the beginning"):
        outcome = resume_study(campaign, unfinished_folder)
    assert_complete(outcome, uninterrupted_study)


def test_invalid_chunks_are_recomputed(campaign, unfinished_folder, uninterrupted_study, tmp_path):
    parts = sorted((unfinished_folder / "progress").iterdir())
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
        outcome = resume_study(campaign, unfinished_folder)
    assert outcome[2] == 0
    assert_complete(outcome, uninterrupted_study)


def test_valid_chunks_are_not_recomputed(campaign, unfinished_folder, uninterrupted_study):
    outcome = resume_study(campaign, unfinished_folder)
    assert outcome[2] >= 16_000
    assert_complete(outcome, uninterrupted_study)
    assert sorted(path.name for path in unfinished_folder.iterdir()) == [
        "study.json",
        "trials.parquet",
    ]


# Nothing is lost


def test_unfinished_study_requires_resume_or_overwrite(
    campaign, unfinished_folder, uninterrupted_study, capsys
):
    (unfinished_folder / "study.json").unlink()
    before = {path: path.read_bytes() for path in unfinished_folder.rglob("*") if path.is_file()}
    with raises("study-unfinished"):
        study(campaign, trials=TRIALS, output=unfinished_folder)
    assert main(["study", str(campaign), "-o", str(unfinished_folder)]) == 1
    assert "discard it with --overwrite" in " ".join(capsys.readouterr().err.split())
    assert {
        path: path.read_bytes() for path in unfinished_folder.rglob("*") if path.is_file()
    } == before
    folder = StudyFolder(unfinished_folder, overwrite=True)
    assert study(campaign, trials=TRIALS, output=folder) == uninterrupted_study[0]
    assert {path.name for path in unfinished_folder.iterdir()} <= {"study.json", "trials.parquet"}


def test_existing_result_requires_overwrite(campaign, tmp_path):
    out = tmp_path / "out"
    study(campaign, trials=100, output=out)
    before = (out / "study.json").read_bytes()
    with pytest.raises(CounterspinError, match="exists; choose another file"):
        study(campaign, trials=200, output=out)
    assert (out / "study.json").read_bytes() == before
    study(campaign, trials=200, output=StudyFolder(out, overwrite=True))
    assert json.loads((out / "study.json").read_bytes())["trials"] == 200


@pytest.mark.parametrize("name", ["study.json", "trials.parquet", "z.svg", "coverage.svg"])
def test_foreign_files_are_not_replaced(campaign, tmp_path, name):
    (tmp_path / name).write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(CounterspinError, match="was not"):
            study(campaign, trials=100, output=StudyFolder(tmp_path, overwrite=overwrite))
    assert (tmp_path / name).read_text() == "mine"


def test_foreign_trials_file_is_not_replaced(campaign, tmp_path):
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
def test_foreign_figure_prevents_resuming(campaign, unfinished_folder, name):
    (unfinished_folder / name).write_text("mine")
    with raises("file-exists", "figure of a study"):
        resume_study(campaign, unfinished_folder)
    assert (unfinished_folder / name).read_text() == "mine"


def test_folder_options_require_folder(campaign, capsys):
    for option in ("--keep-trials", "--resume"):
        assert main(["study", str(campaign), option]) == 2
        assert f"{option} requires the folder " in capsys.readouterr().err


# Patience


def test_long_study_prints_time_estimate(campaign, monkeypatch, capsys):
    monkeypatch.setattr(study_module, "expected_duration", lambda engine, trials: 0.8 * trials)
    messages = []
    monkeypatch.setattr(study_module, "run_batches", lambda *_, **__: messages.append(1) or 1 / 0)
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
