"""The example on the page runs as it stands there, and names methods that there are."""

import re
from pathlib import Path

import pytest
from edited_jobs import puma

from pbonet.config import read_job
from pbonet.master.configuration import check_file
from pbonet.master.editing import EDITS, JobEditor

__all__ = ["puma"]

PAGE = (Path(__file__).parents[3] / "docs" / "assembling.md").read_text()


@pytest.mark.slow
def test_the_example_runs(puma, monkeypatch, capsys):
    monkeypatch.chdir(puma.parent)
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(code, "assembling.md", "exec"), {})  # noqa: S102 - our own page
    printed = capsys.readouterr().out
    assert printed.startswith("True RTPU arm0 (MUF): schedulable")
    assert "jttrace and jttrace_2 both write Q_REF" in printed
    assert "join jttrace and jttrace_2 by join_average into Q_REF True" in printed
    assert "True 1000\n" in printed
    names = [task.rmod for task in read_job("mine.job").tasks]
    assert names[:3] == ["puma_pidg", "grav_comp", "qrdiff"]
    assert names[3:] == ["jttrace_3", "jttrace_2", "join_Q_REF_1"]
    assert check_file("mine.job").legal


def test_methods_are_those_of_the_class():
    table = PAGE[PAGE.index("| method | does |") :]
    named = set(re.findall(r"`(\w+)[`(]", table)) - {"pbonet"}
    public = {
        name
        for name in dir(JobEditor)
        if not name.startswith("_") and callable(getattr(JobEditor, name))
    }
    assert named <= public
    assert set(EDITS) - {"copy_variable"} <= named
