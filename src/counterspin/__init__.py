"""Calibration of inertial accelerometers on precision centrifuges.

    import counterspin as cs

    result = cs.calibrate("my-campaign")
    k_ii = result.accelerometers["Qx"].coefficients["K_II"]
    print(k_ii.value, k_ii.u, k_ii.unit)

Commands as functions:

- `init`: write a commented campaign description
- `simulate`: simulate the records of a campaign from known coefficients
- `calibrate`: calibrate a campaign (`Result`); `TwoStageOptions`: options of the paper's method
- `apply`: correct indicated specific forces with a `Result` (`Correction`); `apply_file`: correct a
  file; `ApplyOptions`: unit, and forces along the other axes
- `export`: export the coefficients of a result for other programs
- `plan`: find the optimal runs for a goal (`PlannedCampaign`)
- `forecast`: predict the uncertainties of a campaign (`Forecast`)
- `study`: analyse many simulated trials of a campaign (`StudyResult`); `StudyFolder`: output
  folder; `Workers`: parallel processes
- `demo`: simulate and calibrate the paper's plan (`Demonstration`)
- `history`: track a coefficient of each instrument over time (`History`)
- `applied`: compute the uncertainty budget of the acceleration that a centrifuge applies, by level
  (`AppliedAcceleration`)
- `operating`: evaluate linearity, hysteresis, threshold, resolution, dead band or warm-up
  (`OperatingTests`)
- `compare`: compare results of different models, methods or campaigns (`ResultComparison`)
- `intercompare`: compare laboratories that calibrated the same instrument (`Intercomparison`)
- `rerun`: repeat the calibration of a result (`RepeatedCalibration`)
- `check`: check a record (`CheckedRun`); `watch`: monitor a campaign during recording
  (`WatchState`), with a polling interval (`Pace`)
- `noise`: analyse the noise of a static record (`NoiseResult`)
- `reproduce`: compare the paper's numbers with recomputed numbers (`Reproduction`)
- `validate`: run the reference cases on this installation (`Dossier`); `write_dossier`: write files
- `print_result`: print a `Result`; `write_result`, `read_result`: write and read its JSON file
- `report`, `write_report`: make the report of any of these results as HTML, PDF or Markdown
- `certificate`: make the Digital Calibration Certificate (`Certificate`) of a result
- `read_campaign`: read and check a description (`Campaign`); `make_campaign`: make a campaign from
  a mapping and data frames; `Quantity`: value, standard uncertainty and unit

Physics:

- `Spindle`, `Ripple`, `fit_spindle`: the angle of the spindle (Eq. 1-4) and its identification
- `Site`, `Trajectory`: position, velocity and specific force of the platform
- `Mounting`, `QX`, `QY`, `QZ`: axes of an accelerometer; `TERMS`, `SHARED_TERMS`: error terms
- `indicated`: indicated specific force (Eq. 7)
- `reference`: the record of an ideal system; `columns`: the error per unit of each coefficient

The paper's two-stage method:

- `strobe_angle`, `strobes_by_angle`, `strobes_by_nominal_rate`: one sample per revolution (Eq. 15)
- `first_stage`: a `Parabola` for each run (Eq. 16-18, 31)
- `StrobedRun`, `second_stage`: K_II from all runs (Eq. 20-27, 33-34), a `SecondStage`;
  `TwoStageRequest`: its model, priors and weights

All errors that counterspin raises on purpose are `CounterspinError`: `CampaignError`,
`RecordError`, `NotIdentifiableError`, `ConvergenceError`. Warnings are `CounterspinWarning`.

Glossary
--------
units
    SI, with angles in rad, unless stated otherwise. Accelerometer coefficients are in g-units (g,
    g/g, g/g^2, g/g^3), where g is the site's plumb-line gravity; misalignments are in rad.
frame
    East-north-up at the spindle axis; vectors are the last axis of an array, shape (n, 3).
spindle angle
    From east towards north; a negative rate is clockwise.
accelerometer axes
    Input I, pendulous P, output O, right-handed: I x P = O.
coefficients
    K_F bias, K_I scale factor, K_II second order, K_III third order, K_IP and so on cross terms,
    with the paper's symbols. Coefficients are not normalised by K_I (IEEE Std 1293:
    K2 = K_II/K_I).
displacement error
    Recorded minus true displacement along the input axis. For a given trajectory, it is linear in
    the coefficients.
u
    Standard uncertainty (k = 1).

Names are loaded on first use, so that ``import counterspin`` is fast.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from counterspin._version import __version__ as __version__
    from counterspin.acceleration_standard.budget import applied as applied
    from counterspin.acceleration_standard.result import AppliedAcceleration as AppliedAcceleration
    from counterspin.calibration.calibrate import calibrate as calibrate
    from counterspin.calibration.options import TwoStageOptions as TwoStageOptions
    from counterspin.calibration.pages.document import print_result as print_result
    from counterspin.calibration.result import Result as Result
    from counterspin.calibration.result import read_result as read_result
    from counterspin.calibration.result import write_result as write_result
    from counterspin.campaign.description import Campaign as Campaign
    from counterspin.campaign.description import read_campaign as read_campaign
    from counterspin.campaign.memory import make_campaign as make_campaign
    from counterspin.campaign.quantity import Quantity as Quantity
    from counterspin.certificates.issuing import Certificate as Certificate
    from counterspin.certificates.issuing import certificate as certificate
    from counterspin.comparisons.compare import compare as compare
    from counterspin.comparisons.intercompare import intercompare as intercompare
    from counterspin.comparisons.rerun import rerun as rerun
    from counterspin.comparisons.result import Intercomparison as Intercomparison
    from counterspin.comparisons.result import RepeatedCalibration as RepeatedCalibration
    from counterspin.comparisons.result import ResultComparison as ResultComparison
    from counterspin.correction.apply import ApplyOptions as ApplyOptions
    from counterspin.correction.apply import Correction as Correction
    from counterspin.correction.apply import apply as apply
    from counterspin.correction.apply_file import apply_file as apply_file
    from counterspin.correction.export import export as export
    from counterspin.errors import CampaignError as CampaignError
    from counterspin.errors import ConvergenceError as ConvergenceError
    from counterspin.errors import CounterspinError as CounterspinError
    from counterspin.errors import CounterspinWarning as CounterspinWarning
    from counterspin.errors import NotIdentifiableError as NotIdentifiableError
    from counterspin.errors import RecordError as RecordError
    from counterspin.histories.history import history as history
    from counterspin.histories.result import History as History
    from counterspin.inference.two_stage.first_stage import Parabola as Parabola
    from counterspin.inference.two_stage.first_stage import by_angle as strobes_by_angle  # noqa: F401
    from counterspin.inference.two_stage.first_stage import (
        by_nominal_rate as strobes_by_nominal_rate,  # noqa: F401
    )
    from counterspin.inference.two_stage.first_stage import first_stage as first_stage
    from counterspin.inference.two_stage.first_stage import strobe_angle as strobe_angle
    from counterspin.inference.two_stage.model import TwoStageRequest as TwoStageRequest
    from counterspin.inference.two_stage.second_stage import SecondStage as SecondStage
    from counterspin.inference.two_stage.second_stage import StrobedRun as StrobedRun
    from counterspin.inference.two_stage.second_stage import second_stage as second_stage
    from counterspin.ingest.starter import init as init
    from counterspin.monitoring.check import check as check
    from counterspin.monitoring.noise import noise as noise
    from counterspin.monitoring.result import CheckedRun as CheckedRun
    from counterspin.monitoring.result import NoiseResult as NoiseResult
    from counterspin.monitoring.result import WatchState as WatchState
    from counterspin.monitoring.watch import Pace as Pace
    from counterspin.monitoring.watch import watch as watch
    from counterspin.operating_tests.measure import operating as operating
    from counterspin.operating_tests.result import OperatingTests as OperatingTests
    from counterspin.physics.accelerometer import QX as QX
    from counterspin.physics.accelerometer import QY as QY
    from counterspin.physics.accelerometer import QZ as QZ
    from counterspin.physics.accelerometer import Mounting as Mounting
    from counterspin.physics.accelerometer import indicated as indicated
    from counterspin.physics.motion import Site as Site
    from counterspin.physics.motion import Trajectory as Trajectory
    from counterspin.physics.observation import columns as columns
    from counterspin.physics.observation import reference as reference
    from counterspin.physics.spindle import Ripple as Ripple
    from counterspin.physics.spindle import Spindle as Spindle
    from counterspin.physics.spindle import fit_spindle as fit_spindle
    from counterspin.physics.terms import SHARED_TERMS as SHARED_TERMS
    from counterspin.physics.terms import TERMS as TERMS
    from counterspin.planning.forecast import Forecast as Forecast
    from counterspin.planning.forecast import forecast as forecast
    from counterspin.planning.plan import PlannedCampaign as PlannedCampaign
    from counterspin.planning.plan import plan as plan
    from counterspin.reports.publication import report as report
    from counterspin.reports.publication import write_report as write_report
    from counterspin.reproduction.comparison import reproduce as reproduce
    from counterspin.reproduction.demo import Demonstration as Demonstration
    from counterspin.reproduction.demo import demo as demo
    from counterspin.reproduction.plan import Reproduction as Reproduction
    from counterspin.simulation.simulate import simulate as simulate
    from counterspin.studies.folder import StudyFolder as StudyFolder
    from counterspin.studies.result import StudyResult as StudyResult
    from counterspin.studies.study import study as study
    from counterspin.validation.page import Dossier as Dossier
    from counterspin.validation.validate import validate as validate
    from counterspin.validation.validate import write_dossier as write_dossier
    from counterspin.workers import Workers as Workers

#: Module -> its names exported here. A test compares them with the imports for type checkers above.
_EXPORTS = {
    "_version": ("__version__",),
    "acceleration_standard.budget": ("applied",),
    "acceleration_standard.result": ("AppliedAcceleration",),
    "operating_tests.measure": ("operating",),
    "operating_tests.result": ("OperatingTests",),
    "campaign.description": ("Campaign", "read_campaign"),
    "campaign.memory": ("make_campaign",),
    "planning.forecast": ("Forecast", "forecast"),
    "campaign.quantity": ("Quantity",),
    "calibration.result": ("Result", "read_result", "write_result"),
    "comparisons.compare": ("compare",),
    "comparisons.intercompare": ("intercompare",),
    "comparisons.rerun": ("rerun",),
    "comparisons.result": ("Intercomparison", "ResultComparison", "RepeatedCalibration"),
    "monitoring.check": ("check",),
    "monitoring.noise": ("noise",),
    "monitoring.result": ("CheckedRun", "NoiseResult", "WatchState"),
    "monitoring.watch": ("Pace", "watch"),
    "correction.apply": ("ApplyOptions", "Correction", "apply"),
    "correction.apply_file": ("apply_file",),
    "correction.export": ("export",),
    "calibration.calibrate": ("calibrate",),
    "reproduction.demo": ("Demonstration", "demo"),
    "histories.history": ("history",),
    "histories.result": ("History",),
    "ingest.starter": ("init",),
    "planning.plan": ("PlannedCampaign", "plan"),
    "simulation.simulate": ("simulate",),
    "calibration.options": ("TwoStageOptions",),
    "errors": (
        "CampaignError",
        "ConvergenceError",
        "CounterspinError",
        "CounterspinWarning",
        "NotIdentifiableError",
        "RecordError",
    ),
    "inference.two_stage.first_stage": (
        *("Parabola", "by_angle", "by_nominal_rate", "first_stage", "strobe_angle"),
    ),
    "inference.two_stage.model": ("TwoStageRequest",),
    "inference.two_stage.second_stage": ("SecondStage", "StrobedRun", "second_stage"),
    "physics.accelerometer": ("QX", "QY", "QZ", "Mounting", "indicated"),
    "physics.motion": ("Site", "Trajectory"),
    "physics.observation": ("columns", "reference"),
    "physics.terms": ("SHARED_TERMS", "TERMS"),
    "physics.spindle": ("Ripple", "Spindle", "fit_spindle"),
    "reports.publication": ("report", "write_report"),
    "certificates.issuing": ("Certificate", "certificate"),
    "calibration.pages.document": ("print_result",),
    "reproduction.comparison": ("reproduce",),
    "reproduction.plan": ("Reproduction",),
    "studies.folder": ("StudyFolder",),
    "studies.result": ("StudyResult",),
    "studies.study": ("study",),
    "validation.page": ("Dossier",),
    "validation.validate": ("validate", "write_dossier"),
    "workers": ("Workers",),
}

#: Name in its module -> exported name, if the former is too short without the module.
_EXPORT_NAMES = {"by_angle": "strobes_by_angle", "by_nominal_rate": "strobes_by_nominal_rate"}

_LOCATIONS = {
    _EXPORT_NAMES.get(name, name): (module, name)
    for module, names in _EXPORTS.items()
    for name in names
}

__all__ = sorted(_LOCATIONS)  # noqa: PLE0605 -- computed, so that no name is written a third time


def __getattr__(name: str) -> Any:
    """Load a name on first use (PEP 562)."""
    if name not in _LOCATIONS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _LOCATIONS[name]
    if module not in ("errors", "_version"):
        from counterspin.errors import require_thread_count

        require_thread_count()
    value = getattr(import_module(f"{__name__}.{module}"), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the exported names and the special attributes, without helpers."""
    return sorted({*_LOCATIONS, *(name for name in globals() if name.startswith("__"))})
