"""What mypy and pyright make of a module, without any plugin."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
FILE = HERE / "reveal_ports.py"
ROOT = HERE.parents[1]
BIN = Path(sys.executable).parent

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def mypy():
    """Return revealed types by line, and the lines with errors."""
    command = [BIN / "mypy", "--strict", "--config-file", ROOT / "pyproject.toml"]
    done = subprocess.run(
        [*command, FILE.name],
        cwd=HERE,
        capture_output=True,
        text=True,
        check=False,
        env={"MYPYPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
    )
    assert done.returncode in {0, 1}, done.stderr + done.stdout
    lines = re.findall(rf"^{FILE.name}:(\d+): (\w+): (.*)$", done.stdout, re.MULTILINE)
    return sort_out(
        (int(line), kind == "error", text.replace("Revealed type is ", ""))
        for line, kind, text in lines
    )


def pyright(tmp_path):
    """Return revealed types by line, and the lines with errors."""
    config = tmp_path / "pyrightconfig.json"
    (tmp_path / FILE.name).write_text(FILE.read_text())
    settings = {
        "include": [FILE.name],
        "extraPaths": [str(ROOT)],
        "typeCheckingMode": "strict",
        "pythonVersion": "3.11",
        "reportUnusedExpression": False,
    }
    config.write_text(json.dumps(settings))
    done = subprocess.run(
        [BIN / "pyright", "--outputjson", "--pythonpath", sys.executable, "-p", config],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in {0, 1}, done.stderr + done.stdout
    return sort_out(
        (
            one["range"]["start"]["line"] + 1,
            one["severity"] == "error",
            re.sub(r'^Type of ".*?" is ', "", one["message"]),
        )
        for one in json.loads(done.stdout)["generalDiagnostics"]
    )


def sort_out(messages):
    types, errors = {}, set()
    for line, is_error, text in messages:
        if is_error:
            errors.add(line)
        elif text.startswith('"'):
            types[line] = text.strip('"')
    return types, errors


def expectations(checker):
    """Return what the comments of the file say."""
    types, errors = {}, set()
    for number, line in enumerate(FILE.read_text().splitlines(), 1):
        code, _, comment = line.partition("  # ")
        if "reveal_type(" in code:
            types[number] = comment
        if comment in {"error", f"error: {checker}"}:
            errors.add(number)
    return types, errors


def compare(checker, types, errors):
    wanted, refused = expectations(checker)
    assert errors == refused
    assert types.keys() == wanted.keys()
    for line, answer in types.items():
        want = wanted[line]
        if want.startswith("= "):
            assert answer == want[2:], f"line {line}"
        else:
            parts = want.split(" & ")
            assert all(part in answer for part in parts), f"line {line}: {answer}"


def test_mypy_sees_ports_and_parameters():
    compare("mypy", *mypy())


def test_pyright_sees_ports_and_parameters(tmp_path):
    compare("pyright", *pyright(tmp_path))
