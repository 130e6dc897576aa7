"""pyproject.toml declares the packages that pbonet imports, and no others."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[3]
IMPORTED_AS = {
    "eclipse-zenoh": {"zenoh"},
    "pin": {"pinocchio"},
    "pyserial": {"serial"},
    "python-can": {"can"},
    "foxglove-sdk": {"foxglove"},
    "prometheus-client": {"prometheus_client"},
    "opentelemetry-sdk": {"opentelemetry"},
    "opentelemetry-exporter-otlp-proto-http": {"opentelemetry"},
    "warp-lang": {"warp"},
}
"""Names in import statements, where they are not the package's own."""


def _imports(node: ast.AST) -> Iterator[str]:
    """Yield the modules that code imports when it runs."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            for other in child.orelse:
                yield from _imports(other)
        elif isinstance(child, ast.Import):
            yield from (one.name for one in child.names)
        elif isinstance(child, ast.ImportFrom) and not child.level:
            yield child.module or ""
        elif (
            isinstance(child, ast.Call)
            and ast.unparse(child.func).endswith("import_module")
            and isinstance(child.args[0], ast.Constant)
        ):
            yield child.args[0].value
        else:
            yield from _imports(child)
        if isinstance(child, ast.Call):
            yield from (name for arg in child.args for name in _imports(arg))


def _declared(requirements: list[str]) -> set[str]:
    names = {re.match(r"[\w.-]+", text)[0] for text in requirements}
    return {name for dist in names for name in IMPORTED_AS.get(dist, {dist})}


def test_what_is_imported_is_declared_and_nothing_else_is() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [one for some in project["optional-dependencies"].values() for one in some]
    found = {
        name.partition(".")[0]
        for path in (ROOT / "pbonet").rglob("*.py")
        for name in _imports(ast.parse(path.read_text()))
    }
    foreign = found - set(sys.stdlib_module_names) - {"pbonet"}
    foreign.discard("torch")  # a back end that its user installs, for the own device
    foreign.discard("pytest")  # pbonet.testing.fixtures is a plugin of a running pytest
    assert foreign == _declared([*project["dependencies"], *extras])


def test_the_demo_installs_what_it_imports_and_nothing_else() -> None:
    """`make demo` installs packages by their names, while the native parts compile."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    script = [sys.executable, ROOT / "scripts" / "requirements.py", "robot", "plot"]
    done = subprocess.run(script, check=True, capture_output=True, text=True)
    extras = project["optional-dependencies"]
    needed = [*project["dependencies"], *extras["robot"], *extras["plot"]]
    assert done.stdout.splitlines() == needed


def test_native_parts_are_built_by_what_pip_and_make_install() -> None:
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]
    makefile = (ROOT / "Makefile").read_text()
    (tools,) = re.findall(r"venv \$\(VENV\)\n\t\$\(PIP\) (.*)", makefile)
    assert [one.strip('"') for one in tools.split()] == build["requires"]
