"""Machines as network namespaces, joined by cables that can be pulled.

Three hosts, each with a cable to each other one. A cable is a pair of virtual Ethernet
devices with addresses of their own, so that pulling one leaves the others alone:

    a -- b: 10.77.1.1, 10.77.1.2     b -- c: 10.77.2.2, 10.77.2.3
    a -- c: 10.77.3.1, 10.77.3.3     and fd77:N::K beside each 10.77.N.K

A host has a name of its own, and a clock of its own where that was asked for. Making
one takes root; where that is missing `missing` says so.
"""

from __future__ import annotations

import contextlib
import math
import os
import secrets
import shutil
import subprocess

from ._delay import Delay

CABLES = {("a", "b"): 1, ("b", "c"): 2, ("a", "c"): 3}
NUMBERS = {"a": 1, "b": 2, "c": 3}
NOBODY = "02:00:00:00:00:99"
"""An address that no device has: frames for it are dropped by each receiver."""
_RANDOM = 0xFFFFF038
"""Where a packet filter of the kernel reads a random number of 32 bits."""
_DROP, _NEXT = 2, 0xFFFFFFFF
"""Results of such a filter."""


def _run(*command: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, check=check, capture_output=True, text=True)


def missing() -> str:
    """Return why no hosts can be made here; empty when they can."""
    tools = [name for name in ("ip", "nsenter", "unshare") if not shutil.which(name)]
    if tools:
        return f"hosts need {' and '.join(tools)} (iproute2, util-linux)"
    if os.geteuid() != 0:
        return "making network namespaces needs root"
    name = f"pbt{secrets.token_hex(3)}"
    made = _run("ip", "netns", "add", name, check=False)
    if made.returncode:
        return f"no network namespaces here: {made.stderr.strip()}"
    try:
        pair = ("type", "veth", "peer", "name", f"{name}b")
        inside = ("ip", "-n", name, "link", "add", f"{name}a", *pair)
        tried = _run(*inside, check=False)
    finally:
        _run("ip", "netns", "del", name)
    return f"no cables here: {tried.stderr.strip()}" if tried.returncode else ""


class Host:
    """One machine.

    Args:
        lan: The network that it belongs to.
        name: ``a``, ``b`` or ``c``.
        ahead: Seconds by which its monotonic clock is set apart from the others.
        hostname: Its host name; ``host-`` and `name` if left out.
    """

    def __init__(
        self, lan: Lan, name: str, ahead: float = 0.0, hostname: str = ""
    ) -> None:
        self.name = name
        self.hostname = hostname or f"host-{name}"
        self.space = f"pb{lan.tag}{name}"
        self.ahead = ahead

    def address(self, other: str, *, six: bool = False) -> str:
        """Return the address that host `other` sees this one at."""
        one, two = sorted((self.name, other))
        cable = CABLES[one, two]
        number = NUMBERS[self.name]
        return f"fd77:{cable}::{number}" if six else f"10.77.{cable}.{number}"

    def command(self, *command: str) -> list[str]:
        """Return the command line that starts `command` on this host."""
        uts = ["unshare", "--uts"]
        if self.ahead:
            uts += ["--time", "--monotonic", f"{self.ahead:g}"]
        shell = f'hostname {self.hostname} && exec "$@"'
        inside = [*uts, "sh", "-c", shell, "sh", *command]
        return ["nsenter", f"--net=/run/netns/{self.space}", *inside]


class Lan:
    """Three hosts and the cables between them.

    Args:
        ahead: By host, the seconds by which its clock is ahead.
        hostnames: By host, its host name; two may have one name.
    """

    def __init__(
        self,
        ahead: dict[str, float] | None = None,
        hostnames: dict[str, str] | None = None,
    ) -> None:
        self.tag = secrets.token_hex(3)
        self.hosts: dict[str, Host] = {}
        self._ahead = ahead or {}
        self._hostnames = hostnames or {}
        self._muted: set[tuple[str, str]] = set()
        self._lossy: set[tuple[str, str]] = set()
        self._delay: Delay | None = None
        try:
            self._make()
        except BaseException:
            self.close()
            raise

    def __getitem__(self, name: str) -> Host:
        return self.hosts[name]

    def cut(self, one: str, other: str) -> None:
        """Pull the cable between two hosts."""
        self._set_cable(one, other, "down")

    def mute(self, one: str, other: str) -> None:
        """Drop everything sent over a cable, which looks intact from both ends."""
        self._muted.add((one, other))
        for host, peer in ((one, other), (other, one)):
            for six in (False, True):
                address = self.hosts[peer].address(host, six=six)
                self._neighbour(host, peer, "replace", address, "lladdr", NOBODY)

    def lose(self, sender: str, receiver: str, share: float = 1.0) -> None:
        """Lose a share of what is sent over a cable in one direction.

        It needs `tc` (iproute2). `heal` ends it.

        Args:
            sender: The host whose packets are lost.
            receiver: The other end of the cable, where they are dropped.
            share: From 0 to 1, of the packets, at random.
        """
        self._keep(sender, receiver)
        self._lossy.add((sender, receiver))
        least = min(round(share * 2**32), 2**32 - 1)
        lines = f"32 0 0 {_RANDOM}", f"53 1 0 {least}", f"6 0 0 {_DROP}"
        filter_ = ",".join((f"{len(lines) + 1}", *lines, f"6 0 0 {_NEXT}"))
        device = ("dev", f"to-{sender}")
        tc = ("tc", "-n", self.hosts[receiver].space)
        _run(*tc, "qdisc", "add", *device, "clsact")
        _run(
            *(*tc, "filter", "add", *device, "ingress"),
            *("bpf", "direct-action", "bytecode", filter_),
        )

    def _keep(self, sender: str, receiver: str) -> None:
        """End the loss in one direction of a cable."""
        if (sender, receiver) in self._lossy:
            self._lossy.discard((sender, receiver))
            where = ("dev", f"to-{sender}", "clsact")
            _run("tc", "-n", self.hosts[receiver].space, "qdisc", "del", *where)

    def heal(self, one: str, other: str) -> None:
        """Plug it in again, or let it carry again."""
        for sender, receiver in ((one, other), (other, one)):
            self._keep(sender, receiver)
        self._set_cable(one, other, "up")
        for host, peer in self._muted & {(one, other), (other, one)}:
            self._muted.discard((host, peer))
            for near, far in ((host, peer), (peer, host)):
                self._neighbour(near, far, "flush")

    def heal_all(self) -> None:
        """Plug every cable in."""
        for one, other in CABLES:
            self.heal(one, other)

    def slow(self, one: str, other: str, seconds: float) -> None:
        """Delay the traffic of a cable, each way, until `quick`."""
        middle = f"pb{self.tag}m"
        _run("ip", "netns", "add", middle)
        try:
            for host, peer in ((one, other), (other, one)):
                self._lead(host, peer, middle)
            devices = f"end-{one}", f"end-{other}"
            self._delay = Delay(middle, devices, seconds)
        except BaseException:
            self.quick()
            raise

    def narrow(self, one: str, other: str, rate: float) -> None:
        """Let a cable carry at most `rate` bytes a second, each way; `inf` ends it.

        What does not fit waits for up to 0.4 s, and is lost then. It needs `tc`
        (iproute2).
        """
        limit = ("tbf", "rate", f"{rate * 8:.0f}bit", "burst", "3kb", "latency")
        for host, peer in ((one, other), (other, one)):
            tc = ("tc", "-n", self.hosts[host].space, "qdisc")
            where = ("dev", f"to-{peer}", "root")
            _run(*tc, "del", *where, check=False)
            if math.isfinite(rate):
                _run(*tc, "add", *where, *limit, "400ms")

    def quick(self) -> None:
        """Delay nothing any more."""
        if self._delay is not None:
            self._delay.close()
            self._delay = None
        _run("ip", "netns", "del", f"pb{self.tag}m", check=False)

    def close(self) -> None:
        """Remove everything, whatever state it is in."""
        self.quick()
        for host in self.hosts.values():
            with contextlib.suppress(subprocess.CalledProcessError):
                _run("ip", "netns", "del", host.space)

    def _make(self) -> None:
        for name in NUMBERS:
            ahead, hostname = self._ahead.get(name, 0.0), self._hostnames.get(name, "")
            host = self.hosts[name] = Host(self, name, ahead, hostname)
            _run("ip", "netns", "add", host.space)
            _run("ip", "-n", host.space, "link", "set", "lo", "up")
        for (one, other), number in CABLES.items():
            here, there = self.hosts[one].space, self.hosts[other].space
            pair = ("type", "veth", "peer", "name", f"to-{one}", "netns", there)
            _run("ip", "-n", here, "link", "add", f"to-{other}", *pair)
            for near, far in ((one, other), (other, one)):
                self._address(near, far, number)
        for one, other in CABLES:
            self.heal(one, other)

    def _address(self, host: str, peer: str, number: int) -> None:
        space, device = self.hosts[host].space, f"to-{peer}"
        four = f"10.77.{number}.{NUMBERS[host]}/24"
        six = f"fd77:{number}::{NUMBERS[host]}/64"
        _run("ip", "-n", space, "addr", "add", four, "dev", device)
        # An IPv6 address would go with the link, and be probed twice at first.
        for name, value in (("keep_addr_on_down", 1), ("accept_dad", 0)):
            path = f"/proc/sys/net/ipv6/conf/{device}/{name}"
            _run(
                *("nsenter", f"--net=/run/netns/{space}", "sh", "-c"),
                f"echo {value} > {path}",
            )
        _run("ip", "-n", space, "addr", "add", six, "dev", device, "nodad")

    def _lead(self, host: str, peer: str, middle: str) -> None:
        """Have a host send to another by way of a device that ends in the middle."""
        space, device = self.hosts[host].space, f"late-{peer}"
        pair = ("type", "veth", "peer", "name", f"end-{host}", "netns", middle)
        _run("ip", "-n", space, "link", "add", device, *pair)
        _run("ip", "-n", middle, "link", "set", f"end-{host}", "up")
        _run("ip", "-n", space, "link", "set", device, "up")
        for six in (False, True):
            here = self.hosts[host].address(peer, six=six)
            there = self.hosts[peer].address(host, six=six)
            _run("ip", "-n", space, "route", "add", there, "dev", device, "src", here)

    def _neighbour(self, host: str, peer: str, verb: str, *what: str) -> None:
        """Change what a host knows of the address of a device that it is joined to."""
        where = ("dev", f"to-{peer}", "nud", "permanent")
        _run("ip", "-n", self.hosts[host].space, "neigh", verb, *what, *where)

    def _set_cable(self, one: str, other: str, state: str) -> None:
        for host, peer in ((one, other), (other, one)):
            space = self.hosts[host].space
            _run("ip", "-n", space, "link", "set", f"to-{peer}", state)


__all__ = ["CABLES", "Host", "Lan", "missing"]
