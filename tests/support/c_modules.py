"""Builds modules in C for tests."""

from __future__ import annotations

import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import pbonet

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "c_pid"
MISBEHAVING = ROOT / "tests" / "misbehaving" / "c"
FLAGS = (
    "-std=gnu11",
    "-O1",
    "-Wall",
    "-Wextra",
    "-ffp-contract=off",
    "-fPIC",
    "-shared",
)


def compile_c(source: Path, into: Path, *options: str) -> Path:
    """Compile a source file into a shared object."""
    command = ["cc", *FLAGS, *options, f"-I{pbonet.get_include()}", "-o", into, source]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr, "the header and its macros make no warning"
    return into


def write_c(folder: Path, name: str, text: str, *options: str) -> Path:
    """Write the source of a module into a folder and build it there."""
    source = folder / f"{name}.c"
    source.write_text(text)
    return compile_c(source, folder / f"{name}.so", *options)


@functools.cache
def misbehaving() -> Path:
    """Build the misbehaving modules in C, once for all tests; return their folder."""
    kept = tempfile.TemporaryDirectory(prefix="pbonet-c-")
    _kept.append(kept)
    for source in MISBEHAVING.glob("*.c"):
        compile_c(source, Path(kept.name) / f"{source.stem}.so", f"-I{MISBEHAVING}")
    return Path(kept.name)


_kept: list[tempfile.TemporaryDirectory[str]] = []


def put_misbehaving(folder: Path) -> None:
    """Copy the misbehaving modules in C into a library."""
    for file in misbehaving().iterdir():
        shutil.copy(file, folder / file.name)
