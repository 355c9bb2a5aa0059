"""Triads at unknown attitudes, from plain matrices that share no code with the package."""

import numpy as np

#: Response of each input axis to a force along each axis of the frame, g/g, and biases, g. In the
#: frame, X is along the first input axis, and Y is in the plane of the first two.
ROWS = np.array([[1.004, 0.0, 0.0], [0.003, 0.997, 0.0], [-0.006, 0.002, 1.0061]])
BIAS = np.array([0.0102, -0.0098, 0.0351])

#: Directions of input and pendulous axes of the level sensor.
DIRECTIONS = {"X": ("east", "north"), "Y": ("north", "up"), "Z": ("up", "east")}

NAMES = tuple(DIRECTIONS)


def draw_directions(count, generator):
    """Return random unit vectors, shape (count, 3)."""
    vectors = generator.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def compute_indications(directions, rows=ROWS, bias=BIAS, squares=(0.0, 0.0, 0.0)):
    """Return the indications of three accelerometers for 1 g along directions, g, shape (n, 3).

    squares: Second-order coefficients, g/g^2.
    """
    return directions @ np.transpose(rows) + bias + np.asarray(squares) * directions**2


def format_accelerometer(name, more=""):
    """Return the table of an accelerometer."""
    input_axis, pendulous_axis = DIRECTIONS[name]
    return (
        f'[accelerometers.{name}]\ninput_axis = "{input_axis}"\n'
        f'pendulous_axis = "{pendulous_axis}"\n'
        f'grade = "consumer"\n{more}'
    )


def format_description(
    more="", model='terms = ["K_F", "K_I", "delta_O", "delta_P"]\nassume = ["all"]'
):
    """Return a description of a triad without its runs."""
    return (
        'schema = 1\nsite = { gravity = "9.81 m/s^2", latitude = "50 deg" }\n'
        f"{more}\n[model]\n{model}\n"
        + "".join(map(format_accelerometer, NAMES))
        + '[triad]\naccelerometers = ["X", "Y", "Z"]\n'
    )


def write_pose_campaign(folder, values, u=None, description=None, **columns):
    """Write a campaign with a table of poses and return its folder.

    values: Indications, g, shape (n, 3).
    columns: Further columns of the table.
    """
    folder.mkdir(parents=True, exist_ok=True)
    u_columns = 'u = { X = "u", Y = "u", Z = "u" }, ' if u is not None else ""
    further_columns = "".join(f'{key} = "{key}", ' for key in columns)
    (folder / "campaign.toml").write_text(
        (description or format_description())
        + '[readings]\nfile = "poses.csv"\nattitude = "unknown"\n'
        f'columns = {{ {further_columns}{u_columns}reading = {{ X = "x", Y = "y", Z = "z" }} }}\n'
    )
    lines = [",".join(["x", "y", "z", *(["u"] if u is not None else []), *columns])]
    for k, row in enumerate(np.asarray(values)):
        cells = [*(f"{value!r}" for value in row.tolist()), *([f"{u!r}"] if u is not None else [])]
        lines.append(",".join([*cells, *(str(column[k]) for column in columns.values())]))
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    return folder


def make_poses(values, u=None, names=NAMES):
    """Return poses for the fit."""
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


#: Unknowns of a triad without priors, in the order of its biases and rows.
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
#: Signs of these parameters in the elements of the rows: the output axis of Y and the pendulous
#: axis of Z point east.
SIGNS = np.array([1.0, 1.0, 1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0])


def true_parameters(rows=ROWS, bias=BIAS):
    """Return the true parameters for rows and biases, shape (9,)."""
    lower = [rows[0, 0], rows[1, 0], rows[1, 1], *rows[2]]
    return SIGNS * np.array([*bias, *lower])


def make_unknowns(extra=(), *, defaults=False):
    """Return the unknowns of a fit, followed by further pairs of owner and symbol.

    defaults: True: with the default priors of consumer grade.
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
