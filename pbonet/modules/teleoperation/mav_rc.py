"""A pilot's sticks over MAVLink, as part of the task that owns the link."""

from collections.abc import Iterator
from typing import Annotated as A, Any

from pbonet import OutVar, Params, PortBasedObject, Vector, param
from pbonet.modules._mavlink import link_of
from pbonet.modules._values import PerElement, keep, spread

CENTRE, HALF = 1500.0, 500.0
"""Microseconds of a pulse in the middle, and from there to an end."""
NO_PULSE = {0, 65534, 65535}
"""Values of a channel that is not there, not used, or given back."""
FULL = 1000.0
"""An axis of MANUAL_CONTROL at its end."""
NO_AXIS = 32767
PULSES = tuple(f"chan{k}_raw" for k in range(1, 19))
MORE = ("s", "t", "aux1", "aux2", "aux3", "aux4", "aux5", "aux6")
"""Axes that a message has when its bit in `enabled_extensions` is set."""


class Sticks(Params):
    """When a pilot is lost, and what counts then."""

    silent: A[float, param("s", "without a message the pilot is lost", gt=0)] = 1.0
    neutral: A[PerElement, param("none", "RC_MEZ without a pilot", ge=-1, le=1)] = (
        0.0,
    )
    component: A[int, param("none", "that of the autopilot", ge=1, le=255)] = 1


class MavRc(PortBasedObject[Sticks], module_class="teleoperation"):
    """RC_MEZ = the pilot's channels, -1 to 1: (pulse - 1500 us) / 500 us.

    A part of the task of `mav_vehicle`, after it: the channels are those of the remote
    control that the vehicle receives (RC_CHANNELS). Or of the task of `mav_ground`:
    then they are what a station sends, as RC_CHANNELS_OVERRIDE, or MANUAL_CONTROL,
    whose axes are y (right), x (forward), z (up) and r (to the right), then s, t and
    aux1 to aux6; RC_BUTTONS are its buttons. A channel that the message lacks is
    NEUTRAL.

    Without a message for SILENT, or while the configuration is illegal, or when the
    other end is lost, the pilot is lost: RC_OK is 0 and RC_MEZ is NEUTRAL until the
    task is turned off and on again, whatever comes. Before the first message both are
    so, too.
    """

    rc: A[Vector, OutVar("RC_MEZ", "nrc", "none", "channels, -1 to 1", new=True)]
    ok: A[int, OutVar("RC_OK", "1", "none", "1 while a pilot is there", new=True)]
    age: A[float, OutVar("RC_AGE", "1", "s", "since the last message", new=True)]
    buttons: A[
        int, OutVar("RC_BUTTONS", "1", "none", "bits of buttons pressed", new=True)
    ]

    def init(self) -> None:
        self._link = link_of(self.task)
        self._neutral = spread(self.params.neutral, len(self.rc), "neutral")

    def set(self, name: str, value: object) -> None:  # noqa: ARG002 - by its name
        keep(name, {"component"})
        self._neutral = spread(self.params.neutral, len(self.rc), "neutral")

    def on(self) -> None:
        self._heard_ns, self._began_ns = 0, self.task.now
        self._lost, self.age = False, 0.0
        self._pressed = 0
        self._values = self._neutral.copy()
        self._rest()

    def cycle(self, dt: float) -> None:  # noqa: ARG002 - the clock tells
        self._receive()
        here = self._link.alive and self.age <= self.params.silent
        if self._heard_ns and not here:
            self._lose()
        if self._lost or not self._heard_ns:
            self._rest()
            return
        self.rc[:] = self._values
        self.ok, self.buttons = 1, self._pressed

    def stable(self, dt: float) -> None:  # noqa: ARG002
        """Write the neutral position."""
        self._receive()
        if self._heard_ns:
            self._lose()
        self._rest()

    def _rest(self) -> None:
        self.rc[:] = self._neutral
        self.ok = self.buttons = 0

    def _lose(self) -> None:
        if not self._lost:
            self._lost = True
            self.task.warn(
                f"no pilot (last heard {self.age:.3g} s ago): RC_MEZ is neutral until "
                "the task is turned off and on"
            )

    def _receive(self) -> None:
        now = self.task.now
        for values, pressed in self._messages() if self._link.alive else ():
            self._heard_ns, self._pressed = now, pressed & 0x7FFFFFFF
            self._values[:] = self._neutral
            for k, value in enumerate(values[: len(self.rc)]):
                if value is not None:
                    self._values[k] = min(max(value, -1.0), 1.0)
        self.age = (now - (self._heard_ns or self._began_ns)) * 1e-9

    def _messages(self) -> Iterator[tuple[list[float | None], int]]:
        """Yield channels and buttons of each message that counts, oldest first."""
        link = self._link
        if link.peer:  # a vehicle
            m = link.newest("RC_CHANNELS", self.params.component)
            if m is not None and m.chancount:
                yield _pulses(m, m.chancount), 0
            return
        for m in link.all_of("RC_CHANNELS_OVERRIDE"):
            if link.is_addressed(m):
                yield _pulses(m, len(PULSES)), 0
        for m in link.all_of("MANUAL_CONTROL"):
            if m.target in {0, link.system}:
                yield _axes(m), m.buttons | m.buttons2 << 16


def _pulses(m: Any, count: int) -> list[float | None]:  # noqa: ANN401 - a message
    """Return the channels of a message of pulses; None: it is not there."""
    raw: list[int] = [getattr(m, name) for name in PULSES[:count]]
    return [None if one in NO_PULSE else (one - CENTRE) / HALF for one in raw]


def _axes(m: Any) -> list[float | None]:  # noqa: ANN401
    """Return the axes of a MANUAL_CONTROL; None: it is not there."""
    raw: list[int] = [m.y, m.x, m.z, m.r]
    raw += [
        getattr(m, name) if m.enabled_extensions >> k & 1 else NO_AXIS
        for k, name in enumerate(MORE)
    ]
    return [None if one == NO_AXIS else one / FULL for one in raw]
