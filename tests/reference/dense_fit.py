"""An independent model of records and readings, and a dense least squares, for make_fits.py.

Nothing here uses counterspin. The physics is written down as a machine and an instrument in the
time domain (position, velocity, specific force, attitude error, indicated force, integrals of it),
with every error term as a number that is given: `record` and `reading` say what is recorded. A fit
takes all rows at once: the derivatives by everything unknown are central differences of that model,
the covariance of the noise is a full matrix for each record, and what is known beforehand are
further rows:

    x = argmin (y - h(x))' V^-1 (y - h(x)) + sum ((x_j - m_j)/s_j)^2        (Gauss and Newton)
    C = (J' V^-1 J + P)^-1,  of the noise C J' V^-1 J C,  of prior j  C_j C_j'/s_j^2
    of a held term: (C J' V^-1 h_held) s, which no weight knows of

Units: m, s, rad; coefficients of an accelerometer in g-units. East-north-up.
"""

import itertools
from dataclasses import dataclass

import numpy as np

EARTH_RATE = 7.292115e-5

#: Coefficient -> the axes whose specific forces are multiplied; J stands for the size of a_I, S for
#: its sign.
PRODUCTS = {
    "K_F": "",
    "K_I": "I",
    "K_II": "II",
    "K_III": "III",
    "K_4": "IIII",
    "K_5": "IIIII",
    "K_IP": "IP",
    "K_IO": "IO",
    "K_PO": "PO",
    "K_PP": "PP",
    "K_OO": "OO",
    "K_OQ": "IJ",
    "K_0_asym": "S",
    "K_I_asym": "J",
    "delta_O": "P",
    "delta_P": "O",
}
WEIGHTS = {"delta_P": -1.0, "K_0_asym": 0.5, "K_I_asym": 0.5}
#: Between minus and plus this, g, a reading has the sign of a_I linearly.
SIGN_WIDTH = 1e-3
AXES = {
    "east": (1.0, 0.0, 0.0),
    "west": (-1.0, 0.0, 0.0),
    "north": (0.0, 1.0, 0.0),
    "south": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}
ON_THE_ARM = {
    "outward": (1.0, 0.0, 0.0),
    "inward": (-1.0, 0.0, 0.0),
    "forward": (0.0, 1.0, 0.0),
    "backward": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}

# Gauss's nodes of a panel, weights, and what takes values there to the integral up to each node.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_BASIS = np.linalg.inv(np.polynomial.legendre.legvander(_NODES, 9))
_UPTO = np.stack(
    [
        np.polynomial.legendre.legval(_NODES, np.polynomial.legendre.legint(row, lbnd=-1))
        for row in np.eye(10)
    ],
    axis=1,
)
_UPTO = _UPTO @ _BASIS

#: Panels between two samples.
_PARTS = 3


@dataclass(frozen=True)
class Instrument:
    """An accelerometer: its axes on the level platform, and what its column holds."""

    name: str
    input_axis: str
    pendulous_axis: str
    observable: str = "displacement"  #: or velocity, or force
    per_g: float = 1.0  #: What one g is in its readings and records of force.

    def axes(self, names=AXES):
        """Rows I, P, O."""
        i, p = (np.array(names[axis]) for axis in (self.input_axis, self.pendulous_axis))
        return np.stack([i, p, np.cross(i, p)])


@dataclass(frozen=True)
class Run:
    """Describe the motion of a record: constant rate with relative drift and ripple."""

    name: str
    rate: float
    times: np.ndarray
    start_angle: float = 0.0
    drift: float = 0.0
    ripple: tuple = (0.0, 0.0)  #: amplitude (rad/s) and phase of the first harmonic
    turn: tuple = (0.0, "east")  #: of the platform: angle, and about what
    begins: float = 0.0  #: s, after the first run
    warmth: float = 0.0  #: K, above the reference temperature
    way: float = 0.0  #: 1/2 where that was reached from below, -1/2 from above

    def angle(self, t):
        """Recorded angle, its rate and its acceleration at times of the record."""
        w, (size, phase) = self.rate, self.ripple
        wave = w * t + phase
        angle = self.start_angle + w * t + 0.5 * self.drift * w * t**2
        angle = angle - size / w * (np.cos(wave) - np.cos(phase))
        rate = w + self.drift * w * t + size * np.sin(wave)
        return angle, rate, self.drift * w + size * w * np.cos(wave)


@dataclass(frozen=True)
class Reading:
    """One value at rest or on the arm."""

    name: str
    motion: str
    axes: np.ndarray  #: rows I, P, O in the motion's frame
    rate: float = 0.0
    mounting: str = ""
    u_rate: float = 0.0  #: random standard uncertainty of the rate, relative
    head: tuple = (0.0, 0.0, 0.0)  #: axis of the dividing head
    u_head: float = 0.0
    head_angle: float = 0.0  #: what the head shows, rad
    warmth: float = 0.0
    way: float = 0.0
    begins: float = 0.0
    value: float = 0.0
    u: float = 1.0


@dataclass(frozen=True)
class Place:
    """Where it is."""

    gravity: float
    latitude: float
    radius: float


def rotated(vectors, angle, axis):
    """Turn row vectors by a right-handed angle about a unit vector (Rodrigues)."""
    along = np.outer(vectors @ axis, axis)
    return (
        np.cos(angle) * vectors
        + np.sin(angle) * np.cross(axis, vectors)
        + (1.0 - np.cos(angle)) * along
    )


def indicated(own, a_ipo, more, sign=np.sign):
    """Indicated specific force in g of forces along I, P, O in g.

    own: coefficient -> value; what is not named is that of a perfect instrument. `more` is what
    conditions add to K_F, K_I and K_II; `sign` that of a_I.
    """
    total = 0.0
    components = dict(zip("IPO", a_ipo, strict=True))
    components |= {"J": np.abs(a_ipo[0]), "S": sign(a_ipo[0])}
    for symbol, axes in PRODUCTS.items():
        size = own.get(symbol, 1.0 if symbol == "K_I" else 0.0) + more.get(symbol, 0.0)
        if np.all(size == 0.0):
            continue
        part = WEIGHTS.get(symbol, 1.0)
        for axis in axes:
            part = part * components[axis]
        total = total + size * part
    return total


def conditions(own, warmth, way, begins, force):
    """Return the changes of coefficients by temperature, its direction, time and force."""

    def warmed(symbol):
        powers = ((1, ""), (2, ".2"), (3, ".3"))
        return sum(own.get(f"{symbol}.temperature{end}", 0.0) * warmth**n for n, end in powers)

    return {
        "K_F": warmed("K_F")
        + own.get("K_F.hysteresis", 0.0) * way
        + own.get("K_F.trend", 0.0) * begins
        + own.get("K_F.heating", 0.0) * force**2,
        "K_I": warmed("K_I"),
        "K_II": own.get("K_II.temperature", 0.0) * warmth,
    }


def of(x, owner):
    """Return the values of an owner by symbol."""
    return {k[len(owner) + 1 :]: v for k, v in x.items() if k.startswith(owner + ".")}


def _path(place, run, x, t):
    """Position, velocity and acceleration in the level frame at true times t, (..., 3) each."""
    fast, late = x.get("records.clock", 0.0), x.get("records.timing_offset", 0.0)
    recorded = (1.0 + fast) * t
    angle, rate, push = run.angle(recorded - late)
    turned = of(x, f"{run.name}.spindle")
    drift = run.rate * turned.get("drift", 0.0)
    angle = angle + turned.get("start_angle", 0.0) + turned.get("rate", 0.0) * recorded
    angle = angle + 0.5 * drift * recorded**2
    rate, push = rate + turned.get("rate", 0.0) + drift * recorded, push + drift
    rate, push = rate * (1.0 + fast), push * (1.0 + fast) ** 2
    # The encoder's error, its slope and its curve by the recorded angle.
    theta, turn, bend = angle, 1.0, 0.0
    for n in (1, 2, 3, 4):
        c, s = (x.get(f"encoder.harmonic.{n}.{wave}", 0.0) for wave in ("cos", "sin"))
        theta = theta - c * np.cos(n * angle) - s * np.sin(n * angle)
        turn = turn + n * (c * np.sin(n * angle) - s * np.cos(n * angle))
        bend = bend + n**2 * (c * np.cos(n * angle) + s * np.sin(n * angle))
    w, alpha = rate * turn, push * turn + rate**2 * bend
    radius = place.radius + x.get("centrifuge.radius", 0.0)
    r = radius * (1.0 + x.get("centrifuge.stretch", 0.0) * radius * run.rate**2) + 0.0 * theta
    slope, curve = 0.0 * theta, 0.0 * theta
    for n in (1, 2):
        c, s = (x.get(f"centrifuge.imbalance.{n}.{wave}", 0.0) for wave in ("cos", "sin"))
        r = r + c * np.cos(n * theta) + s * np.sin(n * theta)
        slope = slope + n * (s * np.cos(n * theta) - c * np.sin(n * theta))
        curve = curve - n**2 * (c * np.cos(n * theta) + s * np.sin(n * theta))
    e = np.exp(1j * theta)
    first, second = (slope + 1j * r) * e, (curve + 2j * slope - r) * e
    about = (x.get(f"centrifuge.axis_tilt.{axis}", 0.0) * radius for axis in ("east", "north"))
    east, north = about
    z = east * np.sin(theta) - north * np.cos(theta)
    dz = east * np.cos(theta) + north * np.sin(theta)
    level = (r * e, first * w, second * w**2 + first * alpha)
    height = (z, dz * w, -z * w**2 + dz * alpha)
    return [
        np.stack([one.real, one.imag, up], axis=-1) for one, up in zip(level, height, strict=True)
    ]


def _panels(times):
    """Edges of panels from 0 to the last of some times, `_PARTS` between any two of them."""
    between = (np.linspace(a, b, _PARTS, endpoint=False) for a, b in itertools.pairwise(times))
    return np.concatenate([*between, times[-1:]])


def _with_sign_changes(edges, along):
    """Edges of panels and, as further ones, where a force along the input axis changes its sign."""
    fine = np.unique(np.concatenate([np.linspace(a, b, 9) for a, b in itertools.pairwise(edges)]))
    sign = np.sign(along(fine))
    changes = np.flatnonzero(sign[:-1] * sign[1:] < 0.0)
    low, high, below = fine[changes], fine[changes + 1], sign[changes]
    for _ in range(50):
        middle = 0.5 * (low + high)
        before = np.sign(along(middle)) == below
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    edges = np.unique(np.concatenate([edges, low]))
    return edges[np.append(True, np.diff(edges) > 1e-9)]


def _attitude(run, x, felt, half, body):
    """Return the attitude error without compliance at all nodes and panel edges, rad.

    felt: specific force along the platform's axes in g, (panels, nodes, 3).
    """
    names = ("east", "north", "up")
    drift, squared = (
        np.array([x.get(f"platform.{kind}.{name}", 0.0) for name in names])
        for kind in ("drift", "g2_sensitivity")
    )
    sensitive = _matrix(x, "g_sensitivity")
    turning = drift + felt @ sensitive.T + np.sum(felt**2, axis=-1)[..., None] * squared
    inside = half[:, None, None] * np.einsum("ij,pjk->pik", _UPTO, turning)
    whole = half[:, None] * np.einsum("j,pjk->pk", _WEIGHTS, turning)
    edges = np.concatenate([np.zeros((1, 3)), np.cumsum(whole, axis=0)])
    tilt = np.array([x.get(f"{run.name}.platform.tilt.{name}", 0.0) for name in names])
    return tilt + (edges[:-1, None] + inside) @ body, tilt + edges @ body


def _matrix(x, kind):
    return np.array([[x.get(f"platform.{kind}.{i}{j}", 0.0) for j in "xyz"] for i in "xyz"])


def record(place, run, instrument, x):
    """Return the noise-free record of an instrument at the times of a run.

    x: name of everything that may be off -> by how much (K_I: its value). Tilts are about east,
    north and up, all else of the platform about its own axes, which the run's turn has turned.
    """
    g = place.gravity + x.get("site.gravity", 0.0)
    latitude = place.latitude + x.get("site.latitude", 0.0)
    earth = EARTH_RATE * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    true = run.times / (1.0 + x.get("records.clock", 0.0))
    angle, about = run.turn
    body = rotated(np.eye(3), angle, np.array(AXES[about]))
    axes = instrument.axes() @ body
    own, soft = of(x, instrument.name), _matrix(x, "compliance")
    lever = place.radius * run.rate**2 / place.gravity

    def force_at(t):
        _, velocity, acceleration = _path(place, run, x, t)
        return acceleration + 2.0 * np.cross(earth, velocity) + g * np.array([0.0, 0.0, 1.0])

    def indication(force, psi, t):
        """Return the force along the input axis, g, of a platform with error psi and compliance."""
        psi = psi + (force @ body.T / g) @ soft.T @ body
        sensed = np.moveaxis((force - np.cross(psi, force)) @ axes.T, -1, 0) / g
        return indicated(own, sensed, conditions(own, run.warmth, run.way, run.begins + t, lever))

    edges = _panels(true)
    if own.get("K_0_asym"):
        edges = _with_sign_changes(edges, lambda t: force_at(t) @ axes[0])
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    t = middle[:, None] + half[:, None] * _NODES
    force = force_at(t)
    psi, psi_at_edges = _attitude(run, x, force @ body.T / g, half, body)
    at = np.searchsorted(edges, true - 1e-8)
    if instrument.observable == "force":
        return instrument.per_g * indication(force_at(true), psi_at_edges[at], true)
    # What the instrument adds to the force that acts, integrated panel by panel.
    error = g * indication(force, psi, t) - force @ axes[0]
    once = np.append(0.0, np.cumsum(half * (error @ _WEIGHTS)))
    inner = half[:, None] * (error @ _UPTO.T)
    twice = np.append(0.0, np.cumsum(half * (inner @ _WEIGHTS) + 2.0 * half * once[:-1]))
    where, velocity, _ = _path(place, run, x, true)
    if instrument.observable == "velocity":
        return velocity @ axes[0] + once[at]
    return where @ axes[0] + twice[at]


def reading(place, one, name, x):
    """Return the indication at rest or the mean over a revolution on the arm, g."""
    g = place.gravity + x.get("site.gravity", 0.0)
    latitude = place.latitude + x.get("site.latitude", 0.0)
    tilts = [x.get(f"centrifuge.axis_tilt.{axis}", 0.0) for axis in ("east", "north")]
    theta = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    turn = np.zeros(3)
    if one.motion == "static":
        force = np.array([[0.0, 0.0, g]])
        turn = turn + x.get("head.zero", 0.0) * np.array(one.head)
        turn = turn + x.get("head of " + one.name, 0.0) * np.array(one.head)
        for n in (1, 2, 3, 4):
            for quadrature, wave in (("cos", np.cos), ("sin", np.sin)):
                size = x.get(f"head.harmonic.{n}.{quadrature}", 0.0)
                turn = turn + size * wave(n * one.head_angle) * np.array(one.head)
        names = ("east", "north", "up")
        lever = 0.0
    else:
        # The radius of a mounting, if known, replaces that of the machine and of the proof mass.
        common = x.get("centrifuge.radius", 0.0)
        common += x.get(f"centrifuge.radius.{name}.{one.mounting}", 0.0)
        radius = place.radius + x.get(f"centrifuge.radius.{one.mounting}", common)
        # The clock of the rate counter is common to all readings.
        fast = x.get("centrifuge.clock", 0.0) + x.get("rate of " + one.name, 0.0)
        w = one.rate * (1.0 + fast)
        radius = radius * (1.0 + x.get("centrifuge.stretch", 0.0) * radius * w**2)
        # What stands upright on the Earth, in the machine's frame, whose axis leans.
        size = np.hypot(*tilts)
        lean = np.array([*tilts, 0.0]) / size if size else np.array([1.0, 0.0, 0.0])
        up, earth = rotated(
            np.array(
                [
                    [0.0, 0.0, g],
                    [0.0, EARTH_RATE * np.cos(latitude), EARTH_RATE * np.sin(latitude)],
                ]
            ),
            -size,
            lean,
        )
        out = np.stack([np.cos(theta), np.sin(theta), 0.0 * theta], axis=-1)
        along = np.stack([-np.sin(theta), np.cos(theta), 0.0 * theta], axis=-1)
        inertial = -radius * w**2 * out + 2.0 * np.cross(earth, radius * w * along) + up
        force = np.stack(
            [np.sum(inertial * out, axis=1), np.sum(inertial * along, axis=1), inertial[:, 2]],
            axis=-1,
        )
        turn[1] += x.get("centrifuge.droop", 0.0) * w**2
        names = ("outward", "forward", "up")
        lever = place.radius * w**2 / place.gravity
    turn = turn + [
        x.get(f"fixture.misalignment.{one.mounting}.{axis}", 0.0) if one.mounting else 0.0
        for axis in names
    ]
    size = np.linalg.norm(turn)
    axes = rotated(one.axes, size, turn / size) if size else one.axes
    own = of(x, name)
    a_ipo = axes @ force.T / g
    more = conditions(own, one.warmth, one.way, one.begins, lever)
    # On the arm the instrument rotates about the machine's axis.
    spins = one.rate**2 * axes[0, 2] * axes[1, 2] if one.motion == "arm" else 0.0
    mean = np.mean(indicated(own, a_ipo, more, lambda a: np.clip(a / SIGN_WIDTH, -1.0, 1.0)))
    return mean + own.get("K_spin", 0.0) * spins


# Least squares.


@dataclass(frozen=True)
class Unknown:
    """Describe an unknown; `sd` is infinite without prior."""

    name: str
    mean: float
    sd: float = np.inf
    kind: str = "asked"  #: or stated, unstated, held
    step: float = 0.0  #: of the difference; by default `sd`


@dataclass(frozen=True)
class Rows:
    """Data with their covariance, the model of them, and polynomials of time that are free."""

    model: object  #: values of everything -> what it says, (n,)
    values: np.ndarray
    covariance: object  #: (n, n), or values of everything -> that
    free: np.ndarray  #: (n, k)

    def noise(self, at):
        return self.covariance(at) if callable(self.covariance) else self.covariance


@dataclass(frozen=True)
class Fit:
    """Contain the result of a fit."""

    unknowns: list  #: That were adjusted.
    estimate: np.ndarray
    of_noise: np.ndarray  #: covariance
    priors: dict  #: Name of what is known beforehand -> what its u moves each estimate by.
    kinds: dict  #: The same -> stated or unstated.
    rows: list  #: Of each group: residuals and leverages in rows of unit variance.

    @property
    def names(self):
        return [u.name for u in self.unknowns]

    def of_kind(self, kind):
        """Return the covariance from stated or default priors."""
        moved = [move for name, move in self.priors.items() if self.kinds[name] == kind]
        return sum((np.outer(m, m) for m in moved), np.zeros_like(self.of_noise))

    @property
    def covariance(self):
        """Return the total covariance."""
        return self.of_noise + self.of_kind("stated") + self.of_kind("unstated")

    def line(self, name):
        """Return value, u and the contributions of noise, stated and default priors."""
        k = self.names.index(name)
        parts = (self.of_noise, self.of_kind("stated"), self.of_kind("unstated"))
        return [
            float(v) for v in (self.estimate[k], *np.sqrt([p[k, k] for p in (sum(parts), *parts)]))
        ]

    def correlation(self, names):
        """Of some of them."""
        places = [self.names.index(name) for name in names]
        some = self.covariance[np.ix_(places, places)]
        u = np.sqrt(np.diag(some))
        return some / np.outer(u, u)

    def misfit(self, groups):
        """Return chi-square and degrees of freedom of the rows of some groups."""
        chosen = [self.rows[k] for k in groups]
        return [
            sum(float(left @ left) for left, _ in chosen),
            sum(left.size - float(followed.sum()) for left, followed in chosen),
        ]


def walk(times, density, integrations):
    """Covariance of white noise of a density N^2 that is integrated once or twice from 0."""
    low, high = np.minimum.outer(times, times), np.maximum.outer(times, times)
    if integrations == 1:
        return density * low
    return density * low**2 * (high / 2.0 - low / 6.0)


def derivatives(rows, unknowns, at):
    """Central differences of the model, (n, p)."""
    columns = []
    for unknown in unknowns:
        step = unknown.step or (unknown.sd if np.isfinite(unknown.sd) else 1e-4)
        more, less = (
            rows.model({**at, unknown.name: at[unknown.name] + sign * step}) for sign in (1, -1)
        )
        columns.append((more - less) / (2.0 * step))
    return np.column_stack(columns)


def _whitened(groups, adjusted, held, at):
    """Return whitened rows [estimated | start errors by group | considered | residual]."""
    p, free = len(adjusted), sum(rows.free.shape[1] for rows in groups)
    parts, offset = [], p
    for rows in groups:
        part = np.zeros((rows.values.size, p + free + len(held) + 1))
        part[:, :p] = derivatives(rows, adjusted, at)
        part[:, offset : offset + rows.free.shape[1]] = rows.free
        if held:
            part[:, p + free : -1] = derivatives(rows, held, at)
        part[:, -1] = rows.values - rows.model(at)
        offset += rows.free.shape[1]
        parts.append(np.linalg.solve(np.linalg.cholesky(rows.noise(at)), part))
    return np.vstack(parts), p + free


def fit(groups, unknowns, rounds=3):
    """Fit all rows at once."""
    adjusted = [u for u in unknowns if u.kind != "held"]
    held = [u for u in unknowns if u.kind == "held"]
    known = [j for j, u in enumerate(adjusted) if np.isfinite(u.sd)]
    at, p = {u.name: u.mean for u in unknowns}, len(adjusted)
    for _ in range(rounds):
        whole, width = _whitened(groups, adjusted, held, at)
        n = len(whole)
        below = np.zeros((len(known), whole.shape[1]))
        for row, j in enumerate(known):
            below[row, j] = 1.0 / adjusted[j].sd
            below[row, -1] = (adjusted[j].mean - at[adjusted[j].name]) / adjusted[j].sd
        whole = np.vstack([whole, below])
        scale = np.linalg.norm(whole[:, :width], axis=0)
        q, r = np.linalg.qr(whole[:, :width] / scale)
        inverse = np.linalg.solve(r, q.T) / scale[:, None]  # takes rows to the solution
        change = inverse @ whole[:, -1]
        for j, unknown in enumerate(adjusted):
            at[unknown.name] += change[j]
    gain = inverse[:p]
    moved = {adjusted[j].name: gain[:, n + row] for row, j in enumerate(known)}
    moved |= {u.name: -gain @ whole[:, width + k] * u.sd for k, u in enumerate(held)}
    left, followed = whole[:n, -1] - whole[:n, :width] @ change, np.sum(q[:n] ** 2, axis=1)
    ends = np.cumsum([rows.values.size for rows in groups])[:-1]
    return Fit(
        adjusted,
        np.array([at[u.name] for u in adjusted]),
        gain[:, :n] @ gain[:, :n].T,
        moved,
        {u.name: "unstated" if u.kind == "unstated" else "stated" for u in (*adjusted, *held)},
        list(zip(np.split(left, ends), np.split(followed, ends), strict=True)),
    )
