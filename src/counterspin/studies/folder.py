"""Folder of a study: its result, its trials, and the files for a resumption."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from counterspin.arrays import Array
from counterspin.errors import CounterspinError, CounterspinWarning, ExistingFileError
from counterspin.frozen import frozen
from counterspin.output import FileType, check_writable, make_folder, write_atomically
from counterspin.studies.batch_runner import BatchResults
from counterspin.studies.result import StudyResult

_RESULT_FILE: Final = "study.json"
_TRIALS_FILE: Final = "trials.parquet"
_PROGRESS_FILE: Final = "progress.npz"
_BATCHES_FOLDER: Final = "progress"

#: Suffixes of the columns of a coefficient.
_COLUMN_SUFFIXES: Final = (".truth", ".estimate", ".u")

#: Largest plausible sum in any unit; the square of a larger number might overflow.
_MAX_SUM: Final = 1e100


@frozen
class StudyFolder:
    """Folder for the result of a study and the files for a resumption.

    Attributes
    ----------
    path
        The folder; created if missing.
    keep_trials
        True: write every trial to ``trials.parquet``.
    resume
        True: continue the unfinished study in the folder.
    overwrite
        True: replace the result of an earlier study, or discard an unfinished study.
    """

    path: Path | str
    keep_trials: bool = False
    resume: bool = False
    overwrite: bool = False

    @property
    def directory(self) -> Path:
        """The folder."""
        return Path(self.path)

    def reserve(self) -> None:
        """Create the folder; raise an error if a file or an unfinished study would be lost.

        Raises
        ------
        CounterspinError
            If so, or if the folder cannot be made.
        """
        make_folder(self.directory)
        check_writable(
            self.directory / _RESULT_FILE,
            StudyResult.file_kind,
            overwrite=self.overwrite or self.resume,
        )
        figure_paths = [
            *(self.directory / "z.svg", self.directory / "coverage.svg"),
            *sorted(self.directory.glob("bias-*.svg")),
        ]
        trials_file = self.directory / _TRIALS_FILE
        if self.keep_trials and trials_file.exists() and not _is_trials_file(trials_file):
            raise _foreign_file_error(trials_file)
        has_progress = (self.directory / _PROGRESS_FILE).exists()
        if (
            (self.directory / _RESULT_FILE).exists()
            or self.resume
            or (has_progress and self.overwrite)
        ):
            if any(figure_path.exists() for figure_path in figure_paths):
                from counterspin.reports.charts import check_figures_writable
                from counterspin.studies.page import FIGURE_TYPE

                check_figures_writable(figure_paths, FIGURE_TYPE, overwrite=True)
            return
        if has_progress:
            raise CounterspinError(
                f"{self.directory}: contains an unfinished study; continue it with `resume=True`, "
                "choose another folder, or discard it with `overwrite=True`",
                code="study-unfinished",
            )
        for path in (trials_file, self.directory / _BATCHES_FOLDER, *figure_paths):
            if path.exists():
                raise _foreign_file_error(path)

    def write(self, result: StudyResult, batch_results: BatchResults) -> None:
        """Write the result, and the trials if they were kept."""
        result.write(self.directory / _RESULT_FILE, overwrite=self.overwrite or self.resume)
        if not batch_results.keep_trials:
            return
        names = [
            f"{coefficient.analysis}.{coefficient.name}"
            for coefficient in batch_results.coefficients
        ]
        write_atomically(
            self.directory / _TRIALS_FILE,
            lambda temporary_path: _write_parquet(temporary_path, names, batch_results),
            lambda: _TRIALS_FILE_TYPE,
            overwrite=self.overwrite or self.resume,
        )


def _foreign_file_error(path: Path) -> CounterspinError:
    return ExistingFileError(
        f"{path} already exists and was not written by a study, so it was not replaced; choose "
        "another folder"
    )


def _is_trials_file(path: Path) -> bool:
    """Check that a file has the columns that `_write_parquet` writes."""
    try:
        first_column, *columns = pl.read_parquet_schema(path)
    except (OSError, ValueError, pl.exceptions.PolarsError):
        return False
    return first_column == "trial" and all(name.endswith(_COLUMN_SUFFIXES) for name in columns)


#: File with the values of each trial.
_TRIALS_FILE_TYPE: Final = FileType("a file with the trials of a study", _is_trials_file)


def _write_parquet(path: Path, names: list[str], batch_results: BatchResults) -> None:
    """Write a row for each trial: its number, and truth, estimate and u of each coefficient."""
    batches = np.flatnonzero(batch_results.is_done)
    trial_numbers = np.concatenate(
        [
            int(batch) * batch_results.batch_size + np.arange(batch_results.trial_count(int(batch)))
            for batch in batches
        ]
    )
    columns = {"trial": pl.Series(trial_numbers)}
    for index, name in enumerate(names):
        for column_index, suffix in enumerate(_COLUMN_SUFFIXES):
            values = [batch_results.values[int(batch)][index, column_index] for batch in batches]
            columns[f"{name}{suffix}"] = pl.Series(np.concatenate(values))
    pl.DataFrame(columns).write_parquet(path)


class StudyProgress:
    """Saved copy of the finished batches of a study."""

    def __init__(self, folder: Path, batch_results: BatchResults, fingerprint: str) -> None:
        self.folder, self.batch_results = folder, batch_results
        self._fingerprint = f"{fingerprint}/{batch_results.batch_size}/{batch_results.keep_trials}"
        self._saved_batches: set[int] = set()

    @property
    def _sums_file(self) -> Path:
        return self.folder / _PROGRESS_FILE

    def _batch_file(self, batch: int) -> Path:
        return self.folder / _BATCHES_FOLDER / f"{batch:07d}.npz"

    def save(self) -> None:
        """Save the finished batches atomically."""
        batch_results = self.batch_results
        if not self._sums_file.exists():
            # This file marks the folder as a study before other files exist.
            self._save_sums(np.zeros_like(batch_results.is_done))
        for batch in set(batch_results.values) - self._saved_batches:
            # Write trials first, so that finished batches are complete.
            self._batch_file(batch).parent.mkdir(parents=True, exist_ok=True)
            self._save_arrays(self._batch_file(batch), values=batch_results.values[batch])
            self._saved_batches.add(batch)
        self._save_sums(batch_results.is_done)

    def _save_sums(self, is_done: Array) -> None:
        batch_results = self.batch_results
        self._save_arrays(
            self._sums_file,
            trials=np.array(batch_results.trials),
            done=is_done,
            sums=batch_results.sums[is_done],
        )

    def _save_arrays(self, path: Path, **arrays: Any) -> None:
        fingerprint = np.array(self._fingerprint)
        write_atomically(path, partial(np.savez, fingerprint=fingerprint, **arrays), overwrite=True)

    def resume(self) -> None:
        """Load the batches of an earlier study; report damaged batches, which run again."""
        if not self._sums_file.exists():
            raise CounterspinError(
                f"{self.folder}: contains no study to resume; omit `resume`, or give the folder "
                "of the study as `output`",
                code="study-not-found",
            )
        arrays = _load_arrays(self._sums_file)
        if arrays is not None and str(arrays.get("fingerprint")) != self._fingerprint:
            raise CounterspinError(
                f"{self.folder}: this folder contains a study with a different description, "
                "engine or `keep_trials`; use another folder",
                code="study-differs",
            )
        try:
            saved_trials, batches, sums = self._check_sums(arrays)
        except (KeyError, TypeError, ValueError):
            _warn_of_repeated_trials(
                f"{self._sums_file} is damaged, so the study starts again from the beginning"
            )
            return
        n_lost = 0
        batch_results = self.batch_results
        for batch, batch_sums in zip(batches, sums, strict=True):
            # A truncated last batch of a shorter study runs again.
            n_saved = min(batch_results.batch_size, saved_trials - batch * batch_results.batch_size)
            if batch >= batch_results.is_done.size or n_saved != batch_results.trial_count(batch):
                continue
            if batch_results.keep_trials:
                values = self._load_trials(batch)
                if values is None:
                    n_lost += 1
                    continue
                batch_results.values[batch] = values
                self._saved_batches.add(batch)
            batch_results.sums[batch], batch_results.is_done[batch] = batch_sums, True
        if n_lost:
            _warn_of_repeated_trials(
                f"{self.folder / _BATCHES_FOLDER}: {n_lost} of {len(batches)} files are missing, "
                "damaged or from another study. The study repeats the trials in these files"
            )

    def _check_sums(self, arrays: dict[str, Array] | None) -> tuple[int, list[int], Array]:
        """Return the number of trials, the finished batches and their sums; check their shapes."""
        if arrays is None:
            raise ValueError
        saved_trials, is_done, sums = int(arrays["trials"]), arrays["done"], arrays["sums"]
        batches = [int(batch) for batch in np.flatnonzero(is_done)]
        is_consistent = is_done.dtype == bool and is_done.shape == (
            -(-saved_trials // self.batch_results.batch_size),
        )
        if not is_consistent or sums.shape != (len(batches), *self.batch_results.sums.shape[1:]):
            raise ValueError
        if sums.dtype != np.float64 or not (np.abs(sums) < _MAX_SUM).all():
            raise ValueError
        return saved_trials, batches, sums

    def _load_trials(self, batch: int) -> Array | None:
        """Return the trials of a batch, or None if its file is missing or does not match."""
        arrays = _load_arrays(self._batch_file(batch))
        if arrays is None or str(arrays.get("fingerprint")) != self._fingerprint:
            return None
        values = arrays.get("values")
        shape = (len(self.batch_results.coefficients), 3, self.batch_results.trial_count(batch))
        if values is None or values.dtype != np.float64 or values.shape != shape:
            return None
        return values

    def clear(self) -> None:
        """Remove the saved batches of a finished or discarded study."""
        self._sums_file.unlink(missing_ok=True)
        directory = self.folder / _BATCHES_FOLDER
        for batch_file in directory.glob("[0-9]" * 7 + ".npz"):
            batch_file.unlink(missing_ok=True)
        if directory.is_dir() and not any(directory.iterdir()):
            directory.rmdir()


def _load_arrays(path: Path) -> dict[str, Array] | None:
    """Return the arrays of a file, or None if it is missing or damaged."""
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file, np.load(file) as arrays:
            return dict(arrays)
    except Exception:  # whatever NumPy, zipfile and zlib raise on a damaged file
        return None


def _warn_of_repeated_trials(text: str) -> None:
    warnings.warn(CounterspinWarning(text, code="trials-repeated"), stacklevel=4)
