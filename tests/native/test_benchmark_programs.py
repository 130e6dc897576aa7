"""The benchmarks' C programs compile against the headers of the native parts."""

from pathlib import Path

import pytest

from benchmarks import faults, rtbench

LIBRARY = "wall_clock"
PROGRAMS = sorted(
    one for one in Path(rtbench.__file__).parent.glob("*.c") if one.stem != LIBRARY
)


@pytest.mark.parametrize("source", PROGRAMS, ids=[one.stem for one in PROGRAMS])
def test_a_program_of_the_benchmarks_compiles(source, tmp_path):
    assert rtbench.compile_c(source.stem, tmp_path).exists()


def test_the_library_that_sets_wall_clocks_compiles(tmp_path):
    assert faults.build_wall_clock(tmp_path).exists()
