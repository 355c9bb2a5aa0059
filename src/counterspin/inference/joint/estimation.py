"""The joint estimate as a list of stages, from the records to degrees of freedom.

Each stage takes the state of the estimate and returns it with what it found. Between them what
nobody asks for is in as few columns as tell the same (`counterspin.inference.joint.prepared`); the
last fit has all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Final

import numpy as np

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.joint import encoder, rotation, used_rows
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.found_noise import (
    growth_of,
    losses,
    noise_of,
    uncertain,
    widened,
)
from counterspin.inference.joint.prepared import (
    Prepared,
    condense,
    prepare_columns,
    prepared_for,
    white_level,
)
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.time_stamps import find_shares
from counterspin.inference.joint.uneven_noise import Uneven, uneven_noise
from counterspin.inference.joint.unknowns import ROTATION, Unknown, Unknowns
from counterspin.inference.joint.used_rows import Rows, independent
from counterspin.inference.noise.model import Noise
from counterspin.inference.noise.search import FoundNoise

#: A change of K_I by less than this changes no platform column noticeably.
_SCALE_TOLERANCE: Final = 1e-4

#: A change of a coefficient by so many of its standard uncertainties changes no input's column
#: noticeably: of its effect it changes a part as large as the input's own uncertainty.
_FAR: Final = 20.0

#: How often weights of uneven noise are looked for: noise of the time stamps, then that of the
#: runs beside it, and both once more.
_ROUNDS_OF_WEIGHTS: Final = 3

#: How often the times of the rows are corrected.
_ROUNDS_OF_STAMPS: Final = 3

#: How often the rotation is taken from the fit: each time the error that is left is squared.
_ROUNDS_OF_ROTATION: Final = 6


@frozen
class Estimate:
    """The joint estimate."""

    fit: JointFit  #: The solved problem.
    #: Accelerometer -> its estimated noise; without those whose noise was given.
    components: Mapping[str, FoundNoise]
    #: Effective degrees of freedom of each unknown, shape (p,); infinite where noise is exact.
    dof: Array
    outliers: Rows = ()  #: For each series, which of its rows were left out, bool.
    #: The data with these rows, about the rotation that was found where none was recorded.
    series: tuple[Series, ...] = ()
    #: The same fit with what nobody asks for condensed; None where there was nothing to condense.
    core: JointFit | None = None
    #: Accelerometer whose noise is not exact -> `found_noise.losses` of the core.
    lost: Mapping[str, Array] = field(default_factory=dict)


@frozen
class _State:
    """An estimate on its way."""

    requests: Mapping[str, Noise]  # noise as it is given or wanted
    series: tuple[Series, ...]  # all rows, about the rotation as far as it is known
    model: Unknowns  # what is estimated, with what the encoder leaves open as soon as it is known
    scale_factors: Mapping[str, float]  # K_I of each accelerometer in the platform's columns
    at: Mapping[Unknown, float]  # estimates, less nominal, at which inputs' derivatives are taken
    prepared: tuple[Prepared, ...]  # the model's columns of the rows that are not left out
    outliers: Rows
    fit: JointFit  # condensed
    found: Mapping[str, FoundNoise] = field(default_factory=dict)
    anew: bool = False  # whether the columns are others than when outliers were left out

    @property
    def values(self) -> dict[Unknown, float]:
        """Estimates of the unknowns minus their nominal values."""
        return dict(zip(self.fit.model.unknowns, self.fit.solution.estimate.tolist(), strict=True))

    def with_model(self, model: Unknowns, scale_factors: Mapping[str, float]) -> _State:
        """Return the state with another model or other scale factors, fitted."""
        at = self.values
        prepared = prepared_for(self.prepared, self.model, model, scale_factors, at)
        noise = self.fit.noise
        fit = solve_joint(*condense(prepared, model, _white(noise)), noise)
        return replace(
            self,
            model=model,
            scale_factors=scale_factors,
            at=at,
            prepared=prepared,
            fit=fit,
            anew=True,
        )

    def with_uneven(self, uneven: Mapping[str, Uneven]) -> _State:
        """Return the state with noise of the records that differs; nothing is fitted anew."""
        series = tuple(
            uneven[one.accelerometer].of(one) if one.accelerometer in uneven else one
            for one in self.series
        )

        def noisy(prepared: Sequence[Prepared]) -> tuple[Prepared, ...]:
            return tuple(
                replace(part, series=part.series.as_noisy_as(whole.without(mask)))
                for part, whole, mask in zip(prepared, series, self.outliers, strict=True)
            )

        fit = replace(self.fit, observations=noisy(self.fit.prepared))
        return replace(self, series=series, prepared=noisy(self.prepared), fit=fit)

    def with_noise(self) -> _State:
        """Return the state with noise found in what the fit leaves, where it is not given."""
        noise, found = noise_of(self.fit.prepared, self.fit.model, self.requests)
        return replace(self, fit=self.fit.with_noise(noise), found=found)


def estimate(
    series: Sequence[Series],
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
        if reject or stage not in (reject_outliers, take_back_outliers):
            state = stage(state)
    whole = solve_joint(state.prepared, state.model, state.fit.noise)
    return _finished(whole, state.fit, state.found, state.outliers, state.series)


def correct_series(
    series: Sequence[Series], model: Unknowns, requests: Mapping[str, Noise]
) -> tuple[Series, ...]:
    """Return the series at the times that their angles correct; as they are without an angle."""
    if all(one.stamps is None for one in series):
        return tuple(series)
    state = first_fit(find_rotation(tuple(series), model, requests), model, requests)
    for stage in (reject_outliers, correct_time_stamps, find_noise, weigh_uneven_noise):
        state = stage(state)
    return state.series


def estimate_again(before: Estimate, fit: JointFit, requests: Mapping[str, Noise]) -> Estimate:
    """Return the estimate of another fit to the same rows, the noise of its records found anew."""
    core = solve_joint(*condense(fit.prepared, fit.model, _white(fit.noise)), fit.noise)
    noise, found = noise_of(core.prepared, core.model, requests)
    core = core.with_noise(noise)
    return _finished(fit.with_noise(noise), core, found, before.outliers, before.series)


# The stages -----------------------------------------------------------------------------------


def find_rotation(
    series: tuple[Series, ...], model: Unknowns, requests: Mapping[str, Noise]
) -> tuple[Series, ...]:
    """Find how runs turned whose angle nobody recorded: columns are taken along the rotation."""
    if not any(unknown.symbol in ROTATION for unknown in model.unknowns):
        return series
    plain = model.without_inputs()
    known = _scale_factors(series, plain, None)
    return rotation.find_rotation(series, plain, known, _rough(requests))


def first_fit(series: tuple[Series, ...], model: Unknowns, requests: Mapping[str, Noise]) -> _State:
    """Fit all rows with equal weights, derivatives being taken where what is asked for lies.

    What nobody asks for moves that by no more than the uncertainties that it brings.
    """
    known = _scale_factors(series, model, None)
    at: dict[Unknown, float] = {}
    if model.has_inputs:
        asked = Unknowns(model.asked)
        alone = solve_joint(prepare_columns(series, asked, known), asked, _rough(requests))
        known = _scale_factors(series, model, alone)
        at = dict(zip(asked.unknowns, alone.solution.estimate.tolist(), strict=True))
        prepared = prepared_for(alone.prepared, asked, model, known, at)
    else:
        prepared = prepare_columns(series, model, known)
    white = _white({name: request.known for name, request in requests.items()})
    fit = solve_joint(*condense(prepared, model, white), _rough(requests))
    none = used_rows.nothing_left_out(series)
    return _State(requests, series, model, known, at, prepared, none, fit)


def locate_input(
    series: tuple[Series, ...], model: Unknowns, requests: Mapping[str, Noise], symbol: str
) -> float:
    """Return the estimate of an input by a first fit with white noise, less nominal.

    The noise is the stated white noise, or that which the records show from row to row.
    """
    state = first_fit(series, model, requests)
    levels: dict[str, float] = {}
    for part in state.prepared:
        stated = math.sqrt(requests[part.accelerometer].known.sample_variance)
        level = stated or white_level(part) or 1.0
        levels[part.accelerometer] = max(level, levels.get(part.accelerometer, 0.0))
    noise = {name: Noise(level) for name, level in levels.items()}
    fit = solve_joint(state.prepared, state.model, noise)
    place = [unknown.symbol for unknown in model.unknowns].index(symbol)
    return float(fit.solution.estimate[place])


def reject_outliers(state: _State) -> _State:
    """Leave out what the noise of its neighbours does not explain, before it is taken for noise."""
    fit, outliers = used_rows.reject(state.fit, state.series, state.requests, state.outliers)
    return replace(
        state, fit=fit, outliers=outliers, prepared=used_rows.kept(state.prepared, outliers)
    )


def correct_time_stamps(state: _State) -> _State:
    """Correct the times of the rows by their angles, where the output shows that the stamps err.

    Twice: the output is a curve, and the first time along slopes at the wrong times.
    """
    for _ in range(_ROUNDS_OF_STAMPS):
        shares = find_shares(state.fit)
        if not shares:
            break
        series = tuple(one.corrected(shares.get(one.run, one.share)) for one in state.series)
        rejected = any(mask.any() for mask in state.outliers)
        state = first_fit(series, state.model, state.requests)
        state = reject_outliers(state) if rejected else state
    return state


def leave_correlated_rows(state: _State) -> _State:
    """Fit anew without rows that tell nothing which those beside them do not tell."""
    kept = tuple(one.without(mask) for one, mask in zip(state.series, state.outliers, strict=True))
    series = independent(state.fit, kept)
    if all(one is before for one, before in zip(series, kept, strict=True)):
        return state
    return first_fit(series, state.model, state.requests)


def find_noise(state: _State) -> _State:
    """Weigh the records."""
    return state.with_noise()


def weigh_uneven_noise(state: _State) -> _State:
    """Weigh each run by its own white noise, and rows by that of their time stamps, where found."""
    for _ in range(_ROUNDS_OF_WEIGHTS):
        uneven = uneven_noise(state.fit, state.series, state.requests)
        if not uneven:
            break
        state = state.with_uneven(uneven).with_noise()
    return state


def find_encoder_waves(state: _State) -> _State:
    """Take along what the encoder has not shown of the rotation, where the weights let it count."""
    series = [part.series for part in state.prepared]
    model = encoder.with_encoder(state.model, series, state.fit.noise)
    if model is state.model:
        return state
    # It is in the residuals until then.
    return find_noise(state.with_model(model, state.scale_factors))


def rescale(state: _State) -> _State:
    """Take the columns of inputs and of the platform again, where the fit is far from theirs."""
    found = _scale_factors(state.series, state.model, state.fit)
    moved = any(abs(found[a] - k) > _SCALE_TOLERANCE for a, k in state.scale_factors.items())
    if not moved and not (state.model.has_inputs and _far(state)):
        return state
    return state.with_model(state.model, found).with_noise()


def _far(state: _State) -> bool:
    """Return whether what is asked for is far from where derivatives were taken."""
    if any(unknown.symbol in encoder.SYMBOLS for unknown in state.model.unknowns):
        return True  # they were taken where the estimate was without what the encoder leaves open
    solution, now = state.fit.solution, state.values
    moves = [
        abs(value - state.at.get(unknown, 0.0)) / u
        for (unknown, value), u in zip(now.items(), solution.u.tolist(), strict=True)
        if unknown.asked and 0.0 < u < unknown.limit
    ]
    return max(moves, default=0.0) > _FAR


def relinearise_rotation(state: _State) -> _State:
    """Take everything along the rotation that the fit found, where that is not only linear.

    Noise that seemed to be there along the first rotation is looked for again.
    """
    if not rotation.may_bend(state.prepared, state.model, state.fit.noise):
        return state
    before = state
    for _ in range(_ROUNDS_OF_ROTATION):
        noise = state.fit.noise
        whole = solve_joint(state.prepared, state.model, noise)
        turned = rotation.turn_to_estimate(whole, state.series)
        if turned is None:
            break
        series, model = turned
        values = np.where(
            [unknown.symbol in encoder.SYMBOLS for unknown in model.unknowns],
            0.0,
            whole.solution.estimate,
        )
        kept = [s.without(mask) for s, mask in zip(series, state.outliers, strict=True)]
        prepared = prepare_columns(kept, model, state.scale_factors, values)
        fit = solve_joint(*condense(prepared, model, _white(noise)), noise)
        at = dict(zip(model.unknowns, values.tolist(), strict=True))
        state = replace(
            state, series=series, model=model, at=at, prepared=prepared, fit=fit, anew=True
        )
    return state if state is before else weigh_uneven_noise(find_noise(state))


def take_back_outliers(state: _State) -> _State:
    """Leave out what stands out of this model alone, and take back what only the first made do so.

    For a model that has become another since outliers were left out.
    """
    if not state.anew:
        return state
    fit, outliers, now = state.fit, state.outliers, state.values
    values = np.array([now.get(unknown, 0.0) for unknown in state.model.unknowns])

    def columns() -> tuple[Prepared, ...]:
        return prepare_columns(state.series, state.model, state.scale_factors, values)

    if used_rows.many(outliers):
        everything = condense(columns(), state.model, _white(fit.noise))
        fit, outliers = used_rows.taken_back(
            fit, everything, state.series, state.requests, outliers
        )
    fit, outliers = used_rows.reject(fit, state.series, state.requests, outliers)
    if fit is state.fit:
        return state
    kept = used_rows.kept(columns(), outliers)
    return replace(state, fit=fit, outliers=outliers, prepared=kept).with_noise()


STAGES: Final = (
    reject_outliers,
    correct_time_stamps,
    leave_correlated_rows,
    find_noise,
    weigh_uneven_noise,
    find_encoder_waves,
    rescale,
    relinearise_rotation,
    take_back_outliers,
)


def _finished(
    fit: JointFit,
    core: JointFit,
    found: Mapping[str, FoundNoise],
    outliers: Rows,
    series: tuple[Series, ...],
) -> Estimate:
    """Widen a fit by noise that does not show, and count degrees of freedom.

    core: The same fit, condensed.
    """
    model = fit.model
    lost = {name: losses(core, name) for name in uncertain(core.noise, found)}
    core, dof = widened(core, growth_of(core, lost), core.noise, found)
    # In the condensed fit what is asked for comes first; one that has nothing condensed is whole.
    places = [place for place, unknown in enumerate(model.unknowns) if unknown.asked]
    if core.model.unknowns == model.unknowns:
        places = list(range(len(model.unknowns)))
    every = np.full(len(model.unknowns), math.inf)
    every[places] = dof[: len(places)]

    def embedded(covariance: Array) -> Array:
        whole = np.zeros((every.size, every.size))
        whole[np.ix_(places, places)] = covariance[: len(places), : len(places)]
        return whole

    added = core.solution.covariance_unseen
    if added is not None:
        solution = replace(fit.solution, covariance_unseen=embedded(added))
        unseen = {name: (level, embedded(one)) for name, (level, one) in core.unseen.items()}
        fit = replace(fit, solution=solution, unseen=unseen)
    return Estimate(fit, found, every, outliers, series, core, lost)


def _rough(requests: Mapping[str, Noise]) -> dict[str, Noise]:
    return {name: Noise(1.0) for name in requests}


def _white(noise: Mapping[str, Noise]) -> dict[str, float | None]:
    """Return the least white noise of a sample, as far as it is known."""
    return {name: math.sqrt(one.sample_variance) or None for name, one in noise.items()}


def _scale_factors(
    series: Sequence[Series], model: Unknowns, fit: JointFit | None
) -> dict[str, float]:
    """Return K_I of each accelerometer: estimated, or known beforehand, or 1."""
    factors = {record.accelerometer: 1.0 for record in series}
    found = {} if fit is None else {other: k for k, other in enumerate(fit.model.unknowns)}
    for unknown in model.unknowns:
        if unknown.symbol == "K_I":
            place = found.get(unknown)
            if fit is not None and place is not None and fit.solution.u[place] < unknown.limit:
                factors[unknown.owner] = 1.0 + float(fit.solution.estimate[place])
            elif math.isfinite(unknown.prior[1]):
                factors[unknown.owner] = unknown.prior[0]
    factors |= {c.owner: c.prior[0] for c in model.considered if c.symbol == "K_I"}
    return factors
