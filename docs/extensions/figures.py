"""Style the figures of the gallery: vector graphics in the colours and sizes of the reports.

The kernels read the settings from an IPython profile in the build folder, so that no gallery page
has to repeat them.
"""

import json
import os
from pathlib import Path

from sphinx.application import Sphinx

from counterspin.reports.drawing import COLOURS

_PLOT_SETTINGS = {
    "figure.figsize": (7.0, 3.2),
    "figure.constrained_layout.use": True,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e3e6e9",
    "legend.frameon": False,
    "font.size": 10.0,
    "svg.hashsalt": "counterspin",
}


def _write_ipython_profile(app: Sphinx) -> None:
    """Write the IPython profile and point the kernels to it."""
    folder = Path(app.doctreedir) / "ipython"
    profile = folder / "profile_default"
    profile.mkdir(parents=True, exist_ok=True)
    (profile / "ipython_kernel_config.py").write_text(
        "import json\n"
        "from cycler import cycler\n"
        "c = get_config()\n"
        'c.InlineBackend.figure_formats = {"svg"}\n'
        "c.HistoryManager.enabled = False\n"
        "c.IPKernelApp.log_level = 40\n"
        f"c.InlineBackend.rc = json.loads({json.dumps(_PLOT_SETTINGS)!r})\n"
        f'c.InlineBackend.rc["axes.prop_cycle"] = cycler(color={list(COLOURS)!r})\n',
        encoding="utf-8",
    )
    os.environ["IPYTHONDIR"] = str(folder)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the extension to Sphinx."""
    app.connect("builder-inited", _write_ipython_profile)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
