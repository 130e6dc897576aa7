"""What tests of express mail share: headers, children that wait, data of an agent."""

import mmap

import numpy as np
from svar_rig import ROOT, Child, wait_for

from pbonet.xm.net.agents import AgentInfo

HEADERS = ROOT / "pbonet" / "xm" / "ipc"
SECOND = 1_000_000_000
LONG = 30 * SECOND
"""Nanoseconds that a wait has which must not time out."""


def words(n: int) -> np.ndarray:
    """Return `n` shared 64-bit words that outlive forks."""
    return np.frombuffer(mmap.mmap(-1, 8 * n), np.int64)


def agent_info(name: str, *, host: str = "h", **more: object) -> AgentInfo:
    """Return what an agent says of itself: defaults, but for `more`."""
    said = {"domain": "d", "host": host, "machine": host, "core": 1, "cores": 2}
    said |= {"pid": 1, "rtpu_pid": 2, "backend": "fifo", "version": "0", "python": "3"}
    return AgentInfo(name=name, **said | more)


class Line:
    """Children that wait for one thing, and in which order they got it."""

    def __init__(self, shared) -> None:
        self.shared = shared
        self.served = words(64)  # the first word counts
        self.children: list[Child] = []

    def join(self, role, mark: int) -> Child:
        """Have a child run `role` (a wait); what returns true is noted as `mark`."""
        before = self.shared.waiting

        def wait() -> None:
            if role():
                self.served[0] += 1  # one at a time: the parent sees to that
                self.served[self.served[0]] = mark

        child = Child(wait)
        self.children.append(child)
        wait_for(lambda: self.shared.waiting == before + 1, "it to stand in the line")
        return child

    @property
    def order(self) -> list[int]:
        return self.served[1 : 1 + self.served[0]].tolist()

    def after(self, count: int) -> list[int]:
        """Return the order, once `count` were served."""
        wait_for(lambda: self.served[0] >= count, f"{count} to be served")
        return self.order

    def end(self) -> list[int]:
        """Return the exit codes of all."""
        return [child.end() for child in self.children]
