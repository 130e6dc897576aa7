"""Agents of one machine beyond the first few are clients of these."""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path

from watching import wait_for

from pbonet.xm.net import client_of_router, run_folder, session

FEW = client_of_router.HERE
NAMES = [f"arm{number}" for number in range(FEW + 2)]
FIRST, FURTHER = NAMES[:FEW], NAMES[FEW:]


def sockets(pid):
    """Return how many sockets a process has."""
    found = 0
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            found += str(one.readlink()).startswith("socket:")
    return found


def routers(nodes):
    positions = run_folder.positions(nodes.domain)
    return sorted(name for name, its in positions.items() if not its.rank)


def all_see(nodes, *names):
    found = sorted(names)
    for name in names:
        where = [run_folder.Places(nodes.domain, name).endpoint]
        with session.client(nodes.domain, connect=where, local=False) as link:
            wait_for(lambda s=link: session.rtpus(s, nodes.domain) == found, "all")


def test_clients_are_steered_while_the_agents_to_which_they_have_links_are_away(nodes):
    """All of them at once; those that come again are linked with the clients again."""
    nodes.agent_processes(*FIRST)
    nodes.agent_processes(*FURTHER)
    assert routers(nodes) == FIRST
    all_see(nodes, *NAMES)
    held = {name: sockets(nodes.processes[name].pid) for name in NAMES}
    assert max(held[name] for name in FURTHER) < min(held[name] for name in FIRST)

    pids = [nodes.processes[name].pid for name in FIRST]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    left = len(FIRST) - len(FURTHER)  # each has a router of its own, and continues that
    wait_for(lambda: sum(map(run_folder.is_stopped, pids)) == left, "their routers")
    for pid in pids:
        os.kill(pid, signal.SIGCONT)

    nodes.forget_session()
    where = [run_folder.Places(nodes.domain, FURTHER[0]).endpoint]
    nodes._session = session.client(nodes.domain, connect=where, local=False)
    master = nodes.master(FURTHER[0], "arm")
    master.spawn("t", "counts")
    master.on("t")
    for name in FIRST:
        nodes.processes[name].kill()
    for name in FIRST:
        nodes.processes[name].wait()
    all_see(nodes, *FURTHER)
    assert master.wait_cycles("t", 10).state == "ON"

    nodes.agent_processes(*FIRST)
    assert routers(nodes) == FIRST
    all_see(nodes, *NAMES)
    assert master.off("t").state == "OFF"
