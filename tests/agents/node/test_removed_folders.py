"""An agent whose runtime folder, or that of the shared memory, is removed, ends."""

from __future__ import annotations

import shutil

import pytest
from nodekit import END_TIME, alive
from watching import wait_for


@pytest.fixture(params=["PBONET_RUN_DIR", "PBONET_SHM_DIR"])
def removed(request, nodes, shared_memory):
    """A folder and the variable that names it; it is made again after the test."""
    by_variable = {"PBONET_RUN_DIR": nodes.folder, "PBONET_SHM_DIR": shared_memory}
    folder = by_variable[request.param]
    yield folder, request.param
    folder.mkdir(mode=0o700, exist_ok=True)


def test_a_folder_that_is_removed_is_told_once_and_ends_the_agent(
    nodes, removed, capfd
):
    folder, variable = removed
    process = nodes.agent_process("arm0")
    arm = nodes.master("arm0", "t")
    arm.spawn("drives", "counts")
    arm.on("drives")
    pids = [nodes.state("arm0").pid, arm.status("drives").tid]
    capfd.readouterr()
    shutil.rmtree(folder)
    assert process.wait(END_TIME) == 1, "it did not end because it was asked to"
    wait_for(lambda: not any(map(alive, pids)), "the tasks have ended, too")
    told = capfd.readouterr().err
    assert "Traceback" not in told, told
    (line,) = [one for one in told.splitlines() if "was removed" in one]
    assert f"{folder}" in line
    assert f"set {variable} to a folder that nothing cleans, and start it" in line
