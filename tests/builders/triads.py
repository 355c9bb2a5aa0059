"""Triads at unknown attitudes, from plain matrices that share no code with the package."""

import numpy as np

#: What is indicated along each input axis by a force along each axis of the frame, g/g, and
#: biases, g. The frame: X along the first axis, Y in the plane of the first two.
ROWS = np.array([[1.004, 0.0, 0.0], [0.003, 0.997, 0.0], [-0.006, 0.002, 1.0061]])
BIAS = np.array([0.0102, -0.0098, 0.0351])

#: Where input and pendulous axes point while the sensor is level.
DIRECTIONS = {"X": ("east", "north"), "Y": ("north", "up"), "Z": ("up", "east")}

NAMES = tuple(DIRECTIONS)


def directions(count, generator):
    """Return random unit vectors, shape (count, 3)."""
    found = generator.standard_normal((count, 3))
    return found / np.linalg.norm(found, axis=1)[:, None]


def indications(along, rows=ROWS, bias=BIAS, squares=(0.0, 0.0, 0.0)):
    """Return the indications of three accelerometers for 1 g along directions, g, shape (n, 3).

    squares: Their second-order coefficients, g/g^2.
    """
    return along @ np.transpose(rows) + bias + np.asarray(squares) * along**2


def accelerometer(name, more=""):
    """Return the table of an accelerometer."""
    one, other = DIRECTIONS[name]
    return (
        f'[accelerometers.{name}]\ninput_axis = "{one}"\npendulous_axis = "{other}"\n'
        f'grade = "consumer"\n{more}'
    )


def head(more="", model='terms = ["K_F", "K_I", "delta_O", "delta_P"]\nassume = ["all"]'):
    """Return a description of a triad without its runs."""
    return (
        'schema = 1\nsite = { gravity = "9.81 m/s^2", latitude = "50 deg" }\n'
        f"{more}\n[model]\n{model}\n"
        + "".join(map(accelerometer, NAMES))
        + '[triad]\naccelerometers = ["X", "Y", "Z"]\n'
    )


def table(folder, values, u=None, description=None, **columns):
    """Write a campaign of a table of poses, indications in g of shape (n, 3); return its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    spread = 'u = { X = "u", Y = "u", Z = "u" }, ' if u is not None else ""
    own = "".join(f'{key} = "{key}", ' for key in columns)
    (folder / "campaign.toml").write_text(
        (description or head()) + '[readings]\nfile = "poses.csv"\nattitude = "unknown"\n'
        f'columns = {{ {own}{spread}reading = {{ X = "x", Y = "y", Z = "z" }} }}\n'
    )
    lines = [",".join(["x", "y", "z", *(["u"] if u is not None else []), *columns])]
    for k, row in enumerate(np.asarray(values)):
        cells = [*(f"{value!r}" for value in row.tolist()), *([f"{u!r}"] if u is not None else [])]
        lines.append(",".join([*cells, *(str(column[k]) for column in columns.values())]))
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    return folder


def group(values, u=None, names=NAMES):
    """Return poses in the form that the fit accepts."""
    from counterspin.physics.accelerometer import Mounting
    from counterspin.physics.conditions import AT_REFERENCE
    from counterspin.triads.poses import TriadPoses

    values = np.asarray(values)
    n = len(values)
    return TriadPoses(
        accelerometers=tuple(names),
        names=tuple(f"pose {k}" for k in range(n)),
        axes=np.array([Mounting.from_axes(*DIRECTIONS[name]).matrix for name in NAMES]),
        gravity=9.81,
        value=values,
        u=None if u is None else np.broadcast_to(u, values.shape).astype(float),
        conditions=AT_REFERENCE.at(np.zeros(n), 0.0),
        repeats=np.ones(n),
        scatter=np.zeros(n),
        in_si=np.zeros((n, 3)),
    )


#: The unknowns of a triad of which nothing else is known, in the order of its biases and rows.
PARAMETERS = (
    ("X", "K_F"),
    ("Y", "K_F"),
    ("Z", "K_F"),
    ("X", "K_I"),
    ("Y", "delta_P"),
    ("Y", "K_I"),
    ("Z", "delta_O"),
    ("Z", "delta_P"),
    ("Z", "K_I"),
)
#: Of these the sign with which each makes an element of the rows: Y's output axis is east, and
#: Z's pendulous axis is.
SIGNS = np.array([1.0, 1.0, 1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0])


def truth(rows=ROWS, bias=BIAS):
    """Return the true parameters of rows and biases, those of K_I unchanged, shape (9,)."""
    lower = [rows[0, 0], rows[1, 0], rows[1, 1], *rows[2]]
    return SIGNS * np.array([*bias, *lower])


def unknowns(extra=(), *, defaults=False):
    """Return the unknowns of a fit, followed by further pairs of owner and symbol.

    defaults: Whether they have the default priors of consumer grade, for where they are needed.
    """
    from counterspin.inference.joint.unknowns import Unknown, Unknowns
    from counterspin.physics.terms import term

    return Unknowns(
        tuple(
            Unknown(
                name,
                symbol,
                (term(symbol).nominal, np.inf),
                term(symbol).sizes("consumer").limit,
                default_sd=term(symbol).sizes("consumer").typical if defaults else np.inf,
            )
            for name, symbol in (*PARAMETERS, *extra)
        )
    )
