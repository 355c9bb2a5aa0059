"""Independent model of records and readings, and dense least squares, for make_fits.py.

Nothing here uses counterspin. The model describes machine and instrument in the time domain
(position, velocity, specific force, attitude error, indicated force and its integrals), with given
values of all error terms: `simulate_record` and `simulate_reading` return the recorded values. A
fit uses all rows at once: derivatives are central differences of the model, the noise of each
record has a full covariance matrix, and priors are additional rows:

    x = argmin (y - h(x))' V^-1 (y - h(x)) + sum ((x_j - m_j)/s_j)^2        (Gauss and Newton)
    C = (J' V^-1 J + P)^-1,  of the noise C J' V^-1 J C,  of prior j  C_j C_j'/s_j^2
    of a considered term: (C J' V^-1 h_considered) s, not included in the weights

Units: m, s, rad; coefficients of an accelerometer in g-units. East-north-up.
"""

import itertools
from dataclasses import dataclass

import numpy as np

EARTH_RATE = 7.292115e-5

#: Coefficient -> axes whose specific forces are multiplied; J: magnitude of a_I, S: its sign.
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
#: Half-width of the linear transition of the sign of a_I in readings, g.
SIGN_WIDTH = 1e-3
AXES = {
    "east": (1.0, 0.0, 0.0),
    "west": (-1.0, 0.0, 0.0),
    "north": (0.0, 1.0, 0.0),
    "south": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}
ARM_AXES = {
    "outward": (1.0, 0.0, 0.0),
    "inward": (-1.0, 0.0, 0.0),
    "forward": (0.0, 1.0, 0.0),
    "backward": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}

# Gauss-Legendre nodes and weights of a panel, and weights of the integrals up to each node.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_BASIS = np.linalg.inv(np.polynomial.legendre.legvander(_NODES, 9))
_CUMULATIVE_WEIGHTS = np.stack(
    [
        np.polynomial.legendre.legval(_NODES, np.polynomial.legendre.legint(row, lbnd=-1))
        for row in np.eye(10)
    ],
    axis=1,
)
_CUMULATIVE_WEIGHTS = _CUMULATIVE_WEIGHTS @ _BASIS

#: Panels between two samples.
_PANELS_PER_SAMPLE = 3


@dataclass(frozen=True)
class Instrument:
    """An accelerometer: its axes on the level platform, and its observable."""

    name: str
    input_axis: str
    pendulous_axis: str
    observable: str = "displacement"  #: or "velocity", "force"
    per_g: float = 1.0  #: Output per g, of readings and records of force.

    def axes(self, names=AXES):
        """Return the axes as rows I, P, O."""
        i, p = (np.array(names[axis]) for axis in (self.input_axis, self.pendulous_axis))
        return np.stack([i, p, np.cross(i, p)])


@dataclass(frozen=True)
class Run:
    """Motion of a record: constant rate with relative drift and ripple."""

    name: str
    rate: float
    times: np.ndarray
    start_angle: float = 0.0
    drift: float = 0.0
    ripple: tuple = (0.0, 0.0)  #: amplitude (rad/s) and phase of the first harmonic
    turn: tuple = (0.0, "east")  #: of the platform: angle and axis
    start_time: float = 0.0  #: s, after the first run
    temperature_change: float = 0.0  #: K, above the reference temperature
    temperature_direction: float = 0.0  #: 1/2: temperature reached from below, -1/2: from above

    def angle(self, t):
        """Return the recorded angle and its first two derivatives at times of the record."""
        w, (amplitude, phase) = self.rate, self.ripple
        wave = w * t + phase
        angle = self.start_angle + w * t + 0.5 * self.drift * w * t**2
        angle = angle - amplitude / w * (np.cos(wave) - np.cos(phase))
        rate = w + self.drift * w * t + amplitude * np.sin(wave)
        return angle, rate, self.drift * w + amplitude * w * np.cos(wave)


@dataclass(frozen=True)
class Reading:
    """A reading at rest or on the arm."""

    name: str
    motion: str
    axes: np.ndarray  #: rows I, P, O in the motion's frame
    rate: float = 0.0
    mounting: str = ""
    u_rate: float = 0.0  #: random standard uncertainty of the rate, relative
    head: tuple = (0.0, 0.0, 0.0)  #: axis of the dividing head
    u_head: float = 0.0
    head_angle: float = 0.0  #: indicated angle of the head, rad
    temperature_change: float = 0.0
    temperature_direction: float = 0.0
    start_time: float = 0.0
    value: float = 0.0
    u: float = 1.0


@dataclass(frozen=True)
class Site:
    """Gravity and latitude of the site, and radius of the machine."""

    gravity: float
    latitude: float
    radius: float


def rotate(vectors, angle, axis):
    """Rotate row vectors by a right-handed angle about a unit vector (Rodrigues)."""
    parallel = np.outer(vectors @ axis, axis)
    return (
        np.cos(angle) * vectors
        + np.sin(angle) * np.cross(axis, vectors)
        + (1.0 - np.cos(angle)) * parallel
    )


def indicate_force(coefficients, a_ipo, changes, sign=np.sign):
    """Return the indicated specific force in g, from the specific force along I, P, O in g.

    coefficients: Coefficient -> value; other coefficients are those of a perfect instrument.
    changes: Changes of K_F, K_I and K_II by the conditions.
    sign: Function that returns the sign of a_I.
    """
    total = 0.0
    components = dict(zip("IPO", a_ipo, strict=True))
    components |= {"J": np.abs(a_ipo[0]), "S": sign(a_ipo[0])}
    for symbol, axes in PRODUCTS.items():
        coefficient = coefficients.get(symbol, 1.0 if symbol == "K_I" else 0.0) + changes.get(
            symbol, 0.0
        )
        if np.all(coefficient == 0.0):
            continue
        product = WEIGHTS.get(symbol, 1.0)
        for axis in axes:
            product = product * components[axis]
        total = total + coefficient * product
    return total


def condition_changes(coefficients, temperature_change, direction, start_time, force):
    """Return the changes of coefficients by temperature, its direction, time and force."""

    def temperature_effect(symbol):
        powers = ((1, ""), (2, ".2"), (3, ".3"))
        return sum(
            coefficients.get(f"{symbol}.temperature{end}", 0.0) * temperature_change**n
            for n, end in powers
        )

    return {
        "K_F": temperature_effect("K_F")
        + coefficients.get("K_F.hysteresis", 0.0) * direction
        + coefficients.get("K_F.trend", 0.0) * start_time
        + coefficients.get("K_F.heating", 0.0) * force**2,
        "K_I": temperature_effect("K_I"),
        "K_II": coefficients.get("K_II.temperature", 0.0) * temperature_change,
    }


def values_of(x, owner):
    """Return the values of an owner by symbol."""
    return {k[len(owner) + 1 :]: v for k, v in x.items() if k.startswith(owner + ".")}


def _compute_path(site, run, x, t):
    """Return position, velocity and acceleration, (..., 3) each, in the level frame at times t."""
    clock_error, timing_offset = x.get("records.clock", 0.0), x.get("records.timing_offset", 0.0)
    recorded = (1.0 + clock_error) * t
    angle, rate, angular_acceleration = run.angle(recorded - timing_offset)
    spindle_errors = values_of(x, f"{run.name}.spindle")
    drift = run.rate * spindle_errors.get("drift", 0.0)
    angle = (
        angle + spindle_errors.get("start_angle", 0.0) + spindle_errors.get("rate", 0.0) * recorded
    )
    angle = angle + 0.5 * drift * recorded**2
    rate, angular_acceleration = (
        rate + spindle_errors.get("rate", 0.0) + drift * recorded,
        angular_acceleration + drift,
    )
    rate, angular_acceleration = (
        rate * (1.0 + clock_error),
        angular_acceleration * (1.0 + clock_error) ** 2,
    )
    # True angle, and its first two derivatives by the recorded angle, from the encoder error.
    theta, slope_by_angle, curvature_by_angle = angle, 1.0, 0.0
    for n in (1, 2, 3, 4):
        c, s = (x.get(f"encoder.harmonic.{n}.{wave}", 0.0) for wave in ("cos", "sin"))
        theta = theta - c * np.cos(n * angle) - s * np.sin(n * angle)
        slope_by_angle = slope_by_angle + n * (c * np.sin(n * angle) - s * np.cos(n * angle))
        curvature_by_angle = curvature_by_angle + n**2 * (
            c * np.cos(n * angle) + s * np.sin(n * angle)
        )
    w, alpha = (
        rate * slope_by_angle,
        angular_acceleration * slope_by_angle + rate**2 * curvature_by_angle,
    )
    radius = site.radius + x.get("centrifuge.radius", 0.0)
    r = radius * (1.0 + x.get("centrifuge.stretch", 0.0) * radius * run.rate**2) + 0.0 * theta
    slope, curve = 0.0 * theta, 0.0 * theta
    for n in (1, 2):
        c, s = (x.get(f"centrifuge.imbalance.{n}.{wave}", 0.0) for wave in ("cos", "sin"))
        r = r + c * np.cos(n * theta) + s * np.sin(n * theta)
        slope = slope + n * (s * np.cos(n * theta) - c * np.sin(n * theta))
        curve = curve - n**2 * (c * np.cos(n * theta) + s * np.sin(n * theta))
    e = np.exp(1j * theta)
    first, second = (slope + 1j * r) * e, (curve + 2j * slope - r) * e
    axis_tilts = (x.get(f"centrifuge.axis_tilt.{axis}", 0.0) * radius for axis in ("east", "north"))
    east, north = axis_tilts
    z = east * np.sin(theta) - north * np.cos(theta)
    dz = east * np.cos(theta) + north * np.sin(theta)
    level = (r * e, first * w, second * w**2 + first * alpha)
    height = (z, dz * w, -z * w**2 + dz * alpha)
    return [
        np.stack([component.real, component.imag, up], axis=-1)
        for component, up in zip(level, height, strict=True)
    ]


def _panel_edges(times):
    """Return the panel edges from 0 to the last time, `_PANELS_PER_SAMPLE` per interval."""
    between = (
        np.linspace(a, b, _PANELS_PER_SAMPLE, endpoint=False) for a, b in itertools.pairwise(times)
    )
    return np.concatenate([*between, times[-1:]])


def _add_sign_changes(edges, axis_force):
    """Return panel edges with the sign changes of the force along the input axis added."""
    fine_grid = np.unique(
        np.concatenate([np.linspace(a, b, 9) for a, b in itertools.pairwise(edges)])
    )
    sign = np.sign(axis_force(fine_grid))
    changes = np.flatnonzero(sign[:-1] * sign[1:] < 0.0)
    low, high, sign_below = fine_grid[changes], fine_grid[changes + 1], sign[changes]
    for _ in range(50):
        middle = 0.5 * (low + high)
        is_before = np.sign(axis_force(middle)) == sign_below
        low, high = np.where(is_before, middle, low), np.where(is_before, high, middle)
    edges = np.unique(np.concatenate([edges, low]))
    return edges[np.append(True, np.diff(edges) > 1e-9)]


def _integrate_attitude(run, x, platform_force, half_widths, body):
    """Return the attitude error without compliance at all nodes and panel edges, rad.

    platform_force: specific force along the platform's axes in g, (panels, nodes, 3).
    """
    names = ("east", "north", "up")
    drift, g2_sensitivity = (
        np.array([x.get(f"platform.{kind}.{name}", 0.0) for name in names])
        for kind in ("drift", "g2_sensitivity")
    )
    g_sensitivity = _platform_matrix(x, "g_sensitivity")
    drift_rate = (
        drift
        + platform_force @ g_sensitivity.T
        + np.sum(platform_force**2, axis=-1)[..., None] * g2_sensitivity
    )
    node_integrals = half_widths[:, None, None] * np.einsum(
        "ij,pjk->pik", _CUMULATIVE_WEIGHTS, drift_rate
    )
    panel_integrals = half_widths[:, None] * np.einsum("j,pjk->pk", _WEIGHTS, drift_rate)
    edges = np.concatenate([np.zeros((1, 3)), np.cumsum(panel_integrals, axis=0)])
    tilt = np.array([x.get(f"{run.name}.platform.tilt.{name}", 0.0) for name in names])
    return tilt + (edges[:-1, None] + node_integrals) @ body, tilt + edges @ body


def _platform_matrix(x, family):
    return np.array([[x.get(f"platform.{family}.{i}{j}", 0.0) for j in "xyz"] for i in "xyz"])


def simulate_record(site, run, instrument, x):
    """Return the noise-free record of an instrument at the times of a run.

    x: Name of an error -> its size (K_I: its value). Tilts are about east, north and up; other
    platform errors are about the axes of the turned platform.
    """
    g = site.gravity + x.get("site.gravity", 0.0)
    latitude = site.latitude + x.get("site.latitude", 0.0)
    earth = EARTH_RATE * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    true_times = run.times / (1.0 + x.get("records.clock", 0.0))
    angle, axis = run.turn
    body = rotate(np.eye(3), angle, np.array(AXES[axis]))
    axes = instrument.axes() @ body
    coefficients, compliance = values_of(x, instrument.name), _platform_matrix(x, "compliance")
    centripetal_force = site.radius * run.rate**2 / site.gravity

    def force_at(t):
        _, velocity, acceleration = _compute_path(site, run, x, t)
        return acceleration + 2.0 * np.cross(earth, velocity) + g * np.array([0.0, 0.0, 1.0])

    def indicated_force(force, psi, t):
        """Return the force along the input axis, g, of a platform with error psi and compliance."""
        psi = psi + (force @ body.T / g) @ compliance.T @ body
        sensed = np.moveaxis((force - np.cross(psi, force)) @ axes.T, -1, 0) / g
        return indicate_force(
            coefficients,
            sensed,
            condition_changes(
                coefficients,
                run.temperature_change,
                run.temperature_direction,
                run.start_time + t,
                centripetal_force,
            ),
        )

    edges = _panel_edges(true_times)
    if coefficients.get("K_0_asym"):
        edges = _add_sign_changes(edges, lambda t: force_at(t) @ axes[0])
    middle, half_widths = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    t = middle[:, None] + half_widths[:, None] * _NODES
    force = force_at(t)
    psi, psi_at_edges = _integrate_attitude(run, x, force @ body.T / g, half_widths, body)
    indices = np.searchsorted(edges, true_times - 1e-8)
    if instrument.observable == "force":
        return instrument.per_g * indicated_force(
            force_at(true_times), psi_at_edges[indices], true_times
        )
    # Integrate the error of the indicated force panel by panel.
    force_error = g * indicated_force(force, psi, t) - force @ axes[0]
    velocity_error = np.append(0.0, np.cumsum(half_widths * (force_error @ _WEIGHTS)))
    node_integrals = half_widths[:, None] * (force_error @ _CUMULATIVE_WEIGHTS.T)
    position_error = np.append(
        0.0,
        np.cumsum(
            half_widths * (node_integrals @ _WEIGHTS) + 2.0 * half_widths * velocity_error[:-1]
        ),
    )
    position, velocity, _ = _compute_path(site, run, x, true_times)
    if instrument.observable == "velocity":
        return velocity @ axes[0] + velocity_error[indices]
    return position @ axes[0] + position_error[indices]


def simulate_reading(site, reading, name, x):
    """Return the indication at rest or the mean over a revolution on the arm, g."""
    g = site.gravity + x.get("site.gravity", 0.0)
    latitude = site.latitude + x.get("site.latitude", 0.0)
    tilts = [x.get(f"centrifuge.axis_tilt.{axis}", 0.0) for axis in ("east", "north")]
    theta = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    rotation = np.zeros(3)
    if reading.motion == "static":
        force = np.array([[0.0, 0.0, g]])
        rotation = rotation + x.get("head.zero", 0.0) * np.array(reading.head)
        rotation = rotation + x.get("head of " + reading.name, 0.0) * np.array(reading.head)
        for n in (1, 2, 3, 4):
            for quadrature, wave in (("cos", np.cos), ("sin", np.sin)):
                size = x.get(f"head.harmonic.{n}.{quadrature}", 0.0)
                rotation = rotation + size * wave(n * reading.head_angle) * np.array(reading.head)
        names = ("east", "north", "up")
        centripetal_force = 0.0
    else:
        # The radius of a mounting, if known, replaces that of the machine and of the proof mass.
        common = x.get("centrifuge.radius", 0.0)
        common += x.get(f"centrifuge.radius.{name}.{reading.mounting}", 0.0)
        radius = site.radius + x.get(f"centrifuge.radius.{reading.mounting}", common)
        # The clock of the rate counter is common to all readings.
        rate_error = x.get("centrifuge.clock", 0.0) + x.get("rate of " + reading.name, 0.0)
        w = reading.rate * (1.0 + rate_error)
        radius = radius * (1.0 + x.get("centrifuge.stretch", 0.0) * radius * w**2)
        # Gravity and Earth rate in the tilted frame of the machine.
        size = np.hypot(*tilts)
        tilt_axis = np.array([*tilts, 0.0]) / size if size else np.array([1.0, 0.0, 0.0])
        up, earth = rotate(
            np.array(
                [
                    [0.0, 0.0, g],
                    [0.0, EARTH_RATE * np.cos(latitude), EARTH_RATE * np.sin(latitude)],
                ]
            ),
            -size,
            tilt_axis,
        )
        outward = np.stack([np.cos(theta), np.sin(theta), 0.0 * theta], axis=-1)
        forward = np.stack([-np.sin(theta), np.cos(theta), 0.0 * theta], axis=-1)
        inertial = -radius * w**2 * outward + 2.0 * np.cross(earth, radius * w * forward) + up
        force = np.stack(
            [
                np.sum(inertial * outward, axis=1),
                np.sum(inertial * forward, axis=1),
                inertial[:, 2],
            ],
            axis=-1,
        )
        rotation[1] += x.get("centrifuge.droop", 0.0) * w**2
        names = ("outward", "forward", "up")
        centripetal_force = site.radius * w**2 / site.gravity
    rotation = rotation + [
        x.get(f"fixture.misalignment.{reading.mounting}.{axis}", 0.0) if reading.mounting else 0.0
        for axis in names
    ]
    size = np.linalg.norm(rotation)
    axes = rotate(reading.axes, size, rotation / size) if size else reading.axes
    coefficients = values_of(x, name)
    a_ipo = axes @ force.T / g
    changes = condition_changes(
        coefficients,
        reading.temperature_change,
        reading.temperature_direction,
        reading.start_time,
        centripetal_force,
    )
    # On the arm, the instrument rotates about the axis of the machine.
    spin_product = reading.rate**2 * axes[0, 2] * axes[1, 2] if reading.motion == "arm" else 0.0
    mean = np.mean(
        indicate_force(coefficients, a_ipo, changes, lambda a: np.clip(a / SIGN_WIDTH, -1.0, 1.0))
    )
    return mean + coefficients.get("K_spin", 0.0) * spin_product


# Least squares.


@dataclass(frozen=True)
class Unknown:
    """An unknown with its prior; `sd` is infinite without a prior."""

    name: str
    mean: float
    sd: float = np.inf
    kind: str = "requested"  #: or stated, unstated, held
    step: float = 0.0  #: of the central difference; 0: `sd`


@dataclass(frozen=True)
class Rows:
    """Data with their model, noise covariance, and columns of free start errors."""

    model: object  #: values of all unknowns -> model values, (n,)
    values: np.ndarray
    covariance: object  #: (n, n), or a function of the values of all unknowns
    free_columns: np.ndarray  #: (n, k)

    def noise(self, values):
        return self.covariance(values) if callable(self.covariance) else self.covariance


@dataclass(frozen=True)
class Fit:
    """Result of a fit."""

    unknowns: list  #: Estimated unknowns.
    estimate: np.ndarray
    covariance_noise: np.ndarray  #: covariance
    prior_effects: dict  #: Unknown with a prior -> effect of its u on each estimate.
    prior_kinds: dict  #: Unknown with a prior -> "stated" or "default".
    rows: list  #: Whitened residuals and leverages of each group.

    @property
    def names(self):
        return [u.name for u in self.unknowns]

    def covariance_of_kind(self, kind):
        """Return the covariance from stated or default priors."""
        effects = [
            effect for name, effect in self.prior_effects.items() if self.prior_kinds[name] == kind
        ]
        return sum((np.outer(m, m) for m in effects), np.zeros_like(self.covariance_noise))

    @property
    def covariance(self):
        """Return the total covariance."""
        return (
            self.covariance_noise
            + self.covariance_of_kind("stated")
            + self.covariance_of_kind("default")
        )

    def summary(self, name):
        """Return value, u and the contributions of noise, stated and default priors."""
        k = self.names.index(name)
        components = (
            self.covariance_noise,
            self.covariance_of_kind("stated"),
            self.covariance_of_kind("default"),
        )
        return [
            float(v)
            for v in (self.estimate[k], *np.sqrt([p[k, k] for p in (sum(components), *components)]))
        ]

    def correlation(self, names):
        """Return the correlation matrix of some unknowns."""
        indices = [self.names.index(name) for name in names]
        covariance = self.covariance[np.ix_(indices, indices)]
        u = np.sqrt(np.diag(covariance))
        return covariance / np.outer(u, u)

    def misfit(self, groups):
        """Return chi-square and degrees of freedom of the rows of some groups."""
        groups_rows = [self.rows[k] for k in groups]
        return [
            sum(float(residuals @ residuals) for residuals, _ in groups_rows),
            sum(residuals.size - float(leverages.sum()) for residuals, leverages in groups_rows),
        ]


def walk_covariance(times, density, integrations):
    """Return the covariance of white noise of density N^2, integrated once or twice from 0."""
    low, high = np.minimum.outer(times, times), np.maximum.outer(times, times)
    if integrations == 1:
        return density * low
    return density * low**2 * (high / 2.0 - low / 6.0)


def differentiate_model(rows, unknowns, values):
    """Return the central differences of the model, (n, p)."""
    columns = []
    for unknown in unknowns:
        step = unknown.step or (unknown.sd if np.isfinite(unknown.sd) else 1e-4)
        upper, lower = (
            rows.model({**values, unknown.name: values[unknown.name] + sign * step})
            for sign in (1, -1)
        )
        columns.append((upper - lower) / (2.0 * step))
    return np.column_stack(columns)


def _whiten_rows(groups, estimated, considered, values):
    """Return whitened rows [estimated | start errors by group | considered | residual]."""
    n_estimated, n_free = len(estimated), sum(rows.free_columns.shape[1] for rows in groups)
    blocks, offset = [], n_estimated
    for rows in groups:
        block = np.zeros((rows.values.size, n_estimated + n_free + len(considered) + 1))
        block[:, :n_estimated] = differentiate_model(rows, estimated, values)
        block[:, offset : offset + rows.free_columns.shape[1]] = rows.free_columns
        if considered:
            block[:, n_estimated + n_free : -1] = differentiate_model(rows, considered, values)
        block[:, -1] = rows.values - rows.model(values)
        offset += rows.free_columns.shape[1]
        blocks.append(np.linalg.solve(np.linalg.cholesky(rows.noise(values)), block))
    return np.vstack(blocks), n_estimated + n_free


def fit(groups, unknowns, n_iterations=3):
    """Fit all rows at once by Gauss-Newton iterations."""
    estimated = [u for u in unknowns if u.kind != "considered"]
    considered = [u for u in unknowns if u.kind == "considered"]
    with_prior = [j for j, u in enumerate(estimated) if np.isfinite(u.sd)]
    values, p = {u.name: u.mean for u in unknowns}, len(estimated)
    for _ in range(n_iterations):
        whole, width = _whiten_rows(groups, estimated, considered, values)
        n = len(whole)
        prior_rows = np.zeros((len(with_prior), whole.shape[1]))
        for row, j in enumerate(with_prior):
            prior_rows[row, j] = 1.0 / estimated[j].sd
            prior_rows[row, -1] = (estimated[j].mean - values[estimated[j].name]) / estimated[j].sd
        whole = np.vstack([whole, prior_rows])
        scale = np.linalg.norm(whole[:, :width], axis=0)
        q, r = np.linalg.qr(whole[:, :width] / scale)
        inverse = np.linalg.solve(r, q.T) / scale[:, None]  # takes rows to the solution
        change = inverse @ whole[:, -1]
        for j, unknown in enumerate(estimated):
            values[unknown.name] += change[j]
    gain = inverse[:p]
    effects = {estimated[j].name: gain[:, n + row] for row, j in enumerate(with_prior)}
    effects |= {u.name: -gain @ whole[:, width + k] * u.sd for k, u in enumerate(considered)}
    residuals, leverages = whole[:n, -1] - whole[:n, :width] @ change, np.sum(q[:n] ** 2, axis=1)
    group_ends = np.cumsum([rows.values.size for rows in groups])[:-1]
    return Fit(
        estimated,
        np.array([values[u.name] for u in estimated]),
        gain[:, :n] @ gain[:, :n].T,
        effects,
        {u.name: "default" if u.kind == "default" else "stated" for u in (*estimated, *considered)},
        list(zip(np.split(residuals, group_ends), np.split(leverages, group_ends), strict=True)),
    )
