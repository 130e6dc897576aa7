"""What `probe` says about rights that are missing, and real refusals."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from pbonet.node.rt import rt_capabilities

ROOT = Path(__file__).parents[3]
UNPRIVILEGED = """
import json, os, sys
from pbonet.errors import RealTimeError
from pbonet.node.rt import _rt
if os.geteuid() == 0:
    os.setgroups([]); os.setgid(65534); os.setuid(65534)
said = [_rt.probe().reasons]
for refused in (_rt.lock_memory, lambda: _rt.Dispatcher(_rt.CoreTable(1), "fifo"),
                lambda: _rt.pin(4095)):
    try:
        refused()
    except RealTimeError as error:
        said.append(str(error))
said.append(_rt.Dispatcher(_rt.CoreTable(1)).backend)
print(json.dumps(said))
"""


@pytest.fixture
def folder():
    path = Path(tempfile.mkdtemp(prefix="pbonet-rt-"))
    path.chmod(0o777)
    yield path
    left = list(path.iterdir())
    shutil.rmtree(path)
    assert left == []


def test_without_rights_every_refusal_is_explained(folder) -> None:
    done = subprocess.run(
        [sys.executable, "-c", UNPRIVILEGED],
        cwd=ROOT,
        env=os.environ | {"PBONET_SHM_DIR": str(folder)},
        capture_output=True,
        check=True,
        text=True,
    )
    reasons, locked, fifo, pin, backend = json.loads(done.stdout)
    if not any("SCHED_FIFO is refused" in reason for reason in reasons):
        pytest.skip("this user has real-time rights")
    assert any("no CAP_SYS_NICE, and the rtprio limit is 0" in why for why in reasons)
    assert any("memory is not locked: the memlock limit is" in why for why in reasons)
    assert locked.startswith("memory cannot be locked (got Operation not permitted)")
    assert "set 'memlock unlimited'" in locked
    assert fifo == (
        "SCHED_FIFO is refused (Operation not permitted): no CAP_SYS_NICE, and the "
        "rtprio limit is 0; set 'rtprio 95' in /etc/security/limits.d, "
        "or --ulimit rtprio=95 for a container"
    )
    assert pin.startswith("the thread cannot be pinned to core 4095 (expected one of [")
    assert backend == "park"


@pytest.mark.skipif(
    os.geteuid() != 0 or not os.access("/sys/fs/cgroup/cpu", os.W_OK),
    reason="needs root and a cpu control group of version 1",
)
def test_a_group_without_budget_is_named() -> None:
    group = Path(f"/sys/fs/cgroup/cpu/pbonet-test-{os.getpid()}")
    code = (
        f"import os; open('{group}/cgroup.procs', 'w').write(str(os.getpid()));"
        "from pbonet.node.rt import _rt; p = _rt.probe();"
        "print(p.backend, p.cgroup_rt_runtime_us, p.reasons[0])"
    )
    group.mkdir()
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=ROOT,
            capture_output=True,
            check=True,
            text=True,
        )
    finally:
        group.rmdir()
    if done.stdout.startswith("fifo"):
        pytest.skip("this kernel schedules real-time tasks in every group")
    assert done.stdout.startswith(
        "park 0 SCHED_FIFO is refused (Operation not permitted"
    )
    assert "the cpu control group has no real-time budget" in done.stdout


@pytest.mark.parametrize(
    ("runtime", "said"),
    [
        (950_000, []),  # the kernel's default, which verification plans with
        (-1, []),
        (1_000_000, []),
        (
            500_000,
            [
                "real-time tasks together get 50.0% of a core "
                "(kernel.sched_rt_runtime_us), and the critical set is planned with "
                "that; raise it to 95%"
            ],
        ),
    ],
)
def test_with_all_rights_only_a_tight_throttle_is_said(
    monkeypatch, runtime, said
) -> None:
    monkeypatch.setattr(rt_capabilities, "_number", lambda path, _default: {
        "/proc/sys/kernel/sched_rt_runtime_us": runtime,
        "/proc/sys/kernel/sched_rt_period_us": 1_000_000,
    }.get(path, 0))  # fmt: skip
    monkeypatch.setattr(rt_capabilities, "_limit", lambda _which: -1)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {0, 1})
    probe = rt_capabilities.probe(0)
    assert probe.reasons == said
    assert probe.fifo
    assert probe.lock_memory


@pytest.mark.parametrize(
    ("kernel", "share", "reason"),
    [
        ((950_000, None, 0), 0.95, "kernel.sched_rt_runtime_us"),
        ((1_000_000, None, 0), 1.0, "the kernel throttles nothing"),
        ((-1, None, 0), 1.0, "the kernel throttles nothing"),
        ((950_000, 400_000, 0), 0.4, "cpu.rt_runtime_us of the control group"),
        ((-1, 400_000, 0), 1.0, "the kernel throttles nothing"),
        ((-1, None, 100_000_000), 0.9, "the kernel's server of other processes"),
    ],
)
def test_a_core_grants_what_the_kernel_says(monkeypatch, kernel, share, reason) -> None:
    runtime, group, server = kernel
    numbers = {
        "/proc/sys/kernel/sched_rt_runtime_us": runtime,
        "/proc/sys/kernel/sched_rt_period_us": 1_000_000,
        "/sys/kernel/debug/sched/fair_server/cpu1/runtime": server,
        "/sys/kernel/debug/sched/fair_server/cpu1/period": 1_000_000_000,
    }
    groups = {"cpu.rt_runtime_us": group, "cpu.rt_period_us": 1_000_000}
    monkeypatch.setattr(rt_capabilities, "_number", numbers.get)
    monkeypatch.setattr(rt_capabilities, "_cgroup", groups.get)
    monkeypatch.setattr(rt_capabilities, "_limit", lambda _which: -1)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {1})
    probe = rt_capabilities.probe(0)
    assert (probe.share, probe.share_reason) == (share, reason)


def test_one_core_and_a_cpu_time_limit_are_said(monkeypatch) -> None:
    monkeypatch.setattr(rt_capabilities, "_limit", lambda _which: 200_000)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {3})
    reasons = rt_capabilities.probe(0).reasons
    assert any("computes for 200000 us without waiting" in reason for reason in reasons)
    assert any("only one core may be used" in reason for reason in reasons)


def test_a_kernel_without_the_policy_is_said() -> None:
    reasons = rt_capabilities.probe(errno.ENOSYS).reasons
    assert any("the kernel does not offer it here" in reason for reason in reasons)
