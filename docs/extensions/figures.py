"""How the gallery's figures look: vector graphics in the colours and sizes of the reports.

The settings go to the kernels through a profile of IPython in the build's folder, so that no page
of the gallery has to begin with them.
"""

import json
import os
from pathlib import Path

from sphinx.application import Sphinx

from counterspin.reports.drawing import COLOURS

_STYLE = {
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


def _on_start(app: Sphinx) -> None:
    """Write the profile and have kernels use it."""
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
        f"c.InlineBackend.rc = json.loads({json.dumps(_STYLE)!r})\n"
        f'c.InlineBackend.rc["axes.prop_cycle"] = cycler(color={list(COLOURS)!r})\n',
        encoding="utf-8",
    )
    os.environ["IPYTHONDIR"] = str(folder)


def setup(app: Sphinx) -> dict[str, bool]:
    """Prepare the kernels before the first page is read."""
    app.connect("builder-inited", _on_start)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
