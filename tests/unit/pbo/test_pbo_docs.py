"""What docs/modules.md shows is run as it stands there."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.config import read_rmod
from pbonet.config.library import Library
from pbonet.errors import DeclarationError
from pbonet.node.task.task_ports import check_ports
from pbonet.node.wire.lifecycle import Step
from pbonet.pbo import METHODS, decode_params

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "modules.md").read_text()


@pytest.fixture
def folder(tmp_path):
    """A folder with the files of the page."""
    shown = re.findall(r"<!-- file: (\S+) -->\n```\w*\n(.*?)```", PAGE, re.DOTALL)
    assert [name for name, _ in shown] == [
        *("hold.py", "test_hold.py", "hold.rmod"),
        *("reach.py", "test_reach.py"),
        *("gripper.py", "gripper.rmod", "test_gripper.py"),
        *("pendulum.py", "test_pendulum.py"),
    ]
    for name, text in shown:
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.slow
def test_the_examples_pass_their_own_tests(folder):
    options = ("-q", "-p", "no:cacheprovider", "--rootdir", folder)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, folder],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    assert "9 passed" in done.stdout


@pytest.mark.parametrize("name", ["hold.py", "reach.py", "gripper.py", "pendulum.py"])
def test_the_examples_pass_ruff(folder, name):
    own = 'lint.isort.known-first-party=["pbonet"]'
    own_form = ("--ignore", "ARG002")  # `cycle` has `dt` whether it is used or not
    options = (
        *own_form,
        "--no-cache",
        "--config",
        str(ROOT / "pyproject.toml"),
        "--config",
        own,
    )
    done = subprocess.run(
        [Path(sys.executable).parent / "ruff", "check", name, *options],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout


def test_the_rmod_of_the_page_configures_the_module_of_the_page(folder):
    rmod = read_rmod(folder / "hold.rmod")
    loaded = Library([folder]).load(rmod.module)
    params = decode_params(loaded.cls, rmod.local)
    assert (params.kp, params.kd, params.limit) == (40.0, 4.0, 20.0)
    assert set(rmod.invar) == {p.name for p in loaded.info.ports if p.kind == "in-var"}


def test_the_server_of_the_page_has_what_a_server_needs(folder):
    rmod = read_rmod(folder / "gripper.rmod")
    info = Library([folder]).load(rmod.module).info
    check_ports(rmod, info)
    assert (rmod.tasktype, rmod.capacity, rmod.freq) == ("deferrable", 0.005, 10.0)


SVAR = """
NAME NDOF
TYPE int
DESC degrees of freedom
UNITS none
NELEM 1
INIT 6
"""
VECTOR = """
NAME {}
TYPE double
DESC one value a joint
UNITS {}
NELEM 6
"""


@pytest.mark.slow
def test_the_commands_of_the_page_write_modules(tmp_path):
    vectors = {"Q_REF": "rad", "Q_MEZ": "rad", "T_REF": "N*m"}
    text = SVAR + "".join(VECTOR.format(*item) for item in vectors.items())
    (tmp_path / "arm.svar").write_text(text + "EOF\n")
    (shown,) = re.findall(r"<!-- commands -->\n```\n(.*?)```", PAGE, re.DOTALL)
    (said,) = re.findall(r"`(pbonet library hold_it)`", PAGE)
    for command in [*shown.splitlines(), said]:
        done = subprocess.run(
            [sys.executable, "-m", "pbonet.cli", *shlex.split(command)[1:]],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert (
        "in-var    Q_REF  q_ref  float64[ndof]  rad   one value a joint" in done.stdout
    )
    assert Library([tmp_path]).load("hold_on").info.ports[0].shape == (6,)


def test_the_fault_is_told_as_shown():
    code, said = re.search(
        r"<!-- fault -->\n```python\n(.*?)```\n\n    (.*?)\n", PAGE, re.DOTALL
    ).groups()
    names = {"__name__": "page"}
    exec(  # noqa: S102 - the page's own code
        "from typing import Annotated as A\n"
        "from pbonet import InVar, PortBasedObject, Vector\n",
        names,
    )
    with pytest.raises(DeclarationError) as caught:
        exec(code, names)  # noqa: S102 - the page's own code
    shown = said.replace("Wrong.q (line 2)", "page.Wrong.q (source unknown)")
    assert str(caught.value) == shown


def test_every_method_is_on_the_page():
    table = PAGE.split("## Methods")[1].split("## What a module knows")[0]
    for name in METHODS:
        assert f"`{name}(" in table
    methods = {str(step) for step in Step if step.is_method} | {
        "error",
        "stable",
        "timing_failure",
    }
    assert methods == set(METHODS)
