"""The full report of a result, for paper and screen: the answer first, then what it rests on."""

from __future__ import annotations

from collections.abc import Iterator

from counterspin.calibration.findings import judge_result
from counterspin.calibration.pages.accelerometer import accelerometer_blocks, budget_blocks
from counterspin.calibration.pages.basis import model_blocks, origin_blocks
from counterspin.calibration.pages.conformity import conformity_blocks
from counterspin.calibration.pages.pictures import (
    budget_bars,
    correlation_map,
    jackknife_plot,
    residual_plots,
    ripple_plot,
)
from counterspin.calibration.pages.pose_pictures import pose_pictures
from counterspin.calibration.pages.sections import answer_blocks, platform_blocks, run_blocks
from counterspin.calibration.pages.triad import triad_blocks
from counterspin.calibration.pages.uncertainty import knowledge_blocks
from counterspin.calibration.pages.verdict import verdict_tables
from counterspin.calibration.result import Result
from counterspin.calibration.result_parts import AccelerometerResult
from counterspin.reports.blocks import Block, Heading, Picture
from counterspin.reports.typography import typeset_block


def document(result: Result) -> list[Block]:
    """Return the full report of a result."""
    result = judge_result(result)
    blocks = (
        *answer_blocks(result, in_g=True),
        Heading("Is it good?"),
        *verdict_tables(result),
        *conformity_blocks(result),
        *_chapters(result),
        *triad_blocks(result, details=True),
        *pose_pictures(result),
        *platform_blocks(result),
        *knowledge_blocks(result),
        *run_blocks(result.runs, details=True),
        *_drawn(ripple_plot(result.runs)),
        *model_blocks(result),
    )
    # Names of files and checksums are left as they are.
    heading, inputs, *origin = origin_blocks(result)
    return [*map(typeset_block, (*blocks, heading, inputs)), *origin]


def _chapters(result: Result) -> Iterator[Block]:
    for name, accelerometer in result.accelerometers.items():
        yield from accelerometer_blocks(name, accelerometer, result.inputs.gravity, details=True)
        yield from _drawn(jackknife_plot(name, accelerometer), correlation_map(name, accelerometer))
        yield from _budget(name, accelerometer)
        plots = list(residual_plots(name, accelerometer, result.runs))
        if plots:
            yield Heading(f"Residuals of {name}", 3)
            yield from plots


def _budget(name: str, accelerometer: AccelerometerResult) -> Iterator[Block]:
    yield from _drawn(budget_bars(name, accelerometer))
    yield from budget_blocks(name, accelerometer)


def _drawn(*pictures: Picture | None) -> Iterator[Picture]:
    yield from (picture for picture in pictures if picture is not None)
