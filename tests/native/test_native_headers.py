"""Every C header by itself: it compiles alone, knows no Python, names its partners."""

import subprocess
from pathlib import Path

import pytest
from svar_rig import ROOT, compiler

HEADERS = sorted((ROOT / "pbonet").rglob("*.h"))
each = pytest.mark.parametrize(
    "header", HEADERS, ids=lambda header: f"{header.parent.name}-{header.name}"
)


@each
@pytest.mark.parametrize("cc", ["gcc", "clang"])
def test_every_header_compiles_alone(header: Path, cc, tmp_path):
    unit = tmp_path / "unit.c"
    unit.write_text(f'#include "{header.name}"\nint main(void) {{ return 0; }}\n')
    strict = ["-std=c11", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    done = subprocess.run(
        [compiler(cc), *strict, f"-I{header.parent}", "-c", str(unit), "-o", "unit.o"],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr


@each
def test_no_header_knows_python(header: Path):
    assert "Python.h" not in header.read_text()


@each
def test_every_ordered_operation_names_its_partner(header: Path):
    """A SYNC POINT stands within ten lines above it."""
    lines = header.read_text().splitlines()
    for number, line in enumerate(lines):
        code = line.split("/*")[0]
        if "memory_order_acquire" in code or "memory_order_release" in code:
            above = "\n".join(lines[max(0, number - 10) : number + 1])
            assert "SYNC POINT" in above, f"{header.name}:{number + 1}"
