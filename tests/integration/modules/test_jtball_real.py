"""The PUMA in real time on real processes, moved by a ball on a serial line."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from magellan import Magellan
from nodekit import Nodes
from watching import wait_for

import pbonet.modules
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.pbo import State

EXAMPLE = Path(__file__).parents[3] / "examples" / "puma"
LIBRARY = Path(pbonet.modules.__file__).parent / "teleoperation"


class Operator:
    """Somebody at the ball, while the test waits for what comes of it."""

    def __init__(self, device: Magellan, subsystem: Subsystem) -> None:
        self.device = device
        self.subsystem = subsystem
        self._next = 0.0

    def value(self, name: str) -> np.ndarray:
        (value,) = self.subsystem.display([name])
        return np.array(value.values)

    def push(self, axes: tuple[int, ...], until: Callable[[], object], what: str):
        """Push the ball until something is true, then let it go."""

        def pushing() -> object:
            self.device.answer()
            if time.monotonic() >= self._next:
                self._next = time.monotonic() + 0.04
                self.device.push(*axes)
            return until()

        result = wait_for(pushing, what)
        self.device.push(0, 0, 0, 0, 0, 0)
        return result

    def arrived(self) -> bool:
        return bool(np.abs(self.value("Q_REF") - self.value("Q_MEZ")).max() < 0.01)


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Magellan]:
    magellan = Magellan(tmp_path / "ttyBALL")
    magellan.plug_in()
    yield magellan
    if magellan.master >= 0:
        os.close(magellan.master)


@pytest.fixture
def job(tmp_path: Path, device: Magellan) -> Path:
    """The example with the ball in the place of the trace."""
    folder = tmp_path / "puma"
    folder.mkdir()
    for name in ("puma.svar", "puma.sbs"):
        (folder / name).write_text((EXAMPLE / name).read_text())
    rmod = (LIBRARY / "jtball.rmod").read_text()
    (folder / "jtball.rmod").write_text(rmod.replace("/dev/ttyUSB0", str(device.link)))
    text = (EXAMPLE / "puma.job").read_text().replace("jttrace", "jtball")
    (folder / "puma.job").write_text(text)
    return folder / "puma.job"


def states(subsystem: Subsystem) -> dict[str, str]:
    return {status.task: status.state for status in subsystem.status_all()}


@pytest.mark.slow
def test_the_arm_goes_where_the_ball_is_pushed(
    nodes: Nodes, job: Path, device: Magellan
) -> None:
    nodes.agent_processes("arm0", "arm1")
    with Subsystem(job, domain=nodes.domain) as subsystem:
        subsystem.start()
        assert set(states(subsystem).values()) == {State.ON}
        operator = Operator(device, subsystem)
        start = operator.value("Q_MEZ")

        operator.push(
            (400, 0, 0, 0, 0, -400),
            lambda: operator.value("Q_MEZ")[0] > start[0] + 0.2,
            "the waist to turn",
        )
        wait_for(operator.arrived, "the arm to arrive")
        moved = operator.value("Q_MEZ") - start
        assert moved[0] > 0.2
        assert moved[5] < -0.2
        assert np.abs(moved[1:5]).max() < 0.02, "nobody pushed those"

        device.unplug()
        lost = wait_for(
            lambda: (s := subsystem.status("jtball")).warn and s, "the warning"
        )
        assert "the ball rests" in lost.warning
        assert lost.state == State.ON
        device.plug_in()
        stood = operator.value("Q_REF")
        operator.push(
            (-400, 0, 0, 0, 0, 400),
            lambda: operator.value("Q_REF")[0] < stood[0] - 0.1,
            "the ball to be found again",
        )
        wait_for(operator.arrived, "the arm to arrive again")
        assert set(states(subsystem).values()) == {State.ON}
    device.said = 0


@pytest.mark.slow
def test_every_cycle_of_a_run_is_on_record(nodes: Nodes, job: Path) -> None:
    nodes.agent_processes("arm0", "arm1")
    job.write_text(job.read_text().replace("jtball", "jttrace"))
    with Subsystem(job, domain=nodes.domain) as subsystem:
        subsystem.start()
        wait_for(lambda: subsystem.status("puma_pidg").cycle > 1500, "1500 cycles")
        recording = subsystem.recordings.finish(subsystem.clients)
    assert recording is not None
    assert recording.lost() == {}
    for task in recording.tasks:
        cycles = recording.arrays(task)["cycle"]
        assert np.array_equal(cycles, np.arange(cycles[0], cycles[0] + len(cycles)))
    arrays = recording.arrays("puma_pidg")
    assert np.all(np.diff(arrays["release_ns"]) % 2_000_000 == 0)
    assert np.all(arrays["start_ns"] >= arrays["release_ns"])
    assert np.all(arrays["cpu_ns"] > 0)
    time_s, measured = recording.series("Q_MEZ")
    when, reference = recording.series("Q_REF")
    newest = np.searchsorted(when, time_s, side="right") - 1
    error = np.abs(measured - reference[newest])[newest >= 0]
    assert np.median(error.max(axis=1)) < 0.02
    assert np.ptp(reference, axis=0).max() > 0.05, "the operator moved something"
