"""Tasks with one device take each other's place: by a swap, and as a fallback."""

from __future__ import annotations

import os
import signal

from nodekit import rmod, svar
from watching import wait_for

from pbonet.config import Entry
from pbonet.master.subsystem import Subsystem

ACTUATES = """
from contextlib import suppress
from typing import Annotated as A, Any

from pbonet import OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import DeviceTakenError
from pbonet.io.drivers import Mode, open_device


class What(Params):
    device: A[str, param("none", "the device", device=True)] = "dac"
    value: A[int, param("none", "what it is given")] = 1


class Actuates(PortBasedObject[What]):
    y: A[Vector, OutVar("Y", "2", "none", "cycles")]

    def init(self) -> None:
        self._dac: Any = None
        with suppress(DeviceTakenError):
            self._dac = self._open()

    def on(self) -> None:
        if self._dac is None or not self._dac.is_open:
            self._dac = self._open()

    def _open(self) -> Any:
        return open_device(self.params.device, mode=Mode.WRITE, safe=[5])

    def cycle(self, dt: float) -> None:
        self.y[0] += 1.0
        if self.params.value == 9:
            raise RuntimeError("it fails")
        self._dac.write([self.params.value])
"""
JOB = """
JOB  shared
DESC a task and its standby at one device
SBS  t.sbs
TASK first arm0 FALLBACK second
EOF
"""


def test_tasks_of_one_device_take_each_others_place(nodes, tmp_path):
    value = tmp_path / "out_voltage0_raw"
    value.write_text("0\n")
    dac = Entry(driver="iio_dac", address=str(tmp_path))
    nodes.write_module("actuates", ACTUATES)
    nodes.agent_process("arm0", device={"dac": dac})
    (tmp_path / "t.sbs").write_text("SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nEOF\n")
    (tmp_path / "t.svar").write_text(svar())
    for k, name in enumerate(("first", "second", "third"), 1):
        (tmp_path / f"{name}.rmod").write_text(rmod("actuates", local={"VALUE": k}))
    (tmp_path / "shared.job").write_text(JOB)
    arm = Subsystem(
        tmp_path / "t.sbs",
        domain=nodes.domain,
        libraries=nodes.config("arm0").libraries,
        warned=lambda _text: None,
        record="off",
    ).open()

    def is_given(number):
        wait_for(lambda: value.read_text() == f"{number}\n", f"{number} at the device")

    def task(name):
        return next(one for one in arm.rtpu_status()[0].tasks if one.task == name)

    try:
        arm.start(tmp_path / "shared.job")
        is_given(1)
        for going, coming, number in (("first", "third", 3), ("third", "first", 1)) * 2:
            arm.swap(going, coming)
            is_given(number)
        arm.set("first", "value", "9")
        is_given(2)
        wait_for(lambda: task("first").state == "ERROR", "its error")
        arm.set("first", "value", "1")
        arm.clear("first")
        arm.swap("second", "first")
        is_given(1)
        wait_for(lambda: task("second").state == "OFF", "the standby")
        os.kill(task("first").tid, signal.SIGKILL)
        is_given(2)
        wait_for(lambda: task("second").state == "ON", "its state")
        arm.off("second")
        is_given(5)
    finally:
        arm.finish()
