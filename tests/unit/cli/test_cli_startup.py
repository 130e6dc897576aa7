"""Each start loads what its verb needs; `benchmarks/startup.py` times it."""

from __future__ import annotations

import functools
import subprocess
import sys
from pathlib import Path

import pytest

PUMA = Path(__file__).parents[3] / "examples" / "puma"
NEVER = {"asyncio", "matplotlib", "mcap", "pint", "prompt_toolkit", "rich", "typer"}
"""What no verb needs that ends by itself."""
HEAVY = NEVER | {"numpy", "zenoh"}
NODE = {"pbonet.node.agent", "pbonet.node.rtpu", "pbonet.node.rt", "pbonet.master.sim"}
"""Rooms of other processes, and of virtual time."""
UNUSED = {"numpy", "logging", "json", "concurrent.futures"}
UNUSED |= {"pbonet.pbo._task", "pbonet.config.rmod", "pbonet.analysis.legality.records"}
"""What a verb that only asks does not need."""
CASES = {
    "version": (["--version"], HEAVY | {"msgspec", "argparse", "pbonet.errors"}),
    "help": (["--help"], HEAVY | NODE),
    "help of a verb": (["swap", "--help"], HEAVY | NODE),
    "completion": (["--complete", "bash", "status", "a.sbs", ""], HEAVY | NODE),
    "wrong usage": (["status"], HEAVY | NODE),
    "check": (["check", str(PUMA / "puma.job")], NEVER | NODE | {"zenoh"}),
    "status": (["status", str(PUMA / "puma.sbs")], NEVER | NODE | UNUSED),
    "explain": (["explain", str(PUMA / "puma.job")], NEVER | NODE),
    "fleet": (["fleet"], NEVER | NODE),
    "set": (["set", str(PUMA / "puma.sbs"), "a", "b", "1"], NEVER | NODE | {"numpy"}),
}
MOST = {"version": 4, "completion": 45, "check": 119, "status": 89}
"""Modules of pbonet that are loaded at most; what adds one should need it."""


def loaded(words: list[str]) -> set[str]:
    """Return the modules that a command line loads; no agent is there."""
    code = (
        "import sys\nfrom pbonet.cli import main\n"
        f"try: main({words!r})\nexcept SystemExit: pass\n"
        "print('\\n' + '\\n'.join(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"PBONET_DOMAIN": "nobody-here"},
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.splitlines())


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_verb_loads_only_what_it_needs(case):
    words, unwanted = CASES[case]
    modules = loaded(words)
    assert not modules & unwanted
    ours = sorted(name for name in modules if name.startswith("pbonet."))
    assert len(ours) <= MOST.get(case, len(ours)), ours


@pytest.mark.slow
def test_status_asks_over_the_network():
    """Else the case above would show nothing."""
    modules = loaded(CASES["status"][0])
    assert {"zenoh", "pbonet.xm.net.rpc"} <= modules


SLOW = {"typing_extensions", "inspect", "dis", "dataclasses", "multiprocessing"}
SLOW |= {"tempfile", "shutil", "random"}
"""Of Python's own library, what takes milliseconds to load."""


def imported(*names: str) -> set[str]:
    """Return what is loaded once these modules are."""
    code = f"import {', '.join(names)}, sys; print('\\n'.join(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(done.stdout.splitlines())


@pytest.mark.slow
def test_an_agent_loads_nothing_that_only_its_rtpu_process_needs():
    """Each machine has one for each RTPU; numpy alone is 5 MB and 60 ms."""
    modules = imported("pbonet.node.agent.agent_main")
    assert "pbonet.node.agent.rtpu_link" in modules
    assert not modules & {"asyncio", "ssl", "pbonet.node.rtpu.rtpu_state"}
    assert not modules & {"numpy", "_hashlib", "tomllib", "pbonet.node.rtpu.ranking"}
    assert not modules & (SLOW - {"random"})


@pytest.mark.slow
def test_a_recorder_loads_nothing_slow_that_it_does_not_need():
    modules = imported("pbonet.node.recorder.recorder_process")
    assert not modules & (SLOW | NEVER | {"ast", "numpy", "zenoh"})


@pytest.mark.slow
def test_an_rtpu_process_loads_asyncio_without_its_encryption():
    """It has no network; a module that needs `ssl` loads it in its task."""
    code = (
        "import sys\n"
        "from pbonet.node.rtpu import rtpu_process\n"
        "rtpu_process.load_rest()\n"
        "assert 'ssl' not in sys.modules and 'asyncio' in sys.modules\n"
        "import ssl"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


TYPES = """
import msgspec
import typing_extensions as t

class Gains(t.TypedDict):
    kp: t.Required[t.Annotated[int, msgspec.Meta(ge=1)]]
    name: t.NotRequired["str"]

for text in (b'{"kp": 1}', b'{"kp": 0}', b'{"name": "a"}', b'{"kp": 1, "name": 2}'):
    try:
        print(msgspec.json.decode(text, type=Gains))
    except msgspec.ValidationError as error:
        print(error)
"""


@pytest.mark.slow
def test_modules_use_types_of_typing_extensions_as_without_pbonet():
    """A task's process has loaded msgspec without that package."""
    run = functools.partial(subprocess.check_output, text=True)
    first = "from pbonet import config, node\n"
    printed = run([sys.executable, "-c", first + TYPES])
    assert printed == run([sys.executable, "-c", TYPES])
    assert printed.splitlines()[0] == "{'kp': 1}"


@pytest.mark.slow
def test_nothing_is_left_out_while_another_thread_may_import_it():
    """Such a thread may be one that Python's `threading` does not know."""
    code = (
        "import _thread, sys\n"
        "wait = _thread.allocate_lock()\n"
        "begun = _thread.allocate_lock()\n"
        "wait.acquire(), begun.acquire()\n"
        "_thread.start_new_thread(lambda: (begun.release(), wait.acquire()), ())\n"
        "begun.acquire()\n"
        "import pbonet.node, msgspec\n"
        "assert 'typing_extensions' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.slow
def test_a_run_loads_before_its_job_is_on_neither_numpy_nor_its_screen():
    """`agents/test_master_run.py` shows the same of one that runs."""
    console = "pbonet.master.console"
    modules = imported(
        f"{console}.run_agents",
        f"{console}.run_job",
        "pbonet.master.subsystem.assembly",
        "pbonet.analysis.legality.verdict",
    )
    assert f"{console}.live_status" in modules
    assert not modules & {"numpy", "rich", "logging", f"{console}.live_screen"}
