"""What ``import pbonet`` brings, and what it must not."""

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pbonet

ROOT = Path(__file__).parents[3]
HEAVY = {"zenoh", "asyncio", "pint", "rich", "mcap", "logging", "threading"}


def loaded(statement):
    """Return the top-level modules that `statement` loads beyond numpy and msgspec."""
    code = (
        "import sys, numpy, msgspec\nbefore = set(sys.modules)\n"
        f"{statement}\n"
        f"print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.split())


def test_importing_pbonet_loads_little_beside_numpy():
    names = loaded("import pbonet")
    assert not {name.partition(".")[0] for name in names} & HEAVY
    inner = {name.split(".")[1] for name in names if name.startswith("pbonet.")}
    assert inner == {"lazy"}


def test_a_module_of_a_user_loads_no_more_than_it_names():
    names = loaded("from pbonet import InVar, OutVar, PortBasedObject, param")
    assert not {name.partition(".")[0] for name in names} & HEAVY
    inner = {name.split(".")[1] for name in names if name.startswith("pbonet.")}
    assert inner == {"lazy", "errors", "pbo", "ports"}


def test_a_bench_needs_no_network():
    names = loaded("import pbonet.testing")
    assert not {name.partition(".")[0] for name in names} & {"zenoh", "asyncio", "pint"}


def test_the_public_names_are_sorted_and_there():
    assert pbonet.__all__ == sorted(pbonet.__all__)
    assert all(hasattr(pbonet, name) for name in pbonet.__all__)
    assert dir(pbonet) == pbonet.__all__
    public = {
        name
        for name, value in vars(pbonet).items()
        if not name.startswith("_") and not isinstance(value, ModuleType)
    }
    assert public == {"attach"}, "all others are loaded when they are used"
