"""One accelerometer's output in one run: columns, what uncertain inputs change, whitening."""

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

#: Step of the reference's slope, rad.
_ANGLE_STEP: Final = 1e-4

#: Singular values below this part of the largest are those of a constant.
_RANK_TOLERANCE: Final = 1e-6

#: Least variance of a row's jitter, over the mean of what an ideal output has: no row is without
#: noise where the slope is zero.
MIN_RELATIVE_VARIANCE: Final = 0.02


@frozen
class TimestampErrors:
    """Errors of the time stamps of a run, as the recorded angle shows them.

    A row is sampled j after its time stamp, so that angle and output are both those of the later
    time. The residual of the angle over the angular rate is j plus the noise of the encoder.
    """

    delay: Array  #: That residual over the rate, s, shape (n,).
    sd: float  #: Its standard deviation in a row of one sample, s.
    dof: int  #: Degrees of freedom of that.
    #: By how much the variance of the times inside each block is larger by the angles than by the
    #: time stamps, s^2, shape (n,).
    variance_change: Array
    #: Stated noise of the time stamps, and stated noise of the encoder over the rate, s; 0: not
    #: stated.
    timestamp_sd: float = 0.0
    encoder_sd: float = 0.0
    fraction: float = 0.0  #: Part of the delays by which the times are corrected.

    def select(self, keep: npt.NDArray[np.bool_]) -> TimestampErrors:
        """Return those of the rows where `keep` (bool, shape (n,)) is true."""
        return replace(self, delay=self.delay[keep], variance_change=self.variance_change[keep])

    @property
    def prior(self) -> tuple[float, float]:
        """The time stamps' share in the variance of the delays as stated, and its uncertainty."""
        if self.timestamp_sd == 0.0 or self.sd == 0.0:
            return 0.0, math.inf
        if self.encoder_sd > 0.0:
            return self.timestamp_sd**2 / (self.timestamp_sd**2 + self.encoder_sd**2), 0.0
        share = min((self.timestamp_sd / self.sd) ** 2, 1.0)
        return share, share * math.sqrt(2.0 / self.dof)

    @property
    def residual_sd(self) -> float:
        """Known residual noise of the time stamps after the correction, s."""
        return (
            self.encoder_sd * math.sqrt(self.fraction) if self.fraction > 0.0 else self.timestamp_sd
        )


@frozen
class ResidualSeries:
    """One accelerometer's output in one run, less what a perfect system records."""

    #: Names.
    accelerometer: str
    run: str
    #: As for `observation.columns`.
    trajectory: Trajectory
    mounting: Mounting
    observable: str
    attitude: Array
    #: Mean time of each block, standard deviation of its samples' times (s) and their number, shape
    #: (n,); for point samples 0 and 1.
    time: Array
    time_sd: Array
    count: Array
    spacing: float  #: Time between samples, s.
    #: S - S_ref, m, m/s or m/s^2, shape (n,), without gaps (missing rows are left out).
    error: Array
    #: Whether the record is in g, so that its size depends on the gravity assumed.
    in_g: bool = False
    recorder: str = ""  #: The one whose clock its times have, where there are several.
    timestamp_sd: float = 0.0  #: Standard deviation of its time stamps, s.
    #: White noise of each sample that comes from it, in the error's unit, its rms; it is added to
    #: the accelerometer's own.
    timing_noise: float = 0.0
    thinning: int = 1  #: One of so many rows of the record, for those between are not independent.
    #: Variance of its white noise, that of the time stamps apart, over that of the accelerometer's.
    variance_ratio: float = 1.0
    #: How far the run may have turned otherwise than `trajectory` says; None where nobody knows.
    angle_error: AngleError | None = None
    #: To which the run is integrated, s, if that is beyond its rows; 0: to the last.
    integration_end: float = 0.0
    #: Change of the error with the latitude for which it was worked out, in its unit and 1/rad,
    #: shape (n,); None where it does not depend on it.
    latitude_sensitivity: Array | None = None
    #: How much a standard deviation of a time stamp moves each row, in the error's unit, shape
    #: (n,); None: not at all.
    jitter_sensitivity: Array | None = None
    #: What the recorded angle shows of the time stamps' errors; None where it shows nothing.
    timestamp_errors: TimestampErrors | None = None

    @property
    def block_spacing(self) -> Array:
        """Time between the samples inside each block, s, shape (n,).

        From the block's own spread of times where it is denser than usual, so that the blocks of
        an uneven clock never seem to overlap.
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
            # A time more, at the run's end: integrals are then those along all of it.
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
        half = math.sqrt(3.0) * self.time_sd
        early, late = (motion.specific_force(self.time + s * half) @ axis for s in (-1.0, 1.0))
        rows = np.flatnonzero((early * late <= 0.0) & (self.time_sd > 0.0))
        spacing = self.block_spacing
        times = [
            self.time[k] + spacing[k] * (np.arange(count) - 0.5 * (count - 1.0))
            for k, count in zip(rows.tolist(), self.count[rows].astype(int).tolist(), strict=True)
        ]
        return rows, np.concatenate(times) if times else np.empty(0)

    def reference(self, trajectory: Trajectory | None = None, delay: float = 0.0) -> Array:
        """Return the reference averaged over the blocks, shape (n,), at times later by `delay`."""
        motion = trajectory or self.trajectory
        return observation.block_average(
            lambda t: observation.reference(
                motion, self.mounting, t + delay, self.observable, self.attitude
            ),
            self.time,
            self.time_sd,
        )

    def rescale_clock(self, rate_error: float) -> ResidualSeries:
        """Return the series at true times, the recorder's clock being fast by a part of itself.

        What was recorded at t happened at t/(1 + fast); the recorded angle is what it was, so that
        the spindle turned faster by that.
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

    def drop_rows(self, drop: npt.NDArray[np.bool_]) -> ResidualSeries:
        """Return the series without the rows where `drop` (bool, shape (n,)) is true."""
        keep = np.logical_not(drop)
        return replace(
            self,
            time=self.time[keep],
            time_sd=self.time_sd[keep],
            count=self.count[keep],
            error=self.error[keep],
            latitude_sensitivity=None
            if self.latitude_sensitivity is None
            else self.latitude_sensitivity[keep],
            jitter_sensitivity=None
            if self.jitter_sensitivity is None
            else self.jitter_sensitivity[keep],
            timestamp_errors=self.timestamp_errors and self.timestamp_errors.select(keep),
        )

    @property
    def corrected_fraction(self) -> float:
        """The part of the angle's delays by which the times are corrected."""
        return 0.0 if self.timestamp_errors is None else self.timestamp_errors.fraction

    @property
    def timestamp_noise(self) -> float:
        """Standard deviation of the time stamps as it is stated or found, s."""
        if self.timestamp_errors is None or self.corrected_fraction == 0.0:
            return self.timestamp_sd
        return self.timestamp_errors.sd * math.sqrt(self.corrected_fraction)

    def correct_times(self, fraction: float) -> ResidualSeries:
        """Return the series at times corrected by a part of the delays that the angle shows.

        The expected error of a time stamp, given its angle, is this part of the delay. What an
        ideal output is then follows at the corrected times, to every order.
        """
        if self.timestamp_errors is None or fraction == self.corrected_fraction:
            return self
        time = self.time + (fraction - self.corrected_fraction) * self.timestamp_errors.delay
        if not np.all(np.diff(time) > 0.0):
            return self  # an encoder this noisy does not tell the order of the rows
        stamps = replace(self.timestamp_errors, fraction=fraction)
        added_variance = (
            fraction - self.corrected_fraction
        ) * self.timestamp_errors.variance_change
        spread = np.sqrt(np.maximum(self.time_sd**2 + added_variance, 0.0))
        corrected_series = replace(self, time=time, time_sd=spread, timestamp_errors=stamps)
        error = self.error + self.reference() - corrected_series.reference()
        return replace(corrected_series, error=error).with_timestamp_noise(stamps.residual_sd)

    def add_angle(self, coefficients: Array) -> ResidualSeries | None:
        """Return the series about a rotation that is ahead by coefficients of its angle's error.

        The recorded angle is what it was, so that the delays and the corrected times change too.

        coefficients: Shape (m,), in the units of `AngleError`.
        Returns: None if the corrected times would not increase.
        """
        previous, error = self.trajectory.spindle, self.angle_error
        assert error is not None
        spindle = previous.add_angle(error, coefficients)
        error = replace(error, rate=spindle.rate, deviation=error.deviation - coefficients)
        time, stamps = self.time, self.timestamp_errors
        if stamps is not None:
            stamp_times = time - stamps.fraction * stamps.delay
            sample_times = stamp_times + stamps.delay
            ahead = observation.block_average(
                lambda t: spindle.angle(t) - previous.angle(t), sample_times, self.time_sd
            )
            stamps = replace(
                stamps, delay=stamps.delay - ahead / spindle.angular_rate(sample_times)
            )
            time = stamp_times + stamps.fraction * stamps.delay
            if not np.all(np.diff(time) > 0.0):
                return None
        rotated = replace(
            self,
            trajectory=replace(self.trajectory, spindle=spindle),
            angle_error=error,
            time=time,
            timestamp_errors=stamps,
        )
        rotated = replace(rotated, error=self.error + self.reference() - rotated.reference())
        timing = (
            stamps.residual_sd
            if stamps is not None and stamps.fraction > 0.0
            else self.timestamp_sd
        )
        return rotated.with_timestamp_noise(0.0).with_timestamp_noise(timing)

    def with_encoder_noise(self, noise: float) -> ResidualSeries:
        """Return corrected series with what noise of the encoder leaves open of the times.

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
        """Return the noise of an accelerometer with what the time stamps' noise adds here."""
        white = math.sqrt(self.variance_ratio) * noise.white
        return replace(noise, white=math.hypot(white, self.timing_noise))

    def with_timestamp_noise(self, timestamp_sd: float) -> ResidualSeries:
        """Return the series with what noise of its time stamps adds: it goes with the slope.

        timestamp_sd: Standard deviation of a time stamp, s.
        """
        if timestamp_sd == self.timestamp_sd:
            return self
        if timestamp_sd == 0.0:
            return replace(self, timestamp_sd=0.0, jitter_sensitivity=None, timing_noise=0.0)
        reference_slope, error_slope = self.slopes()
        slope = reference_slope + error_slope
        floor = math.sqrt(MIN_RELATIVE_VARIANCE * float(np.mean(reference_slope**2)))
        return replace(
            self,
            timestamp_sd=timestamp_sd,
            jitter_sensitivity=timestamp_sd * np.maximum(np.abs(slope), floor),
            timing_noise=timestamp_sd * math.sqrt(float(np.mean(slope**2))),
        )

    def scale_noise(self, run_ratios: Mapping[str, float]) -> ResidualSeries:
        """Return the series with its white noise as many times as large as is said of its run."""
        return replace(
            self, variance_ratio=self.variance_ratio * run_ratios.get(self.run, 1.0) ** 2
        )

    def with_noise_of(self, source: ResidualSeries) -> ResidualSeries:
        """Return the series with the noise of another one of the same rows."""
        return replace(
            self,
            variance_ratio=source.variance_ratio,
            timestamp_sd=source.timestamp_sd,
            timing_noise=source.timing_noise,
            jitter_sensitivity=source.jitter_sensitivity,
        )

    def slopes(self, known: Mapping[str, float] = MappingProxyType({})) -> tuple[Array, Array]:
        """Return d/dt of the reference and of the error, in the error's unit and 1/s, (n,) each.

        The slope of what coefficients explain of the error is exact. That of the rest is the slope
        of a cubic with a wave through it: a bias of 5 mg has moved the platform at 20 m/s after
        400 s, five times as fast as the arm does.

        known: Coefficients of the accelerometer, less nominal.
        """
        step = _ANGLE_STEP / abs(self.trajectory.spindle.rate)
        ideal = (self.reference(delay=step) - self.reference(delay=-step)) / (2.0 * step)
        length = max(float(self.time[-1]), self.spacing)
        t = self.time / length
        angle = self.trajectory.spindle.angle(self.time)
        angular_rate = self.trajectory.spindle.angular_rate(self.time)
        wave = [np.cos(angle), np.sin(angle)]
        # At strobes the wave is a constant, and nothing is left of it.
        shape = np.column_stack([np.vander(t, 4), *(column - column.mean() for column in wave)])
        residual, explained = self.error, np.zeros(())
        if known:
            values = np.array([*known.values()])
            residual = residual - self.columns([*known], 1.0) @ values
            explained = self._column_slopes([*known]) @ values
        coefficients = np.linalg.lstsq(shape, residual, rcond=_RANK_TOLERANCE)[0]
        polynomial_slope = np.polyval(np.polyder(coefficients[:4]), t) / length
        return ideal, explained + polynomial_slope + angular_rate * (
            coefficients[5] * wave[0] - coefficients[4] * wave[1]
        )

    def _column_slopes(self, symbols: Sequence[str]) -> Array:
        """Return d/dt of columns of the accelerometer's terms, shape (n, m)."""
        if self.order > 0:
            lower = {order: name for name, order in observation.ORDERS.items()}[self.order - 1]
            return replace(self, observable=lower).columns(symbols, 1.0)
        step = _ANGLE_STEP / abs(self.trajectory.spindle.rate)
        ahead, behind = (
            replace(self, time=self.time + s).columns(symbols, 1.0) for s in (step, -step)
        )
        return (ahead - behind) / (2.0 * step)

    @property
    def jitter_variance(self) -> Array:
        """Variance of a sample's jitter in each row, (n,), over `relative`; () without any."""
        return (
            np.zeros(())
            if self.jitter_sensitivity is None
            else self.jitter_sensitivity**2 / self.variance_ratio
        )

    @cached_property
    def differences(self) -> Differences:
        """The differences of the rows in which start offset and velocity do not show."""
        return Differences.of(
            self.time, self.order, self.count, self.block_spacing, self.variance_ratio
        )

    def whitener(self, noise: Noise) -> Whitener:
        """Return the whitener of the rows, which gives their noise unit covariance."""
        start = self.trajectory.conditions.start
        return build_whitener(self.differences, noise, start, self.jitter_variance)


# What inputs change -----------------------------------------------------------------------------

#: Steps of derivatives: of times in radians turned, of the clock in parts of itself; of the others
#: in parts of their size.
_RELATIVE_STEP: Final = 1e-5
_INPUT_STEP: Final = 1e-6

#: Uncertain inputs: how each changes the trajectory.
INPUT_PERTURBATIONS: Final[Mapping[str, Callable[[Trajectory, float], Trajectory]]] = {
    "centrifuge.radius": lambda motion, step: replace(motion, radius=motion.radius + step),
    "site.gravity": lambda motion, step: replace(
        motion, site=replace(motion.site, gravity=motion.site.gravity + step)
    ),
    "site.latitude": lambda motion, step: replace(
        motion, site=replace(motion.site, latitude=motion.site.latitude + step)
    ),
}
TIMING: Final = "records.timing_offset"  #: s, by which an angle is sampled after its output
CLOCK: Final = "records.clock"  #: the part of itself by which the recorder's clock runs fast
RATE: Final = "centrifuge.rate"  #: the random relative error of each rate of readings
RATE_CLOCK: Final = "centrifuge.clock"  #: the same of the counter that measures rates of readings


def rotation_column(series: ResidualSeries, symbol: str) -> Array:
    """Return d(reference)/d(a parameter of the rotation), by central differences, shape (n,)."""
    spindle = series.trajectory.spindle
    duration = float(series.time[-1])
    name, step = {
        "spindle.start_angle": ("start_angle", _RELATIVE_STEP),
        "spindle.rate": ("rate", _RELATIVE_STEP / duration),
        "spindle.drift": ("drift", _RELATIVE_STEP / (abs(spindle.rate) * duration**2)),
    }[symbol]
    ahead, behind = (
        series.reference(
            replace(
                series.trajectory,
                spindle=replace(spindle, **{name: getattr(spindle, name) + change}),
            )
        )
        for change in (step, -step)
    )
    return (ahead - behind) / (2.0 * step)


def input_owner(series: ResidualSeries, name: str) -> str:
    """Return the owner of an input that shows in a series: recorder, accelerometer or nobody."""
    if name == CLOCK:
        return series.recorder
    return series.accelerometer if name in RESPONSE_INPUTS and name != CUTOFF else ""


def input_affects(series: ResidualSeries, name: str, owner: str) -> bool:
    """Return whether an input of an owner shows in a series."""
    if name == RATE_CLOCK or (name in RESPONSE_INPUTS and series.mounting.response is None):
        return False
    return owner == input_owner(series, name)


def expected_output(
    series: ResidualSeries, known: Mapping[str, float], table: Mapping[str, Array]
) -> Array:
    """Return the output of a series with known errors, columns from a table, shape (n,)."""
    output = series.reference()
    for symbol, value in known.items():
        output = output + value * table[symbol]
    return output


def input_column(
    series: ResidualSeries,
    name: str,
    scale_factor: float,
    known: Mapping[str, float],
    expected: Array,
) -> Array:
    """Return d(recorded output)/d(input) at the estimate, by a forward difference, shape (n,).

    scale_factor: K_I, with which the accelerometer sees the platform's errors.
    known: The errors of the estimate, with which `expected` is what is expected.
    """
    reference, columns, step = with_input(series, name, list(known), scale_factor)
    change: Array = (reference + columns @ np.array([*known.values()]) - expected) / step
    if name == "site.latitude" and series.latitude_sensitivity is not None:
        change = change - series.latitude_sensitivity
    if name == "site.gravity" and series.in_g:
        # A record in g was turned into m/s^2 with the gravity assumed. What it should be is what
        # counts: with its noise in the column, it would explain itself.
        change = change - expected / series.trajectory.site.gravity
    return change


def with_input(
    series: ResidualSeries, name: str, symbols: Sequence[str], scale_factor: float
) -> tuple[Array, Array, float]:
    """Return reference (n,) and columns (n, q) with an input off by a small step, and the step."""
    if name == TIMING:
        spindle = series.trajectory.spindle
        step = _RELATIVE_STEP / abs(spindle.rate)
        # Angles that were taken later were reached later: the spindle was behind by that time, for
        # what the errors make of the motion too.
        behind = replace(series.trajectory, spindle=spindle.later(-step))
        late = series.columns(symbols, scale_factor, behind)
        return series.reference(delay=-step), late, step
    if name == CLOCK:
        rescaled = series.rescale_clock(_RELATIVE_STEP)
        return rescaled.reference(), rescaled.columns(symbols, scale_factor), _RELATIVE_STEP
    if name in RESPONSE_INPUTS:
        response = series.mounting.response
        assert response is not None
        step = response.step(name)
        mounting = replace(series.mounting, response=response.deviate(name, step))
        changed_series = replace(series, mounting=mounting)
        return changed_series.reference(), changed_series.columns(symbols, scale_factor), step
    step_size = {
        "centrifuge.radius": series.trajectory.radius,
        "site.gravity": series.trajectory.site.gravity,
        "site.latitude": 1.0,
    }[name]
    step = _INPUT_STEP * step_size
    trajectory = INPUT_PERTURBATIONS[name](series.trajectory, step)
    return series.reference(trajectory), series.columns(symbols, scale_factor, trajectory), step
