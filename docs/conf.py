"""Sphinx configuration; build with ``python -m sphinx -W -b html docs docs/_build/html``.

Neither the build nor the pages ask the network for anything: formulas become MathML, names of other projects are looked
up in ``_inventories``, and the theme's fonts are the reader's.
"""

import re
import shutil
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes

from eip_scipy import __version__

project = "eip_scipy"
author = "The eip_scipy developers"
copyright = "2026, The eip_scipy developers"
release = __version__
version = release

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx_design",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "_inventories"]

myst_enable_extensions = ["amsmath", "colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # .ci/notebooks executed them
nb_merge_streams = True
nb_output_stderr = "remove"  # progress bars

autosummary_generate = True
autosummary_imported_members = False
autodoc_typehints = "none"  # the docstrings give the types
numpydoc_show_class_members = False  # the templates list them
default_role = "py:obj"
intersphinx_mapping = {
    "numpy": ("https://numpy.org/doc/stable/", "_inventories/numpy.txt"),
    "scipy": ("https://docs.scipy.org/doc/scipy/", "_inventories/scipy.txt"),
}

smartquotes = False  # options have two hyphens
html_domain_indices = False
html_theme = "furo"
html_title = f"eip_scipy {release}"
html_theme_options = {"navigation_with_keys": True}
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_math_renderer = "mathml"


# docutils reads \frac12 as 12 over what follows, and draws the index of an accented letter below it; Chromium draws the
# sign of a root too low.
MISDRAWN = re.compile(r"\\[td]?frac\s*\d\d|\\(?:bar|d?dot|hat|tilde|vec)\s*\{?\\?\w+\}?_|\\sqrt")


def mathml(text, **options):
    """Return a formula as MathML; refuse what would be drawn wrong."""
    if found := MISDRAWN.search(text):
        raise ValueError(f"{found[0]} in {text!r}: write \\frac{{1}}{{2}}, \\hat y^{{}}_k and x^{{1/2}}")
    return tex2mathml(text, **options)


def inline_formula(writer, node):
    """A formula within a line."""
    writer.body.append(mathml(node.astext()))
    raise nodes.SkipNode


def formula(writer, node):
    """A formula of its own, which scrolls where the page is narrow."""
    writer.body.append(f'<div class="math">{mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def without_single_names(app, env):
    """End the sidebar at the page of reference: a hundred more names on each page took 0.33 of the build time."""
    for entry in list(env.tocs["reference/index"].findall(addnodes.toctree)):
        if any("generated" in page for page in entry["includefiles"]):
            entry.parent.remove(entry)


def show_notebooks():
    """Copy the executed notebooks of examples/ to where Sphinx finds them, and remove older copies."""
    shown = Path(__file__).parent / "notebooks"
    shown.mkdir(exist_ok=True)
    for page in shown.glob("*.ipynb"):
        page.unlink()
    for source in (shown.parents[1] / "examples").glob("*.ipynb"):
        shutil.copy(source, shown)


def keep_short_cells_whole(app, doctree):
    """Numbers such as 1e-8 in tables are not broken at their hyphens: narrow pages scroll the table."""
    for cell in doctree.findall(nodes.entry):
        words_of_a_head = isinstance(cell.parent.parent, nodes.thead) and " " in cell.astext()
        if len(cell.astext()) <= 14 and not words_of_a_head:
            cell["classes"].append("short")


def setup(app):
    """Sphinx calls it."""
    show_notebooks()
    app.connect("env-updated", without_single_names)
    app.connect("doctree-read", keep_short_cells_whole)
    app.add_html_math_renderer("mathml", (inline_formula, None), (formula, None))
