"""A MAVLink vehicle at 100 Hz with 50 messages a cycle: its share of a core.

`mav_vehicle` on a bench receives 50 messages of telemetry over the loopback in each
cycle, each in a datagram of its own, and sends set-points. Measured is the CPU time of
its `cycle` with the system calls, as MAXC is one, with the pause of its period between
two cycles, in which caches get cold. The objects that Python holds after the warm-up
and at the end must be the same but for `GROWTH`. The goal: at most 6 % of a core,
whether the link waits for the vehicle (udpin) or calls it (udpout). Ends with status 3
when one is missed.

    python -m benchmarks.mavlink [--cycles N]
"""

from __future__ import annotations

import argparse
import gc
import platform
import socket
import sys
import time
from importlib import import_module
from time import thread_time_ns
from typing import Any

import numpy as np

from pbonet.modules.robot_interfaces.mav_vehicle import MavVehicle
from pbonet.testing import Bench

RATE, MESSAGES = 100.0, 50
GOAL = 0.06
GROWTH = 100
"""Objects that the cycles after the warm-up may keep."""
MISSED = 3


def frames(mav: Any) -> list[bytes]:  # noqa: ANN401 - it has no types
    """Return the messages of one cycle as an autopilot sends them, packed."""
    kinds = [
        mav.attitude_quaternion_encode(1000, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3),
        mav.attitude_encode(1000, 0.1, 0.2, 0.3, 0.1, 0.2, 0.3),
        mav.local_position_ned_encode(1000, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3),
        mav.global_position_int_encode(1000, 473977000, 85456000, 1, 2, 3, 4, 5, 6),
        mav.vfr_hud_encode(1.0, 2.0, 90, 50, 100.0, 0.5),
    ]
    packed = [bytes(kinds[k % len(kinds)].pack(mav)) for k in range(MESSAGES - 1)]
    return [bytes(mav.heartbeat_encode(2, 12, 129, 0, 4, 3).pack(mav)), *packed]


def run(cycles: int, kind: str) -> tuple[np.ndarray[Any, np.dtype[np.float64]], int]:
    """Return the CPU time of each cycle (s), and how many objects they have kept.

    Args:
        cycles: How many are measured, after a tenth as many.
        kind: udpin or udpout.
    """
    common: Any = import_module("pymavlink.dialects.v20.common")

    other, place = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    for one in (other, place):
        one.bind(("127.0.0.1", 0))
    if kind == "udpin":
        to = place.getsockname()
        place.close()
    else:
        to = other.getsockname()
    params = {"address": f"{kind}:127.0.0.1:{to[1]}", "wait": 0.0}
    base = Bench(MavVehicle, params=params, freq=RATE, critical=True)
    used = list[float]()
    cycle = base.module.cycle

    def timed(dt: float) -> None:
        begin = thread_time_ns()
        cycle(dt)
        used.append((thread_time_ns() - begin) * 1e-9)

    setattr(base.module, "cycle", timed)  # noqa: B010 - as a type checker wants it
    setattr(base.executor.instance, "cycle", timed)  # noqa: B010
    base.inputs.setpoint = [84.0, 0xDF8, 1.0, 2.0, -3.0, *[0.0] * 8]
    base.on()
    base.step()
    if kind == "udpout":
        _, to = other.recvfrom(4096)
    sent = frames(common.MAVLink(None, 1, 1))
    before = 0
    for k in range(cycles // 10 + cycles):
        if k == cycles // 10:
            used.clear()
            gc.collect()
            before = len(gc.get_objects())
        for data in sent:
            other.sendto(data, to)
        time.sleep(1.0 / RATE)
        base.step()
    gc.collect()
    kept = len(gc.get_objects()) - before
    assert base.outputs.age < 2.0 / RATE, "what was sent has arrived"
    base.kill()
    other.close()
    place.close()
    return np.array(used), kept


def main() -> None:
    """Measure, and say whether the goals were met."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    words.add_argument("--cycles", type=int, default=1000)
    told = words.parse_args()
    print(f"{platform.processor() or platform.machine()}, {told.cycles} cycles")
    missed = False
    for kind in ("udpin", "udpout"):
        used, growth = run(told.cycles, kind)
        share = float(np.mean(used)) * RATE
        low, mid, high = 1e3 * np.quantile(used, (0.0, 0.5, 0.99))
        print(
            f"{kind}: cycle, CPU time: least {low:.2f} ms, p50 {mid:.2f} ms, "
            f"p99 {high:.2f} ms"
        )
        print(f"  share of a core at {RATE:g} Hz: {share:.1%} (goal {GOAL:.0%})")
        print(f"  objects kept: {growth} (goal {GROWTH})")
        missed = missed or share > GOAL or growth > GROWTH
    if missed:
        sys.exit(MISSED)


if __name__ == "__main__":
    main()
