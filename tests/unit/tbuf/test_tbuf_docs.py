"""What docs/tbuf.md shows is run, and every test that it names is there."""

import re
from pathlib import Path

import pytest

from pbonet import xm
from pbonet.config import parse_rmod
from pbonet.config.library import Library
from pbonet.node.task.task_ports import check_ports
from pbonet.pbo import decode_params

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "tbuf.md").read_text()
RMODS = re.findall(r"```text\n(MODULE.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("text", RMODS, ids=["send", "receive"])
def test_the_rmod_files_fit_their_modules(text):
    rmod = parse_rmod(text, "shown.rmod")
    loaded = Library(()).load(rmod.module)
    check_ports(rmod, loaded.info)
    params = decode_params(loaded.cls, rmod.local, where=rmod.file)
    assert params.link in {"target", "vision:target"}


def test_the_program_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    xm.live_on("vision0", subsystem="vision")
    names = {}
    try:
        exec(compile(code, "docs/tbuf.md", "exec"), names)  # noqa: S102
        assert capsys.readouterr().out.startswith("[0.4 0.  0.3] 1 0 ")
    finally:
        for end in ("target", "seen"):
            names[end].close()
        xm.live_on("local")


def test_every_test_that_is_named_is_there():
    named = set(re.findall(r"`(test_tbuf_\w+)`", PAGE))
    there = {path.stem for path in (ROOT / "tests").rglob("test_tbuf_*.py")}
    assert named
    assert named <= there
