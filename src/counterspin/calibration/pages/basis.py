"""The method of a result, as a report states it: equations as used, and how to do it again."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Iterator
from typing import Final

from counterspin.calibration.options import TwoStageOptions, acceptance_words, command_words
from counterspin.calibration.pages.motions import poses_of, reading_blocks, readings_of
from counterspin.calibration.result import Result
from counterspin.campaign.documents import DESCRIPTION_NAME
from counterspin.physics.effects import Product
from counterspin.physics.terms import MOTION_TERMS, PLATFORM_TERMS, TERMS, Term
from counterspin.reports.blocks import Block, Column, Heading, Paragraph, Table
from counterspin.reports.numbers import format_number

_OBSERVED: Final = {
    "displacement": "S(t) = S₀ + V₀ t + ∬ (g a_ind − a_h) dt dt",
    "velocity": "V(t) = V₀ + ∫ (g a_ind − a_h) dt",
    "specific_force": "f(t) = g a_ind",
}


def model_blocks(result: Result) -> Iterator[Block]:
    """Yield the equations of the fit with the terms that it had."""
    yield Heading("Model")
    yield Paragraph(
        "Indication of an accelerometer in g, with the specific force a along its "
        "input, pendulous and output axes I, P and O:"
    )
    for name, accelerometer in result.accelerometers.items():
        # A term without a value was not in the fit.
        known = {**accelerometer.known, **accelerometer.coefficients}
        symbols = {symbol for symbol, c in known.items() if c.value is not None}
        used = [TERMS[symbol] for symbol in TERMS if symbol in symbols]
        yield Paragraph(f"{name}: a_ind = {_sum(used)}", "equation")
    platform = dict.fromkeys(
        [*result.platform, *(symbol for run in result.runs.values() for symbol in run.terms)]
    )
    if turns := [symbol for symbol in platform if symbol in PLATFORM_TERMS]:
        yield Paragraph(
            "The small attitude error ψ of the platform turns the sensed force to f − ψ × f; it is "
            "ψ = tilt + ∫ (drift + D f/g + E |f|²/g²) dt + C f/g. Taken into account: "
            f"{_list(turns)}."
        )
    if paths := [symbol for symbol in platform if symbol in MOTION_TERMS]:
        yield Paragraph(
            "Errors of the path, which displace the platform from the position given by radius "
            "and recorded angle: "
            f"{_list(paths)}."
        )
    yield from reading_blocks(result)
    if result.runs or not (readings_of(result) or poses_of(result)):
        yield from _recorded(result)
    yield Paragraph(_method(result))


def _recorded(result: Result) -> Iterator[Block]:
    """Yield what records of a double turntable were taken to be."""
    observables = {
        accelerometer.observable or "displacement"
        for accelerometer in result.accelerometers.values()
    }
    yield Paragraph(
        "The recorded signal, where a_h is the harmful acceleration (gravity, Coriolis and "
        "centrifugal) that the system subtracts; fitted along the motion of the spindle:"
    )
    for observable in sorted(observables):
        yield Paragraph(_OBSERVED[observable], "equation")
    yield Paragraph(
        "θ(t) = θ₀ + ω (t + C t²/2) + ripple by harmonics of the revolution", "equation"
    )


def _method(result: Result) -> str:
    if result.model == "as-printed":
        return (
            "The observation model is the paper's as printed, which returns half the true "
            "K_II; it is for comparison only."
        )
    if result.method == "two-stage":
        return (
            "Two stages, as in the paper: a parabola through one sample a revolution where the "
            "reference displacement is zero, then its curvature against the rate."
        )
    readings = ["all readings of all test methods"] if readings_of(result) else []
    poses = ["all poses (two unknown angles each)"] if poses_of(result) else []
    if readings or poses:
        records = ["all samples of the records"] if result.runs else []
        every = " and ".join([*records, *readings, *poses])
        return (
            f"{every[:1].upper()}{every[1:]} in one weighted least-squares fit, with prior "
            f"knowledge as further observations; quantities that are held and not estimated "
            f"contribute "
            "to u by their sensitivity."
        )
    return (
        "All samples of all runs and accelerometers in one weighted least-squares fit, with "
        "prior knowledge as further observations; quantities that are held and not estimated "
        "contribute to "
        "u by their sensitivity. Each run has a start offset and a start velocity of its own."
    )


def _sum(terms: Iterable[Term[Product]]) -> str:
    parts = []
    for term in terms:
        product = term.effect.text.replace("*", " ")
        sign = "−" if term.effect.sign < 0.0 else "+"
        parts.append(f"{sign} {term.symbol}" + ("" if product == "1" else f" {product}"))
    return " ".join(parts).removeprefix("+ ")


def _list(words: Iterable[str]) -> str:
    return ", ".join(words)


def origin_blocks(result: Result) -> Iterator[Block]:
    """Yield what the result was made from and how to make it again."""
    yield Heading("Inputs and reproduction")
    inputs = result.inputs
    latitude = format_number(math.degrees(inputs.latitude), 8)
    radius = f", radius {inputs.radius:.10g} m" if inputs.radius else ""
    yield Paragraph(
        f"Gravity {format_number(inputs.gravity, 9)} m/s^2, latitude {latitude} deg{radius}."
    )
    yield Table(
        columns=(Column("File"), Column("SHA-256")),
        rows=tuple(
            (file, checksum.removeprefix("sha256:")) for file, checksum in result.provenance.shown
        ),
    )
    made = f"Made by counterspin {result.provenance.version}."
    if result.provenance.in_memory:
        those = "; ".join(f"{name} ({how})" for name, how in result.provenance.in_memory.items())
        yield Paragraph(
            f"{made} Not from files: {those}. Therefore no command line gives the same "
            "result; `Campaign.write` writes a folder from which one does."
        )
        return
    yield Paragraph(f"{made} In the folder that holds these files, the same result comes from")
    options = list(result.provenance.options)
    asked = command_words(result.method, TwoStageOptions())
    # Once the two-stage method was the default, and did not have to be asked for.
    options = [*(word for word in asked if word not in options), *options]
    options += acceptance_words(result.accepted_misfit)
    description = next(iter(result.provenance.inputs), DESCRIPTION_NAME)
    where = "." if description == DESCRIPTION_NAME else description
    yield Paragraph(shlex.join(("counterspin", "calibrate", where, *options)), "command")
