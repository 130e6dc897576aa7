"""Sphinx: MyST pages beside generated ones; warnings are errors (``make docs``)."""

import ast as _ast
import sys as _sys
from importlib.metadata import version as _version
from pathlib import Path as _Path

_sys.path.insert(0, str(_Path(__file__).parent))
from figures import draw as _draw
from library_responses import draw as _draw_responses
from sphinx.application import Sphinx as _Sphinx
from sphinx.environment import BuildEnvironment as _Environment

_draw(_Path(__file__).parent / "_generated")
_draw_responses(_Path(__file__).parent / "_generated")

project = "pbonet"
author = "the pbonet founders"
release = _version("pbonet")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
extensions += ["sphinx.ext.viewcode"]
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


def _stubs() -> dict[str, str]:
    """Return the docstrings of native classes, which stand in their stubs."""
    found: dict[str, str] = {}
    for name in ("xm/ipc/_ipc.pyi", "tbuf/_tbuf.pyi"):
        path = _Path(__file__).parents[1] / "pbonet" / name
        for cls in _ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(cls, _ast.ClassDef):
                continue
            found.setdefault(cls.name, _ast.get_docstring(cls) or "")
            for one in cls.body:
                if isinstance(one, _ast.FunctionDef):
                    text = _ast.get_docstring(one) or ""
                    found[f"{cls.name}.{one.name}"] = text
    return found


_STUBS = _stubs()
_BASES = {"Writer": "Out", "Reader": "In"}


def _document(
    _: _Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]
) -> None:
    """Give a native method the docstring of its stub."""
    del what, obj, options
    if any(lines) or not name.startswith(("pbonet.xm.", "pbonet.tbuf.")):
        return
    cls, _dot, member = name.rpartition(".")
    owner = cls.rpartition(".")[2]
    for key in (f"{owner}.{member}", f"{_BASES.get(owner)}.{member}", member):
        if text := _STUBS.get(key):
            lines[:] = [*text.splitlines(), ""]
            return


def setup(app: _Sphinx) -> None:
    """Connect the functions above to Sphinx."""
    app.connect("env-updated", _leave_out)
    app.connect("autodoc-process-docstring", _document, priority=1)
