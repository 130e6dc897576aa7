"""The benchmarks' C programs compile against the headers of the native parts."""

from pathlib import Path

import pytest

from benchmarks import rtbench

PROGRAMS = sorted(Path(rtbench.__file__).parent.glob("*.c"))


@pytest.mark.parametrize("source", PROGRAMS, ids=[one.stem for one in PROGRAMS])
def test_a_program_of_the_benchmarks_compiles(source, tmp_path):
    assert rtbench.compile_c(source.stem, tmp_path).exists()
