"""What a report draws of a triad's poses: where they point, how they fit, how they were found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Final

import numpy as np

from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import PoseResult, PosesInRecord, TriadResult
from counterspin.reports.blocks import Picture, Plot, PlotSeries, Sphere

#: Names of the axes of a triad's frame.
FRAME: Final = ("x", "y", "z")

#: A pose is marked whose residual is this many of its own standard deviations.
_STANDS_OUT: Final = 4.0

#: As many poses have their numbers on an axis.
_MOST_NUMBERS: Final = 30

#: From m/s^2.
_SMALL: Final = ("mm/s^2", 1e3)


def pose_pictures(result: Result) -> Iterator[Picture]:
    """Yield the pictures of a triad's poses; none where there are none."""
    triad = result.triad
    if triad is None or not triad.poses:
        return
    yield _sphere(triad, result.inputs.gravity)
    yield from _residuals(result, triad)
    for name, record in triad.records.items():
        if record.time:
            own = [pose for pose in triad.poses if pose.start is not None]
            yield _found(name, record, [pose for pose in own if _is_of(pose, name)])


def _is_of(pose: PoseResult, record: str) -> bool:
    return pose.name.rpartition(" ")[0].rpartition(" ")[0] == record


def _stands_out(pose: PoseResult) -> bool:
    return pose.z is not None and abs(pose.z) > _STANDS_OUT


def _sphere(triad: TriadResult, gravity: float) -> Sphere:
    unit, factor = _SMALL
    x, y, z = FRAME
    return Sphere(
        title="Directions of the specific force in the triad's frame, by pose",
        axes=(x, y, z),
        points=tuple((p.direction[0], p.direction[1], p.direction[2]) for p in triad.poses),
        values=tuple(pose.residual * gravity * factor for pose in triad.poses),
        names=tuple(str(number) for number in range(1, len(triad.poses) + 1)),
        value_label=f"residual, {unit}",
        stands_out=frozenset(k for k, pose in enumerate(triad.poses) if _stands_out(pose)),
    )


def _residuals(result: Result, triad: TriadResult) -> Iterator[Plot]:
    """Yield |f| - g of each pose by the nominal sensitivities, and what the fit leaves of it."""
    unit, factor = _SMALL
    scale = result.inputs.gravity * factor
    places = tuple(float(place) for place in range(len(triad.poses)))
    each = -(-len(places) // _MOST_NUMBERS)
    names = tuple("" if place % each else str(place + 1) for place in range(len(places)))
    axes = [result.accelerometers[name].axes for name in triad.accelerometers]
    if all(axes):
        rows = np.array([own[0] for own in axes if own])
        values = np.array([pose.values for pose in triad.poses])
        before = scale * (np.linalg.norm(np.linalg.solve(rows, values.T), axis=0) - 1.0)
        yield Plot(
            title="|f| - g of each pose, uncorrected",
            x_label="pose",
            y_label=f"|f| - g, {unit}",
            series=(PlotSeries("", places, tuple(before.tolist()), kind="points", colour=0),),
            levels=(0.0,),
            x_names=names,
            height=0.7,
        )
    after = [pose.residual * scale for pose in triad.poses]
    spread = [pose.u * scale for pose in triad.poses]
    yield Plot(
        title="Residual of each pose along the specific force",
        x_label="pose",
        y_label=f"residual, {unit}",
        series=(
            PlotSeries(
                "bar: standard uncertainty of what is indicated",
                places,
                tuple(after),
                low=tuple(value - u for value, u in zip(after, spread, strict=True)),
                high=tuple(value + u for value, u in zip(after, spread, strict=True)),
                kind="points",
                colour=0,
            ),
        ),
        levels=(0.0,),
        x_names=names,
        height=0.7,
    )


def _found(name: str, record: PosesInRecord, poses: Sequence[PoseResult]) -> Plot:
    """Return the level over time with the threshold, and where the poses are."""
    floor = 0.7 * min((level for level in record.level if level > 0.0), default=record.threshold)
    spans = [(pose.start, pose.end) for pose in poses if pose.start is not None and pose.end]
    # A gap after each pose, so that they are not joined.
    times = tuple(chain.from_iterable((start, end, end) for start, end in spans))
    parts = len(spans)
    shaded = PlotSeries(
        "poses, below the threshold",
        times,
        (record.threshold, record.threshold, None) * parts,
        low=(floor, floor, None) * parts,
        high=(record.threshold, record.threshold, None) * parts,
        kind="band",
        colour=2,
    )
    # Where nothing moves to the last digit the level is nothing, and its logarithm none.
    level = PlotSeries(
        "largest scatter over a second",
        tuple(record.time),
        tuple(value if value > 0.0 else None for value in record.level),
        colour=0,
    )
    return Plot(
        title=f"Where {name} was at rest",
        x_label="time, s",
        y_label="scatter, m/s^2",
        series=(shaded, level),
        levels=(record.threshold,),
        log_y=True,
        zoom=True,
    )
