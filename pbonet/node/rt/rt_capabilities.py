"""Determine a process's real-time rights, with a sentence for each one it lacks."""

from __future__ import annotations

import os
import re
import resource
from pathlib import Path

from pbonet.analysis.schedule import Probe

_CAP_SYS_NICE = 23
_CAP_IPC_LOCK = 14
_EPERM = 1
_USUAL = 0.95
"""Share of a core at which Linux throttles real-time tasks by default."""
_LEAST = 0.001
"""A share of 0 would be that of a core where nothing may run."""
_FAIR_SERVER = 6, 12
"""Version of Linux that began to serve other processes beside real-time tasks."""


def probe(errno: int) -> Probe:
    """Return the rights of this process.

    Args:
        errno: The kernel's answer to a request for SCHED_FIFO; 0: granted.
    """
    rtprio = _limit(resource.RLIMIT_RTPRIO)
    memlock = _limit(resource.RLIMIT_MEMLOCK)
    budget = _cgroup("cpu.rt_runtime_us")
    runtime = _number("/proc/sys/kernel/sched_rt_runtime_us", -1)
    period = _number("/proc/sys/kernel/sched_rt_period_us", 1_000_000)
    nice, lock = _capable(_CAP_SYS_NICE), _capable(_CAP_IPC_LOCK)
    cores = sorted(os.sched_getaffinity(0))
    share, share_reason = 1.0, "timing is soft, and no throttle applies"
    reasons: list[str] = []
    if errno:
        reasons.append(_why_no_fifo(errno, rtprio, budget, nice=nice))
    else:
        share, share_reason = _granted(runtime / period, cores)
        reasons += _throttling(share, share_reason)
        rttime = _limit(resource.RLIMIT_RTTIME)
        if rttime >= 0:
            reasons.append(
                f"RLIMIT_RTTIME ends a task that computes for {rttime} us without "
                "waiting; raise it (ulimit -R unlimited)"
            )
    if memlock >= 0 and not lock:
        reasons.append(
            f"memory is not locked: the memlock limit is {memlock // 1024} KiB; "
            "set 'memlock unlimited' in /etc/security/limits.d, "
            "or --ulimit memlock=-1 for a container"
        )
    if not Path("/proc/sys/kernel/seccomp/actions_avail").exists():
        reasons.append(
            "modules may change priorities and kill processes of the node: this kernel "
            "has no seccomp filters"
        )
    if len(cores) == 1:
        reasons.append(
            "only one core may be used, so housekeeping shares it with the tasks"
        )
    return Probe(
        backend="park" if errno else "fifo",
        fifo=not errno,
        errno=errno,
        reasons=reasons,
        rtprio_limit=rtprio,
        cap_sys_nice=nice,
        cgroup_rt_runtime_us=budget,
        rt_runtime_us=runtime,
        rt_period_us=period,
        memlock_limit=memlock,
        lock_memory=memlock < 0 or lock,
        cores=cores,
        share=share,
        share_reason=share_reason,
        preempt=_preemption(),
    )


def _why_no_fifo(errno: int, rtprio: int, budget: int | None, *, nice: bool) -> str:
    refused = f"SCHED_FIFO is refused ({os.strerror(errno)}), timing is soft: "
    if errno != _EPERM:
        return refused + "the kernel does not offer it here"
    if nice or rtprio < 0 or rtprio >= 95:  # noqa: PLR2004
        if budget == 0:
            return (
                refused + "the cpu control group has no real-time budget "
                "(cpu.rt_runtime_us is 0); give it one or leave the group"
            )
        return refused + "the kernel or a security policy forbids it"
    return (
        refused + f"no CAP_SYS_NICE, and the rtprio limit is {rtprio}; "
        "set 'rtprio 95' in /etc/security/limits.d, "
        "or --ulimit rtprio=95 for a container"
    )


def _granted(throttle: float, cores: list[int]) -> tuple[float, str]:
    """Return the share of a core that real-time tasks get, and what limits it.

    A kernel that does not throttle does not enforce the budget of a group either.

    Args:
        throttle: The share that the kernel throttles at; below 0: it does not.
        cores: Those that this process may use.
    """
    group = _cgroup("cpu.rt_runtime_us") if throttle >= 0.0 else None
    budget = (group or -1) / (_cgroup("cpu.rt_period_us") or 1_000_000)
    limits = [
        (throttle, "kernel.sched_rt_runtime_us"),
        (budget, "cpu.rt_runtime_us of the control group"),
        (1.0 - _fair_server(cores), "the kernel's server of other processes"),
    ]
    least, reason = min(one for one in limits if one[0] >= 0.0)
    if least >= 1.0:
        return 1.0, "the kernel throttles nothing"
    return max(least, _LEAST), reason


def _fair_server(cores: list[int]) -> float:
    """Return the share that the kernel keeps for other processes, if they want it.

    Linux has that since 6.12; only root may read how much it is.
    """
    version = tuple(map(int, re.findall(r"\d+", os.uname().release)[:2]))
    usual = 50_000_000 if version >= _FAIR_SERVER else 0
    shares: list[float] = []
    for core in cores:
        folder = f"/sys/kernel/debug/sched/fair_server/cpu{core}"
        runtime = _number(f"{folder}/runtime", usual)
        shares.append(runtime / max(_number(f"{folder}/period", 1_000_000_000), 1))
    return max(shares, default=0.0)


def _throttling(share: float, reason: str) -> list[str]:
    """Report when the kernel gives real-time tasks less than it usually does."""
    if share >= _USUAL:
        return []
    return [
        f"real-time tasks together get {share:.1%} of a core ({reason}), and the "
        f"critical set is planned with that; raise it to {_USUAL:.0%}"
    ]


def _limit(which: int) -> int:
    soft = resource.getrlimit(which)[0]
    return -1 if soft == resource.RLIM_INFINITY else soft


def _number(path: str, default: int) -> int:
    try:
        return int(Path(path).read_text("utf-8"))
    except (OSError, ValueError):
        return default


def _capable(bit: int) -> bool:
    for line in Path("/proc/self/status").read_text("utf-8").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> bit & 1)
    return False


def _cgroup(name: str) -> int | None:
    """Return a number of our cgroup-v1 cpu group; None if there is none."""
    place = mount = None
    for line in Path("/proc/self/cgroup").read_text("utf-8").splitlines():
        _, controllers, path = line.split(":", 2)
        if "cpu" in controllers.split(","):
            place = path
    for line in Path("/proc/self/mountinfo").read_text("utf-8").splitlines():
        before, _, after = line.partition(" - ")
        if after.startswith("cgroup ") and "cpu" in after.split()[-1].split(","):
            mount = before.split()[4]
    if place is None or mount is None:
        return None
    file = Path(mount) / place.lstrip("/") / name
    return _number(str(file), 0) if file.exists() else None


def _preemption() -> str:
    if _number("/sys/kernel/realtime", 0):
        return "PREEMPT_RT"
    words = os.uname().version.split()
    return next((word for word in words if word.startswith("PREEMPT")), "not stated")
