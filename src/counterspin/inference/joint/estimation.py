"""The joint estimate as a list of stages, from the records to degrees of freedom.

Each stage takes the state of the estimate and returns it updated. Between stages, nuisance
parameters are compressed to a few equivalent columns (`counterspin.inference.joint.design_blocks`);
the last fit has all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint import encoder, outlier_rejection, rotation
from counterspin.inference.joint.design_blocks import (
    DesignBlock,
    build_design_blocks,
    compress_nuisance,
    estimate_white_noise,
    update_design_blocks,
)
from counterspin.inference.joint.estimated_noise import (
    estimate_noise_by_accelerometer,
    inflate_for_noise,
)
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.heteroscedasticity import (
    VarianceModel,
    estimate_heteroscedasticity,
)
from counterspin.inference.joint.outlier_rejection import RowMasks, thin_rows
from counterspin.inference.joint.series import ResidualSeries
from counterspin.inference.joint.time_stamps import estimate_timestamp_fractions
from counterspin.inference.joint.unknowns import ROTATION, Unknown, Unknowns
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.search import NoiseEstimate

#: A change of K_I by less than this changes no platform column noticeably.
_SCALE_TOLERANCE: Final = 1e-4

#: A change of a coefficient by so many of its standard uncertainties changes no input's column
#: noticeably: of its effect it changes a part as large as the input's own uncertainty.
_MAX_SHIFT_SDS: Final = 20.0

#: How often weights of uneven noise are looked for: noise of the time stamps, then that of the
#: runs beside it, and both once more.
_WEIGHTING_ROUNDS: Final = 3

#: How often the times of the rows are corrected.
_TIMESTAMP_ROUNDS: Final = 3

#: How often the rotation is taken from the fit: each time the error that is left is squared.
_ROTATION_ROUNDS: Final = 6


@frozen
class Estimate:
    """The joint estimate."""

    fit: JointFit  #: The solved problem.
    #: Accelerometer -> its estimated noise; without those whose noise was given.
    estimated_noise: Mapping[str, NoiseEstimate]
    #: Effective degrees of freedom of each unknown, shape (p,); infinite where noise is exact.
    dof: Array
    outliers: RowMasks = ()  #: For each series, which of its rows were left out, bool.
    #: The data with these rows, about the rotation that was found where none was recorded.
    series: tuple[ResidualSeries, ...] = ()
    #: The same fit with nuisance parameters compressed; None where there are none.
    compressed_fit: JointFit | None = None
    #: Accelerometer whose noise is not exact -> `estimated_noise.information_losses` of
    #: `compressed_fit`.
    information_losses: Mapping[str, Array] = field(default_factory=dict)


@frozen
class _EstimationState:
    """Intermediate state of an estimate."""

    requests: Mapping[str, Noise]  # noise as it is given or wanted
    series: tuple[ResidualSeries, ...]  # all rows, about the rotation as far as it is known
    model: Unknowns  # what is estimated, with what the encoder leaves open as soon as it is known
    scale_factors: Mapping[str, float]  # K_I of each accelerometer in the platform's columns
    linearization_point: Mapping[
        Unknown, float
    ]  # estimates, less nominal, at which inputs' derivatives are taken
    design_blocks: tuple[DesignBlock, ...]  # the model's columns of the rows that are not left out
    outliers: RowMasks
    fit: JointFit  # condensed
    noise_estimates: Mapping[str, NoiseEstimate] = field(default_factory=dict)
    columns_changed: bool = False  # whether the columns are others than when outliers were left out

    @property
    def values(self) -> dict[Unknown, float]:
        """Estimates of the unknowns minus their nominal values."""
        return dict(zip(self.fit.model.unknowns, self.fit.solution.estimate.tolist(), strict=True))

    def with_model(self, model: Unknowns, scale_factors: Mapping[str, float]) -> _EstimationState:
        """Return the state with another model or other scale factors, fitted."""
        at = self.values
        design_blocks = update_design_blocks(
            self.design_blocks, self.model, model, scale_factors, at
        )
        noise = self.fit.noise
        fit = solve_joint(*compress_nuisance(design_blocks, model, _white_noise(noise)), noise)
        return replace(
            self,
            model=model,
            scale_factors=scale_factors,
            linearization_point=at,
            design_blocks=design_blocks,
            fit=fit,
            columns_changed=True,
        )

    def with_variance_models(self, uneven: Mapping[str, VarianceModel]) -> _EstimationState:
        """Return the state with heteroscedastic noise, without a refit."""
        series = tuple(
            uneven[record.accelerometer].apply_to(record)
            if record.accelerometer in uneven
            else record
            for record in self.series
        )

        def reweight(design_blocks: Sequence[DesignBlock]) -> tuple[DesignBlock, ...]:
            return tuple(
                replace(block, series=block.series.with_noise_of(record.drop_rows(mask)))
                for block, record, mask in zip(design_blocks, series, self.outliers, strict=True)
            )

        fit = replace(self.fit, observations=reweight(self.fit.design_blocks))
        return replace(self, series=series, design_blocks=reweight(self.design_blocks), fit=fit)

    def with_noise(self) -> _EstimationState:
        """Return the state with noise estimated from the residuals, where it is not given."""
        noise, estimates = estimate_noise_by_accelerometer(
            self.fit.design_blocks, self.fit.model, self.requests
        )
        return replace(self, fit=self.fit.with_noise(noise), noise_estimates=estimates)


def estimate(
    series: Sequence[ResidualSeries],
    model: Unknowns,
    requests: Mapping[str, Noise],
    *,
    reject: bool = True,
) -> Estimate:
    """Estimate a model from all series.

    reject: Whether outliers are looked for.
    """
    state = first_fit(find_rotation(tuple(series), model, requests), model, requests)
    for stage in STAGES:
        if reject or stage not in (reject_outliers, reinstate_outliers):
            state = stage(state)
    full_fit = solve_joint(state.design_blocks, state.model, state.fit.noise)
    return _finish(full_fit, state.fit, state.noise_estimates, state.outliers, state.series)


def correct_series(
    series: Sequence[ResidualSeries], model: Unknowns, requests: Mapping[str, Noise]
) -> tuple[ResidualSeries, ...]:
    """Return the series at the times that their angles correct; as they are without an angle."""
    if all(record.timestamp_errors is None for record in series):
        return tuple(series)
    state = first_fit(find_rotation(tuple(series), model, requests), model, requests)
    for stage in (reject_outliers, correct_time_stamps, find_noise, model_heteroscedasticity):
        state = stage(state)
    return state.series


def reestimate(previous: Estimate, fit: JointFit, requests: Mapping[str, Noise]) -> Estimate:
    """Return the estimate of another fit to the same rows, with the noise estimated again."""
    compressed_fit = solve_joint(
        *compress_nuisance(fit.design_blocks, fit.model, _white_noise(fit.noise)), fit.noise
    )
    noise, noise_estimates = estimate_noise_by_accelerometer(
        compressed_fit.design_blocks, compressed_fit.model, requests
    )
    compressed_fit = compressed_fit.with_noise(noise)
    return _finish(
        fit.with_noise(noise), compressed_fit, noise_estimates, previous.outliers, previous.series
    )


# The stages -----------------------------------------------------------------------------------


def find_rotation(
    series: tuple[ResidualSeries, ...], model: Unknowns, requests: Mapping[str, Noise]
) -> tuple[ResidualSeries, ...]:
    """Find how runs turned whose angle nobody recorded: columns are taken along the rotation."""
    if not any(unknown.symbol in ROTATION for unknown in model.unknowns):
        return series
    base_model = model.without_inputs()
    scale_factors = _scale_factors(series, base_model, None)
    return rotation.find_rotation(series, base_model, scale_factors, _unit_noise(requests))


def first_fit(
    series: tuple[ResidualSeries, ...], model: Unknowns, requests: Mapping[str, Noise]
) -> _EstimationState:
    """Fit all rows with equal weights; linearize at estimates of the parameters of interest.

    Nuisance parameters move that point by no more than the uncertainties that they add.
    """
    scale_factors = _scale_factors(series, model, None)
    at: dict[Unknown, float] = {}
    if model.has_inputs:
        of_interest = Unknowns(model.of_interest)
        interest_fit = solve_joint(
            build_design_blocks(series, of_interest, scale_factors),
            of_interest,
            _unit_noise(requests),
        )
        scale_factors = _scale_factors(series, model, interest_fit)
        at = dict(zip(of_interest.unknowns, interest_fit.solution.estimate.tolist(), strict=True))
        design_blocks = update_design_blocks(
            interest_fit.design_blocks, of_interest, model, scale_factors, at
        )
    else:
        design_blocks = build_design_blocks(series, model, scale_factors)
    white = _white_noise({name: request.known for name, request in requests.items()})
    fit = solve_joint(*compress_nuisance(design_blocks, model, white), _unit_noise(requests))
    none = outlier_rejection.no_outliers(series)
    return _EstimationState(requests, series, model, scale_factors, at, design_blocks, none, fit)


def locate_inputs(
    series: tuple[ResidualSeries, ...],
    model: Unknowns,
    requests: Mapping[str, Noise],
    names: Sequence[str],
) -> dict[str, float]:
    """Return estimates of inputs, minus nominal, by a first fit with white noise.

    The noise is the stated white noise, or that which the records show from row to row.
    """
    state = first_fit(series, model, requests)
    levels: dict[str, float] = {}
    for block in state.design_blocks:
        stated_sd = math.sqrt(requests[block.accelerometer].known.sample_variance)
        level = stated_sd or estimate_white_noise(block) or 1.0
        levels[block.accelerometer] = max(level, levels.get(block.accelerometer, 0.0))
    noise = {name: Noise(level) for name, level in levels.items()}
    fit = solve_joint(state.design_blocks, state.model, noise)
    estimates = zip(model.unknowns, fit.solution.estimate.tolist(), strict=True)
    return {unknown.name: value for unknown, value in estimates if unknown.name in names}


def reject_outliers(state: _EstimationState) -> _EstimationState:
    """Reject outliers before the noise is estimated."""
    fit, outliers = outlier_rejection.reject_outliers(
        state.fit, state.series, state.requests, state.outliers
    )
    return replace(
        state,
        fit=fit,
        outliers=outliers,
        design_blocks=outlier_rejection.select_rows(state.design_blocks, outliers),
    )


def correct_time_stamps(state: _EstimationState) -> _EstimationState:
    """Correct the times of the rows by their angles, where the output shows that the stamps err.

    Twice: the output is a curve, and the first time along slopes at the wrong times.
    """
    for _ in range(_TIMESTAMP_ROUNDS):
        shares = estimate_timestamp_fractions(state.fit)
        if not shares:
            break
        series = tuple(
            record.correct_times(shares.get(record.run, record.corrected_fraction))
            for record in state.series
        )
        has_outliers = any(mask.any() for mask in state.outliers)
        state = first_fit(series, state.model, state.requests)
        state = reject_outliers(state) if has_outliers else state
    return state


def thin_correlated_rows(state: _EstimationState) -> _EstimationState:
    """Thin rows whose errors are correlated, then refit."""
    thinned = tuple(
        record.drop_rows(mask) for record, mask in zip(state.series, state.outliers, strict=True)
    )
    series = thin_rows(state.fit, thinned)
    if all(record is thin_record for record, thin_record in zip(series, thinned, strict=True)):
        return state
    return first_fit(series, state.model, state.requests)


def find_noise(state: _EstimationState) -> _EstimationState:
    """Estimate the noise, which weights the records."""
    return state.with_noise()


def model_heteroscedasticity(state: _EstimationState) -> _EstimationState:
    """Weight each run by its white noise, and rows by the noise of their time stamps."""
    for _ in range(_WEIGHTING_ROUNDS):
        uneven = estimate_heteroscedasticity(state.fit, state.series, state.requests)
        if not uneven:
            break
        state = state.with_variance_models(uneven).with_noise()
    return state


def add_encoder_terms(state: _EstimationState) -> _EstimationState:
    """Add rotation errors due to encoder noise to the model, where they are not negligible."""
    series = [block.series for block in state.design_blocks]
    model = encoder.add_encoder_terms(state.model, series, state.fit.noise)
    if model is state.model:
        return state
    # Until now these errors were in the residuals.
    return find_noise(state.with_model(model, state.scale_factors))


def relinearise_inputs(state: _EstimationState) -> _EstimationState:
    """Recompute columns of inputs and the platform if the estimate moved far from their point."""
    scale_factors = _scale_factors(state.series, state.model, state.fit)
    has_changed = any(
        abs(scale_factors[a] - k) > _SCALE_TOLERANCE for a, k in state.scale_factors.items()
    )
    if not has_changed and not (state.model.has_inputs and _is_far(state)):
        return state
    return state.with_model(state.model, scale_factors).with_noise()


def _is_far(state: _EstimationState) -> bool:
    """Return whether parameters of interest are far from the linearization point."""
    if any(unknown.symbol in encoder.SYMBOLS for unknown in state.model.unknowns):
        return True  # they were taken where the estimate was without what the encoder leaves open
    solution, now = state.fit.solution, state.values
    moves = [
        abs(value - state.linearization_point.get(unknown, 0.0)) / u
        for (unknown, value), u in zip(now.items(), solution.u.tolist(), strict=True)
        if unknown.is_of_interest and 0.0 < u < unknown.limit
    ]
    return max(moves, default=0.0) > _MAX_SHIFT_SDS


def relinearise_rotation(state: _EstimationState) -> _EstimationState:
    """Take everything along the rotation that the fit found, where that is not only linear.

    Noise that seemed to be there along the first rotation is looked for again.
    """
    if not rotation.may_be_nonlinear(state.design_blocks, state.model, state.fit.noise):
        return state
    initial = state
    for _ in range(_ROTATION_ROUNDS):
        noise = state.fit.noise
        full_fit = solve_joint(state.design_blocks, state.model, noise)
        rotated_series = rotation.rotate_to_estimate(full_fit, state.series)
        if rotated_series is None:
            break
        series, model = rotated_series
        values = np.where(
            [unknown.symbol in encoder.SYMBOLS for unknown in model.unknowns],
            0.0,
            full_fit.solution.estimate,
        )
        kept_series = [s.drop_rows(mask) for s, mask in zip(series, state.outliers, strict=True)]
        design_blocks = build_design_blocks(kept_series, model, state.scale_factors, values)
        fit = solve_joint(*compress_nuisance(design_blocks, model, _white_noise(noise)), noise)
        at = dict(zip(model.unknowns, values.tolist(), strict=True))
        state = replace(
            state,
            series=series,
            model=model,
            linearization_point=at,
            design_blocks=design_blocks,
            fit=fit,
            columns_changed=True,
        )
    return state if state is initial else model_heteroscedasticity(find_noise(state))


def reinstate_outliers(state: _EstimationState) -> _EstimationState:
    """Reject outliers of the final model, and reinstate rows that are not outliers of it.

    Only if the columns changed since outliers were rejected.
    """
    if not state.columns_changed:
        return state
    fit, outliers, now = state.fit, state.outliers, state.values
    values = np.array([now.get(unknown, 0.0) for unknown in state.model.unknowns])

    def columns() -> tuple[DesignBlock, ...]:
        return build_design_blocks(state.series, state.model, state.scale_factors, values)

    if outlier_rejection.has_many_outliers(outliers):
        everything = compress_nuisance(columns(), state.model, _white_noise(fit.noise))
        fit, outliers = outlier_rejection.reinstate_rows(
            fit, everything, state.series, state.requests, outliers
        )
    fit, outliers = outlier_rejection.reject_outliers(fit, state.series, state.requests, outliers)
    if fit is state.fit:
        return state
    kept_blocks = outlier_rejection.select_rows(columns(), outliers)
    return replace(state, fit=fit, outliers=outliers, design_blocks=kept_blocks).with_noise()


STAGES: Final = (
    reject_outliers,
    correct_time_stamps,
    thin_correlated_rows,
    find_noise,
    model_heteroscedasticity,
    add_encoder_terms,
    relinearise_inputs,
    relinearise_rotation,
    reinstate_outliers,
)


def _finish(
    fit: JointFit,
    core: JointFit,
    noise_estimates: Mapping[str, NoiseEstimate],
    outliers: RowMasks,
    series: tuple[ResidualSeries, ...],
) -> Estimate:
    """Add undetected noise to a covariance, and count degrees of freedom.

    core: The same fit, compressed.
    """
    model = fit.model
    core, dof, losses = inflate_for_noise(core, noise_estimates)
    # Parameters of interest come first in the compressed fit; uncompressed, it has all unknowns.
    indices = [index for index, unknown in enumerate(model.unknowns) if unknown.is_of_interest]
    if core.model.unknowns == model.unknowns:
        indices = list(range(len(model.unknowns)))
    full_dof = np.full(len(model.unknowns), math.inf)
    full_dof[indices] = dof[: len(indices)]

    def embed(covariance: Array) -> Array:
        matrix = np.zeros((full_dof.size, full_dof.size))
        matrix[np.ix_(indices, indices)] = covariance[: len(indices), : len(indices)]
        return matrix

    added_covariance = core.solution.covariance_undetected
    if added_covariance is not None:
        solution = replace(fit.solution, covariance_undetected=embed(added_covariance))
        unseen = {
            name: (level, embed(covariance))
            for name, (level, covariance) in core.undetected_walks.items()
        }
        fit = replace(fit, solution=solution, undetected_walks=unseen)
    return Estimate(fit, noise_estimates, full_dof, outliers, series, core, losses)


def _unit_noise(requests: Mapping[str, Noise]) -> dict[str, Noise]:
    return {name: Noise(1.0) for name in requests}


def _white_noise(noise: Mapping[str, Noise]) -> dict[str, float | None]:
    """Return the least white noise of a sample, as far as it is known."""
    return {name: math.sqrt(component.sample_variance) or None for name, component in noise.items()}


def _scale_factors(
    series: Sequence[ResidualSeries], model: Unknowns, fit: JointFit | None
) -> dict[str, float]:
    """Return K_I of each accelerometer: estimated, or known beforehand, or 1."""
    factors = {record.accelerometer: 1.0 for record in series}
    places_of_unknowns = (
        {} if fit is None else {fitted: k for k, fitted in enumerate(fit.model.unknowns)}
    )
    for unknown in model.unknowns:
        if unknown.symbol == "K_I":
            index = places_of_unknowns.get(unknown)
            if fit is not None and index is not None and fit.solution.u[index] < unknown.limit:
                factors[unknown.owner] = 1.0 + float(fit.solution.estimate[index])
            elif math.isfinite(unknown.prior[1]):
                factors[unknown.owner] = unknown.prior[0]
    factors |= {c.owner: c.prior[0] for c in model.considered if c.symbol == "K_I"}
    return factors
