"""The gimbal of a MAVLink vehicle, over its task's link."""

from math import nan, sqrt
from typing import Annotated as A, Any, Literal

from pbonet import InConst, InVar, OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._mavlink import Commands, Every, finite, link_of
from pbonet.modules._values import keep

CONFIGURE = 1001
"""The command that takes control of a gimbal."""
LEVEL = 4 | 8
"""Flags: roll and pitch are those of the horizon."""
YAW = {"vehicle": 32, "earth": 16 | 64}
"""Flags: from where the yaw is."""
AGAIN_NS = 1_000_000_000
"""Nanoseconds between two attempts to take control."""
SHORTEST = 0.5
"""Norm of four numbers that are no attitude."""


class Pointing(Params):
    """The gimbal, and how it is steered."""

    device: A[int, param("none", "its id; 0 is the vehicle's first", ge=0, le=255)] = 0
    yaw: A[
        Literal["vehicle", "earth"],
        param("none", "GIMBAL_DES is from the vehicle's heading, or from north"),
    ] = "vehicle"
    rate: A[float, param("Hz", "attitudes sent a second", gt=0)] = 20.0
    silent: A[float, param("s", "an older GIMBAL_DES is not sent", gt=0)] = 0.5
    component: A[int, param("none", "that of its manager", ge=1, le=255)] = 1


class MavGimbal(PortBasedObject[Pointing], module_class="robot interface"):
    """GIMBAL_DES to the gimbal of the vehicle, and its attitude out.

    A part of the task of `mav_vehicle`, after it, by version 2 of the gimbal protocol.
    While GIMBAL_DES is not older than SILENT it asks the vehicle for control, and sends
    attitudes, RATE times a second, as soon as the vehicle says that this station has
    it: then GIMBAL_OURS is 1. When another station takes it over, nothing is sent until
    the task is turned off and on again. So too when the vehicle is lost. While
    GIMBAL_DES is older, or the configuration is illegal, nothing is sent; the gimbal
    keeps the attitude that it has. A MAXAGE of GIMBAL_DES would be about the whole
    task, so that a silent wish ended the vehicle's set-points.

    Roll and pitch are from the horizon. GIMBAL_AGE is the age of GIMBAL_MEZ and
    GIMBAL^_MEZ, from arrival.
    """

    system: A[int, InConst("MAV_SYS", "1", "none", "system id of the vehicle")]
    des: A[Vector, InVar("GIMBAL_DES", "4", "none", "desired attitude w x y z")]
    att: A[Vector, OutVar("GIMBAL_MEZ", "4", "none", "attitude w x y z", new=True)]
    rates: A[Vector, OutVar("GIMBAL^_MEZ", "3", "rad/s", "its rates", new=True)]
    age: A[float, OutVar("GIMBAL_AGE", "1", "s", "since they were heard", new=True)]
    ours: A[int, OutVar("GIMBAL_OURS", "1", "none", "1: it follows us", new=True)]

    def init(self) -> None:
        self._link = link_of(self.task)
        self._commands = Commands()

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"component", "device"})
        self._due = Every(self.params.rate)

    def on(self) -> None:
        self._heard_ns, self._began_ns = 0, self.task.now
        self._next_ns = 0
        self._taken = False
        self.ours, self.age = 0, 0.0
        self._due = Every(self.params.rate)
        self._commands.clear()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the clock tells
        self._receive()
        if self._taken or not self._link.alive or not self._is_fresh():
            self._commands.clear()
            return
        now, size = self.task.now, sqrt(float(self.des @ self.des))
        if size < SHORTEST:
            return
        if not self.ours:
            self._take_control(now)
        elif self._due.due(now):
            self._send(self.des / size)
        for problem in self._commands.run(self._link, now):
            self.task.warn(f"gimbal of vehicle {self.system}: {problem}")

    def stable(self, dt: float) -> None:  # noqa: ARG002
        """Send nothing."""
        self._commands.clear()
        self._receive()

    def _is_fresh(self) -> bool:
        task = self.task
        return task.age("des") <= self.params.silent and not task.stale("des")

    def _take_control(self, now: int) -> None:
        if now < self._next_ns:
            return
        self._next_ns = now + AGAIN_NS
        link, k = self._link, self.params
        control = [link.system, link.component, -1.0, -1.0, 0.0, 0.0, k.device]
        self._commands.ask(
            link.mav.command_long_encode(
                self.system, k.component, CONFIGURE, 0, *control
            ),
            now,
        )

    def _send(self, q: Vector) -> None:
        k, link = self.params, self._link
        link.send(
            link.mav.gimbal_manager_set_attitude_encode(
                self.system,
                k.component,
                LEVEL | YAW[k.yaw],
                k.device,
                q.tolist(),
                *(nan, nan, nan),
            )
        )

    def _receive(self) -> None:
        now, link = self.task.now, self._link
        for m in link.all_of("GIMBAL_DEVICE_ATTITUDE_STATUS"):
            if not self._is_ours(m, m.get_srcComponent()):
                continue
            rates = m.angular_velocity_x, m.angular_velocity_y, m.angular_velocity_z
            if finite(*m.q):
                self._heard_ns = now
                self.att[:] = m.q
                self.rates[:] = rates if finite(*rates) else 0.0
        self.age = (now - (self._heard_ns or self._began_ns)) * 1e-9
        for m in link.all_of("GIMBAL_MANAGER_STATUS"):
            if m.get_srcComponent() == self.params.component and self._is_ours(m, 0):
                self._take_status(m)
        if not link.alive:
            self.ours = 0

    def _is_ours(self, m: Any, component: int) -> bool:  # noqa: ANN401 - a message
        """Return whether a message is about our gimbal."""
        return self.params.device in {0, m.gimbal_device_id, component}

    def _take_status(self, m: Any) -> None:  # noqa: ANN401
        """Judge who has control."""
        owner = m.primary_control_sysid, m.primary_control_compid
        ours = owner == (self._link.system, self._link.component)
        if self.ours and not ours and not self._taken:
            self._taken = True
            self.task.warn(
                f"gimbal of vehicle {self.system}: system {owner[0]} has taken it: "
                "nothing is sent until the task is turned off and on"
            )
        self.ours = int(ours and not self._taken)
