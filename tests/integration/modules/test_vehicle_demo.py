"""The vehicle example over real agents: a square over a MAVLink link, and its logs."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import sys
from contextlib import ExitStack
from pathlib import Path

from watching import processes_of, wait_for

from pbonet import Subsystem

EXAMPLE = Path(__file__).parents[3] / "examples" / "vehicle"
spec = importlib.util.spec_from_file_location("vehicle_demo", EXAMPLE / "demo.py")
assert spec is not None
assert spec.loader is not None
demo = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = demo
spec.loader.exec_module(demo)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def test_it_takes_off_flies_a_square_and_lands_and_its_logs_replay() -> None:
    pilot, logs = demo.fly(port=free_port())
    result = demo.judge(pilot, logs)
    assert result.differs == []
    assert result.top > 2.9
    assert result.home < demo.HOME
    assert not result.armed
    _, measured, _ = demo.way(pilot)
    for corner in ((4, 0), (4, 4), (0, 4)):
        assert abs(measured[:, :2] - corner).max(axis=1).min() < demo.NEAR, corner


def test_another_vehicle_is_called_at_its_address() -> None:
    with ExitStack() as stack:
        folder = demo._with_address(stack, vehicle="udpin:localhost:14550")
        text = (folder / "vehicle.rmod").read_text()
        assert "ADDRESS   udpin:localhost:14550\n" in text
        assert "14561" not in text
        assert (folder / "pilot.job").is_file()


MARK = "PBONET_VEHICLE_TEST"
"""A variable in the environment of all processes of a test."""


def title(pid: int) -> str:
    return Path(f"/proc/{pid}/comm").read_text().strip()


def value(subsystem: Subsystem, name: str) -> float:
    return float(subsystem.display(name)[0].values[0])


def killed(subsystem: Subsystem, task: str) -> None:
    """End a task's process as `kill -9` does."""
    ours = processes_of(MARK, str(os.getpid()))
    (pid,) = (pid for pid, _ in ours if title(pid) == task)
    os.kill(pid, signal.SIGKILL)
    wait_for(
        lambda: (
            (task, "NOT-CREATED")
            in {(one.task, one.state) for one in subsystem.status_all()}
        ),
        "the end of the task",
    )


def test_after_a_loss_nothing_is_sent_before_the_task_is_turned_on_again(
    monkeypatch,
) -> None:
    monkeypatch.setenv(MARK, str(os.getpid()))
    with ExitStack() as stack:
        folder = demo._on_port(free_port(), stack)
        told = {"domain": f"lost{os.getpid()}", "embed": True, "libraries": [folder]}
        craft = Subsystem(folder / "craft.job", **told)
        pilot = Subsystem(folder / "pilot.job", **told)
        demo._started(craft, stack)
        demo._started(pilot, stack)
        wait_for(lambda: value(craft, "SETPOINT") == 84, "set-points")
        killed(craft, "ground")
        wait_for(lambda: value(pilot, "LINK_AGE") > 2.6, "the loss")
        craft.spawn("ground", "craft0")
        craft.on("ground")
        wait_for(lambda: value(pilot, "LINK_AGE") < 1.0, "the vehicle again")
        began = craft.status("ground").cycle
        wait_for(lambda: craft.status("ground").cycle > began + 100, "a second")
        assert value(craft, "SETPOINT") == 0
        assert pilot.status("vehicle").state == "ON"
        pilot.off("vehicle")
        pilot.on("vehicle")
        wait_for(lambda: value(craft, "SETPOINT") == 84, "set-points again")
        killed(pilot, "vehicle")
        wait_for(lambda: value(craft, "SETPOINT") == 0, "that none come")
        wait_for(lambda: value(craft, "LINK_AGE") > 2.5, "that the station is missed")
        assert craft.status("ground").state == "ON"
