"""Blocks of every type, and pages made from them, for tests of the HTML report."""

import math
import random
from datetime import UTC, datetime

from counterspin.reports.blocks import (
    Bars,
    Column,
    Heading,
    HeatMap,
    Paragraph,
    Plot,
    PlotSeries,
    Sphere,
    Table,
)
from counterspin.reports.html import render_html

NASTY = "</script ></style><script >alert('1')</script>\"&<!--"


def make_residual_plot(title="Residuals of Qx, run 1", label="smallest to largest", count=1500):
    """Return a residual plot of a run: a band with a gap, outliers and a line."""
    rng = random.Random(3)
    time = tuple(0.5 * index for index in range(count))
    high = [5.0 + rng.random() for _ in time]
    low = [-5.0 - rng.random() for _ in time]
    for index in range(count // 3, count // 3 + 20):
        high[index] = low[index] = None
    middle = tuple(None if a is None else 0.5 * (a + b) for a, b in zip(low, high, strict=True))
    sparse_time = time[::50]
    return Plot(
        title,
        "time, s",
        "residual, mm",
        (
            PlotSeries(label, time, middle, tuple(low), tuple(high), kind="band"),
            PlotSeries("mean", sparse_time, tuple(math.sin(0.02 * t) for t in sparse_time)),
            PlotSeries(
                "left out",
                (10.25, 10.25, 600.0),
                (12.0, -13.0, 4000.0),
                kind="points",
                is_highlighted=True,
            ),
        ),
        levels=(0.0,),
        zoom=True,
    )


def make_blocks(name="Qx"):
    """Return a report with every type of block; `name` fills every text of the user."""
    spectrum = Plot("Spectrum", "Hz", name, (PlotSeries(name, (1.0, 2.0), (3.0, 4.0)),), log_x=True)
    return [
        Heading(f"Calibration of {name}", 1),
        Paragraph(
            f"K_II of {name} = 27.04 ± 0.11 ug/g^2 = 2.7e-5 g/g^2   (95 %: a to b)", "answer"
        ),
        Paragraph(f"Warning: {name} is odd", "warning"),
        Paragraph("Joint method.", "quiet"),
        Heading("Quality checks"),
        Paragraph(f"The result for {name} passed all checks."),
        Heading(f"Accelerometer {name}"),
        Table(
            (Column("Symbol"), Column("Words", wraps=True), Column("Value", "right")),
            (("K_F", name, "1.25"), ("K_I", "scale", "-10.5"), ("K_II", "two\nlines", "3")),
            quiet_rows=frozenset({1}),
        ),
        Heading("Uncertainty budget", 3),
        Bars(f"Budget {name}", (name, "b"), (2.0, 1.0), ("2 (67 %)", "1 (33 %)")),
        HeatMap(f"Correlation {name}", (name, "b"), ((1.0, -0.5), (-0.5, 1.0))),
        Sphere(
            f"Poses of {name}",
            (name, "b", "c"),
            ((0.0, 0.6, 0.8), (0.6, 0.0, -0.8)),
            (1.0, -0.5),
            (name, "2"),
            name,
            frozenset({1}),
        ),
        spectrum,
        make_residual_plot(f"Residuals of {name}", label=name),
        make_residual_plot(f"Residuals of {name}", label=name, count=1400),
        Heading("Model"),
        Paragraph("a_ind = K_F + K_II a_I² + platform.g_sensitivity.zx", "equation"),
        Paragraph(f"counterspin calibrate {name}", "command"),
    ]


def render_page(name="Qx", page_blocks=None, **changes):
    """Return a page of the blocks."""
    metadata = {
        "title": f"Calibration of {name}",
        "identifier": f"LAB 7/26 {name}",
        "date": datetime(2026, 3, 1, tzinfo=UTC),
        "version": "1.2.3",
    }
    return render_html(
        make_blocks(name) if page_blocks is None else page_blocks, **metadata | changes
    )
