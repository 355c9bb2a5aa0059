"""Sphinx configuration: `make docs` builds the site in build/site.

The pages are the Markdown files in this folder, which remain readable without Sphinx.
`extensions/` adds generated content. The site loads nothing from other hosts.
"""

import os
import sys
from pathlib import Path

from counterspin import __version__

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

from published_schemas import write_schemas

# Notebook kernels inherit these variables.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("SOURCE_DATE_EPOCH", "1772323200")

project = "counterspin"
author = "The counterspin developers"
copyright = "The counterspin developers, MIT licence"
version = release = __version__
language = "en"

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "numpydoc",
    "myst_nb",
    # Ours, in extensions/.
    "mathml",
    "navigation",
    "reference",
    "figures",
]

root_doc = "index"
nitpicky = True
suppress_warnings = ["config.cache"]

# Pages: heading anchors as on a Git host.
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 4
myst_links_external_new_tab = False

# Gallery: each page runs in a new kernel; an error fails the build.
nb_execution_mode = "auto"
nb_execution_timeout = 600  # on a busy machine
nb_execution_raise_on_error = True
nb_merge_streams = True

# Reference of the Python interface.
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
autodoc_type_aliases = {
    "Array": "numpy.ndarray",
    "ArrayLike": "numpy.typing.ArrayLike",
    "npt.ArrayLike": "numpy.typing.ArrayLike",
}
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

# Documentation of other packages. The inventories are stored here: nothing is downloaded.
_EXTERNAL_DOCS = {
    "python": "https://docs.python.org/3/",
    "numpy": "https://numpy.org/doc/stable/",
    "polars": "https://docs.pola.rs/api/python/stable/reference/",
    "rich": "https://rich.readthedocs.io/en/stable/",
}
_INVENTORIES = Path(__file__).parent / "inventories"
intersphinx_mapping = {
    name: (address, str(_INVENTORIES / f"{name}.txt")) for name, address in _EXTERNAL_DOCS.items()
}

html_theme = "furo"
html_title = f"counterspin {version}"
html_static_path = ["theme"]
html_extra_path = [str(write_schemas())]  # schemas/*.json
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sourcelink = False
html_show_search_summary = False  # unavailable for file:// pages
html_theme_options = {"navigation_with_keys": True}
pygments_style = "a11y-high-contrast-light"
pygments_dark_style = "a11y-high-contrast-dark"
