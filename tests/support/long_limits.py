"""Time limits of masters and agents, made long for tests on a machine that stalls.

The product's own are short, so that whoever steers knows soon that an agent hangs. For
a test that is not about them each is a wait for a condition, and has a generous end. A
test that is about them bears the mark `own_limits`.
"""

from __future__ import annotations

from pbonet.master.subsystem import (
    first_cycle_check,
    recording_control,
    rtpu_clients,
    subsystem,
    subsystem_tasks,
)
from pbonet.xm.net import rpc, session

LIMIT = 30.0
"""Seconds for whatever ends by itself."""
LEASE_MS = 20_000
"""A link stands for so long without a sign of the other end."""


def be_patient(monkeypatch) -> None:
    """Wait long in this process, and in the agents that it starts."""
    for module, names in (
        (rpc, ("ANSWER_TIME", "PROOF_TIME", "WAY_TIME", "_LOSS_TIME")),
        (subsystem_tasks, ("CONTROL_TIME", "SPAWN_TIME", "STOP_TIME")),
        (subsystem, ("CONTROL_TIME",)),
        (recording_control, ("FINISH_TIME",)),
        (first_cycle_check, ("PATIENCE",)),
    ):
        for name in names:
            monkeypatch.setattr(module, name, LIMIT)
    monkeypatch.setattr(session, "LEASE_MS", LEASE_MS)
    monkeypatch.setattr(session, "SILENT_MS", LEASE_MS)
    monkeypatch.setattr(session, "OPEN_MS", LEASE_MS)
    for function in (
        *(rpc.Client.call, rpc.Client.call_all, session.client),
        *(rtpu_clients.RtpuClients.call, rtpu_clients.RtpuClients.each),
    ):
        monkeypatch.setitem(function.__kwdefaults__, "timeout", LIMIT)
