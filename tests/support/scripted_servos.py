"""Servos by their registers, as a device with ports that does not wait."""

from __future__ import annotations

from typing import ClassVar

from pbonet.errors import DeviceError
from pbonet.io.drivers import PortDevice, Wait

SIZES = 1, 1, 4, 2, 4, 4
"""Bytes of the registers 98, 64, 116, 126, 128 and 132."""
WATCHDOG, TORQUE, GOAL, CURRENT, SPEED, PLACE = range(6)


class Servos(PortDevice):
    """Two servos of each address; a reading is there a call after it was asked for."""

    kind = "RCB"
    waits = frozenset({Wait.ALL, Wait.NONE})
    tables: ClassVar[dict[str, list[list[int]]]] = {}
    silent = False

    def connect(self):
        self.table = self.tables[self.entry.address]
        self.asked = False

    def disconnect(self):
        pass

    def port_bits(self, port):
        return 8 * SIZES[port // 2]

    def read_ports(self):
        asked, self.asked = self.asked, True
        if not asked or Servos.silent:
            return None
        self.asked = False
        places = range(self.opening.start, self.opening.end + 1)
        return [self.table[port // 2][port % 2] for port in places]

    def write_ports(self, values):
        for port, value in enumerate(values, self.opening.start):
            register, servo = divmod(port, 2)
            if register == GOAL and self.table[WATCHDOG][servo] == 255:
                raise DeviceError("a servo refuses the request", where="watchdog")
            self.table[register][servo] = value
            if register == GOAL and self.table[TORQUE][servo]:
                self.table[PLACE][servo] = value
