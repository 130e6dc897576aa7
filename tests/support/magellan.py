"""A Magellan ball that is only software: the device's end of a serial line."""

from __future__ import annotations

import os
import tty
from pathlib import Path

VERSION = "MAGELLAN  Version 5.79  3Dconnexion GmbH 05/05/01"
ALPHABET = "0AB3D56GH9:K<MN?"


class Magellan:
    """The device's end of a serial line, at a path that stays when it is replugged."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.master = -1
        self.mode = 0
        self.said = 0
        self._command = b""
        self.commands: list[bytes] = []

    def plug_in(self) -> None:
        """Appear at the path, in the state after power-up: nothing is reported."""
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(slave))
        os.close(slave)
        self.mode = self.said = 0
        self._command = b""

    def unplug(self) -> None:
        """Vanish, with the path."""
        self.link.unlink()
        os.close(self.master)
        self.master = -1

    def answer(self) -> None:
        """Obey the commands that have arrived."""
        try:
            self._command += os.read(self.master, 4096)
        except (BlockingIOError, OSError):
            return
        *lines, self._command = self._command.split(b"\r")
        for line in filter(None, lines):
            self.commands.append(line)
            if line == b"vQ":
                self.say(b"v" + VERSION.encode())
            elif line[:1] == b"m":
                self.mode = b"0AB3".index(line[1:])
                self.say(line)

    def push(self, *axes: int) -> None:
        """Report a deflection of six axes, if the mode that was set wants it."""
        if self.mode == 3:
            digits = "".join(f"{value + 32768:04x}" for value in axes)
            self.say(b"d" + "".join(ALPHABET[int(d, 16)] for d in digits).encode())

    def hold(self, *buttons: int) -> None:
        """Report which buttons are held, 1 to 9."""
        mask = sum(1 << (button - 1) for button in buttons)
        self.say(b"k" + "".join(ALPHABET[mask >> s & 15] for s in (0, 4, 8)).encode())

    def say(self, packet: bytes) -> None:
        """Send one packet."""
        self.raw(packet + b"\r")

    def raw(self, data: bytes) -> None:
        """Send bytes as they are."""
        self.said += len(data)
        while data:
            data = data[os.write(self.master, data) :]
