"""Configuration of the documentation: ``python -m sphinx -W -b html docs docs/_build/html``."""

import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_ext")]

project = "clsplat"
author = "the clsplat authors"
copyright = "the clsplat authors; Apache License 2.0"

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "numpydoc",
    "myst_parser",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "matplotlib.sphinxext.plot_directive",
    "from_package",
]
exclude_patterns = ["_build"]
default_role = "py:obj"

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = "clsplat"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_show_sphinx = False

autodoc_typehints = "none"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

# Vector graphics on white paper: readable on the dark theme, too.
plot_formats = ["svg"]
plot_html_show_formats = False
plot_html_show_source_link = False
plot_rcparams = {"figure.facecolor": "white", "font.size": 10, "svg.fonttype": "path"}
plot_apply_rcparams = True


def escape_bars(app, what, name, obj, options, lines):
    """Docstrings are read in the source first, where |x| is a magnitude, not a substitution."""
    for i, line in enumerate(lines):
        parts = re.split(r"(`+.+?`+)", line)
        lines[i] = "".join(p if k % 2 else p.replace("|", r"\|") for k, p in enumerate(parts))


def setup(app):
    app.connect("autodoc-process-docstring", escape_bars)
