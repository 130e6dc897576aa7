"""Where a module failed: in every line that a person reads, without being asked."""

from pathlib import Path

import pytest

from pbonet.cli import main
from pbonet.config.library import Library
from pbonet.errors import ConfigFileError
from pbonet.master.configuration.subsystem_files import Files
from pbonet.node.task.step_failures import own_place

LINE = "raises.py:14 in cycle"
RAISES = '''"""Raises."""

from typing import Annotated as A

from pbonet import OutVar, PortBasedObject


class Raises(PortBasedObject):
    """Raises in its first cycle."""

    y: A[float, OutVar("Y", "1", "none", "cycles")]

    def cycle(self, dt: float) -> None:
        raise RuntimeError("oops")
'''
FILES = {
    "raises.py": RAISES,
    "raises.rmod": "MODULE raises\nDESC raises\nINCONST none\nOUTCONST none\n"
    "INVAR none\nOUTVAR Y\nTASKTYPE periodic\nFREQ 100\nEOF\n",
    "t.svar": "NAME Y\nTYPE double\nDESC y\nUNITS none\nNELEM 1\nEOF\n",
    "t.sbs": "SUBSYSTEM t\nSVARFILE t.svar\nRTPU r\nEOF\n",
    "t.job": "JOB t\nDESC raises\nSBS t.sbs\nTASK raises\nEOF\n",
}


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """The job of one task that raises in its first cycle."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path / "t.job"


@pytest.fixture
def shown(capsys):
    """Calls a verb; returns what it printed."""

    def call(*words: str) -> str:
        with pytest.raises(SystemExit):
            main(words)
        return capsys.readouterr().out

    return call


def test_a_simulation_and_its_log_tell_the_line(job, shown):
    runs, place = job.parent / "runs", f"({job.parent}/{LINE})"
    given = ["run", str(job), "--sim", "--seconds", "0.1", "--runs", str(runs)]
    output = shown(*given, "--library", str(job.parent))
    error = f"raises.cycle: RuntimeError: oops {place}"
    assert f"s raises: {error}" in output
    assert f"ERROR> raises: {error}" in output
    (log,) = runs.iterdir()
    events = shown("log", "events", str(log)).splitlines()
    (line,) = [one for one in events if " METHOD " in one]
    assert line.endswith(
        f"errnum=1 raises.cycle: RuntimeError: oops; it is ERROR {place}"
    )


def test_a_crash_in_a_library_is_told_with_the_module_s_own_line():
    folder = Path(own_place.__code__.co_filename).parents[2]
    trace = f"""Fatal Python error: Segmentation fault

Current thread 0x00007f (most recent call first):
  File "/usr/lib/python3.13/ctypes/__init__.py", line 519 in string_at
  File "/modules/pend/helper.py", line 7 in look
  File "/modules/pend/lqr.py", line 48 in cycle
  File "{folder}/node/task/task_process.py", line 300 in _cycle
  File "<string>", line 1 in <module>
"""
    assert own_place(trace) == "/modules/pend/helper.py:7 in look"
    assert own_place("killed from outside") == ""


@pytest.mark.parametrize(
    ("line", "file"), [("SBS t.sbs", "t.job:3"), ("SVARFILE t.svar", "t.sbs:2")]
)
def test_a_missing_file_is_told_with_the_line_that_names_it(job, line, file):
    names = job.parent / file.partition(":")[0]
    keyword = line.split()[0]
    names.write_text(names.read_text().replace(line, f"{keyword} nono.txt"))
    with pytest.raises(ConfigFileError) as caught:
        Files(job, Library([]))
    assert caught.value.where == f"{job.parent}/{file}: {job.parent}/nono.txt"


def test_a_size_that_does_not_fit_is_told_with_both_lines(job, shown):
    table = job.with_name("t.svar")
    table.write_text(table.read_text().replace("NELEM 1", "NELEM 2"))
    output = shown("check", str(job), "--library", str(job.parent))
    assert f"{job.parent}/raises.rmod:6:1: raises: port y (Y) has another" in output
    assert f"got 2 elements (Y {table}:1:1)" in output
