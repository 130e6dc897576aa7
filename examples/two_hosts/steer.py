"""Runs the two subsystems and says, line by line, what the arm knows of its target.

    python examples/two_hosts/steer.py --connect tcp/HOST:7447 [--seconds 10]

Agents arm0, arm1 and eye0 must run somewhere: on one machine, on three, or in
containers. The age is that of the target's pose as the arm has it; the distance is from
the hand to that pose. SIGTERM ends both subsystems in order.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from pbonet import Subsystem
from pbonet.errors import PbonetError
from pbonet.xm.net import session

HERE = Path(__file__).parent
RTPUS = {"arm0", "arm1", "eye0"}
LOOK = 0.2
"""Seconds between two looks."""
POSITION = [3, 7, 11]
"""Elements of a pose in which the position is."""


def say(text: str) -> None:
    """Print a line at once, also into a pipe."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def look(arm: Subsystem, begin: float) -> str:
    """Return a line about the target and the hand."""
    seen, hand = arm.display(["X_DES", "X_MEZ"])
    apart = np.subtract(seen.values, hand.values)[POSITION]
    age = (
        f"{1e3 * seen.age:7.0f}" if seen.writer and seen.age is not None else "   none"
    )
    return f"{time.monotonic() - begin:6.2f}  {age}  {1e3 * np.linalg.norm(apart):7.1f}"


def watch(arm: Subsystem, seconds: float, over: threading.Event) -> None:
    """Say how it goes until the time is over or somebody ends it."""
    say("     s  age ms  apart mm")
    begin = time.monotonic()
    while time.monotonic() - begin < seconds and not over.wait(LOOK):
        try:
            say(look(arm, begin))
        except PbonetError as error:
            say(f"        {error}")


def meet(seconds: float, *, domain: str, connect: list[str]) -> None:
    """Wait until the agents are there, at most so long."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with (
            contextlib.suppress(PbonetError),
            session.client(domain, connect=connect) as link,
        ):
            if not RTPUS - set(session.rtpus(link, domain)):
                return
        time.sleep(LOOK)


def main(argv: list[str] | None = None) -> None:
    """Start both subsystems, watch, end both."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--connect", action="append", default=[], metavar="ENDPOINT")
    words.add_argument("--domain", default="default")
    words.add_argument("--seconds", type=float, default=10.0)
    words.add_argument("--wait", type=float, default=0.0, help="for agents, s")
    told = words.parse_args(argv)
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda _number, _frame: over.set())
    reach = {"domain": told.domain, "connect": told.connect}
    try:
        meet(told.wait, **reach)
        with (
            Subsystem(HERE / "vision.job", **reach) as vision,
            Subsystem(HERE / "arm.job", **reach) as arm,
        ):
            vision.start()
            arm.start()
            watch(arm, told.seconds, over)
    except PbonetError as error:
        sys.exit(f"steer: {error}")


if __name__ == "__main__":
    main()
