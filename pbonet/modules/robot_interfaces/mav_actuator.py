"""Actuators of a MAVLink vehicle, over its task's link: grippers, valves, servos."""

from math import nan
from typing import Annotated as A

import numpy as np

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.errors import ParameterError
from pbonet.modules._mavlink import Commands, Every, link_of
from pbonet.modules._values import keep

SET = 187
"""The command that sets up to six actuators."""
MOST = 6
PULSES = 16
"""Pulses of one message."""
NAMES = tuple(f"servo{k}_raw" for k in range(1, PULSES + 1))


class Outputs(Params):
    """Which actuators are set, and how often."""

    group: A[int, param("none", "which six: 0 is actuators 1 to 6", ge=0, le=100)] = 0
    step: A[float, param("none", "smallest change that is sent", gt=0)] = 0.01
    rate: A[float, param("Hz", "changes sent a second at most", gt=0)] = 10.0
    silent: A[float, param("s", "an older ACT_DES is not sent", gt=0)] = 0.5
    component: A[int, param("none", "that of its autopilot", ge=1, le=255)] = 1


class MavActuator(PortBasedObject[Outputs], module_class="robot interface"):
    """ACT_DES, -1 to 1, to actuators of the vehicle; PULSE_MEZ is what it puts out.

    A part of the task of `mav_vehicle`, after it. ACT_DES is sent when it changes by
    STEP while the task is ON, until the vehicle answers (MAV_CMD_DO_SET_ACTUATOR); what
    it is at `on` is not sent. While it is older than SILENT, the configuration illegal,
    or the vehicle lost, nothing is sent, also not later: what ACT_DES is when it counts
    again is as at `on`. After a loss that needs `off` and `on`. The actuators keep what
    they have; what they do then is set in the autopilot.

    PULSE_MEZ are the pulses of all outputs, motors included (SERVO_OUTPUT_RAW), in
    seconds, 0 for those that have none; PULSE_AGE is their age, from arrival.
    """

    system: A[int, InConst("MAV_SYS", "1", "none", "system id of the vehicle")]
    des: A[Vector, InVar("ACT_DES", "nact", "none", "desired, -1 to 1")]
    pulse: A[Vector, OutVar("PULSE_MEZ", "npulse", "s", "pulses put out", new=True)]
    age: A[float, OutVar("PULSE_AGE", "1", "s", "since they were heard", new=True)]

    def init(self) -> None:
        if len(self.des) > MOST:
            raise ParameterError(
                "too many actuators",
                expected=f"ACT_DES of at most {MOST} elements: a command sets {MOST}",
                got=str(len(self.des)),
                remedy="change NELEM of the variable",
            )
        self._link = link_of(self.task)
        self._commands = Commands()
        self._sent: Vector | None = None

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"component", "group"})
        self._due = Every(self.params.rate)

    def on(self) -> None:
        self._heard_ns, self._began_ns = 0, self.task.now
        self.age = 0.0
        self._due = Every(self.params.rate)
        self._forget()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the clock tells
        self._receive()
        old = self.task.age("des") > self.params.silent or self.task.stale("des")
        if old or not self._link.alive:
            self._forget()
            return
        wanted = np.clip(self.des, -1.0, 1.0)
        if self._sent is None:
            self._sent = wanted
        now = self.task.now
        if np.abs(wanted - self._sent).max() >= self.params.step and self._due.due(now):
            self._sent = wanted
            self._send(wanted, now)
        for problem in self._commands.run(self._link, now):
            self.task.warn(f"actuators of vehicle {self.system}: {problem}")

    def stable(self, dt: float) -> None:  # noqa: ARG002
        """Send nothing."""
        self._receive()
        self._forget()

    def _forget(self) -> None:
        """Send nothing that was wanted until now."""
        self._commands.clear()
        self._sent = None

    def _send(self, wanted: Vector, now: int) -> None:
        k, link = self.params, self._link
        values = [*wanted.tolist(), *[nan] * (MOST - len(wanted))]
        self._commands.ask(
            link.mav.command_long_encode(
                self.system, k.component, SET, 0, *values, k.group
            ),
            now,
        )

    def _receive(self) -> None:
        now = self.task.now
        for m in self._link.all_of("SERVO_OUTPUT_RAW"):
            if m.get_srcComponent() != self.params.component:
                continue
            self._heard_ns = now
            first = m.port * PULSES
            for k, name in enumerate(NAMES[: max(len(self.pulse) - first, 0)], first):
                self.pulse[k] = getattr(m, name) * 1e-6
        self.age = (now - (self._heard_ns or self._began_ns)) * 1e-9
