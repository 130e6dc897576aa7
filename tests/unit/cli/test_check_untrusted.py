"""``check`` of files that are not trusted: no code, no files from elsewhere."""

import pytest

MODULE = """
from pathlib import Path
from typing import Annotated as A
from pbonet import OutVar, Params, PortBasedObject, Vector, param

Path({mark!r}).write_text("ran")


class Gains(Params):
    gain: A[float, param("m", "amplitude")] = 1.0


class Wave(PortBasedObject[Gains]):
    "A wave."

    x: A[Vector, OutVar("X", "2", "m", "position")]

    def cycle(self, dt):
        self.x[0] = self.params.gain
"""
FILES = {
    "wave.rmod": "MODULE wave\nDESC d\nINCONST none\nOUTCONST none\nINVAR none\n"
    "OUTVAR X\nTASKTYPE periodic\nFREQ 10\nMAXC 0.01\nEOF\n",
    "t.svar": "NAME X\nTYPE double\nDESC\nUNITS m\nNELEM 2\nEOF\n",
    "t.sbs": "SUBSYSTEM t\nSVARFILE t.svar\nRTPU c0\nEOF\n",
    "t.job": "JOB t\nDESC d\nSBS t.sbs\nTASK wave\nEOF\n",
}


@pytest.fixture
def job(tmp_path):
    """Return a job whose module leaves a mark when its code runs."""
    folder = tmp_path / "job"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / name).write_text(text)
    mark = str(tmp_path / "mark")
    (folder / "wave.py").write_text(MODULE.format(mark=mark))
    return folder / "t.job"


def test_the_jobs_folder_is_a_library_of_check_and_run(call, job):
    status, out, _ = call("check", job)
    assert (status, out.splitlines()[-1]) == (0, f"{job}: job t of 1 tasks: legal")
    run = ("run", job, "--sim", "--seconds", "1", "--record", "off")
    status, out, _ = call(*run)
    assert status == 0
    assert "job t is ON in virtual time: wave" in out
    assert call("check", job.with_name("wave.rmod"))[0] == 0


def test_without_code_no_module_is_imported_and_the_rest_is_judged(call, job, tmp_path):
    for name in ("t.job", "wave.rmod"):
        status, out, _ = call("check", "--no-code", job.with_name(name))
        assert status == 0
        assert "WARNING> no module was imported (--no-code)" in out
    rmod = job.with_name("wave.rmod")
    rmod.write_text(rmod.read_text().replace("OUTVAR X", "OUTVAR XX"))
    status, out, _ = call("check", "--no-code", job)
    assert status == 1
    assert "XX" in out
    assert not (tmp_path / "mark").exists()
    call("check", job)
    assert (tmp_path / "mark").exists()


@pytest.mark.parametrize("keyword", ["SBS", "SVARFILE"])
def test_a_file_outside_the_jobs_folder_is_read_on_request_only(
    call, job, tmp_path, keyword
):
    named, by = {"SBS": ("t.sbs", job), "SVARFILE": ("t.svar", job.with_name("t.sbs"))}[
        keyword
    ]
    job.with_name(named).rename(tmp_path / named)
    if keyword == "SBS":
        job.with_name("t.svar").rename(tmp_path / "t.svar")
    by.write_text(by.read_text().replace(named, f"../{named}"))
    line = by.read_text().splitlines().index(f"{keyword} ../{named}") + 1
    status, out, _ = call("check", job)
    assert status == 1
    assert (
        f"ERROR> {by}:{line}: {keyword} names a file outside the folder of the file "
        f"that is checked (expected a file in {job.parent}, got {tmp_path / named}); "
        "--allow-outside reads it nevertheless"
    ) in out
    assert call("check", job, "--allow-outside")[0] == 0
    by.write_text(by.read_text().replace(f"../{named}", named))
    job.with_name(named).symlink_to(tmp_path / named)
    assert call("check", job)[0] == 1, "a link leads outside"


def test_the_first_line_of_a_wrong_file_is_not_printed(call, job, tmp_path):
    (tmp_path / "key").write_text("hunter2secret of another file\n")
    sbs = job.with_name("t.sbs")
    sbs.write_text(sbs.read_text().replace("t.svar", "../key"))
    for words in (("check", "--allow-outside"), ("run", "--sim", "--record", "off")):
        status, out, err = call(*words, job)
        assert status == 1
        assert (
            "key:1:1: the first line has no keyword of this kind of file" in out + err
        )
        assert "hunter2" not in out + err
