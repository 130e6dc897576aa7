"""The C headers of the dispatcher: the sanitizers find nothing in them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RT, RING = (ROOT / "pbonet" / "node" / room for room in ("rt", "ring"))
HEADERS = sorted(path.name for path in RT.glob("*.h"))
STRICT = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
STRICT += [f"-I{RT}", f"-I{RING}"]
MEMORY = "-fsanitize=address,undefined"
COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]


def run(*command: str | Path) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def built(folder: Path, name: str, compiler: str, sanitizer: str) -> Path:
    """Compile a program of this folder with a sanitizer that ends it at a finding."""
    program = folder / name
    quiet = ["-Wno-tsan"] if compiler == "gcc" and sanitizer != MEMORY else []
    run(
        compiler, *STRICT, *quiet, "-O1", "-g", sanitizer, "-fno-sanitize-recover=all",
        ROOT / "tests" / "native" / f"{name}.c", "-o", program, "-lpthread",
    )  # fmt: skip
    return program


def test_every_header_is_named_as_a_dependency() -> None:
    listed = (RT / "_rt.pyx").read_text().split("depends = ")[1].splitlines()[0]
    own = [x for x in listed.split() if x.endswith(".h") and "/" not in x]
    assert sorted(own) == HEADERS


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("seed", [1, 2])
def test_random_histories_under_the_sanitizers(tmp_path, compiler, seed) -> None:
    program = built(tmp_path, "rt_turn", compiler, MEMORY)
    run(program, str(seed), "150")


def test_a_failure_reaches_its_cycle_whenever_its_signal_comes(tmp_path) -> None:
    program = built(tmp_path, "rt_failures", COMPILERS[0], MEMORY)
    run(program)


def test_the_age_of_a_stall_and_a_leader_that_begins(tmp_path) -> None:
    program = built(tmp_path, "rt_stalls", COMPILERS[0], MEMORY)
    run(program)


def test_the_last_cycle_s_end_takes_a_look_back(tmp_path) -> None:
    program = built(tmp_path, "rt_looks", COMPILERS[0], MEMORY)
    if subprocess.run([program], check=False).returncode == 77:
        pytest.skip("the kernel refuses pidfd_getfd")
    run(program)


def test_tasks_take_every_release_once_and_every_turn_knows(tmp_path) -> None:
    program = built(tmp_path, "rt_lease", COMPILERS[0], MEMORY)
    for seed in ("1", "2", "3"):
        run(program, seed, "200")


@pytest.mark.parametrize("compiler", COMPILERS)
def test_dispatcher_and_tasks_under_the_thread_sanitizer(tmp_path, compiler) -> None:
    """It knows neither fences, which order atomics here, nor mutexes with a clock."""
    program = built(tmp_path, "rt_threads", compiler, "-fsanitize=thread")
    run("env", "TSAN_OPTIONS=report_mutex_bugs=0", program, "500")


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("maxc_ns", [0, 200_000])
def test_tasks_that_release_themselves_and_turns_at_once(
    tmp_path, compiler, maxc_ns
) -> None:
    """Each release is run once or counted as missed, and nothing races."""
    program = built(tmp_path, "rt_apart", compiler, "-fsanitize=thread")
    command = ["env", "TSAN_OPTIONS=report_mutex_bugs=0", program, "601", str(maxc_ns)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 77:
        pytest.skip("no real-time rights")
    assert done.returncode == 0, done.stderr
