"""`counterspin simulate`: records of a campaign whose coefficients are known.

- `simulate`: a campaign description with [truth] tables -> record files in a folder
- `simulate_run`: one run's columns, in memory
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from counterspin.arrays import Array
from counterspin.campaign.description import read_campaign
from counterspin.campaign.resolved import (
    Accelerometer,
    Campaign,
    Run,
    SimulatedTruth,
    StatedNoise,
    sample_count,
)
from counterspin.campaign.toml_file import DESCRIPTION_NAME, load_document
from counterspin.campaign.truth import unfit
from counterspin.errors import CampaignError, CounterspinError
from counterspin.output import make_folder, write_open, write_whole
from counterspin.physics import observation, simulation
from counterspin.physics.motion import Trajectory
from counterspin.physics.path_errors import encoder_error

#: How the record of each ending is written.
WRITERS: Final[Mapping[str, Callable[[pl.DataFrame, Path], object]]] = {
    ".csv": lambda frame, path: write_open(path, frame.write_csv),
    ".parquet": lambda frame, path: write_open(path, frame.write_parquet),
}

#: A run is made in memory, column by column, so that more rows than this would fill it.
_MOST_ROWS: Final = 10**8


def simulate(
    where: Path | str | Campaign, folder: Path | str, *, overwrite: bool = False
) -> tuple[Path, ...]:
    """Write the records of every run, and the campaign's description beside them.

    Each run draws from a random stream of its own, so that adding a run at the end, or changing
    one, changes no other.

    Parameters
    ----------
    where
        A campaign's description file or its folder, or a campaign already read; with [truth].
    folder
        Where to write; made if it is not there.
    overwrite
        Whether records that are already there may be replaced.

    Returns
    -------
    tuple of Path
        The record files, in the order of the runs.

    Raises
    ------
    CampaignError
        If the description is wrong, the truth is missing or not credible, or a record's format
        cannot be written.
    CounterspinError
        If a file is in the way or cannot be written.
    """
    campaign = where if isinstance(where, Campaign) else read_campaign(where)
    campaign.require_records("simulate")
    folder = Path(folder)
    if campaign.simulation is None:
        raise CampaignError(
            str(campaign.path),
            ["truth: missing; `simulate` needs [truth.NAME] tables with the true coefficients"],
        )
    _refuse_long_runs(campaign, campaign.simulation.sampling_rate)
    if problems := unfit(campaign):
        raise CampaignError(str(campaign.path), problems)
    targets = _targets(campaign, folder)
    description = folder / DESCRIPTION_NAME
    own = description.exists() and description.samefile(campaign.path)
    if description.exists() and not own and not _is_simulated(description):
        raise CounterspinError(
            f"{description} is not of a simulated campaign; its files are not replaced: simulate "
            "into another folder"
        )
    in_the_way = [path for path in (*targets, *([] if own else [description])) if path.exists()]
    if in_the_way and not overwrite:
        raise CounterspinError(
            f"{in_the_way[0]} exists; simulate into another folder, or give `overwrite=True`"
        )
    for place in (folder, *(target.parent for target in targets)):
        make_folder(place)

    streams = np.random.SeedSequence(campaign.simulation.seed).spawn(len(campaign.runs))
    for run, stream, target in zip(campaign.runs, streams, targets, strict=True):
        frame = pl.DataFrame(simulate_run(campaign, run, np.random.default_rng(stream)))
        write = WRITERS[target.suffix.lower()]
        write_whole(target, partial(write, frame))
    if not own:
        write_whole(description, partial(shutil.copyfile, campaign.path))
    return targets


def _is_simulated(description: Path) -> bool:
    try:
        return "truth" in load_document(description)
    except CampaignError:
        return False


def _refuse_long_runs(campaign: Campaign, sampling_rate: float) -> None:
    problems = [
        f"runs[{index}]: {run.duration * sampling_rate:.3g} rows are more than can be simulated "
        f"at once ({_MOST_ROWS:.0e}); choose fewer revolutions, a shorter duration or a lower "
        "simulation.sampling_rate"
        for index, run in enumerate(campaign.runs)
        if run.duration is not None and run.duration * sampling_rate > _MOST_ROWS
    ]
    if problems:
        raise CampaignError(str(campaign.path), problems)


def _targets(campaign: Campaign, folder: Path) -> tuple[Path, ...]:
    """Return where each record goes: the place that it has in the campaign's own folder."""
    targets, problems = [], []
    for index, run in enumerate(campaign.runs):
        if run.record.suffix.lower() not in WRITERS:
            problems.append(
                f"runs[{index}].record: {run.record.name} cannot be simulated; "
                "write .csv or .parquet"
            )
        elif ".." in run.record.parts or not run.record.is_relative_to(campaign.folder):
            problems.append(
                f"runs[{index}].record: {run.record} is not inside the campaign's folder, so that "
                "a simulation has no place for it; name a file beside the description"
            )
        else:
            targets.append(folder / run.record.relative_to(campaign.folder))
    if problems:
        raise CampaignError(str(campaign.path), problems)
    return tuple(targets)


def simulate_run(
    campaign: Campaign, run: Run, generator: np.random.Generator
) -> Mapping[str, Array]:
    """Return the columns of one run's record, in the units of the campaign's channels.

    Parameters
    ----------
    campaign
        With [simulation] and [truth].
    run
        One of its runs.
    generator
        Source of the noise.

    Returns
    -------
    Mapping
        Column name -> values, shape (n,): time, angle (if the campaign has one), and one column
        for each accelerometer.

    Raises
    ------
    ValueError
        If the campaign has no simulation.
    """
    if campaign.simulation is None or run.truth is None or run.duration is None:
        raise ValueError("this campaign says nothing of what to simulate")
    truth, rate = campaign.simulation.truth, campaign.simulation.sampling_rate
    trajectory = Trajectory(run.truth.spindle, campaign.radius.value, campaign.site)
    times = np.arange(sample_count(run.duration, rate)) / rate
    noise = truth.noise
    columns = {campaign.time.column: _noisy(generator, times, noise.timing) / campaign.time.factor}
    if campaign.angle is not None:
        late = campaign.timing_offset.value if campaign.timing_offset else 0.0
        angle = run.truth.spindle.angle(times + late)
        angle = _noisy(generator, angle + encoder_error(run.truth.shared, angle), noise.angle)
        columns[campaign.angle.column] = angle / campaign.angle.factor
    for name, accelerometer in campaign.accelerometers.items():
        signal = simulation.recorded(
            trajectory,
            accelerometer.mounting,
            truth.coefficients.get(name, {}),
            run.truth.shared,
            times,
            accelerometer.observable,
            attitude=run.attitude,
        )
        signal = signal + _start_error(truth, name, times, accelerometer.observable)
        signal = _measured(generator, times, signal, accelerometer, noise)
        columns[accelerometer.channel.column] = signal / accelerometer.channel.factor
    return columns


def _start_error(truth: SimulatedTruth, name: str, times: Array, observable: str) -> Array | float:
    """Return what the system's error at the start leaves in its output: nothing in a force."""
    offset, velocity = truth.start_offset.get(name, 0.0), truth.start_velocity.get(name, 0.0)
    if observable == "displacement":
        return offset + velocity * times
    return velocity if observable == "velocity" else 0.0


def _noisy(generator: np.random.Generator, values: Array, sigma: float | str) -> Array:
    return values + _number(sigma) * generator.standard_normal(values.size)


def _measured(
    generator: np.random.Generator,
    times: Array,
    signal: Array,
    accelerometer: Accelerometer,
    noise: StatedNoise,
) -> Array:
    """Add the accelerometer's and the record's noise, then quantise."""
    order = observation.ORDERS[accelerometer.observable]
    walk = simulation.accelerometer_walk(generator, times, _number(noise.acceleration), order)
    white = _number(getattr(noise, accelerometer.observable))
    signal = _noisy(generator, signal + walk, white)
    step = _number(noise.quantisation)
    if step > 0.0 and accelerometer.observable == "displacement":
        signal = np.round(signal / step) * step
    return signal


def _number(sigma: float | str) -> float:
    """Return a true noise; the description has made sure that it is a number."""
    return float(sigma)
