"""Folder of a study: its result, its trials, and the files that a resumption needs."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl

from counterspin.arrays import Array
from counterspin.errors import CounterspinError, CounterspinWarning
from counterspin.frozen import frozen
from counterspin.output import FileType, make_folder, reserve, write_whole
from counterspin.studies.result import StudyResult
from counterspin.studies.work import Ledger

_RESULT: Final = "study.json"
_TRIALS: Final = "trials.parquet"
_PROGRESS: Final = "progress.npz"
_PARTS: Final = "progress"

#: Endings of the columns of a trial.
_OF_A_COEFFICIENT: Final = (".truth", ".estimate", ".u")

#: No sum of a study comes near it, in any unit; squares of it can still be added.
_LARGEST_SUM: Final = 1e100


@frozen
class StudyFolder:
    """The folder of a study's result and of the files that a resumption needs.

    Attributes
    ----------
    path
        The folder; created if missing.
    keep_trials
        True: write every trial to ``trials.parquet``.
    resume
        True: continue the study that was begun in the folder.
    overwrite
        True: replace an earlier study's result, or discard an unfinished study.
    """

    path: Path | str
    keep_trials: bool = False
    resume: bool = False
    overwrite: bool = False

    @property
    def place(self) -> Path:
        """The folder."""
        return Path(self.path)

    def reserve(self) -> None:
        """Make the folder, and refuse one in which a file or a begun study would be lost.

        Raises
        ------
        CounterspinError
            If so, or if the folder cannot be made.
        """
        make_folder(self.place)
        reserve(
            self.place / _RESULT, StudyResult.file_kind, overwrite=self.overwrite or self.resume
        )
        figures = [
            *(self.place / "z.svg", self.place / "coverage.svg"),
            *sorted(self.place.glob("bias-*.svg")),
        ]
        trials = self.place / _TRIALS
        if self.keep_trials and trials.exists() and not _holds_trials(trials):
            raise _not_of_a_study(trials)
        begun = (self.place / _PROGRESS).exists()
        if (self.place / _RESULT).exists() or self.resume or (begun and self.overwrite):
            if any(figure.exists() for figure in figures):
                from counterspin.reports.charts import reserve_figures
                from counterspin.studies.page import FIGURE

                reserve_figures(figures, FIGURE, overwrite=True)
            return
        if begun:
            raise CounterspinError(
                f"{self.place}: contains an unfinished study; continue it with `resume=True`, "
                "choose another folder, or discard it with `overwrite=True`"
            )
        for path in (trials, self.place / _PARTS, *figures):
            if path.exists():
                raise _not_of_a_study(path)

    def write(self, result: StudyResult, ledger: Ledger) -> None:
        """Write the result, and the trials where they were kept."""
        result.write(self.place / _RESULT, overwrite=self.overwrite or self.resume)
        if not ledger.keep:
            return
        names = [f"{coefficient.analysis}.{coefficient.name}" for coefficient in ledger.reported]
        write_whole(
            self.place / _TRIALS,
            lambda part: _parquet(part, names, ledger),
            lambda: _KEPT_TRIALS,
            overwrite=self.overwrite or self.resume,
        )


def _not_of_a_study(path: Path) -> CounterspinError:
    return CounterspinError(
        f"{path} exists and was not written by a study, so it is not replaced: name another folder"
    )


def _holds_trials(path: Path) -> bool:
    """Check that a file has the columns that `_parquet` writes."""
    try:
        first, *others = pl.read_parquet_schema(path)
    except (OSError, ValueError, pl.exceptions.PolarsError):
        return False
    return first == "trial" and all(name.endswith(_OF_A_COEFFICIENT) for name in others)


#: What is written of each trial.
_KEPT_TRIALS: Final = FileType("a file of a study's trials", _holds_trials)


def _parquet(path: Path, names: list[str], ledger: Ledger) -> None:
    """Write one row a trial: its number, and truth, estimate and u of each coefficient."""
    batches = np.flatnonzero(ledger.done)
    number = np.concatenate(
        [int(b) * ledger.size + np.arange(ledger.trials_of(int(b))) for b in batches]
    )
    columns = {"trial": pl.Series(number)}
    for place, name in enumerate(names):
        for part, word in enumerate(_OF_A_COEFFICIENT):
            values = [ledger.values[int(b)][place, part] for b in batches]
            columns[f"{name}{word}"] = pl.Series(np.concatenate(values))
    pl.DataFrame(columns).write_parquet(path)


class StudyProgress:
    """The copy on disk of the finished batches of a study."""

    def __init__(self, folder: Path, ledger: Ledger, fingerprint: str) -> None:
        self.folder, self.ledger = folder, ledger
        self._fingerprint = f"{fingerprint}/{ledger.size}/{ledger.keep}"
        self._written: set[int] = set()

    @property
    def _file(self) -> Path:
        return self.folder / _PROGRESS

    def _part(self, batch: int) -> Path:
        return self.folder / _PARTS / f"{batch:07d}.npz"

    def save(self) -> None:
        """Write the copy, whole or not at all."""
        ledger = self.ledger
        if not self._file.exists():
            # Whatever comes to lie there from now on is known as a study's.
            self._save_done(np.zeros_like(ledger.done))
        for batch in set(ledger.values) - self._written:
            # Trials first, so that batches marked as done are complete.
            self._part(batch).parent.mkdir(parents=True, exist_ok=True)
            self._save(self._part(batch), values=ledger.values[batch])
            self._written.add(batch)
        self._save_done(ledger.done)

    def _save_done(self, done: Array) -> None:
        ledger = self.ledger
        self._save(self._file, trials=np.array(ledger.trials), done=done, sums=ledger.sums[done])

    def _save(self, path: Path, **arrays: Any) -> None:
        fingerprint = np.array(self._fingerprint)
        write_whole(path, partial(np.savez, fingerprint=fingerprint, **arrays), overwrite=True)

    def resume(self) -> None:
        """Load the batches of an earlier study; report damaged batches, which run again."""
        if not self._file.exists():
            raise CounterspinError(
                f"{self.folder}: contains no study to resume; leave out `resume`, or "
                "give its folder as `output`"
            )
        kept = _read(self._file)
        if kept is not None and str(kept.get("fingerprint")) != self._fingerprint:
            raise CounterspinError(
                f"{self.folder}: the study begun there differs (in its description, "
                "engine or `keep_trials`); use another folder"
            )
        try:
            before, batches, sums = self._sums(kept)
        except (KeyError, TypeError, ValueError):
            _tell(f"{self._file} is damaged: the study starts again from the beginning")
            return
        lost = 0
        ledger = self.ledger
        for batch, row in zip(batches, sums, strict=True):
            # A last batch that another study truncated runs again.
            complete = min(ledger.size, before - batch * ledger.size)
            if batch >= ledger.done.size or complete != ledger.trials_of(batch):
                continue
            if ledger.keep:
                values = self._values(batch)
                if values is None:
                    lost += 1
                    continue
                ledger.values[batch] = values
                self._written.add(batch)
            ledger.sums[batch], ledger.done[batch] = row, True
        if lost:
            _tell(
                f"{self.folder / _PARTS}: {lost} of {len(batches)} files are missing, damaged "
                "or from another study: their trials are repeated"
            )

    def _sums(self, kept: dict[str, Array] | None) -> tuple[int, list[int], Array]:
        """Return trials, batches that are done and their sums; raises if they do not fit."""
        if kept is None:
            raise ValueError
        before, done, sums = int(kept["trials"]), kept["done"], kept["sums"]
        batches = [int(batch) for batch in np.flatnonzero(done)]
        fits = done.dtype == bool and done.shape == (-(-before // self.ledger.size),)
        if not fits or sums.shape != (len(batches), *self.ledger.sums.shape[1:]):
            raise ValueError
        if sums.dtype != np.float64 or not (np.abs(sums) < _LARGEST_SUM).all():
            raise ValueError
        return before, batches, sums

    def _values(self, batch: int) -> Array | None:
        """Return the trials of a batch, or None where its file does not hold them."""
        kept = _read(self._part(batch))
        if kept is None or str(kept.get("fingerprint")) != self._fingerprint:
            return None
        values = kept.get("values")
        shape = (len(self.ledger.reported), 3, self.ledger.trials_of(batch))
        if values is None or values.dtype != np.float64 or values.shape != shape:
            return None
        return values

    def clear(self) -> None:
        """Remove the copy: everything is in the result, or it is given up."""
        self._file.unlink(missing_ok=True)
        place = self.folder / _PARTS
        for part in place.glob("[0-9]" * 7 + ".npz"):
            part.unlink(missing_ok=True)
        if place.is_dir() and not any(place.iterdir()):
            place.rmdir()


def _read(path: Path) -> dict[str, Array] | None:
    """Return a file's arrays; None where it is missing or damaged."""
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file, np.load(file) as kept:
            return dict(kept)
    except Exception:  # whatever NumPy, zipfile and zlib raise on a damaged file
        return None


def _tell(text: str) -> None:
    warnings.warn(text, CounterspinWarning, stacklevel=4)
