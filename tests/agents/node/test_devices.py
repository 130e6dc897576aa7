"""Devices of an ``agent.toml``: opened by tasks, told by a verb, freed by a death."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tty
from itertools import pairwise
from statistics import median

import pytest
from log_of_real_tasks import finish, record
from nodekit import rmod, svar
from watching import wait_for

from pbonet.config import Entry
from pbonet.errors import MethodError, VerificationError
from pbonet.master.subsystem import Subsystem
from pbonet.testing import verify
from pbonet.xm.net import messages as m

READS = """
from typing import Annotated as A

from pbonet import OutVar, Params, PortBasedObject, Vector, param
from pbonet.io.drivers import Mode, open_device


class Where(Params):
    device: A[str, param("none", "the device", device=True)] = "mem"


class Reads(PortBasedObject[Where]):
    y: A[Vector, OutVar("Y", "2", "none", "what was read")]

    def init(self) -> None:
        self.memory = open_device(self.params.device, 3, mode=Mode.READ)

    def cycle(self, dt: float) -> None:
        self.y[0] = self.memory.read(1, at=5)[0]
"""


def told(nodes):
    """Return what ``pbonet devices`` says."""
    words = ["devices", "--json", "--domain", nodes.domain]
    done = subprocess.run(
        [sys.executable, "-m", "pbonet.cli", *words],
        capture_output=True,
        text=True,
        timeout=200,
        check=True,
    )
    return json.loads(done.stdout)


def test_a_device_of_a_machine_is_read_told_freed_and_replayed(nodes, tmp_path):
    file = tmp_path / "memory"
    file.write_bytes(bytes(range(64)))
    mem = Entry(driver="file", address=str(file), first=2, ports=8)
    nodes.write_module("reads", READS)
    nodes.agent_processes("arm0", "arm1", device={"mem": mem})
    arm, leg = nodes.master("arm0", "arm"), nodes.master("arm1", "leg")
    path = record(arm)
    arm.spawn("first", "reads", text=rmod("reads"))
    arm.on("first")
    wait_for(lambda: arm.value("Y0").values[0] == 5.0, "what the file has")
    pid = arm.status("first").tid
    user = {"port": 3, "task": "arm0/first", "mode": "READ", "pid": pid}
    device, same = told(nodes)["devices"]
    assert (same["rtpu"], same["users"]) == ("arm1", [user]), "on one machine"
    assert device.pop("host") == same["host"]
    assert device == {
        "rtpu": "arm0",
        "name": "mem",
        "driver": "file",
        "kind": "MEM",
        "address": str(file),
        "first": 2,
        "ports": 8,
        "users": [user],
        "fault": None,
    }
    for one in (arm, leg):
        error = one.refused(
            MethodError, one.spawn, "other", "reads", text=rmod("reads", "Y1")
        )
        assert f"port 3: arm0/first (process {pid})" in str(error)
    os.kill(pid, signal.SIGKILL)
    leg.spawn("other", "reads", text=rmod("reads", "Y1"))  # at once
    leg.on("other")
    wait_for(lambda: leg.value("Y1").values[0] == 5.0, "what the file has")
    leg.kill("other")
    arm.wait_event("TASK_DIED", "first")
    arm.spawn("other", "reads", text=rmod("reads", "Y1"))
    arm.on("other")
    wait_for(lambda: arm.value("Y1").values[0] == 5.0, "what the file has")
    arm.off("other")
    arm.kill("other")
    log = finish(arm, path)
    file.unlink()
    for verdict in verify(log, ["first", "other"]):
        assert verdict.good, str(verdict)
        assert verdict.cycles


def test_a_task_goes_where_its_device_is_and_is_refused_elsewhere(nodes, tmp_path):
    file = tmp_path / "memory"
    file.write_bytes(bytes(range(64)))
    mem = Entry(driver="file", address=str(file), ports=8)
    nodes.write_module("reads", READS)
    nodes.agent_process("arm0", wait=False)
    nodes.agent_process("arm1", wait=False, device={"mem": mem})
    for name in ("arm0", "arm1"):
        nodes.wait_agent(name)
    sbs = "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nRTPU arm1\nEOF\n"
    (tmp_path / "t.sbs").write_text(sbs)
    (tmp_path / "t.svar").write_text(svar())
    (tmp_path / "reads.rmod").write_text(rmod("reads"))
    for name, line in {"free": "TASK reads", "far": "TASK reads arm0"}.items():
        (tmp_path / f"{name}.job").write_text(
            f"JOB {name}\nDESC d\nSBS t.sbs\n{line}\nEOF\n"
        )
    arm = Subsystem(
        tmp_path / "t.sbs",
        domain=nodes.domain,
        libraries=nodes.config("arm0").libraries,
        warned=lambda _text: None,
        record="off",
    ).open()
    try:
        for refused in (arm.check, arm.start):
            with pytest.raises(VerificationError) as caught:
                refused(tmp_path / "far.job")
            said = "far.job:4:1: arm0 has no device mem, which reads opens"
            assert said in str(caught.value)
            assert "mem stands on arm1" in str(caught.value)
        with pytest.raises(VerificationError, match="mem stands on arm1"):
            arm.spawn("reads", "arm0")
        assert not [task for one in arm.rtpu_status() for task in one.tasks]
        (status,) = arm.start(tmp_path / "free.job")
        assert status.rtpu == "arm1"
    finally:
        arm.finish()


SENSOR = """MODULE {module}
DESC a sensor or its twin
SVARALIAS Y=Y0
INCONST none
OUTCONST none
INVAR none
OUTVAR Y
TASKTYPE periodic
FREQ 50
LOCAL
SCALE 1.0
{local}
EOF
"""


FORCE = """MODULE ft300
DESC a force sensor
SVARALIAS F_RAW=F
INCONST none
OUTCONST none
INVAR none
OUTVAR F_RAW
TASKTYPE synchronous
FREQ 20
HANDLER 30
LOCAL
DEVICE force
SILENT 0.5
EOF
"""
WRENCH = """
NAME F
TYPE double
DESC a wrench
UNITS mixed
NELEM 6

EOF
"""
FRAME = bytes.fromhex("204e0100020003000400050006007c5b")


@pytest.fixture
def sensors(nodes, tmp_path):
    """A master of a machine with a converter, and the far end of a force sensor."""
    for k in (0, 1):
        (tmp_path / f"in_voltage{k}_raw").write_text("7\n")
    far, near = os.openpty()
    tty.setraw(far)
    devices = {
        "adc": Entry(driver="iio_adc", address=str(tmp_path)),
        "force": Entry(driver="serial", address=os.ttyname(near)),
    }
    nodes.agent_process("arm0", device=devices)
    arm = nodes.master("arm0", "arm", table=False)
    arm.open_table(svar().replace("\nEOF\n", WRENCH))
    yield arm, far
    os.close(far)
    os.close(near)


def force_until_it_is_silent(arm, far):
    """Run the force sensor in cycles of its own, and end it by its silence."""
    arm.spawn("force", "ft300", text=FORCE)
    arm.on("force")

    def measured():
        os.write(far, b"\x20" + FRAME * 3)
        return arm.value("F").values == pytest.approx([0.01, 0.02, 0.03, *TORQUE])

    wait_for(measured, "a wrench")
    event = arm.wait_event("METHOD", "force")
    assert "the sensor has sent no frame for 0.5 s" in event.text
    assert arm.status("force").state == "ERROR"
    arm.kill("force")


TORQUE = 0.004, 0.005, 0.006


def test_sensors_and_twins_of_a_machine(sensors):
    """A twin takes a sensor's place without a lost cycle; a sensor is a clock."""
    arm, far = sensors
    path = record(arm)
    tasks = {"real": "DEVICE adc", "twin": "MEAN 3"}
    values = {"real": [7.0, 7.0], "twin": [3.0, 3.0]}
    for task, local in tasks.items():
        module = {"real": "linear_sensor", "twin": "linear_sensor_sim"}[task]
        arm.spawn(task, module, text=SENSOR.format(module=module, local=local))
    arm.on("real")
    old, new = "real", "twin"
    for _ in range(6):
        wait_for(lambda old=old: arm.value("Y0").values == values[old], "a value")
        arm.ask(m.Reconfig(items=[(old, "off"), (new, "on")]), m.Reconfigured)
        old, new = new, old
    wait_for(lambda: arm.value("Y0").values == values["real"], "a value")
    arm.off("real")
    for task in tasks:
        arm.kill(task)
    force_until_it_is_silent(arm, far)
    log = finish(arm, path)
    found = []
    for life in [*log.lives("real"), *log.lives("twin")]:
        arrays = life.schema.arrays(life.commits)
        releases = arrays["release_ns"][arrays["kind"] == 0]
        found += [(int(at), life.name) for at in releases]
    gaps = [
        (after[0] - before[0]) * 50 / 1e9
        for before, after in pairwise(sorted(found))
        if before[1] != after[1]
    ]
    assert len(gaps) == 6
    assert all(gap == pytest.approx(round(gap)) and gap > 0.5 for gap in gaps)
    assert median(gaps) == pytest.approx(1.0)  # the machine may be busy now and then
    for verdict in verify(log, ["real", "twin", "force"]):
        assert verdict.good, str(verdict)
        assert verdict.cycles
