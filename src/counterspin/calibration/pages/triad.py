"""Triad of accelerometers, as blocks of a report: parameters, poses, plots."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Final

import numpy as np

from counterspin.calibration.pages.accelerometer import coefficient_cells
from counterspin.calibration.pages.uncertainty import default_prior_sentence
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, PoseResult, PosesInRecord, TriadResult
from counterspin.physics.terms import is_term, term
from counterspin.reports.blocks import (
    Block,
    Column,
    Heading,
    Paragraph,
    Picture,
    Plot,
    PlotSeries,
    Sphere,
    Table,
)
from counterspin.reports.numbers import format_number

#: Kind of a parameter -> name.
_PARAMETER_NAMES: Final = {
    "offset": "offset of {}",
    "sensitivity": "sensitivity of {}",
    "angle": "angle between {} and {}",
}

#: Number of poses with the largest residuals that a short table lists.
_MAX_LISTED_POSES: Final = 5

#: An angle is shown as its deviation from a right angle if this is below the tolerance, rad.
_RIGHT_ANGLE: Final = 0.5 * math.pi
_ANGLE_TOLERANCE: Final = 0.2

#: Names of the axes of a triad's frame.
FRAME_AXES: Final = ("x", "y", "z")

#: Residual over its standard deviation above which a pose is marked.
_OUTLIER_Z: Final = 4.0

#: Largest number of labels on an axis of poses.
_MAX_LABELS: Final = 30

#: Unit of residuals in plots, and factor from m/s^2.
_RESIDUAL_UNIT: Final = ("mm/s^2", 1e3)


def triad_summary(result: Result) -> Iterator[Block]:
    """Yield a sentence on the residuals of the poses before and after the calibration."""
    triad = result.triad
    if triad is None or triad.rms_before is None:
        return
    names = ", ".join(triad.accelerometers)
    text = f"Triad {names} in {len(triad.poses)} poses of unknown attitude"
    rms_before_text = f"{format_number(triad.rms_before, 3)} m/s^2"
    if triad.rms_after is None:
        yield Paragraph(f"{text}. Uncorrected, |f| - g has an rms of {rms_before_text}.")
    else:
        rms_after_text = f"{format_number(triad.rms_after, 3)} m/s^2"
        yield Paragraph(
            f"{text}. The rms of |f| - g is {rms_before_text} before and {rms_after_text} after "
            f"correction."
        )
    for name in triad.accelerometers:
        if sentence := default_prior_sentence(result.accelerometers[name], "K_F"):
            yield Paragraph(f"{name}: {sentence}")


def nominal_outputs(result: Result, triad: TriadResult) -> str:
    """Return the nominal output of each accelerometer of a triad; empty for outputs in g."""
    outputs = {name: result.accelerometers[name].nominal for name in triad.accelerometers}
    return ", ".join(f"{name} {output.words}" for name, output in outputs.items() if output)


def triad_blocks(result: Result, *, show_details: bool) -> Iterator[Block]:
    """Yield parameters, corrected output and poses of a triad; details: all poses."""
    triad = result.triad
    if triad is None:
        return
    yield Heading(f"Triad {', '.join(triad.accelerometers)}")
    yield _parameter_table(triad)
    if triad.matrix is not None and triad.bias is not None:
        bias_text = ", ".join(f"{value:.7f}" for value in triad.bias)
        name_list = ", ".join(triad.accelerometers)
        yield Paragraph(
            "Corrected output: f = M (y - b), where f, y and b are in g. The components of y "
            f"are in the order {name_list}. The components of f are along the axes of the triad "
            f"frame. b = ({bias_text})."
        )
        if outputs := nominal_outputs(result, triad):
            yield Paragraph(f"y is calculated from the nominal outputs: {outputs}.")
        yield Table(
            (Column("M", "right"), *(Column(name, "right") for name in triad.accelerometers)),
            tuple(
                (f"f_{axis}", *(f"{value:.7f}" for value in row))
                for axis, row in zip("xyz", triad.matrix, strict=True)
            ),
        )
    elif triad.why_no_matrix is not None:
        yield Paragraph(f"The corrected output is not available. {triad.why_no_matrix}", "warning")
    for name, record in triad.records.items():
        yield Paragraph(
            f"{name}: {record.poses} {'pose' if record.poses == 1 else 'poses'}, detected "
            f"where the scatter is below {format_number(record.threshold, 3)} m/s^2."
        )
        for note in record.notes:
            yield Paragraph(f"{name}: {note}", "warning")
    yield from _pose_blocks(triad, show_details=show_details)


def _parameter_table(triad: TriadResult) -> Table:
    rows = [_parameter_row(name, coefficient) for name, coefficient in triad.parameters.items()]
    return Table(
        columns=(
            Column("Parameter", wraps=True),
            Column("Value", "right"),
            Column("u (k = 1)"),
            Column("Unit"),
            Column("Uncertainty contributions", wraps=True),
        ),
        rows=tuple(rows),
        quiet_rows=frozenset(
            k
            for k, coefficient in enumerate(triad.parameters.values())
            if not coefficient.estimated
        ),
    )


def _parameter_row(name: str, coefficient: Coefficient) -> tuple[str, ...]:
    description, coefficient = describe_parameter(name, coefficient)
    return (description, *coefficient_cells(coefficient))


def describe_parameter(name: str, coefficient: Coefficient) -> tuple[str, Coefficient]:
    """Return description and value of a parameter; an angle near 90 deg as its deviation."""
    description = parameter_description(name)
    if name.startswith("angle.") and coefficient.value is not None:
        is_near_right = abs(coefficient.value - _RIGHT_ANGLE) < _ANGLE_TOLERANCE
        coefficient = (
            coefficient.model_copy(update={"value": coefficient.value - _RIGHT_ANGLE})
            if is_near_right
            else coefficient
        )
        description += " minus 90 deg" if is_near_right else ""
    return description, coefficient


def parameter_description(name: str) -> str:
    """Return the name of a parameter."""
    kind, *names = name.split(".")
    if kind in _PARAMETER_NAMES and not is_term(".".join(names)):
        return _PARAMETER_NAMES[kind].format(*names)
    owner, _, symbol = name.partition(".")
    return f"{symbol} of {owner}, {term(symbol).words}"


def _pose_blocks(triad: TriadResult, *, show_details: bool) -> Iterator[Block]:
    poses = triad.poses
    if not show_details:
        worst_poses = sorted(poses, key=lambda pose: -abs(pose.z or 0.0))[:_MAX_LISTED_POSES]
        poses = [pose for pose in triad.poses if pose in worst_poses]
    if not poses:
        return
    yield Table(
        columns=(
            Column("No.", "right"),
            Column("Pose", wraps=True),
            Column("Direction of f", "right"),
            Column("Residual, ug", "right"),
            Column("Residual / u(residual)", "right"),
        ),
        rows=tuple(
            (
                str(triad.poses.index(pose) + 1),
                pose.name,
                "  ".join(f"{component: .3f}" for component in pose.direction),
                f"{pose.residual * 1e6:.1f}",
                "-" if pose.z is None else f"{pose.z:.2f}",
            )
            for pose in poses
        ),
    )
    if len(poses) < len(triad.poses):
        yield Paragraph(
            f"The table lists the {len(poses)} of {len(triad.poses)} poses with the largest "
            "residuals.",
            "quiet",
        )


# Pictures


def pose_pictures(result: Result) -> Iterator[Picture]:
    """Yield the pictures of the poses of a triad."""
    triad = result.triad
    if triad is None or not triad.poses:
        return
    yield _direction_sphere(triad, result.inputs.gravity)
    yield from _residual_plots(result, triad)
    for name, record in triad.records.items():
        if record.time:
            recorded_poses = [pose for pose in triad.poses if pose.start is not None]
            yield _detection_plot(
                name, record, [pose for pose in recorded_poses if _is_from_record(pose, name)]
            )


def _is_from_record(pose: PoseResult, record: str) -> bool:
    return pose.name.rpartition(" ")[0].rpartition(" ")[0] == record


def _is_outlying(pose: PoseResult) -> bool:
    return pose.z is not None and abs(pose.z) > _OUTLIER_Z


def _direction_sphere(triad: TriadResult, gravity: float) -> Sphere:
    unit, factor = _RESIDUAL_UNIT
    x, y, z = FRAME_AXES
    return Sphere(
        title="Direction of the specific force in the triad frame, by pose",
        axes=(x, y, z),
        points=tuple(
            (pose.direction[0], pose.direction[1], pose.direction[2]) for pose in triad.poses
        ),
        values=tuple(pose.residual * gravity * factor for pose in triad.poses),
        names=tuple(str(pose_number) for pose_number in range(1, len(triad.poses) + 1)),
        value_label=f"residual, {unit}",
        highlighted_points=frozenset(k for k, pose in enumerate(triad.poses) if _is_outlying(pose)),
    )


def _residual_plots(result: Result, triad: TriadResult) -> Iterator[Plot]:
    """Yield plots by pose: |f| - g with nominal sensitivities, and residuals of the fit."""
    unit, factor = _RESIDUAL_UNIT
    scale = result.inputs.gravity * factor
    x_values = tuple(float(index) for index in range(len(triad.poses)))
    label_step = -(-len(x_values) // _MAX_LABELS)
    labels = tuple("" if index % label_step else str(index + 1) for index in range(len(x_values)))
    axes = [result.accelerometers[name].axes for name in triad.accelerometers]
    if all(axes):
        input_axes = np.array([axis_rows[0] for axis_rows in axes if axis_rows])
        values = np.array([pose.values for pose in triad.poses])
        raw_errors = scale * (np.linalg.norm(np.linalg.solve(input_axes, values.T), axis=0) - 1.0)
        yield Plot(
            title="Uncorrected |f| - g by pose",
            x_label="pose",
            y_label=f"|f| - g, {unit}",
            series=(PlotSeries("", x_values, tuple(raw_errors.tolist()), kind="points", colour=0),),
            levels=(0.0,),
            x_names=labels,
            height=0.7,
        )
    residuals = [pose.residual * scale for pose in triad.poses]
    uncertainties = [pose.u * scale for pose in triad.poses]
    yield Plot(
        title="Residual along the specific force by pose",
        x_label="pose",
        y_label=f"residual, {unit}",
        series=(
            PlotSeries(
                "error bar: standard uncertainty of the indication",
                x_values,
                tuple(residuals),
                low=tuple(value - u for value, u in zip(residuals, uncertainties, strict=True)),
                high=tuple(value + u for value, u in zip(residuals, uncertainties, strict=True)),
                kind="points",
                colour=0,
            ),
        ),
        levels=(0.0,),
        x_names=labels,
        height=0.7,
    )


def _detection_plot(name: str, record: PosesInRecord, poses: Sequence[PoseResult]) -> Plot:
    """Return a plot of the scatter over time with the threshold and the poses."""
    y_min = 0.7 * min((level for level in record.level if level > 0.0), default=record.threshold)
    pose_spans = [(pose.start, pose.end) for pose in poses if pose.start is not None and pose.end]
    # A gap after each pose, so that they are not joined.
    times = tuple(chain.from_iterable((start, end, end) for start, end in pose_spans))
    n_poses = len(pose_spans)
    pose_band = PlotSeries(
        "poses (scatter below the threshold)",
        times,
        (record.threshold, record.threshold, None) * n_poses,
        low=(y_min, y_min, None) * n_poses,
        high=(record.threshold, record.threshold, None) * n_poses,
        kind="band",
        colour=2,
    )
    # A constant output has the scatter 0, which has no logarithm.
    level = PlotSeries(
        "largest scatter over one second",
        tuple(record.time),
        tuple(value if value > 0.0 else None for value in record.level),
        colour=0,
    )
    return Plot(
        title=f"Rest intervals of {name}",
        x_label="time, s",
        y_label="scatter, m/s^2",
        series=(pose_band, level),
        levels=(record.threshold,),
        log_y=True,
        zoom=True,
    )
