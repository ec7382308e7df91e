"""Sphinx configuration."""

from factorgraph_loc import __version__

project = "factorgraph-loc"
author = "The factorgraph-loc authors"
release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"factorgraph-loc {release}"
html_static_path = ["static"]
html_css_files = ["tables.css"]
exclude_patterns = ["_build"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_mock_imports = ["rerun"]  # optional


def _keep_bars(_app, _what, _name, _obj, _options, lines):
    """Docstrings write ``|x|`` for a magnitude; Sphinx would take it for a substitution."""
    lines[:] = [line.replace("|", r"\|") for line in lines]


def setup(app):
    app.connect("autodoc-process-docstring", _keep_bars)
