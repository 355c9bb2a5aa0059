"""Plots on Matplotlib axes in notebooks."""

import os
import subprocess
import sys

#: The backend of ipykernel, loaded with the first figure; it shows the figures made afterwards.
BACKEND = """
import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg as FigureCanvas
from matplotlib.backends.backend_agg import FigureManagerBase
from matplotlib.figure import Figure

shown = []


def new_figure_manager_given_figure(num, figure):
    if matplotlib.is_interactive():
        shown.append(num)
    return FigureManagerBase(FigureCanvas(figure), num)


def new_figure_manager(num, *args, FigureClass=Figure, **more):
    return new_figure_manager_given_figure(num, FigureClass(*args, **more))


matplotlib.interactive(True)
matplotlib.rcParams["figure.dpi"] = 72.5
"""

CELLS = """
import sys
from counterspin.reports.blocks import Plot, PlotSeries
from counterspin.reports.drawing import PAPER_COLOURS
from counterspin.reports.publication import draw_on_axes

plot = Plot("A plot", "x", "y", (PlotSeries("", (0.0, 1.0), (0.0, 1.0)),))
assert "matplotlib" not in sys.modules
first = draw_on_axes([plot])
second = draw_on_axes([plot, plot])
import matplotlib as mpl
import matplotlib.pyplot as plt
import standing_in
from matplotlib.colors import to_hex

assert mpl.get_backend() == "module://standing_in"
assert (len(first), len(second)) == (1, 2)
assert to_hex(second[0].figure.get_facecolor()) == PAPER_COLOURS["ground"]
plt.figure()
assert standing_in.shown == [1, 2, 3], standing_in.shown
assert mpl.rcParams["figure.dpi"] == 72.5
assert mpl.rcParams["axes.spines.top"]
"""


def test_notebook_shows_figures_and_keeps_settings(tmp_path):
    (tmp_path / "standing_in.py").write_text(BACKEND)
    environment = {**os.environ, "MPLBACKEND": "module://standing_in", "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", CELLS], env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_pyplot_is_not_imported_for_given_axes():
    cells = CELLS.partition("first =")[0] + (
        "from matplotlib.figure import Figure\n"
        "draw_on_axes([plot], Figure().add_subplot())\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", cells], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
