"""Sphinx: MyST pages beside generated ones; warnings are errors (``make docs``)."""

from importlib.metadata import version as _version

project = "pbonet"
author = "the pbonet founders"
release = _version("pbonet")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
autodoc_typehints = "description"
