"""Sphinx: how the manual is built. ``make docs`` fails on any warning.

The notebooks, which `docs/notebooks` links to, are stored with their outputs: `make examples`
renews them, and the tests of `make docs` run them. The gallery is run at each build.
"""

from __future__ import annotations

import sys
from pathlib import Path

import dahl_ident

sys.path.insert(0, str(Path(__file__).parent / "extensions"))

project = "dahl_ident"
author = "The dahl_ident developers"
release = version = dahl_ident.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "numpydoc",
    "offline",
    "commands",
    "thumbnails",
]
exclude_patterns = ["_build", "extensions"]
nitpicky = True
nitpick_ignore_regex = [
    ("py:mod", r"dahl_ident\..*"),  # rooms inside, which the reference leaves to their source
    ("py:class", r"integer -- .*"),  # from the docstrings of tuple itself
]

myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 2
nb_execution_mode = "force"
nb_execution_excludepatterns = ["*.ipynb"]
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_execution_timeout = 120
nb_output_stderr = "error"
nb_merge_streams = True

html_math_renderer = "mathml"
html_theme = "pydata_sphinx_theme"
html_title = "dahl_ident"
html_show_sourcelink = False
html_theme_options = {"header_links_before_dropdown": 7}
smartquotes_action = "qe"  # two hyphens begin an option
html_static_path = ["_static"]
html_css_files = ["manual.css"]
# pages without others below them have nothing to list on the left
html_sidebars = {
    page: []
    for page in (
        "theory",
        "benchmarks",
        "changelog",
        "contributing",
        "install",
        "quick_start",
        "cheat_sheet",
        "command_line",
        "gallery",
        "glossary",
    )
}

autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
numpydoc_validation_checks: set[str] = set()
