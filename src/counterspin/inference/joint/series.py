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
from counterspin.inference.noise.model import Differences, Noise, Whitener, whitener_of
from counterspin.physics import observation
from counterspin.physics.accelerometer import Mounting
from counterspin.physics.angle_error import AngleError
from counterspin.physics.motion import Trajectory
from counterspin.physics.terms import TERMS

#: Step of the reference's slope, rad.
_STEP_OF_TURN: Final = 1e-4

#: Singular values below this part of the largest are those of a constant.
_CONSTANT: Final = 1e-6

#: Least variance of a row's jitter, over the mean of what an ideal output has: no row is without
#: noise where the slope is zero.
LEAST_SHARE: Final = 0.02


@frozen
class StampErrors:
    """Errors of the time stamps of a run, as the recorded angle shows them.

    A row is sampled j after its time stamp, so that angle and output are both those of the later
    time. The residual of the angle over the angular rate is j plus the noise of the encoder.
    """

    delay: Array  #: That residual over the rate, s, shape (n,).
    sd: float  #: Its standard deviation in a row of one sample, s.
    dof: int  #: Degrees of freedom of that.
    #: By how much the variance of the times inside each block is larger by the angles than by the
    #: time stamps, s^2, shape (n,).
    widening: Array
    #: Stated noise of the time stamps, and stated noise of the encoder over the rate, s; 0: not
    #: stated.
    timing: float = 0.0
    encoder: float = 0.0
    share: float = 0.0  #: Part of the delays by which the times are corrected.

    def of_rows(self, keep: npt.NDArray[np.bool_]) -> StampErrors:
        """Return those of the rows where `keep` (bool, shape (n,)) is true."""
        return replace(self, delay=self.delay[keep], widening=self.widening[keep])

    @property
    def prior(self) -> tuple[float, float]:
        """The time stamps' share in the variance of the delays as stated, and its uncertainty."""
        if self.timing == 0.0 or self.sd == 0.0:
            return 0.0, math.inf
        if self.encoder > 0.0:
            return self.timing**2 / (self.timing**2 + self.encoder**2), 0.0
        share = min((self.timing / self.sd) ** 2, 1.0)
        return share, share * math.sqrt(2.0 / self.dof)

    @property
    def left(self) -> float:
        """Known residual noise of the time stamps after the correction, s."""
        return self.encoder * math.sqrt(self.share) if self.share > 0.0 else self.timing


@frozen
class Series:
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
    spread: Array
    count: Array
    spacing: float  #: Time between samples, s.
    #: S - S_ref, m, m/s or m/s^2, shape (n,), without gaps (missing rows are left out).
    error: Array
    #: Whether the record is in g, so that its size depends on the gravity assumed.
    in_g: bool = False
    recorder: str = ""  #: The one whose clock its times have, where there are several.
    timing: float = 0.0  #: Standard deviation of its time stamps, s.
    #: White noise of each sample that comes from it, in the error's unit, its rms; it is added to
    #: the accelerometer's own.
    jitter: float = 0.0
    every: int = 1  #: One of so many rows of the record, for those between are not independent.
    #: Variance of its white noise, that of the time stamps apart, over that of the accelerometer's.
    relative: float = 1.0
    #: How far the run may have turned otherwise than `trajectory` says; None where nobody knows.
    angle_error: AngleError | None = None
    #: To which the run is integrated, s, if that is beyond its rows; 0: to the last.
    until: float = 0.0
    #: Change of the error with the latitude for which it was worked out, in its unit and 1/rad,
    #: shape (n,); None where it does not depend on it.
    by_latitude: Array | None = None
    #: How much a standard deviation of a time stamp moves each row, in the error's unit, shape
    #: (n,); None: not at all.
    moved: Array | None = None
    #: What the recorded angle shows of the time stamps' errors; None where it shows nothing.
    stamps: StampErrors | None = None

    @property
    def block_spacing(self) -> Array:
        """Time between the samples inside each block, s, shape (n,).

        From the block's own spread of times where it is denser than usual, so that the blocks of
        an uneven clock never seem to overlap.
        """
        several = self.spread > 0.0
        across = np.sqrt(12.0 / (np.maximum(self.count, 2.0) ** 2 - 1.0)) * self.spread
        return np.where(several, np.minimum(across, self.spacing), self.spacing)

    def columns(
        self, symbols: Sequence[str], scale_factor: float, trajectory: Trajectory | None = None
    ) -> Array:
        """Return observation columns averaged over the blocks, shape (n, m).

        Columns of specific force that jump or bend where a_I changes sign are averaged over the
        samples of the block in which it does.
        """
        motion = trajectory or self.trajectory

        def shown(t: Array, symbols: Sequence[str] = symbols) -> Array:
            # A time more, at the run's end: integrals are then those along all of it.
            times = np.append(t, self.until) if self.until else t
            return observation.columns(
                motion,
                self.mounting,
                symbols,
                times,
                self.observable,
                attitude=self.attitude,
                scale_factor=scale_factor,
            )[: t.size]

        columns = observation.block_average(shown, self.time, self.spread)
        kinked = [k for k, s in enumerate(symbols) if s in TERMS and TERMS[s].effect.has_kink]
        if kinked and self.order == 0 and np.any(self.spread):
            rows, times = self._samples_at_sign_changes(motion)
            if rows.size:
                counts = self.count[rows].astype(int)
                values = shown(times, [symbols[k] for k in kinked])
                starts = np.cumsum(counts) - counts
                means = np.add.reduceat(values, starts) / counts[:, None]
                columns[rows[:, None], kinked] = means
        return columns

    def _samples_at_sign_changes(self, motion: Trajectory) -> tuple[npt.NDArray[np.intp], Array]:
        """Return the blocks in which a_I changes sign, and the times of all their samples, s."""
        axis = self.mounting.turned(self.attitude).input_axis
        half = math.sqrt(3.0) * self.spread
        early, late = (motion.specific_force(self.time + s * half) @ axis for s in (-1.0, 1.0))
        rows = np.flatnonzero((early * late <= 0.0) & (self.spread > 0.0))
        spacing = self.block_spacing
        times = [
            self.time[k] + spacing[k] * (np.arange(count) - 0.5 * (count - 1.0))
            for k, count in zip(rows.tolist(), self.count[rows].astype(int).tolist(), strict=True)
        ]
        return rows, np.concatenate(times) if times else np.empty(0)

    def reference(self, trajectory: Trajectory | None = None, later: float = 0.0) -> Array:
        """Return the reference averaged over the blocks, shape (n,), at times later by `later`."""
        motion = trajectory or self.trajectory
        return observation.block_average(
            lambda t: observation.reference(
                motion, self.mounting, t + later, self.observable, self.attitude
            ),
            self.time,
            self.spread,
        )

    def by_clock(self, fast: float) -> Series:
        """Return the series at true times, the recorder's clock being fast by a part of itself.

        What was recorded at t happened at t/(1 + fast); the recorded angle is what it was, so that
        the spindle turned faster by that.
        """
        slow, spindle = 1.0 / (1.0 + fast), self.trajectory.spindle
        faster = replace(
            spindle,
            rate=spindle.rate / slow,
            drift=spindle.drift / slow,
            ripples=tuple(replace(r, amplitude=r.amplitude / slow) for r in spindle.ripples),
        )
        return replace(
            self,
            trajectory=replace(self.trajectory, spindle=faster),
            time=self.time * slow,
            spread=self.spread * slow,
            until=self.until * slow,
        )

    def without(self, drop: npt.NDArray[np.bool_]) -> Series:
        """Return the series without the rows where `drop` (bool, shape (n,)) is true."""
        keep = np.logical_not(drop)
        return replace(
            self,
            time=self.time[keep],
            spread=self.spread[keep],
            count=self.count[keep],
            error=self.error[keep],
            by_latitude=None if self.by_latitude is None else self.by_latitude[keep],
            moved=None if self.moved is None else self.moved[keep],
            stamps=self.stamps and self.stamps.of_rows(keep),
        )

    @property
    def share(self) -> float:
        """The part of the angle's delays by which the times are corrected."""
        return 0.0 if self.stamps is None else self.stamps.share

    @property
    def scatter(self) -> float:
        """Standard deviation of the time stamps as it is stated or found, s."""
        if self.stamps is None or self.share == 0.0:
            return self.timing
        return self.stamps.sd * math.sqrt(self.share)

    def corrected(self, share: float) -> Series:
        """Return the series at times corrected by a part of the delays that the angle shows.

        The expected error of a time stamp, given its angle, is this part of the delay. What an
        ideal output is then follows at the corrected times, to every order.
        """
        if self.stamps is None or share == self.share:
            return self
        time = self.time + (share - self.share) * self.stamps.delay
        if not np.all(np.diff(time) > 0.0):
            return self  # an encoder this noisy does not tell the order of the rows
        stamps = replace(self.stamps, share=share)
        more = (share - self.share) * self.stamps.widening
        spread = np.sqrt(np.maximum(self.spread**2 + more, 0.0))
        moved = replace(self, time=time, spread=spread, stamps=stamps)
        error = self.error + self.reference() - moved.reference()
        return replace(moved, error=error).with_timing(stamps.left)

    def add_angle(self, coefficients: Array) -> Series | None:
        """Return the series about a rotation that is ahead by coefficients of its angle's error.

        The recorded angle is what it was, so that the delays and the corrected times change too.

        coefficients: Shape (m,), in the units of `AngleError`.
        Returns: None if the corrected times would not increase.
        """
        before, error = self.trajectory.spindle, self.angle_error
        assert error is not None
        spindle = before.add_angle(error, coefficients)
        error = replace(error, rate=spindle.rate, deviation=error.deviation - coefficients)
        time, stamps = self.time, self.stamps
        if stamps is not None:
            stamped = time - stamps.share * stamps.delay
            sampled = stamped + stamps.delay
            ahead = observation.block_average(
                lambda t: spindle.angle(t) - before.angle(t), sampled, self.spread
            )
            stamps = replace(stamps, delay=stamps.delay - ahead / spindle.angular_rate(sampled))
            time = stamped + stamps.share * stamps.delay
            if not np.all(np.diff(time) > 0.0):
                return None
        moved = replace(
            self,
            trajectory=replace(self.trajectory, spindle=spindle),
            angle_error=error,
            time=time,
            stamps=stamps,
        )
        moved = replace(moved, error=self.error + self.reference() - moved.reference())
        timing = stamps.left if stamps is not None and stamps.share > 0.0 else self.timing
        return moved.with_timing(0.0).with_timing(timing)

    def with_encoder_noise(self, noise: float) -> Series:
        """Return corrected series with what noise of the encoder leaves open of the times.

        noise: Standard deviation of a recorded angle, rad.
        """
        rate = abs(self.trajectory.spindle.rate)
        return self.with_timing(noise * math.sqrt(self.share) / rate)

    @property
    def order(self) -> int:
        """Number of times that the observable integrates the specific force."""
        return observation.ORDERS[self.observable]

    def polynomials(self, count: int) -> Array:
        """Return the columns of start offset and start velocity, 1 and t, shape (n, count)."""
        return np.vander(self.time, count, increasing=True)

    def total(self, noise: Noise) -> Noise:
        """Return the noise of an accelerometer with what the time stamps' noise adds here."""
        white = math.sqrt(self.relative) * noise.white
        return replace(noise, white=math.hypot(white, self.jitter))

    def with_timing(self, timing: float) -> Series:
        """Return the series with what noise of its time stamps adds: it goes with the slope.

        timing: Standard deviation of a time stamp, s.
        """
        if timing == self.timing:
            return self
        if timing == 0.0:
            return replace(self, timing=0.0, moved=None, jitter=0.0)
        ideal, of_error = self.slopes()
        slope = ideal + of_error
        least = math.sqrt(LEAST_SHARE * float(np.mean(ideal**2)))
        return replace(
            self,
            timing=timing,
            moved=timing * np.maximum(np.abs(slope), least),
            jitter=timing * math.sqrt(float(np.mean(slope**2))),
        )

    def louder(self, runs: Mapping[str, float]) -> Series:
        """Return the series with its white noise as many times as large as is said of its run."""
        return replace(self, relative=self.relative * runs.get(self.run, 1.0) ** 2)

    def as_noisy_as(self, other: Series) -> Series:
        """Return the series with the noise of another one of the same rows."""
        return replace(
            self,
            relative=other.relative,
            timing=other.timing,
            jitter=other.jitter,
            moved=other.moved,
        )

    def slopes(self, known: Mapping[str, float] = MappingProxyType({})) -> tuple[Array, Array]:
        """Return d/dt of the reference and of the error, in the error's unit and 1/s, (n,) each.

        The slope of what coefficients explain of the error is exact. That of the rest is the slope
        of a cubic with a wave through it: a bias of 5 mg has moved the platform at 20 m/s after
        400 s, five times as fast as the arm does.

        known: Coefficients of the accelerometer, less nominal.
        """
        step = _STEP_OF_TURN / abs(self.trajectory.spindle.rate)
        ideal = (self.reference(later=step) - self.reference(later=-step)) / (2.0 * step)
        length = max(float(self.time[-1]), self.spacing)
        t = self.time / length
        angle = self.trajectory.spindle.angle(self.time)
        turning = self.trajectory.spindle.angular_rate(self.time)
        wave = [np.cos(angle), np.sin(angle)]
        # At strobes the wave is a constant, and nothing is left of it.
        shape = np.column_stack([np.vander(t, 4), *(part - part.mean() for part in wave)])
        rest, explained = self.error, np.zeros(())
        if known:
            values = np.array([*known.values()])
            rest = rest - self.columns([*known], 1.0) @ values
            explained = self._slopes_of_columns([*known]) @ values
        found = np.linalg.lstsq(shape, rest, rcond=_CONSTANT)[0]
        grown = np.polyval(np.polyder(found[:4]), t) / length
        return ideal, explained + grown + turning * (found[5] * wave[0] - found[4] * wave[1])

    def _slopes_of_columns(self, symbols: Sequence[str]) -> Array:
        """Return d/dt of columns of the accelerometer's terms, shape (n, m)."""
        if self.order > 0:
            lower = {order: name for name, order in observation.ORDERS.items()}[self.order - 1]
            return replace(self, observable=lower).columns(symbols, 1.0)
        step = _STEP_OF_TURN / abs(self.trajectory.spindle.rate)
        ahead, behind = (
            replace(self, time=self.time + s).columns(symbols, 1.0) for s in (step, -step)
        )
        return (ahead - behind) / (2.0 * step)

    @property
    def jitter_variance(self) -> Array:
        """Variance of a sample's jitter in each row, (n,), over `relative`; () without any."""
        return np.zeros(()) if self.moved is None else self.moved**2 / self.relative

    @cached_property
    def differences(self) -> Differences:
        """The differences of the rows in which start offset and velocity do not show."""
        return Differences.of(self.time, self.order, self.count, self.block_spacing, self.relative)

    def whitener(self, noise: Noise) -> Whitener:
        """Return the whitener of the rows, which gives their noise unit covariance."""
        start = self.trajectory.conditions.start
        return whitener_of(self.differences, noise, start, self.jitter_variance)


# What inputs change -----------------------------------------------------------------------------

#: Steps of derivatives: of times in radians turned, of the clock in parts of itself; of the others
#: in parts of their size.
_STEP: Final = 1e-5
_INPUT_STEP: Final = 1e-6

#: Uncertain inputs: how each changes the trajectory.
INPUTS: Final[Mapping[str, Callable[[Trajectory, float], Trajectory]]] = {
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


def rotation_column(series: Series, symbol: str) -> Array:
    """Return d(reference)/d(a parameter of the rotation), by central differences, shape (n,)."""
    spindle = series.trajectory.spindle
    duration = float(series.time[-1])
    name, step = {
        "spindle.start_angle": ("start_angle", _STEP),
        "spindle.rate": ("rate", _STEP / duration),
        "spindle.drift": ("drift", _STEP / (abs(spindle.rate) * duration**2)),
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


def concerns(series: Series, name: str, recorder: str) -> bool:
    """Return whether an input shows in a series; of clocks it is that of its own recorder."""
    return recorder == series.recorder if name == CLOCK else name != RATE_CLOCK


def expected_output(
    series: Series, known: Mapping[str, float], table: Mapping[str, Array]
) -> Array:
    """Return the output of a series with known errors, columns from a table, shape (n,)."""
    output = series.reference()
    for symbol, value in known.items():
        output = output + value * table[symbol]
    return output


def input_column(
    series: Series, name: str, scale_factor: float, known: Mapping[str, float], now: Array
) -> Array:
    """Return d(recorded output)/d(input) at the estimate, by a forward difference, shape (n,).

    scale_factor: K_I, with which the accelerometer sees the platform's errors.
    known: The errors of the estimate, with which `now` is what is expected.
    """
    reference, columns, step = with_input(series, name, list(known), scale_factor)
    change: Array = (reference + columns @ np.array([*known.values()]) - now) / step
    if name == "site.latitude" and series.by_latitude is not None:
        change = change - series.by_latitude
    if name == "site.gravity" and series.in_g:
        # A record in g was turned into m/s^2 with the gravity assumed. What it should be is what
        # counts: with its noise in the column, it would explain itself.
        change = change - now / series.trajectory.site.gravity
    return change


def with_input(
    series: Series, name: str, symbols: Sequence[str], scale_factor: float
) -> tuple[Array, Array, float]:
    """Return reference (n,) and columns (n, q) with an input off by a small step, and the step."""
    if name == TIMING:
        spindle = series.trajectory.spindle
        step = _STEP / abs(spindle.rate)
        # Angles that were taken later were reached later: the spindle was behind by that time, for
        # what the errors make of the motion too.
        behind = replace(series.trajectory, spindle=spindle.later(-step))
        late = series.columns(symbols, scale_factor, behind)
        return series.reference(later=-step), late, step
    if name == CLOCK:
        there = series.by_clock(_STEP)
        return there.reference(), there.columns(symbols, scale_factor), _STEP
    size = {
        "centrifuge.radius": series.trajectory.radius,
        "site.gravity": series.trajectory.site.gravity,
        "site.latitude": 1.0,
    }[name]
    step = _INPUT_STEP * size
    moved = INPUTS[name](series.trajectory, step)
    return series.reference(moved), series.columns(symbols, scale_factor, moved), step
