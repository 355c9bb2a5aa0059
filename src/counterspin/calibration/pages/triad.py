"""Three accelerometers as one sensor: their parameters, the corrected output, the poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from counterspin.calibration.pages.accelerometer import coefficient_cells
from counterspin.calibration.pages.uncertainty import dominance
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import Coefficient, TriadResult
from counterspin.physics.terms import is_term, term
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import format_number

#: What the parameters are called.
_WORDS: Final = {
    "offset": "offset of {}",
    "sensitivity": "sensitivity of {}",
    "angle": "angle between {} and {}",
}

#: So many poses are listed where not all are asked for: those that fit least.
_FEW_POSES: Final = 5

#: An angle is shown as what it differs by from a right one, if that is less, rad.
_RIGHT: Final = 0.5 * math.pi
_NEARLY: Final = 0.2


def triad_line(result: Result) -> Iterator[Block]:
    """Yield in a sentence what the poses were off before and are now."""
    triad = result.triad
    if triad is None or triad.rms_before is None:
        return
    names = ", ".join(triad.accelerometers)
    text = f"Triad {names}: {len(triad.poses)} poses of unknown attitude"
    before = f"{format_number(triad.rms_before, 3)} m/s^2"
    if triad.rms_after is None:
        yield Paragraph(f"{text}; |f| - g has an rms of {before}, uncorrected.")
    else:
        after = f"{format_number(triad.rms_after, 3)} m/s^2"
        yield Paragraph(f"{text}; |f| - g has an rms of {before} before and {after} after.")
    for name in triad.accelerometers:
        if sentence := dominance(result.accelerometers[name], "K_F"):
            yield Paragraph(f"{name}: {sentence}")


def nominal_outputs(result: Result, triad: TriadResult) -> str:
    """Return by what a triad's outputs are taken for specific forces; empty where they are such."""
    outputs = {name: result.accelerometers[name].nominal for name in triad.accelerometers}
    return ", ".join(f"{name} {one.words}" for name, one in outputs.items() if one)


def triad_blocks(result: Result, *, details: bool) -> Iterator[Block]:
    """Yield the triad's parameters, the corrected output and the poses, all with `details`."""
    triad = result.triad
    if triad is None:
        return
    yield Heading(f"Triad {', '.join(triad.accelerometers)}")
    yield _parameters(triad)
    if triad.matrix is not None and triad.bias is not None:
        bias = ", ".join(f"{value:.7f}" for value in triad.bias)
        order = ", ".join(triad.accelerometers)
        yield Paragraph(
            f"Corrected output: f = M (y - b), all in g, y in the order {order}, f along the axes "
            f"of the triad's frame; b = ({bias})."
        )
        if outputs := nominal_outputs(result, triad):
            yield Paragraph(f"y is by the nominal outputs: {outputs}.")
        yield Table(
            (Column("M", "right"), *(Column(name, "right") for name in triad.accelerometers)),
            tuple(
                (f"f_{axis}", *(f"{value:.7f}" for value in row))
                for axis, row in zip("xyz", triad.matrix, strict=True)
            ),
        )
    for name, record in triad.records.items():
        yield Paragraph(
            f"{name}: {record.poses} {'pose' if record.poses == 1 else 'poses'}, found where the "
            "scatter stays below "
            f"{format_number(record.threshold, 3)} m/s^2."
        )
        for note in record.notes:
            yield Paragraph(f"{name}: {note}", "warning")
    yield from _poses(triad, details=details)


def _parameters(triad: TriadResult) -> Table:
    rows = [_row(name, c) for name, c in triad.parameters.items()]
    return Table(
        columns=(
            Column("Parameter", wraps=True),
            Column("Value", "right"),
            Column("u (k = 1)"),
            Column("Unit"),
            Column("u comes from", wraps=True),
        ),
        rows=tuple(rows),
        quiet=frozenset(k for k, c in enumerate(triad.parameters.values()) if not c.estimated),
    )


def _row(name: str, c: Coefficient) -> tuple[str, ...]:
    words, c = shown_parameter(name, c)
    return (words, *coefficient_cells(c))


def shown_parameter(name: str, c: Coefficient) -> tuple[str, Coefficient]:
    """Return a parameter as it is read, in words: of an angle near 90 deg what it differs by."""
    words = parameter_words(name)
    if name.startswith("angle.") and c.value is not None:
        near = abs(c.value - _RIGHT) < _NEARLY
        c = c.model_copy(update={"value": c.value - _RIGHT}) if near else c
        words += " less 90 deg" if near else ""
    return words, c


def parameter_words(name: str) -> str:
    """Return what a parameter is called."""
    kind, *names = name.split(".")
    if kind in _WORDS and not is_term(".".join(names)):
        return _WORDS[kind].format(*names)
    owner, _, symbol = name.partition(".")
    return f"{symbol} of {owner}, {term(symbol).words}"


def _poses(triad: TriadResult, *, details: bool) -> Iterator[Block]:
    poses = triad.poses
    if not details:
        worst = sorted(poses, key=lambda pose: -abs(pose.z or 0.0))[:_FEW_POSES]
        poses = [pose for pose in triad.poses if pose in worst]
    if not poses:
        return
    yield Table(
        columns=(
            Column("No.", "right"),
            Column("Pose", wraps=True),
            Column("Direction of f", "right"),
            Column("Residual, ug", "right"),
            Column("Residual / its u", "right"),
        ),
        rows=tuple(
            (
                str(triad.poses.index(pose) + 1),
                pose.name,
                "  ".join(f"{part: .3f}" for part in pose.direction),
                f"{pose.residual * 1e6:.1f}",
                "-" if pose.z is None else f"{pose.z:.2f}",
            )
            for pose in poses
        ),
    )
    if len(poses) < len(triad.poses):
        yield Paragraph(f"The {len(poses)} of {len(triad.poses)} poses that fit least.", "quiet")
