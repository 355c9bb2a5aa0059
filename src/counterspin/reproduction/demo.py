"""`counterspin demo`: the paper's plan from simulation to result, by every method."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Final

from counterspin.calibration.joint import fit_jointly
from counterspin.calibration.joint_problem import JointProblem
from counterspin.calibration.observed_runs import observe_runs
from counterspin.calibration.options import TwoStageOptions
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.calibration.two_stage.method import TwoStageOutcome, calibrate_accelerometer
from counterspin.campaign.description import Campaign, read_campaign
from counterspin.campaign.documents import DESCRIPTION_NAME
from counterspin.errors import ExistingFileError, WriteError
from counterspin.frozen import frozen
from counterspin.input import read_file
from counterspin.output import make_folder, write_text
from counterspin.simulation.simulate import simulate
from counterspin.toml_text import parse_toml

#: Default folder of the demonstration.
DEFAULT_FOLDER: Final = "counterspin-demo"

#: Options of the paper: its equations as printed, and unweighted runs.
_PAPER_OPTIONS: Final = TwoStageOptions(model="as-printed", weighted=False)


@frozen
class Demonstration:
    """One simulated campaign with a single accelerometer, calibrated three ways."""

    campaign: Campaign  #: The plan of the paper, including the true coefficients.
    records: tuple[Path, ...]  #: The record files.
    joint: AccelerometerResult  #: All samples in one fit.
    two_stage: TwoStageOutcome  #: The paper's method with exact equations.
    #: The paper's method with its equations as printed: K_II is half the truth.
    as_printed: TwoStageOutcome

    @property
    def truth(self) -> Mapping[str, float]:
        """Term symbol -> true coefficient of the simulated records, in g-units."""
        assert self.campaign.simulation is not None
        (coefficients,) = self.campaign.simulation.truth.coefficients.values()
        return coefficients


def demo(folder: Path | str = DEFAULT_FOLDER, *, overwrite: bool = False) -> Demonstration:
    """Simulate the paper's plan (its Tables 1 and 2, section 2.3) and calibrate it.

    Parameters
    ----------
    folder
        Folder of ``campaign.toml`` and its records; created if it does not exist.
    overwrite
        Whether an earlier demonstration in the folder may be replaced.

    Returns
    -------
    Demonstration

    Raises
    ------
    CounterspinError
        If the folder contains another or an edited campaign or its records, or is not writable.
    """
    folder = Path(folder)
    write_description(folder)
    campaign = read_campaign(folder)
    records = simulate(campaign, folder, overwrite=overwrite)
    problem = JointProblem(campaign, tuple(observe_runs(campaign)))
    (accelerometer,) = campaign.accelerometers.values()
    return Demonstration(
        campaign=campaign,
        records=records,
        joint=fit_jointly(problem).accelerometers[accelerometer.name],
        two_stage=calibrate_accelerometer(
            problem, accelerometer, TwoStageOptions(), {}, problem.series
        ),
        as_printed=calibrate_accelerometer(
            problem, accelerometer, _PAPER_OPTIONS, {}, problem.series
        ),
    )


def write_description(folder: Path) -> None:
    """Write the paper's plan; CounterspinError if the folder holds another campaign or records."""
    text = (files("counterspin.reproduction") / "paper.toml").read_text("utf-8")
    path = folder / DESCRIPTION_NAME
    try:
        if path.exists() and read_file(path) != text.encode():
            raise ExistingFileError(
                f"{path} belongs to another campaign, or to an earlier or edited demonstration; "
                "remove it, or choose another folder"
            )
        existing_records = [
            record_path
            for run in parse_toml(text)["runs"]
            if (record_path := folder / run["record"]).exists()
        ]
        if existing_records and not path.exists():
            raise ExistingFileError(
                f"{existing_records[0]} does not belong to a demonstration; choose another folder"
            )
    except OSError as error:
        raise WriteError(f"{folder} cannot be used ({error.strerror})") from error
    make_folder(folder)
    if not path.exists():
        write_text(path, text)
