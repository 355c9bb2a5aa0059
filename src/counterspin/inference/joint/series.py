"""Output of an accelerometer in a run: columns, effects of uncertain inputs, whitening."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from counterspin.arrays import Array
from counterspin.frozen import frozen
from counterspin.inference.noise.model import Differences, Noise, Whitener, build_whitener
from counterspin.physics import observation
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.angle_error import AngleError
from counterspin.physics.frequency_response import CUTOFF, RESPONSE_INPUTS
from counterspin.physics.motion import Trajectory
from counterspin.physics.terms import TERMS

#: Step of the spindle angle for slopes of the reference, rad.
_ANGLE_STEP: Final = 1e-4

#: Relative singular value below which a centred harmonic is constant, as at strobes.
_RANK_TOLERANCE: Final = 1e-6

#: Smallest jitter variance of a row over the mean of the reference, so that rows with slope 0 have
#: noise too.
MIN_RELATIVE_VARIANCE: Final = 0.02


@frozen
class TimestampErrors:
    """Errors of the time stamps of a run, estimated from the recorded angle.

    A row is sampled j after its time stamp, so that angle and output are both those of the later
    time. The residual of the angle over the angular rate is j plus the noise of the encoder.
    """

    delay: Array  #: Residual of the angle over the angular rate, s, shape (n,).
    sd: float  #: Standard deviation of the delay of a single sample, s.
    dof: int  #: Degrees of freedom of `sd`.
    #: Variance of the times inside each block from the angles minus that from the time stamps, s^2,
    #: shape (n,).
    variance_change: Array
    timestamp_sd: float = 0.0  #: Stated noise of the time stamps, s; 0: not stated.
    encoder_sd: float = 0.0  #: Stated noise of the encoder over the rate, s; 0: not stated.
    fraction: float = 0.0  #: Fraction of the delays that is corrected.

    def select(self, mask: npt.NDArray[np.bool_]) -> TimestampErrors:
        """Return the errors of the rows that a mask of shape (n,) selects."""
        return replace(self, delay=self.delay[mask], variance_change=self.variance_change[mask])

    @property
    def prior(self) -> tuple[float, float]:
        """Prior fraction of the delay variance due to the time stamps, and its uncertainty."""
        if self.timestamp_sd == 0.0 or self.sd == 0.0:
            return 0.0, math.inf
        if self.encoder_sd > 0.0:
            return self.timestamp_sd**2 / (self.timestamp_sd**2 + self.encoder_sd**2), 0.0
        fraction = min((self.timestamp_sd / self.sd) ** 2, 1.0)
        return fraction, fraction * math.sqrt(2.0 / self.dof)

    @property
    def residual_sd(self) -> float:
        """Known residual noise of the time stamps after the correction, s."""
        return (
            self.encoder_sd * math.sqrt(self.fraction) if self.fraction > 0.0 else self.timestamp_sd
        )


@frozen
class ResidualSeries:
    """Output of an accelerometer in a run, minus the output of a perfect system."""

    #: Names of accelerometer and run.
    accelerometer: str
    run: str
    #: Parameters of `observation.columns`.
    trajectory: Trajectory
    mounting: Mounting
    observable: str
    attitude: Array
    #: Mean time of each block, standard deviation of the times of its samples (s; 0 for single
    #: samples) and number of samples, shape (n,).
    time: Array
    time_sd: Array
    count: Array
    spacing: float  #: Time between samples, s.
    error: Array  #: S - S_ref, m, m/s or m/s^2, shape (n,), without missing rows.
    in_g: bool = False  #: True if the record is in g, so that it depends on the assumed gravity.
    recorder: str = ""  #: Name of the recorder whose clock measures the times; empty: only one.
    timestamp_sd: float = 0.0  #: Standard deviation of the time stamps, s.
    timing_noise: float = 0.0  #: Rms noise of a sample due to the time stamps, in the error's unit.
    thinning: int = 1  #: Ratio of the rows of the record to the rows that are used.
    #: White-noise variance without time stamps, over that of the accelerometer.
    variance_ratio: float = 1.0
    angle_error: AngleError | None = None  #: Error of the spindle angle; None: unknown.
    integration_end: float = 0.0  #: End of the integration beyond the last row, s; 0: last row.
    #: d(error)/d(latitude), 1/rad, shape (n,); None: independent of the latitude.
    latitude_sensitivity: Array | None = None
    #: Effect of a standard deviation of a time stamp, in the unit of the error, shape (n,).
    jitter_sensitivity: Array | None = None
    timestamp_errors: TimestampErrors | None = None  #: None: not detectable.

    @property
    def block_spacing(self) -> Array:
        """Time between the samples inside each block, s, shape (n,).

        Dense blocks use the spread of their times, so that blocks of an irregular clock never
        overlap.
        """
        has_several_samples = self.time_sd > 0.0
        uniform_spacing = np.sqrt(12.0 / (np.maximum(self.count, 2.0) ** 2 - 1.0)) * self.time_sd
        return np.where(
            has_several_samples, np.minimum(uniform_spacing, self.spacing), self.spacing
        )

    def columns(
        self, symbols: Sequence[str], scale_factor: float, trajectory: Trajectory | None = None
    ) -> Array:
        """Return observation columns averaged over the blocks, shape (n, m).

        Columns of specific force that jump or bend where a_I changes sign are averaged over the
        samples of the block in which it does.
        """
        motion = trajectory or self.trajectory

        def evaluate(t: Array, symbols: Sequence[str] = symbols) -> Array:
            # The end of the run is appended so that the integrals extend over the whole run.
            times = np.append(t, self.integration_end) if self.integration_end else t
            return observation.columns(
                motion,
                self.mounting,
                symbols,
                times,
                self.observable,
                attitude=self.attitude,
                scale_factor=scale_factor,
            )[: t.size]

        columns = observation.block_average(evaluate, self.time, self.time_sd)
        kinked_columns = [
            k for k, s in enumerate(symbols) if s in TERMS and TERMS[s].effect.has_kink
        ]
        if kinked_columns and self.order == 0 and np.any(self.time_sd):
            rows, times = self._samples_at_sign_changes(motion)
            if rows.size:
                counts = self.count[rows].astype(int)
                values = evaluate(times, [symbols[k] for k in kinked_columns])
                starts = np.cumsum(counts) - counts
                means = np.add.reduceat(values, starts) / counts[:, None]
                columns[rows[:, None], kinked_columns] = means
        return columns

    def _samples_at_sign_changes(self, motion: Trajectory) -> tuple[npt.NDArray[np.intp], Array]:
        """Return the blocks in which a_I changes sign, and the times of all their samples, s."""
        axis = self.mounting.turned(self.attitude).input_axis
        half_width = math.sqrt(3.0) * self.time_sd
        ends = self.time - half_width, self.time + half_width
        a_start, a_end = (motion.specific_force(t) @ axis for t in ends)
        rows = np.flatnonzero((a_start * a_end <= 0.0) & (self.time_sd > 0.0))
        spacing = self.block_spacing
        times = [
            self.time[k] + spacing[k] * (np.arange(count) - 0.5 * (count - 1.0))
            for k, count in zip(rows.tolist(), self.count[rows].astype(int).tolist(), strict=True)
        ]
        return rows, np.concatenate(times) if times else np.empty(0)

    def reference(self, trajectory: Trajectory | None = None, delay: float = 0.0) -> Array:
        """Return the reference, delayed by `delay` and averaged over the blocks, shape (n,)."""
        motion = trajectory or self.trajectory
        return observation.block_average(
            lambda t: observation.reference(
                motion, self.mounting, t + delay, self.observable, self.attitude
            ),
            self.time,
            self.time_sd,
        )

    def rescale_clock(self, rate_error: float) -> ResidualSeries:
        """Return the series at true times, for a relative rate error of the recorder's clock.

        Samples recorded at t were taken at t/(1 + rate_error). The recorded angle is unchanged, so
        that the spindle turned faster.
        """
        time_scale, spindle = 1.0 / (1.0 + rate_error), self.trajectory.spindle
        rescaled_spindle = replace(
            spindle,
            rate=spindle.rate / time_scale,
            drift=spindle.drift / time_scale,
            ripples=tuple(replace(r, amplitude=r.amplitude / time_scale) for r in spindle.ripples),
        )
        return replace(
            self,
            trajectory=replace(self.trajectory, spindle=rescaled_spindle),
            time=self.time * time_scale,
            time_sd=self.time_sd * time_scale,
            integration_end=self.integration_end * time_scale,
        )

    def drop_rows(self, mask: npt.NDArray[np.bool_]) -> ResidualSeries:
        """Return the series without the rows where `mask` (bool, shape (n,)) is true."""
        is_kept = np.logical_not(mask)
        return replace(
            self,
            time=self.time[is_kept],
            time_sd=self.time_sd[is_kept],
            count=self.count[is_kept],
            error=self.error[is_kept],
            latitude_sensitivity=None
            if self.latitude_sensitivity is None
            else self.latitude_sensitivity[is_kept],
            jitter_sensitivity=None
            if self.jitter_sensitivity is None
            else self.jitter_sensitivity[is_kept],
            timestamp_errors=self.timestamp_errors and self.timestamp_errors.select(is_kept),
        )

    @property
    def corrected_fraction(self) -> float:
        """Fraction of the delays that is corrected."""
        return 0.0 if self.timestamp_errors is None else self.timestamp_errors.fraction

    @property
    def timestamp_noise(self) -> float:
        """Stated or estimated standard deviation of the time stamps, s."""
        if self.timestamp_errors is None or self.corrected_fraction == 0.0:
            return self.timestamp_sd
        return self.timestamp_errors.sd * math.sqrt(self.corrected_fraction)

    def correct_times(self, fraction: float) -> ResidualSeries:
        """Return the series at times corrected by a fraction of the delays.

        The expected error of a time stamp, given its angle, is this fraction of the delay. The
        reference is recomputed at the corrected times.
        """
        if self.timestamp_errors is None or fraction == self.corrected_fraction:
            return self
        time = self.time + (fraction - self.corrected_fraction) * self.timestamp_errors.delay
        if not np.all(np.diff(time) > 0.0):
            return self  # the encoder is too noisy for the order of the rows
        errors = replace(self.timestamp_errors, fraction=fraction)
        fraction_change = fraction - self.corrected_fraction
        variance_change = fraction_change * self.timestamp_errors.variance_change
        time_sd = np.sqrt(np.maximum(self.time_sd**2 + variance_change, 0.0))
        corrected_series = replace(self, time=time, time_sd=time_sd, timestamp_errors=errors)
        error = self.error + self.reference() - corrected_series.reference()
        return replace(corrected_series, error=error).with_timestamp_noise(errors.residual_sd)

    def add_angle(self, coefficients: Array) -> ResidualSeries | None:
        """Return the series for a rotation that is advanced by an angle error.

        The recorded angle is unchanged, so that the delays and the corrected times change too.

        coefficients: Coefficients of the functions of `AngleError`, shape (m,).
        Returns: None if the corrected times would not increase.
        """
        old_spindle, angle_error = self.trajectory.spindle, self.angle_error
        assert angle_error is not None
        spindle = old_spindle.add_angle(angle_error, coefficients)
        deviation = angle_error.deviation - coefficients
        angle_error = replace(angle_error, rate=spindle.rate, deviation=deviation)
        time, errors = self.time, self.timestamp_errors
        if errors is not None:
            stamp_times = time - errors.fraction * errors.delay
            sample_times = stamp_times + errors.delay
            angle_change = observation.block_average(
                lambda t: spindle.angle(t) - old_spindle.angle(t), sample_times, self.time_sd
            )
            errors = replace(
                errors, delay=errors.delay - angle_change / spindle.angular_rate(sample_times)
            )
            time = stamp_times + errors.fraction * errors.delay
            if not np.all(np.diff(time) > 0.0):
                return None
        rotated_series = replace(
            self,
            trajectory=replace(self.trajectory, spindle=spindle),
            angle_error=angle_error,
            time=time,
            timestamp_errors=errors,
        )
        rotated_series = replace(
            rotated_series, error=self.error + self.reference() - rotated_series.reference()
        )
        timestamp_sd = (
            errors.residual_sd
            if errors is not None and errors.fraction > 0.0
            else self.timestamp_sd
        )
        return rotated_series.with_timestamp_noise(0.0).with_timestamp_noise(timestamp_sd)

    def with_encoder_noise(self, noise: float) -> ResidualSeries:
        """Return the series with the timing noise that the encoder adds to corrected times.

        noise: Standard deviation of a recorded angle, rad.
        """
        rate = abs(self.trajectory.spindle.rate)
        return self.with_timestamp_noise(noise * math.sqrt(self.corrected_fraction) / rate)

    @property
    def order(self) -> int:
        """Number of times that the observable integrates the specific force."""
        return observation.ORDERS[self.observable]

    def polynomials(self, count: int) -> Array:
        """Return the columns of start offset and start velocity, 1 and t, shape (n, count)."""
        return np.vander(self.time, count, increasing=True)

    def total_noise(self, noise: Noise) -> Noise:
        """Return the noise of the accelerometer plus the timing noise of the series."""
        white = math.sqrt(self.variance_ratio) * noise.white
        return replace(noise, white=math.hypot(white, self.timing_noise))

    def with_timestamp_noise(self, timestamp_sd: float) -> ResidualSeries:
        """Return the series with timing noise, which is proportional to the slope.

        timestamp_sd: Standard deviation of a time stamp, s.
        """
        if timestamp_sd == self.timestamp_sd:
            return self
        if timestamp_sd == 0.0:
            return replace(self, timestamp_sd=0.0, jitter_sensitivity=None, timing_noise=0.0)
        reference_slope, error_slope = self.slopes()
        slope = reference_slope + error_slope
        min_slope = math.sqrt(MIN_RELATIVE_VARIANCE * float(np.mean(reference_slope**2)))
        return replace(
            self,
            timestamp_sd=timestamp_sd,
            jitter_sensitivity=timestamp_sd * np.maximum(np.abs(slope), min_slope),
            timing_noise=timestamp_sd * math.sqrt(float(np.mean(slope**2))),
        )

    def scale_noise(self, run_ratios: Mapping[str, float]) -> ResidualSeries:
        """Return the series with its white noise multiplied by the ratio of its run."""
        return replace(
            self, variance_ratio=self.variance_ratio * run_ratios.get(self.run, 1.0) ** 2
        )

    def copy_noise(self, source: ResidualSeries) -> ResidualSeries:
        """Return the series with the noise of another series of the same rows."""
        return replace(
            self,
            variance_ratio=source.variance_ratio,
            timestamp_sd=source.timestamp_sd,
            timing_noise=source.timing_noise,
            jitter_sensitivity=source.jitter_sensitivity,
        )

    def slopes(self, deviations: Mapping[str, float] = MappingProxyType({})) -> tuple[Array, Array]:
        """Return d/dt of the reference and of the error, in the error's unit and 1/s, (n,) each.

        The slope of the error due to the given coefficients is exact. The slope of the remaining
        error is that of a fitted cubic with a harmonic of the spindle. A bias of 5 mg causes a
        velocity of 20 m/s after 400 s, five times the velocity of the arm.

        deviations: Coefficients of the accelerometer minus nominal values.
        """
        step = _ANGLE_STEP / abs(self.trajectory.spindle.rate)
        reference_slope = (self.reference(delay=step) - self.reference(delay=-step)) / (2.0 * step)
        duration = max(float(self.time[-1]), self.spacing)
        t = self.time / duration
        angle = self.trajectory.spindle.angle(self.time)
        angular_rate = self.trajectory.spindle.angular_rate(self.time)
        harmonic = [np.cos(angle), np.sin(angle)]
        # At strobes, the harmonic is constant and its centred columns vanish.
        centered = [column - column.mean() for column in harmonic]
        regressors = np.column_stack([np.vander(t, 4), *centered])
        residual, known_slope = self.error, np.zeros(())
        if deviations:
            values = np.array([*deviations.values()])
            residual = residual - self.columns([*deviations], 1.0) @ values
            known_slope = self._column_slopes([*deviations]) @ values
        coefficients = np.linalg.lstsq(regressors, residual, rcond=_RANK_TOLERANCE)[0]
        polynomial_slope = np.polyval(np.polyder(coefficients[:4]), t) / duration
        return reference_slope, known_slope + polynomial_slope + angular_rate * (
            coefficients[5] * harmonic[0] - coefficients[4] * harmonic[1]
        )

    def _column_slopes(self, symbols: Sequence[str]) -> Array:
        """Return d/dt of columns of the accelerometer's terms, shape (n, m)."""
        if self.order > 0:
            derivative = {order: name for name, order in observation.ORDERS.items()}[self.order - 1]
            return replace(self, observable=derivative).columns(symbols, 1.0)
        step = _ANGLE_STEP / abs(self.trajectory.spindle.rate)
        later, earlier = (
            replace(self, time=self.time + s).columns(symbols, 1.0) for s in (step, -step)
        )
        return (later - earlier) / (2.0 * step)

    @property
    def jitter_variance(self) -> Array:
        """Jitter variance of a sample over `variance_ratio`, (n,); shape () without jitter."""
        return (
            np.zeros(())
            if self.jitter_sensitivity is None
            else self.jitter_sensitivity**2 / self.variance_ratio
        )

    @cached_property
    def differences(self) -> Differences:
        """Differences of the rows, which do not contain start offset and velocity."""
        return Differences.from_times(
            self.time, self.order, self.count, self.block_spacing, self.variance_ratio
        )

    def whitener(self, noise: Noise) -> Whitener:
        """Return the whitener of the rows."""
        start = self.trajectory.conditions.start
        return build_whitener(self.differences, noise, start, self.jitter_variance)


# Effects of inputs ------------------------------------------------------------------------------

#: Steps of derivatives: rad for times, relative for the clock.
_RELATIVE_STEP: Final = 1e-5
_INPUT_STEP: Final = 1e-6  #: relative step of other inputs

#: Uncertain input -> function that changes it in a trajectory.
INPUT_PERTURBATIONS: Final[Mapping[str, Callable[[Trajectory, float], Trajectory]]] = {
    "centrifuge.radius": lambda motion, step: replace(motion, radius=motion.radius + step),
    "site.gravity": lambda motion, step: replace(
        motion, site=replace(motion.site, gravity=motion.site.gravity + step)
    ),
    "site.latitude": lambda motion, step: replace(
        motion, site=replace(motion.site, latitude=motion.site.latitude + step)
    ),
}
TIMING: Final = "records.timing_offset"  #: delay of the angle samples after the output samples, s
CLOCK: Final = "records.clock"  #: relative rate error of the recorder's clock
RATE: Final = "centrifuge.rate"  #: random relative error of each rate of readings
RATE_CLOCK: Final = "centrifuge.clock"  #: relative error of the counter that measures these rates


def rotation_column(series: ResidualSeries, symbol: str) -> Array:
    """Return d(reference)/d(a parameter of the rotation), by central differences, shape (n,)."""
    spindle = series.trajectory.spindle
    duration = float(series.time[-1])
    name, step = {
        "spindle.start_angle": ("start_angle", _RELATIVE_STEP),
        "spindle.rate": ("rate", _RELATIVE_STEP / duration),
        "spindle.drift": ("drift", _RELATIVE_STEP / (abs(spindle.rate) * duration**2)),
    }[symbol]
    upper, lower = (
        series.reference(
            replace(
                series.trajectory,
                spindle=replace(spindle, **{name: getattr(spindle, name) + change}),
            )
        )
        for change in (step, -step)
    )
    return (upper - lower) / (2.0 * step)


def input_owner(series: ResidualSeries, name: str) -> str:
    """Return the owner of an input of a series: recorder, accelerometer or empty."""
    if name == CLOCK:
        return series.recorder
    return series.accelerometer if name in RESPONSE_INPUTS and name != CUTOFF else ""


def input_affects(series: ResidualSeries, name: str, owner: str) -> bool:
    """Return whether an input of an owner affects a series."""
    if name == RATE_CLOCK or (name in RESPONSE_INPUTS and series.mounting.response is None):
        return False
    return owner == input_owner(series, name)


def expected_output(
    series: ResidualSeries, deviations: Mapping[str, float], columns: Mapping[str, Array]
) -> Array:
    """Return the output of a series with known deviations of coefficients, shape (n,)."""
    output = series.reference()
    for symbol, value in deviations.items():
        output = output + value * columns[symbol]
    return output


def input_column(
    series: ResidualSeries,
    name: str,
    scale_factor: float,
    deviations: Mapping[str, float],
    nominal_output: Array,
) -> Array:
    """Return d(recorded output)/d(input) at the estimate, by a forward difference, shape (n,).

    scale_factor: K_I in the columns of platform errors.
    deviations: Estimated coefficients minus nominal values, included in `nominal_output`.
    """
    reference, columns, step = evaluate_with_input(series, name, list(deviations), scale_factor)
    change: Array = (reference + columns @ np.array([*deviations.values()]) - nominal_output) / step
    if name == "site.latitude" and series.latitude_sensitivity is not None:
        change = change - series.latitude_sensitivity
    if name == "site.gravity" and series.in_g:
        # A record in g was converted to m/s^2 with the assumed gravity. The expected output is
        # used here: the noise of the recorded output would correlate with itself.
        change = change - nominal_output / series.trajectory.site.gravity
    return change


def evaluate_with_input(
    series: ResidualSeries, name: str, symbols: Sequence[str], scale_factor: float
) -> tuple[Array, Array, float]:
    """Return reference (n,) and columns (n, q) with an input changed by a step, and the step."""
    if name == TIMING:
        spindle = series.trajectory.spindle
        step = _RELATIVE_STEP / abs(spindle.rate)
        # Angles were sampled later than the output, so the spindle was behind by this time.
        delayed_trajectory = replace(series.trajectory, spindle=spindle.later(-step))
        columns = series.columns(symbols, scale_factor, delayed_trajectory)
        return series.reference(delay=-step), columns, step
    if name == CLOCK:
        series = series.rescale_clock(_RELATIVE_STEP)
        return series.reference(), series.columns(symbols, scale_factor), _RELATIVE_STEP
    if name in RESPONSE_INPUTS:
        response = series.mounting.response
        assert response is not None
        step = response.step(name)
        mounting = replace(series.mounting, response=response.deviate(name, step))
        changed_series = replace(series, mounting=mounting)
        return changed_series.reference(), changed_series.columns(symbols, scale_factor), step
    scale = {
        "centrifuge.radius": series.trajectory.radius,
        "site.gravity": series.trajectory.site.gravity,
        "site.latitude": 1.0,
    }[name]
    step = _INPUT_STEP * scale
    trajectory = INPUT_PERTURBATIONS[name](series.trajectory, step)
    return series.reference(trajectory), series.columns(symbols, scale_factor, trajectory), step
