"""The result of a calibration, and its JSON file.

The JSON is a contract with programs of users: within one schema version, keys keep their names and
meanings, and new keys may be added. Coefficients are in g-units of the stated gravity; all other
numbers are in SI units unless a unit is given.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, ModelWrapValidatorHandler, PrivateAttr, field_validator, model_validator

from counterspin.calibration.result_parts import (
    AccelerometerResult,
    Coefficient,
    Correlation,
    Covariance,
    Finding,
    Inputs,
    Knowledge,
    Provenance,
    RunResult,
    State,
    TriadResult,
)
from counterspin.calibration.si_estimates import StatedGravity
from counterspin.errors import CounterspinError
from counterspin.inference.identifiability import ConfoundedTerms
from counterspin.loading import load_name
from counterspin.physics.terms import TERMS
from counterspin.results import NamedParts, ReportableResult, draw_pictures

if TYPE_CHECKING:
    import polars as pl

    from counterspin.physics.correction import Prediction
    from counterspin.reports.blocks import Picture
    from counterspin.reports.publication import Publication

#: Modules of the plots, of the validation of files, and of conversions, loaded on demand.
_PICTURES_MODULE: Final = "counterspin.calibration.pages.pictures"
_RESULT_FILE_MODULE: Final = "counterspin.calibration.result_file"
_CONVERSION_MODULE: Final = "counterspin.calibration.result_conversion"

#: Error message if a result has no residuals, which files do not store.
_NO_RESIDUALS_MESSAGE = (
    "the result contains no residuals of records, because result files do not store them; to "
    "obtain residuals, calibrate a campaign with records again by the joint method"
)


class Result(ReportableResult):
    """Result of a calibration: accelerometers, platform, runs and inputs."""

    BLOCKS: ClassVar[str] = "counterspin.calibration.pages.document:notebook_blocks"
    REPORT_BLOCKS: ClassVar[str] = "counterspin.calibration.pages.document:full_report_blocks"
    REPORT_KIND: ClassVar[str] = "a calibration report"

    schema_version: Annotated[int, Field(alias="schema")] = 2

    method: str  #: ``joint`` or ``two-stage``.
    model: str  #: ``exact`` or ``as-printed``.
    #: Worst state of any part of the result: ``good``, ``reservations``, ``not-determined`` or
    #: ``contradicted``; null in results written by versions that did not record a state.
    state: State | None = None
    #: Findings on all accelerometers and on the campaign, most severe first.
    findings: list[Finding] = []
    accepted_misfit: str | None = None  #: Reason for accepting a contradicted result.
    title: str = ""  #: Title of the campaign.
    accelerometers: dict[str, AccelerometerResult]  #: Results of each accelerometer.
    platform: dict[str, Coefficient] = {}  #: Coefficients of the platform, common to all runs.
    #: Result for the three accelerometers as a single sensor; null if the campaign has no
    #: ``[triad]``.
    triad: TriadResult | None = None
    confounded: list[ConfoundedTerms] = []  #: Sets of platform terms that cannot be separated.
    #: Correlation matrix of all determined terms of the accelerometers and the platform, with full
    #: names such as ``Qx.K_II`` and ``run1.platform.tilt.north``; null for the two-stage method.
    correlation: Correlation | None = None
    runs: dict[str, RunResult]  #: Results of each run.
    inputs: Inputs  #: Gravity, latitude and radius.
    #: Stated or default prior information on terms and inputs that were not requested.
    rests_on: list[Knowledge] = []
    #: Terms and inputs that were assumed perfect and do not contribute to `u`. A certificate
    #: requires evidence for each of them.
    assumed: list[str] = []
    details: dict[str, str] = {}  #: Further entries of ``[campaign]``.
    warnings: list[str] = []  #: Remarks and findings on the campaign, as text.
    provenance: Provenance  #: Version of counterspin, options, and checksums of the input files.

    _residuals: Sequence[Mapping[str, Any]] = PrivateAttr(default=())
    _assumes_all: bool = PrivateAttr(default=False)

    @field_validator("accelerometers", "runs")
    @classmethod
    def _suggest_names(cls, values: dict[str, Any]) -> dict[str, Any]:
        return NamedParts(values)

    @model_validator(mode="wrap")
    @classmethod
    def _upgrade_schema_1(cls, document: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Upgrade the document of an earlier version."""
        is_schema_1 = isinstance(document, dict) and document.get("schema") == 1
        result = handler(
            load_name(f"{_RESULT_FILE_MODULE}:upgrade_document")(document)
            if is_schema_1
            else document
        )
        if is_schema_1:
            result._assumes_all = True
        return result

    @property
    def assumes_all(self) -> bool:
        """Whether the file had schema 1, in which unstated terms were assumed perfect."""
        return self._assumes_all

    def model_post_init(self, context: Any, /) -> None:  # noqa: ARG002 -- pydantic's signature
        """Set the gravity that defines the unit of each coefficient."""
        if not 0.0 < self.inputs.gravity < math.inf:
            return  # `validation_errors` reports it
        for name, accelerometer in self.accelerometers.items():
            for symbol, coefficient in accelerometer.coefficients.items():
                coefficient._gravity = self.gravity_of(name, symbol)
        terms = (coefficient for run in self.runs.values() for coefficient in run.terms.values())
        for coefficient in (*self.platform.values(), *terms):
            coefficient._gravity = StatedGravity(self.inputs.gravity, self.inputs.u_gravity)

    def gravity_of(self, name: str, symbol: str) -> StatedGravity:
        """Return the g that defines the unit of a coefficient, with the sensitivity to it."""
        inputs = self.inputs
        sensitivity = _gravity_sensitivity(self, self.accelerometers[name], symbol)
        return StatedGravity(inputs.gravity, inputs.u_gravity, sensitivity)

    def __getstate__(self) -> dict[Any, Any]:
        """Return the pickled state: the numbers, without the full residuals."""
        state = super().__getstate__()
        private_attributes = dict(state["__pydantic_private__"] or {})
        return state | {"__pydantic_private__": private_attributes | {"_residuals": ()}}

    def coefficient(self, name: str) -> Coefficient:
        """Return a coefficient by its whole name.

        Parameters
        ----------
        name
            Such as ``Qx.K_II``, ``platform.drift.north`` or ``run1.platform.tilt.north``.

        Raises
        ------
        KeyError
            If no coefficient has this name; the message lists the names.
        """
        if name in self.platform:
            return self.platform[name]
        owners = {
            owner: accelerometer.coefficients
            for owner, accelerometer in self.accelerometers.items()
        }
        owners |= {owner: run.terms for owner, run in self.runs.items()}
        for owner, coefficients in owners.items():
            symbol = name.removeprefix(f"{owner}.")
            if symbol != name and symbol in coefficients:
                return coefficients[symbol]
        known_names = [
            f"{owner}.{symbol}" for owner, coefficients in owners.items() for symbol in coefficients
        ]
        raise KeyError(f"{name}; the terms are {', '.join([*known_names, *self.platform])}")

    def __getitem__(self, name: str) -> Coefficient:
        """Return a coefficient by its whole name: ``result["Qx.K_II"]``; as `coefficient`."""
        return self.coefficient(name)

    def _ipython_key_completions_(self) -> list[str]:
        """Return the names that may follow ``result["``."""
        return [f"{owner}.{symbol}" if owner else symbol for owner, symbol, _ in self.rows()]

    def rows(self) -> Iterator[tuple[str, str, Coefficient]]:
        """Yield owner, symbol and coefficient: accelerometers, platform (no owner), runs."""
        for name, accelerometer in self.accelerometers.items():
            for symbol, coefficient in accelerometer.coefficients.items():
                yield name, symbol, coefficient
        for symbol, coefficient in self.platform.items():
            yield "", symbol, coefficient
        for name, run in self.runs.items():
            for symbol, coefficient in run.terms.items():
                yield name, symbol, coefficient

    def predict(
        self,
        accelerometer: str,
        force: npt.ArrayLike,
        *,
        pendulous: npt.ArrayLike = 0.0,
        output_axis: npt.ArrayLike = 0.0,
    ) -> Prediction:
        """Predict the indication of an accelerometer (Eq. 7) with its uncertainty.

        The prediction holds at `inputs.reference_temperature`, the reference of the slopes.

        Parameters
        ----------
        accelerometer
            Name of the accelerometer.
        force
            Specific force along the input axis in g, shape (n,), or one number.
        pendulous, output_axis
            Specific force along the other two axes, in the same form.

        Returns
        -------
        Prediction
            `indicated` and `u`, both in g, shape (n,). u includes the covariance of the
            coefficients and default standard uncertainties, but no noise.

        Raises
        ------
        KeyError
            If no accelerometer has this name.
        ValueError
            If the forces are not finite, or differ in length.
        """
        prediction: Prediction = load_name("counterspin.correction.instrument:predict")(
            self, self._accelerometer_name(accelerometer), force, pendulous, output_axis
        )
        return prediction

    @property
    def covariance(self) -> Covariance | None:
        """Covariances of all determined coefficients; None if the result has no correlations."""
        correlation = self.correlation
        if correlation is None and len(self.accelerometers) == 1:
            # Results of versions without a joint matrix.
            ((name, accelerometer),) = self.accelerometers.items()
            correlation = accelerometer.correlation
            if correlation is not None:
                coefficients = accelerometer.coefficients
                terms = [
                    f"{name}.{symbol}" if symbol in coefficients else symbol
                    for symbol in correlation.terms
                ]
                correlation = correlation.model_copy(update={"terms": terms})
        if correlation is None:
            return None
        coefficients_by_index = {
            index: coefficient
            for index, coefficient in enumerate(map(self._find_determined, correlation.terms))
            if coefficient
        }
        indices = list(coefficients_by_index)
        u = np.array([coefficient.u for coefficient in coefficients_by_index.values()], dtype=float)
        return Covariance(
            tuple(correlation.terms[index] for index in indices),
            np.outer(u, u) * np.array(correlation.matrix)[np.ix_(indices, indices)],
            tuple(coefficient.unit for coefficient in coefficients_by_index.values()),
        )

    def _find_determined(self, name: str) -> Coefficient | None:
        """Return a coefficient with u; None if it was removed from the result."""
        try:
            coefficient = self.coefficient(name)
        except KeyError:
            return None
        return coefficient if coefficient.u is not None else None

    def stated_covariance(self) -> Covariance:
        """Return `covariance`; CounterspinError if the result has no correlations."""
        covariance = self.covariance
        if covariance is None:
            raise CounterspinError(
                "the result has no correlations between accelerometers: the two-stage method "
                "estimates each accelerometer separately, and versions before 0.2 did not write "
                "correlations",
                code="missing-in-result",
            )
        return covariance

    def table(self, library: str = "polars") -> Any:
        """Return the coefficients as a frame of ``polars`` or ``pandas``, in units of the field."""
        return load_name(f"{_CONVERSION_MODULE}:coefficient_frame")(self, library)

    def to_uncertainties(self) -> dict[str, Any]:
        """Return the coefficients for the package uncertainties, with their correlations."""
        coefficients: dict[str, Any] = load_name(f"{_CONVERSION_MODULE}:to_uncertainties")(self)
        return coefficients

    def to_gtc(self) -> dict[str, Any]:
        """Return the coefficients for the package GTC, with their correlations."""
        coefficients: dict[str, Any] = load_name(f"{_CONVERSION_MODULE}:to_gtc")(self)
        return coefficients

    def residuals(self, accelerometer: str | None = None, run: str | None = None) -> pl.DataFrame:
        """Return the residuals of the records, for one or all accelerometers and runs.

        The residuals of readings are in `readings` of each accelerometer.

        Returns
        -------
        polars.DataFrame
            A row for each sample or mean of `count` samples: `accelerometer`, `run`, `time` (s from
            the start of the run), `count`, `error` (recorded output minus the output of a perfect
            accelerometer), `fitted`, `residual` (error - fitted), `whitened` (of unit variance;
            null in the first rows of differences), `unit` (of error, fitted and residual).

        Raises
        ------
        CounterspinError
            If the result was read from a file, or is of the two-stage method, or has no records.
        KeyError
            If no residuals have these names.
        """
        if not self._residuals:
            raise CounterspinError(_NO_RESIDUALS_MESSAGE, code="missing-in-result")
        frame: pl.DataFrame = load_name(f"{_CONVERSION_MODULE}:residual_frame")(self._residuals)
        criteria = {"accelerometer": accelerometer, "run": run}
        filters = {column: name for column, name in criteria.items() if name is not None}
        selected_rows = frame.filter(**filters) if filters else frame
        if selected_rows.is_empty():
            available_pairs = frame.select(*criteria).unique(maintain_order=True).rows()
            names = ", ".join(f"{owner} in {name}" for owner, name in available_pairs)
            raise KeyError(
                f"the result has no residuals of {accelerometer} in {run}; it has those of {names}"
            )
        return selected_rows

    def plot(self, accelerometer: str | None = None, *, axes: Any = None) -> list[Any]:
        """Draw the residuals over time, one plot for each run.

        `axes` as for `reports.publication.draw_on_axes`.
        """
        return self.plot_residuals(accelerometer, axes=axes)

    def plot_residuals(self, accelerometer: str | None = None, *, axes: Any = None) -> list[Any]:
        """Draw the residuals over time, one plot for each run; `axes` as for `plot`."""
        return self._plot_pictures("residuals_over_time", accelerometer, axes)

    def plot_spectrum(self, accelerometer: str | None = None, *, axes: Any = None) -> list[Any]:
        """Draw the spectrum of the whitened residuals."""
        return self._plot_pictures("residual_spectra", accelerometer, axes)

    def plot_budget(
        self, accelerometer: str | None = None, coefficient: str = "K_II", *, axes: Any = None
    ) -> list[Any]:
        """Draw the uncertainty budget of a coefficient."""
        name = self._accelerometer_name(accelerometer)
        bars = load_name(f"{_PICTURES_MODULE}:budget_bars")(
            name, self.accelerometers[name], coefficient
        )
        return self._draw([] if bars is None else [bars], axes)

    def _plot_pictures(self, function_name: str, accelerometer: str | None, axes: Any) -> list[Any]:
        name = self._accelerometer_name(accelerometer)
        pictures = load_name(f"{_PICTURES_MODULE}:{function_name}")(
            name, self.accelerometers[name], self.runs
        )
        return self._draw([*pictures], axes)

    def _accelerometer_name(self, accelerometer: str | None) -> str:
        """Return the name of an accelerometer; None: the first one."""
        name = accelerometer or next(iter(self.accelerometers))
        if name not in self.accelerometers:
            raise KeyError(f"{name}; the accelerometers are {', '.join(self.accelerometers)}")
        return name

    def _draw(self, pictures: Sequence[Picture], axes: Any) -> list[Any]:
        if not pictures:
            raise CounterspinError(
                "the result does not contain the data for this plot", code="missing-in-result"
            )
        return draw_pictures(pictures, axes)

    def __repr__(self) -> str:
        """Return state, coefficients and the most severe finding, at most 20 lines."""
        text: str = load_name(f"{_CONVERSION_MODULE}:summarize")(self)
        return text

    __str__ = __repr__

    def publication(self, identifier: str | None = None) -> Publication:
        """Return the report, for a file in HTML, PDF or Markdown."""
        report: Publication = super().publication(identifier)
        return replace(report, title=self.title or "Calibration", version=self.provenance.version)

    def validation_errors(self) -> Iterator[str]:
        """Yield the contradictions between the parts of a result."""
        yield from load_name(f"{_RESULT_FILE_MODULE}:find_faults")(self)


read_result = Result.read
write_result = Result.write


def _gravity_sensitivity(result: Result, accelerometer: AccelerometerResult, symbol: str) -> float:
    """Return the sensitivity of a coefficient to the assumed g, per m/s^2."""
    coefficient = accelerometer.coefficients[symbol]
    is_early_version = result.method == "two-stage" and not accelerometer.budget
    if is_early_version and symbol in TERMS and coefficient.value is not None:
        # Without a budget: a coefficient of degree n from b2 is proportional to g^(n-1).
        return (len(TERMS[symbol].effect.factors) - 1) * coefficient.value / result.inputs.gravity
    for line in accelerometer.budget.get(symbol, ()):
        if line.source == "site.gravity" and line.sensitivity is not None:
            return line.sensitivity
    return 0.0
