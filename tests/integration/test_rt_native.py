"""The C headers by themselves: they compile alone, and the sanitizers find nothing."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NODE = ROOT / "pbonet" / "node"
HEADERS = sorted(path.name for path in NODE.glob("*.h"))
STRICT = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{NODE}"]
COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]


def run(*command: str | Path) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("header", HEADERS)
def test_each_header_compiles_alone(tmp_path, compiler, header) -> None:
    source = tmp_path / "alone.c"
    source.write_text(f'#include "{header}"\nint main(void) {{ return 0; }}\n')
    run(compiler, *STRICT, "-O2", "-c", source, "-o", tmp_path / "alone.o")


def test_headers_know_no_python() -> None:
    for header in HEADERS:
        assert "Python.h" not in (NODE / header).read_text()


def test_every_header_is_named_as_a_dependency() -> None:
    listed = (NODE / "_rt.pyx").read_text().split("depends = ")[1].splitlines()[0]
    assert sorted(x for x in listed.split() if x.endswith(".h")) == HEADERS


def test_every_sync_point_is_commented() -> None:
    """Each acquire and release has its partner named in the same file."""
    for header in HEADERS:
        text = (NODE / header).read_text()
        if "memory_order_acquire" in text or "memory_order_release" in text:
            assert "SYNC POINT" in text or header == "table.h", header


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("seed", [1, 2])
def test_random_histories_under_the_sanitizers(tmp_path, compiler, seed) -> None:
    program = tmp_path / "rt_turn"
    run(
        compiler, *STRICT, "-O1", "-g", "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all", ROOT / "tests" / "native" / "rt_turn.c",
        "-o", program, "-lpthread",
    )  # fmt: skip
    run(program, str(seed), "150")


def test_a_failure_reaches_its_cycle_whenever_its_signal_comes(tmp_path) -> None:
    program = tmp_path / "rt_failures"
    run(
        COMPILERS[0], *STRICT, "-O1", "-g", "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all", ROOT / "tests" / "native" / "rt_failures.c",
        "-o", program, "-lpthread",
    )  # fmt: skip
    run(program)


@pytest.mark.parametrize("compiler", COMPILERS)
def test_dispatcher_and_tasks_under_the_thread_sanitizer(tmp_path, compiler) -> None:
    """It knows neither fences, which order atomics here, nor mutexes with a clock."""
    program = tmp_path / "rt_threads"
    quiet = ["-Wno-tsan"] if compiler == "gcc" else []
    run(
        compiler, *STRICT, *quiet, "-O1", "-g", "-fsanitize=thread",
        ROOT / "tests" / "native" / "rt_threads.c", "-o", program, "-lpthread",
    )  # fmt: skip
    run("env", "TSAN_OPTIONS=report_mutex_bugs=0", program, "500")
