"""Faults that a campaign's model leaves out, and what each would do to its estimates unseen.

A fault is a term of the table that is neither estimated nor considered, at its typical size, or a
bias that heating changes. Each moves the estimates, and leaves something in the
residuals; where that is too little, the plan cannot notice it.

- `Fault`, `faults_of`, `of_path`: what may be wrong
- `square`, `mean_square`: K_II itself in the same form, and without its harmonics
- `watch`, `Watched`: what a campaign's fit would make of faults
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from counterspin.arrays import Array, triangle_of
from counterspin.calibration.joint_problem import left_out_of
from counterspin.campaign.resolved import Campaign
from counterspin.inference.joint.fit import JointFit, solve_joint
from counterspin.inference.joint.series import Series
from counterspin.inference.joint.unknowns import Considered, Unknowns
from counterspin.physics.shared_terms import MOTION_TERMS, MotionTerm, term
from counterspin.planning.forecast import Forecast

#: What a record shows of one unit of a fault: shape (n, k); None where nothing.
Columns = Callable[[Series], Array | None]


@dataclass(frozen=True, eq=False)
class Fault:
    """Something that may be wrong, and that the model does not know.

    Attributes
    ----------
    symbol, words
        As the term table has it, or as it would; what it is called.
    size, unit
        What to reckon with where nothing is known, SI and g-units.
    columns
        One function for each of its parts, which have the size each.
    random
        Whether the parts are independent (each run has its own); else they are cosine and sine
        of one amplitude, the worst phase of which is taken.
    """

    symbol: str
    words: str
    size: float
    unit: str
    columns: tuple[Columns, ...]
    random: bool = False


@dataclass(frozen=True, eq=False)
class Watched:
    """What a fit would make of faults.

    Attributes
    ----------
    prediction
        The campaign's forecast.
    faults
        The faults.
    moved
        For each fault, what one unit of each of its parts moves the unknowns by, (p, k).
    left
        For each fault, the products of what one unit of its parts leaves in the whitened rows and
        priors once the fit has followed it as far as it can, (k, k).
    left_in
        By accelerometer, the same in its own whitened residuals.
    """

    prediction: Forecast
    faults: tuple[Fault, ...]
    moved: tuple[Array, ...]
    left: tuple[Array, ...]
    left_in: dict[str, tuple[Array, ...]]

    def shift(self, fault: int, place: int) -> float:
        """Return by how much a fault of its size moves an unknown, without sign."""
        return self.faults[fault].size * self.sensitivity(fault, place)

    def sensitivity(self, fault: int, place: int) -> float:
        """Return what one unit of a fault moves an unknown by, without sign."""
        return float(np.linalg.norm(self.moved[fault][place]))

    def deviation(self, fault: int, place: int) -> float:
        """Return how many standard deviations the best test for this very fault would see."""
        return math.sqrt(self._square(self.left, fault, place))

    def detection(self, fault: int, place: int, accelerometer: str, significance: float) -> float:
        """Return the probability that the residuals of an accelerometer fail their test.

        Parameters
        ----------
        fault, place
            The fault, at the phase that moves this unknown most.
        accelerometer
            Its name.
        significance
            Of the test of their sum of squares.
        """
        from scipy.special import chdtri, chndtr

        fit = self.prediction.fit
        parts = zip(fit.degrees_of_freedom, fit.prepared, strict=True)
        dof = max(1.0, sum(own for own, part in parts if part.accelerometer == accelerometer))
        square = self._square(self.left_in[accelerometer], fault, place)
        return 1.0 - float(chndtr(chdtri(dof, significance), dof, square))

    def _square(self, left: Sequence[Array], fault: int, place: int) -> float:
        products, size = left[fault], self.faults[fault].size
        if self.faults[fault].random:
            return size**2 * float(np.trace(products))
        moved = self.moved[fault][place]
        length = float(np.linalg.norm(moved))
        phase = moved / length if length > 0.0 else np.eye(moved.size)[0]
        return max(0.0, size**2 * float(phase @ products @ phase))


def watch(prediction: Forecast, faults: Sequence[Fault]) -> Watched:
    """Return what a campaign's fit would make of faults, each by itself."""
    model = prediction.fit.model
    known = [*model.considered]
    known += [Considered("", name, (0.0, u), u) for name, u in (model.inputs or {}).items()]
    parts = [(index, columns) for index, fault in enumerate(faults) for columns in fault.columns]
    names = [Considered("fault", str(i), (0.0, 0.0), 1.0) for i in range(len(parts))]
    watched = Unknowns(model.unknowns, (*known, *names))
    prepared = []
    for part in prediction.fit.prepared:
        shown = [(i, columns(part.series)) for i, (_, columns) in enumerate(parts)]
        seen = [(i, column) for i, column in shown if column is not None]
        prepared.append(
            replace(
                part,
                fixed=np.column_stack([part.fixed, *(column for _, column in seen)]),
                considered=(*part.considered, *(len(known) + i for i, _ in seen)),
            )
        )
    fit = solve_joint(prepared, watched, prediction.fit.noise)
    owners = np.array([index for index, _ in parts])
    of_fault = [np.flatnonzero(owners == index) for index in range(len(faults))]
    moved = -fit.solution.sensitivity_considered[:, len(known) :]
    total, by_accelerometer = _left(fit, len(known))
    return Watched(
        prediction,
        tuple(faults),
        tuple(moved[:, places] for places in of_fault),
        tuple(total[np.ix_(places, places)] for places in of_fault),
        {
            name: tuple(own[np.ix_(places, places)] for places in of_fault)
            for name, own in by_accelerometer.items()
        },
    )


def _left(fit: JointFit, known: int) -> tuple[Array, dict[str, Array]]:
    """Return the products of what the watched columns leave in rows and priors.

    What is considered is followed here as what is estimated: the test of the residuals allows
    for it.
    """
    model = fit.model
    spread = [*(u.spread for u in model.unknowns), *(c.prior[1] for c in model.considered[:known])]
    p = len(spread)
    held = np.diag([1.0 / u if u > 0.0 else 1e30 for u in spread])
    rows = [np.hstack([block.factor, block.considered]) for block in fit.blocks]
    prior = np.hstack([held, np.zeros((p, rows[0].shape[1] - p))])
    triangle = triangle_of(np.vstack([*rows, prior]))
    rest = triangle[p:, p:]
    followed = np.linalg.solve(triangle[:p, :p], triangle[:p, p:])
    by_accelerometer: dict[str, Array] = {}
    for block, part in zip(rows, fit.prepared, strict=True):
        residual = block[:, p:] - block[:, :p] @ followed
        product = residual.T @ residual
        before = by_accelerometer.get(part.accelerometer)
        by_accelerometer[part.accelerometer] = product if before is None else before + product
    return rest.T @ rest, by_accelerometer


# What may be wrong


def faults_of(campaign: Campaign, name: str) -> list[Fault]:
    """Return what may be wrong for an accelerometer: what its model leaves out."""
    by_symbol: dict[str, list[Considered]] = {}
    for left_out in left_out_of(campaign, name):
        by_symbol.setdefault(_family(left_out.symbol), []).append(left_out)
    terms = [
        Fault(
            symbol,
            _words(parts[0].symbol),
            campaign.model.typical[parts[0].symbol],
            term(parts[0].symbol).unit,
            tuple(_of_term(part, campaign) for part in parts),
            random=term(parts[0].symbol).per_run,
        )
        for symbol, parts in by_symbol.items()
    ]
    return [*terms, _HEATING]


def of_path(symbol: str) -> Fault:
    """Return an error of the path, both quadratures: such as ``encoder.harmonic.1``."""
    rows = [row for row in MOTION_TERMS.values() if _family(row.symbol) == symbol]
    return Fault(
        symbol,
        _words(rows[0].symbol),
        rows[0].typical,
        rows[0].unit,
        tuple(_seen(row.symbol) for row in rows),
    )


def _family(symbol: str) -> str:
    """Return a term's symbol, without the quadrature of a harmonic."""
    row = MOTION_TERMS.get(symbol)
    return symbol.removesuffix(f".{row.quadrature}") if row is not None else symbol


def _words(symbol: str) -> str:
    row = term(symbol)
    return row.of_harmonic if isinstance(row, MotionTerm) else row.words


def _seen(symbol: str) -> Columns:
    return lambda series: series.columns([symbol], 1.0)[:, 0]


def square(name: str) -> Fault:
    """Return K_II of an accelerometer itself, as the estimate is to see it whole."""
    return Fault("K_II", "", 1.0, "g/g^2", (_only(name, _k_ii),))


def mean_square(name: str) -> Fault:
    """Return what K_II of an accelerometer does to the mean force, without its harmonics."""
    return Fault("K_II", "", 1.0, "g/g^2", (_only(name, _mean_of_square),))


def _only(name: str, columns: Columns) -> Columns:
    return lambda series: columns(series) if series.accelerometer == name else None


def _k_ii(series: Series) -> Array:
    return series.columns(["K_II"], 1.0)[:, 0]


def _mean_of_square(series: Series) -> Array:
    motion = series.trajectory
    times = np.arange(16.0) / 16.0 * (2.0 * math.pi / abs(motion.spindle.rate))
    along = motion.specific_force(times) @ series.mounting.turned(series.attitude).input_axis
    mean = float(np.mean((along / motion.site.gravity) ** 2))
    return np.asarray(mean * series.columns(["K_F"], 1.0)[:, 0])


def _of_term(part: Considered, campaign: Campaign) -> Columns:
    def columns(series: Series) -> Array | None:
        prior = campaign.accelerometers[series.accelerometer].priors.get("K_I")
        factor = prior.value if prior else 1.0
        return series.columns([part.symbol], factor)[:, 0] if part.concerns(series) else None

    return columns


def _heating(series: Series) -> Array:
    """Return what a bias shows that grows by 1 g for each g^2 of the centripetal force."""
    motion = series.trajectory
    force = motion.radius * motion.spindle.rate**2 / motion.site.gravity
    return np.asarray(force**2 * series.columns(["K_F"], 1.0)[:, 0])


_HEATING: Final = Fault(
    "K_F.heating", "bias that grows with the square of the force", 1e-7, "g/g^2", (_heating,)
)
