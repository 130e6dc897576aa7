"""Sphinx: MyST pages beside generated ones; warnings are errors (``make docs``)."""

import sys as _sys
from importlib.metadata import version as _version
from pathlib import Path as _Path

_sys.path.insert(0, str(_Path(__file__).parent))
from figures import draw as _draw
from sphinx.application import Sphinx as _Sphinx
from sphinx.environment import BuildEnvironment as _Environment

_draw(_Path(__file__).parent / "_generated")

project = "pbonet"
author = "the pbonet founders"
release = _version("pbonet")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence", "dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
autodoc_typehints = "description"


def _leave_out(_: _Sphinx, env: _Environment) -> list[str]:
    """Keep decisions out of the navigation; pages link to single ones."""
    for page in env.found_docs:
        if page.startswith("decisions/"):
            env.metadata[page]["orphan"] = True
    return []


def setup(app: _Sphinx) -> None:
    """Connect the function above to Sphinx."""
    app.connect("env-updated", _leave_out)
