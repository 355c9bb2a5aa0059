"""Joint estimation in stages, from the records to the degrees of freedom.

Each stage takes the state of the estimation and returns an updated state. Between stages, nuisance
parameters are compressed to a few columns (`counterspin.inference.joint.design_blocks`); the last
fit contains all of them.
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

#: Columns of inputs are recomputed if a coefficient moved by more than this, in standard
#: uncertainties; a smaller move changes them by less than the relative uncertainty of the inputs.
_MAX_MOVE_SDS: Final = 20.0

#: Largest number of fits of heteroscedastic noise: time stamps, then runs, then both again.
_WEIGHTING_ROUNDS: Final = 3

#: Largest number of corrections of the times.
_TIMESTAMP_ROUNDS: Final = 3

#: Largest number of relinearisations of the rotation; the error converges quadratically.
_ROTATION_ROUNDS: Final = 6


@frozen
class Estimate:
    """The joint estimate."""

    fit: JointFit  #: The solved problem.
    #: Accelerometer -> its estimated noise; without those whose noise was given.
    estimated_noise: Mapping[str, NoiseEstimate]
    #: Effective degrees of freedom of each unknown, shape (p,); infinite where noise is exact.
    dof: Array
    outliers: RowMasks = ()  #: For each series, the mask of its rejected rows.
    #: All rows, including rejected rows, along the estimated rotation if no angle was recorded.
    series: tuple[ResidualSeries, ...] = ()
    #: The same fit with compressed nuisance parameters; None if there are none.
    compressed_fit: JointFit | None = None
    #: Accelerometer whose noise is not exact -> `estimated_noise.information_losses` of
    #: `compressed_fit`.
    information_losses: Mapping[str, Array] = field(default_factory=dict)


@frozen
class _EstimationState:
    """Intermediate state of an estimate."""

    requests: Mapping[str, Noise]  # given noise, or noise components to estimate
    series: tuple[ResidualSeries, ...]  # all rows, along the latest estimate of the rotation
    model: Unknowns  # with encoder terms once they are known
    scale_factors: Mapping[str, float]  # K_I of each accelerometer in the columns of the platform
    # Estimates minus nominal values, at which the columns of inputs were computed.
    linearization_point: Mapping[Unknown, float]
    design_blocks: tuple[DesignBlock, ...]  # columns of the accepted rows
    outliers: RowMasks
    fit: JointFit  # compressed
    noise_estimates: Mapping[str, NoiseEstimate] = field(default_factory=dict)
    columns_changed: bool = False  # True if the columns changed after the rejection of outliers

    @property
    def values(self) -> dict[Unknown, float]:
        """Estimates of the unknowns minus their nominal values."""
        return dict(zip(self.fit.model.unknowns, self.fit.solution.estimate.tolist(), strict=True))

    def with_model(self, model: Unknowns, scale_factors: Mapping[str, float]) -> _EstimationState:
        """Return the state refitted with another model or other scale factors."""
        values = self.values
        design_blocks = update_design_blocks(
            self.design_blocks, self.model, model, scale_factors, values
        )
        noise = self.fit.noise
        fit = solve_joint(*compress_nuisance(design_blocks, model, _white_noise(noise)), noise)
        return replace(
            self,
            model=model,
            scale_factors=scale_factors,
            linearization_point=values,
            design_blocks=design_blocks,
            fit=fit,
            columns_changed=True,
        )

    def with_variance_models(self, models: Mapping[str, VarianceModel]) -> _EstimationState:
        """Return the state with heteroscedastic noise, without a refit."""
        series = tuple(
            models[record.accelerometer].apply_to(record)
            if record.accelerometer in models
            else record
            for record in self.series
        )

        def reweight(design_blocks: Sequence[DesignBlock]) -> tuple[DesignBlock, ...]:
            return tuple(
                replace(block, series=block.series.copy_noise(record.drop_rows(mask)))
                for block, record, mask in zip(design_blocks, series, self.outliers, strict=True)
            )

        fit = replace(self.fit, observations=reweight(self.fit.design_blocks))
        return replace(self, series=series, design_blocks=reweight(self.design_blocks), fit=fit)

    def estimate_noise(self) -> _EstimationState:
        """Return the state with estimates of the noise that is not given."""
        noise, estimates = estimate_noise_by_accelerometer(
            self.fit.design_blocks, self.fit.model, self.requests
        )
        return replace(self, fit=self.fit.with_noise(noise), noise_estimates=estimates)


def estimate(
    series: Sequence[ResidualSeries],
    model: Unknowns,
    requests: Mapping[str, Noise],
    *,
    rejects_outliers: bool = True,
) -> Estimate:
    """Estimate a model from all series.

    rejects_outliers: Whether outliers are rejected.
    """
    state = first_fit(find_rotation(tuple(series), model, requests), model, requests)
    for stage in STAGES:
        if rejects_outliers or stage not in (reject_outliers, reinstate_outliers):
            state = stage(state)
    full_fit = solve_joint(state.design_blocks, state.model, state.fit.noise)
    return _make_estimate(full_fit, state.fit, state.noise_estimates, state.outliers, state.series)


def correct_series(
    series: Sequence[ResidualSeries], model: Unknowns, requests: Mapping[str, Noise]
) -> tuple[ResidualSeries, ...]:
    """Return the series with times corrected by the angle; unchanged without a recorded angle."""
    if all(record.timestamp_errors is None for record in series):
        return tuple(series)
    state = first_fit(find_rotation(tuple(series), model, requests), model, requests)
    for stage in (reject_outliers, correct_time_stamps, find_noise, model_heteroscedasticity):
        state = stage(state)
    return state.series


def reestimate(previous: Estimate, fit: JointFit, requests: Mapping[str, Noise]) -> Estimate:
    """Return the estimate of another fit to the same rows, with new noise estimates."""
    compressed_fit = solve_joint(
        *compress_nuisance(fit.design_blocks, fit.model, _white_noise(fit.noise)), fit.noise
    )
    noise, noise_estimates = estimate_noise_by_accelerometer(
        compressed_fit.design_blocks, compressed_fit.model, requests
    )
    compressed_fit = compressed_fit.with_noise(noise)
    return _make_estimate(
        fit.with_noise(noise), compressed_fit, noise_estimates, previous.outliers, previous.series
    )


# The stages -----------------------------------------------------------------------------------


def find_rotation(
    series: tuple[ResidualSeries, ...], model: Unknowns, requests: Mapping[str, Noise]
) -> tuple[ResidualSeries, ...]:
    """Estimate the rotation of runs without a recorded angle."""
    if not any(unknown.symbol in ROTATION for unknown in model.unknowns):
        return series
    base_model = model.without_inputs()
    scale_factors = _scale_factors(series, base_model, None)
    return rotation.find_rotation(series, base_model, scale_factors, _unit_noise(requests))


def first_fit(
    series: tuple[ResidualSeries, ...], model: Unknowns, requests: Mapping[str, Noise]
) -> _EstimationState:
    """Fit all rows with equal weights, linearised at estimates of the parameters of interest."""
    scale_factors = _scale_factors(series, model, None)
    point: dict[Unknown, float] = {}
    if model.has_inputs:
        of_interest = Unknowns(model.of_interest)
        interest_fit = solve_joint(
            build_design_blocks(series, of_interest, scale_factors),
            of_interest,
            _unit_noise(requests),
        )
        scale_factors = _scale_factors(series, model, interest_fit)
        estimates = interest_fit.solution.estimate.tolist()
        point = dict(zip(of_interest.unknowns, estimates, strict=True))
        design_blocks = update_design_blocks(
            interest_fit.design_blocks, of_interest, model, scale_factors, point
        )
    else:
        design_blocks = build_design_blocks(series, model, scale_factors)
    white_noise = _white_noise({name: request.known for name, request in requests.items()})
    fit = solve_joint(*compress_nuisance(design_blocks, model, white_noise), _unit_noise(requests))
    masks = outlier_rejection.empty_masks(series)
    return _EstimationState(
        requests, series, model, scale_factors, point, design_blocks, masks, fit
    )


def locate_inputs(
    series: tuple[ResidualSeries, ...],
    model: Unknowns,
    requests: Mapping[str, Noise],
    names: Sequence[str],
) -> dict[str, float]:
    """Return estimates of inputs, minus nominal, by a first fit with white noise.

    The noise is the stated white noise, or otherwise estimated from row to row.
    """
    state = first_fit(series, model, requests)
    white_noise: dict[str, float] = {}
    for block in state.design_blocks:
        stated_sd = math.sqrt(requests[block.accelerometer].known.sample_variance)
        sd = stated_sd or estimate_white_noise(block) or 1.0
        white_noise[block.accelerometer] = max(sd, white_noise.get(block.accelerometer, 0.0))
    noise = {name: Noise(level) for name, level in white_noise.items()}
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
    """Correct the times of the rows by their angles, if the time stamps have significant errors.

    The correction is iterated because the slopes of the output depend on the times.
    """
    for _ in range(_TIMESTAMP_ROUNDS):
        fractions = estimate_timestamp_fractions(state.fit)
        if not fractions:
            break
        series = tuple(
            record.correct_times(fractions.get(record.run, record.corrected_fraction))
            for record in state.series
        )
        has_outliers = any(mask.any() for mask in state.outliers)
        state = first_fit(series, state.model, state.requests)
        state = reject_outliers(state) if has_outliers else state
    return state


def thin_correlated_rows(state: _EstimationState) -> _EstimationState:
    """Thin rows whose errors are correlated, then refit."""
    accepted_series = tuple(
        record.drop_rows(mask) for record, mask in zip(state.series, state.outliers, strict=True)
    )
    thinned_series = thin_rows(state.fit, accepted_series)
    if all(old is new for old, new in zip(accepted_series, thinned_series, strict=True)):
        return state
    return first_fit(thinned_series, state.model, state.requests)


def find_noise(state: _EstimationState) -> _EstimationState:
    """Estimate the noise of the records."""
    return state.estimate_noise()


def model_heteroscedasticity(state: _EstimationState) -> _EstimationState:
    """Weight runs by their white noise, and rows by the noise of their time stamps."""
    for _ in range(_WEIGHTING_ROUNDS):
        variance_models = estimate_heteroscedasticity(state.fit, state.series, state.requests)
        if not variance_models:
            break
        state = state.with_variance_models(variance_models).estimate_noise()
    return state


def add_encoder_terms(state: _EstimationState) -> _EstimationState:
    """Add rotation errors due to encoder noise to the model, if they are not negligible."""
    series = [block.series for block in state.design_blocks]
    model = encoder.add_encoder_terms(state.model, series, state.fit.noise)
    if model is state.model:
        return state
    # These errors were part of the residuals so far.
    return find_noise(state.with_model(model, state.scale_factors))


def relinearise_inputs(state: _EstimationState) -> _EstimationState:
    """Recompute the columns of inputs and platform if the estimate moved far."""
    scale_factors = _scale_factors(state.series, state.model, state.fit)
    has_changed = any(
        abs(scale_factors[a] - k) > _SCALE_TOLERANCE for a, k in state.scale_factors.items()
    )
    if not has_changed and not (state.model.has_inputs and _has_moved_far(state)):
        return state
    return state.with_model(state.model, scale_factors).estimate_noise()


def _has_moved_far(state: _EstimationState) -> bool:
    """Return whether parameters of interest are far from the linearization point."""
    if any(unknown.symbol in encoder.SYMBOLS for unknown in state.model.unknowns):
        return True  # the columns were computed without encoder terms
    solution, values = state.fit.solution, state.values
    shifts_in_sds = [
        abs(value - state.linearization_point.get(unknown, 0.0)) / u
        for (unknown, value), u in zip(values.items(), solution.u.tolist(), strict=True)
        if unknown.is_of_interest and 0.0 < u < unknown.limit
    ]
    return max(shifts_in_sds, default=0.0) > _MAX_MOVE_SDS


def relinearise_rotation(state: _EstimationState) -> _EstimationState:
    """Relinearise at the estimated rotation if its effect is nonlinear; re-estimate the noise."""
    if not rotation.may_be_nonlinear(state.design_blocks, state.model, state.fit.noise):
        return state
    initial_state = state
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
        pairs = zip(series, state.outliers, strict=True)
        accepted_series = [record.drop_rows(mask) for record, mask in pairs]
        design_blocks = build_design_blocks(accepted_series, model, state.scale_factors, values)
        fit = solve_joint(*compress_nuisance(design_blocks, model, _white_noise(noise)), noise)
        point = dict(zip(model.unknowns, values.tolist(), strict=True))
        state = replace(
            state,
            series=series,
            model=model,
            linearization_point=point,
            design_blocks=design_blocks,
            fit=fit,
            columns_changed=True,
        )
    return state if state is initial_state else model_heteroscedasticity(find_noise(state))


def reinstate_outliers(state: _EstimationState) -> _EstimationState:
    """Reject and reinstate rows by the final model, if the columns changed."""
    if not state.columns_changed:
        return state
    fit, outliers, estimates = state.fit, state.outliers, state.values
    values = np.array([estimates.get(unknown, 0.0) for unknown in state.model.unknowns])

    def build_blocks() -> tuple[DesignBlock, ...]:
        return build_design_blocks(state.series, state.model, state.scale_factors, values)

    if outlier_rejection.has_many_outliers(outliers):
        full_problem = compress_nuisance(build_blocks(), state.model, _white_noise(fit.noise))
        fit, outliers = outlier_rejection.reinstate_rows(
            fit, full_problem, state.series, state.requests, outliers
        )
    fit, outliers = outlier_rejection.reject_outliers(fit, state.series, state.requests, outliers)
    if fit is state.fit:
        return state
    blocks = outlier_rejection.select_rows(build_blocks(), outliers)
    return replace(state, fit=fit, outliers=outliers, design_blocks=blocks).estimate_noise()


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


def _make_estimate(
    fit: JointFit,
    compressed_fit: JointFit,
    noise_estimates: Mapping[str, NoiseEstimate],
    outliers: RowMasks,
    series: tuple[ResidualSeries, ...],
) -> Estimate:
    """Add undetected noise to the covariance, and compute degrees of freedom.

    compressed_fit: The same fit with compressed nuisance parameters.
    """
    model = fit.model
    compressed_fit, dof, losses = inflate_for_noise(compressed_fit, noise_estimates)
    # Parameters of interest come first in the compressed fit; uncompressed, it has all unknowns.
    indices = [index for index, unknown in enumerate(model.unknowns) if unknown.is_of_interest]
    if compressed_fit.model.unknowns == model.unknowns:
        indices = list(range(len(model.unknowns)))
    full_dof = np.full(len(model.unknowns), math.inf)
    full_dof[indices] = dof[: len(indices)]

    def embed_matrix(covariance: Array) -> Array:
        matrix = np.zeros((full_dof.size, full_dof.size))
        matrix[np.ix_(indices, indices)] = covariance[: len(indices), : len(indices)]
        return matrix

    added_covariance = compressed_fit.solution.covariance_undetected
    if added_covariance is not None:
        solution = replace(fit.solution, covariance_undetected=embed_matrix(added_covariance))
        walks = {
            name: (level, embed_matrix(covariance))
            for name, (level, covariance) in compressed_fit.undetected_walks.items()
        }
        fit = replace(fit, solution=solution, undetected_walks=walks)
    return Estimate(fit, noise_estimates, full_dof, outliers, series, compressed_fit, losses)


def _unit_noise(requests: Mapping[str, Noise]) -> dict[str, Noise]:
    return {name: Noise(1.0) for name in requests}


def _white_noise(noise: Mapping[str, Noise]) -> dict[str, float | None]:
    """Return the white noise of a sample; None if it is unknown."""
    return {name: math.sqrt(component.sample_variance) or None for name, component in noise.items()}


def _scale_factors(
    series: Sequence[ResidualSeries], model: Unknowns, fit: JointFit | None
) -> dict[str, float]:
    """Return K_I of each accelerometer: its estimate, else its prior value, else 1."""
    factors = {record.accelerometer: 1.0 for record in series}
    indices = {} if fit is None else {unknown: k for k, unknown in enumerate(fit.model.unknowns)}
    for unknown in model.unknowns:
        if unknown.symbol == "K_I":
            index = indices.get(unknown)
            if fit is not None and index is not None and fit.solution.u[index] < unknown.limit:
                factors[unknown.owner] = 1.0 + float(fit.solution.estimate[index])
            elif math.isfinite(unknown.prior[1]):
                factors[unknown.owner] = unknown.prior[0]
    factors |= {c.owner: c.prior[0] for c in model.considered if c.symbol == "K_I"}
    return factors
