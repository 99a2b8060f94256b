"""Sphinx configuration; build with ``python -m sphinx -W -b html docs docs/_build/html``."""

from eip_scipy import __version__

project = "eip_scipy"
author = "The eip_scipy developers"
copyright = "2026, The eip_scipy developers"
release = __version__
version = release

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
]
templates_path = ["_templates"]
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 3

autosummary_generate = True
autosummary_imported_members = False
autodoc_typehints = "none"  # the docstrings give the types
numpydoc_show_class_members = False  # the templates list them

html_theme = "furo"
html_title = f"eip_scipy {release}"
html_theme_options = {"navigation_with_keys": True}
