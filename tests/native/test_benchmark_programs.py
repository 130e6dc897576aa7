"""The benchmarks' C programs compile against the headers of the native parts."""

from pathlib import Path

import pytest

from benchmarks import cmodules, faults, rtbench

LIBRARIES = {"between_waits", "wall_clock"}
SOURCES = Path(rtbench.__file__).parent.glob("*.c")
PROGRAMS = sorted(one for one in SOURCES if one.stem not in LIBRARIES)


@pytest.mark.parametrize("source", PROGRAMS, ids=[one.stem for one in PROGRAMS])
def test_a_program_of_the_benchmarks_compiles(source, tmp_path):
    assert rtbench.compile_c(source.stem, tmp_path).exists()


def test_the_library_that_sets_wall_clocks_compiles(tmp_path):
    assert faults.build_wall_clock(tmp_path).exists()


def test_the_library_that_reads_the_clock_between_waits_compiles(tmp_path):
    assert Path(cmodules.waits_library(tmp_path)).exists()
