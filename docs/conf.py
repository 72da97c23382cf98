"""Configuration of the documentation: ``python -m sphinx -W -b html docs docs/_build/html``."""

import hashlib
import os
import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [str(ROOT), str(HERE / "_ext"), str(ROOT / "tests" / "stability" / "scenes")]
# The kernels of the notebooks run in separate processes.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))

project = "clsplat"
author = "the clsplat authors"
copyright = "the clsplat authors; Apache License 2.0"

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "numpydoc",
    "myst_nb",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "matplotlib.sphinxext.plot_directive",
    "from_package",
]
exclude_patterns = ["_build"]
default_role = "py:obj"
smartquotes_action = "qe"  # no dashes: options begin with two hyphens


def package_digest():
    """Digest of the files that a notebook's outputs depend on, besides its own cells."""
    digest = hashlib.sha256()
    for path in sorted([*ROOT.glob("clsplat/**/*.py"), *ROOT.glob("cl/*"), *ROOT.glob("docs/results/*")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


# A notebook is executed if it or the package has changed. Its outputs are stored in _build only.
nb_execution_mode = "cache"
nb_execution_cache_path = str(HERE / "_build" / "notebooks" / package_digest())
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True
# stderr has progress bars and the number of a driver's warnings about a kernel.
nb_output_stderr = "remove"

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

# Vector graphics on a white background are readable with the dark theme, too.
plot_formats = ["svg"]
plot_html_show_formats = False
plot_html_show_source_link = False
plot_rcparams = {"figure.facecolor": "white", "font.size": 10, "svg.fonttype": "path"}
plot_apply_rcparams = True


def escape_bars(app, what, name, obj, options, lines):
    """Escape bars in docstrings: |x| is a magnitude there, not a substitution of reStructuredText."""
    for i, line in enumerate(lines):
        parts = re.split(r"(`+.+?`+)", line)
        lines[i] = "".join(p if k % 2 else p.replace("|", r"\|") for k, p in enumerate(parts))


def copy_notebooks():
    """Copy the notebooks to docs/, where Sphinx finds them, and adapt their links to pages of docs/."""
    (HERE / "notebooks").mkdir(exist_ok=True)
    names = {path.name for path in ROOT.glob("notebooks/*.ipynb")}
    for path in HERE.glob("notebooks/*.ipynb"):
        if path.name not in names:
            path.unlink()
    for name in names:
        text = (ROOT / "notebooks" / name).read_text().replace("](../docs/", "](../")
        copy = HERE / "notebooks" / name
        if not copy.exists() or copy.read_text() != text:
            copy.write_text(text)


def setup(app):
    copy_notebooks()
    app.connect("autodoc-process-docstring", escape_bars)
