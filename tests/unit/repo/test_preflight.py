"""What a fresh machine is told before anything is installed."""

from __future__ import annotations

import importlib.util
import sysconfig
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / "scripts" / "preflight.py"
FAKE = "#!/bin/sh\necho 'stdlib.h: No such file or directory' >&2\nexit 1\n"


@pytest.fixture
def preflight(monkeypatch):
    """The script, on a machine that has what is needed."""
    spec = importlib.util.spec_from_file_location("preflight", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "has_venv", lambda: True)
    monkeypatch.setattr(module, "has_headers", lambda: True)
    monkeypatch.setattr(module, "compiles", lambda _: True)
    return module


def test_machine_with_everything_passes_in_silence(preflight, capsys):
    assert preflight.main() == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("part", "remedy"),
    [
        ("has_venv", "apt-get install python3-venv"),
        ("has_headers", "apt-get install python3-dev"),
    ],
)
def test_missing_part_of_python_is_named(preflight, monkeypatch, capsys, part, remedy):
    monkeypatch.setattr(preflight, part, lambda: False)
    assert preflight.main() == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("pbonet: ")
    assert line.endswith(remedy)


def test_older_python_is_refused_with_the_way_to_give_another(
    preflight, monkeypatch, capsys
):
    monkeypatch.setattr(preflight, "OLDEST", (99, 0))
    assert preflight.main() == 1
    assert "make with PYTHON=" in capsys.readouterr().err


def test_missing_compiler_is_named(preflight, monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert preflight.main() == 1
    assert "apt-get install gcc libc6-dev" in capsys.readouterr().err


def test_compiler_without_headers_is_found(monkeypatch, preflight, capsys, tmp_path):
    monkeypatch.undo()
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setenv("CC", "mycc -pthread")
    (tmp_path / "mycc").write_text(FAKE)
    (tmp_path / "mycc").chmod(0o700)
    preflight.main()
    assert "apt-get install libc6-dev" in capsys.readouterr().err


def test_names_of_headers_and_venv_are_looked_for_where_they_are(
    preflight, monkeypatch, tmp_path
):
    monkeypatch.undo()
    assert preflight.has_headers()
    monkeypatch.setattr(sysconfig, "get_path", lambda _: str(tmp_path))
    assert not preflight.has_headers()
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert not preflight.has_venv()
