r"""How the control plane grows with the number of machines.

Thin agents (no task runs), each with folders of its own as on a machine of its own, are
clients of a router (`pbonet router`) on this machine. For each number of them, in turn:

* CPU time of an agent's process, of the router, and packets over the network, idle;
* CPU time and memory of two agents that have the table of a subsystem of two RTPUs;
* for how long a status is waited for, and one of that whole subsystem;
* until an agent that was killed is seen to be lost by the other RTPU of its subsystem;
* beside it, as many bare sessions of zenoh with the same token and queryables.

Then a subsystem has ever more RTPUs, which all give each other signs of life. With the
greatest number of agents half of them are killed at once, and started at once; a second
router is there, and one of the two is killed, and comes again. At last 1,000 sessions,
50 in a process, with one and three routers: idle, and with a tenth of them in
subsystems of four that exchange signs of life. Last, agents of one machine without
a router: their CPU time and sockets.

Goals: an agent takes at most 0.3 % of a core, with a table 1 %, and at 100 at most a
quarter more than at 20; the router at most 10 %; a status takes at most twice as long
as with 5; all are found within 10 s of the last one's start; a loss is seen as with 5
(half a second more at most); after each fault all are found again, and nothing has
ended.

As root it has a network of its own, so that only its own packets are counted.

    python -m benchmarks.scale [--agents 1 5 20 50 100] [--sessions 1000]
        [--seconds 10] [--quick] [--save FILE]
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks import fleet_rig as rig
from pbonet.errors import PbonetError
from pbonet.xm.net import Client, key_expressions, messages as m, open_files, session

AGENT_GOAL = 0.3
"""Most of a core in percent for an idle agent."""
TABLE_GOAL = 1.0
"""The same for one that has the table of a subsystem of two RTPUs."""
GROWTH_GOAL = 1.25
"""Most by which that may grow from 20 agents to the greatest number."""
ROUTER_GOAL = 10.0
"""Most of a core in percent for the router."""
STATUS_GOAL = 2.0
"""Most by which a status may take longer with the greatest number than with few."""
FOUND_GOAL = 10.0
"""Most seconds until all are found."""
LOSS_GOAL = 0.5
"""Most seconds by which a loss may be seen later than with few."""
FEW = 5
MET = 1.5
"""Seconds in which agents of a subsystem have met."""
SETTLED = 5.0
"""Seconds after which what was started is idle."""
GROUPS = (2, 4, 8, 16)
"""RTPUs of one subsystem."""
SUBSYSTEM = "pair"
OWN_NETWORK = "PBONET_SCALE_OWN_NETWORK"
HEAD = (
    "| agents | agent % | router % | packets/s | agent MB | router MB | with a table % "
    "| its MB | found s | status ms | of both ms | loss s |",
    "|" + "---|" * 12,
)
MOST_HERE = 20
"""Most agents of one machine that are measured."""
ONE_MACHINE = (
    "| agents of one machine | all, % of a core | each | sockets of all | most of one "
    "| MB each |"
)
MANY = "with signs of life | a router % | MB | packets/s | session % | opened in s |"
SVAR = """
NAME V0
TYPE double
DESC a variable
UNITS none
NELEM 2

EOF
"""


def idle(fleet_pids: list[int], routers: rig.Routers, seconds: float) -> dict[str, Any]:
    """Return percent of a core for each of some processes, and for the routers."""
    before = rig.cpu(fleet_pids), rig.cpu(routers.pids()), rig.packets()
    begin = time.monotonic()
    time.sleep(seconds)
    passed = time.monotonic() - begin
    own = rig.cpu(fleet_pids) - before[0]
    hub = rig.cpu(routers.pids()) - before[1]
    return {
        "cpu": 100 * own / passed,
        "router": 100 * hub / passed / max(len(routers.running), 1),
        "packets": (rig.packets() - before[2]) / passed,
    }


class Group:
    """A master by way of a router, with a table on the first machines."""

    def __init__(self, fleet: rig.Fleet, count: int = 2) -> None:
        self.fleet = fleet
        self.names = [one.name for one in fleet.machines[:count]]
        self.link = session.client(
            rig.DOMAIN, connect=fleet.alive_routers(), timeout=20.0, local=False
        )
        self.client = Client(self.link, rig.DOMAIN, "scale")
        key = key_expressions.master(rig.DOMAIN, SUBSYSTEM, "scale")
        self.token = self.link.liveliness().declare_token(key)
        for name in self.names:
            self._claim(name)

    def _claim(self, name: str) -> None:
        claim = m.Claim(
            subsystem=SUBSYSTEM,
            usage="shared",
            svar=SVAR,
            svar_name="b.svar",
            keep=name == self.names[0],
            keeper=self.names[0],
        )
        self.client.call(name, claim, m.Claimed)

    def idle(self, seconds: float) -> dict[str, Any]:
        """Return percent of a core for each of their agents, and memory."""
        time.sleep(SETTLED)
        pids = [one.pid for one in self.fleet.machines[: len(self.names)]]
        found = idle(pids, self.fleet.routers, seconds)
        found["cpu"] /= len(pids)
        return found | {"memory": median(map(rig.memory, pids))}

    def status_times(self, rounds: int) -> tuple[float, float]:
        """Return how long statuses take, in ms: one RTPU's, and the subsystem's."""
        ones: list[float] = []
        alls: list[float] = []
        for _ in range(rounds):
            begin = time.monotonic()
            self.client.call(self.names[0], m.Status(), m.RtpuStatus)
            ones.append(time.monotonic() - begin)
            begin = time.monotonic()
            asked = {name: m.Status() for name in self.names}
            _, errors = self.client.call_all(asked, m.RtpuStatus)
            assert not errors, errors
            alls.append(time.monotonic() - begin)
        return 1e3 * median(ones), 1e3 * median(alls)

    def loss_time(self) -> float:
        """Kill the second agent; return the seconds until the first one names it."""
        lost = self.fleet.machines[1]
        with session.client(
            rig.DOMAIN, connect=[self.fleet.machines[0].socket], local=False
        ) as near:
            asks = Client(near, rig.DOMAIN, "near")

            def knows() -> bool:
                info = asks.call(self.names[0], m.Hello(), m.AgentInfo)
                return any(one.rtpu == lost.name for one in info.lost)

            rig.wait(lambda: not knows(), "that it is seen", 30.0)
            time.sleep(MET)
            lost.kill()
            took = rig.wait(knows, "the news of a loss", 30.0)
        lost.start()
        self.fleet.wait_seen()
        return took

    def close(self) -> None:
        """Give the RTPUs back."""
        for name in self.names:
            with contextlib.suppress(PbonetError):
                self.client.call(name, m.Stop(subsystem=SUBSYSTEM), m.Stopped)
        self.client.close()


def bare(count: int, seconds: float) -> dict[str, Any]:
    """Return the figures of as many bare sessions, and print them."""
    routers = rig.Routers(1)
    routers.start(0)
    held = rig.Sessions(routers, count, each=10)
    try:
        row = idle(held.pids(), routers, seconds)
    finally:
        held.close()
        routers.close()
    row |= {"sessions": count, "cpu": row["cpu"] / count}
    print(
        f"| {count} | {row['cpu']:.3f} | {row['router']:.2f} | {row['packets']:.0f} |",
        flush=True,
    )
    return row


def at(fleet: rig.Fleet, count: int, seconds: float, rounds: int) -> dict[str, Any]:
    """Return the figures of a number of agents."""
    fleet.grow(count)
    time.sleep(SETTLED)
    row: dict[str, Any] = {"agents": count, "found": fleet.found}
    # The first two had a table before, and give signs of life for another minute.
    pids = fleet.pids()[2:] or fleet.pids()
    row |= idle(pids, fleet.routers, seconds)
    row["cpu"] /= len(pids)
    row["memory"] = median(map(rig.memory, fleet.pids()))
    row["router_memory"] = max(map(rig.memory, fleet.routers.pids()))
    if count > 1:
        pair = Group(fleet)
        try:
            shared = pair.idle(seconds)
            row["table"], row["table_memory"] = shared["cpu"], shared["memory"]
            row["one"], row["all"] = pair.status_times(rounds)
            row["loss"] = pair.loss_time()
        finally:
            pair.close()
    return row


def groups(fleet: rig.Fleet, seconds: float) -> list[dict[str, Any]]:
    """Return the figures of subsystems of several sizes, and print them."""
    rows: list[dict[str, Any]] = []
    print(
        "\n| RTPUs of a subsystem | agent % | agent MB | packets/s |", "|" + "---|" * 4
    )
    for count in [one for one in GROUPS if one <= len(fleet.machines)]:
        group = Group(fleet, count)
        try:
            row = group.idle(seconds) | {"rtpus": count}
        finally:
            group.close()
        rows.append(row)
        print(
            f"| {count} | {row['cpu']:.2f} | {row['memory']:.0f} "
            f"| {row['packets']:.0f} |",
            flush=True,
        )
    return rows


def faults(fleet: rig.Fleet, seconds: float) -> list[dict[str, Any]]:
    """Cause faults; return a row for each: seconds until it is healed, and CPU."""
    rows: list[dict[str, Any]] = []
    before = fleet.started_again

    def heal(what: str, cause: Any) -> None:  # noqa: ANN401 - any function
        spent, begin = rig.cpu(fleet.routers.pids()), time.monotonic()
        cause()
        healed = fleet.wait_seen()
        over = time.monotonic() - begin
        share = 100 * max(rig.cpu(fleet.routers.pids()) - spent, 0.0) / over
        rows.append({"fault": what, "healed": healed, "router": share})
        print(f"  {what}: all found after {healed:.1f} s", flush=True)

    half = fleet.machines[1::2]

    def kill_half() -> None:
        for one in half:
            one.kill()
        kept = fleet.names() - {one.name for one in half}
        took = rig.wait(lambda: fleet.seen() == kept, "the loss of half")
        rows.append({"fault": "half killed: seen", "healed": took, "router": 0.0})
        fleet.routers.start(1)
        for one in half:
            one.start()

    heal("half started at once, which use router 2", kill_half)
    two = idle(fleet.pids(), fleet.routers, seconds)
    rows.append({
        "fault": "two routers, idle",
        "healed": 0.0,
        "router": two["router"],
        "cpu": two["cpu"] / len(fleet.machines),
    })
    heal("router 1 killed: half of the agents reconnect", lambda: fleet.routers.kill(0))
    heal("router 1 started", lambda: fleet.routers.start(0))

    def restart_all() -> None:
        for number in (0, 1):
            fleet.routers.kill(number)
        time.sleep(1.0)
        fleet.routers.start(0)

    heal("both killed, one started: all reconnect", restart_all)
    rows.append({
        "fault": "agents that ended, or did not start",
        "healed": fleet.started_again - before,
    })
    return rows


def many(count: int, seconds: float) -> list[dict[str, Any]]:
    """Return the figures of very many sessions, and print them."""
    rows: list[dict[str, Any]] = []
    for routers_of in (1, 3):
        for groups in (0, count // 40):
            rows.append(held_by(routers_of, groups, count, seconds))
            row = rows[-1]
            print(
                f"| {count} | {routers_of} | {groups} | {row['router']:.1f} "
                f"| {row['memory']:.0f} | {row['packets']:.0f} | {row['cpu']:.3f} "
                f"| {row['opened']:.1f} |",
                flush=True,
            )
    return rows


def held_by(routers_of: int, groups: int, count: int, seconds: float) -> dict[str, Any]:
    """Return the figures of sessions that some routers share."""
    routers = rig.Routers(routers_of)
    for number in range(routers_of):
        routers.start(number)
    begin = time.monotonic()
    held = rig.Sessions(routers, count, each=50, active=groups)
    opened = time.monotonic() - begin
    try:
        row = idle(held.pids(), routers, seconds)
        row["memory"] = max(map(rig.memory, routers.pids()))
    finally:
        held.close()
        routers.close()
    row["cpu"] /= count
    return row | {"routers": routers_of, "groups": groups, "opened": opened}


def one_machine(count: int, seconds: float) -> dict[str, Any]:
    """Return the figures of agents of one machine without a router, and print them."""
    folder = Path(tempfile.mkdtemp(prefix="pbonet-scale-"))
    found = [rig.Machine(f"h{n}", folder, machine="here") for n in range(count)]
    try:
        for one in found:
            one.start()
        for one in found:
            rig.wait(one.is_ready, one.name)
        time.sleep(SETTLED)
        pids = [one.pid for one in found]
        spent, begin = rig.cpu(pids), time.monotonic()
        time.sleep(seconds)
        cpu = 100 * (rig.cpu(pids) - spent) / (time.monotonic() - begin)
        held = [*map(rig.sockets, pids)]
        row = {"agents": count, "cpu": cpu, "sockets": sum(held), "most": max(held)}
        row["memory"] = median(map(rig.memory, pids))
    finally:
        for one in found:
            if one.agent is not None:
                one.agent.terminate()
        for one in found:
            if one.agent is not None:
                one.agent.wait()
        shutil.rmtree(folder, ignore_errors=True)
    print(
        f"| {count} | {cpu:.1f} | {cpu / count:.2f} | {row['sockets']} "
        f"| {row['most']} | {row['memory']:.1f} |",
        flush=True,
    )
    return row


def judge(rows: list[dict[str, Any]], broken: list[dict[str, Any]]) -> bool:
    """Print each goal; return whether all are met."""
    last = rows[-1]
    few = next((one for one in rows if one["agents"] >= FEW), last)
    twenty = next((one for one in rows if one["agents"] >= 4 * FEW), last)
    ended = next(one["healed"] for one in broken if "ended" in one["fault"])
    checks = {
        f"an idle agent <= {AGENT_GOAL} %": last["cpu"] <= AGENT_GOAL,
        "not growing": last["cpu"] <= GROWTH_GOAL * max(twenty["cpu"], 0.01),
        f"router <= {ROUTER_GOAL:g} %": last["router"] <= ROUTER_GOAL,
        f"found within {FOUND_GOAL:g} s": max(r["found"] for r in rows) <= FOUND_GOAL,
        "nothing ended": ended == 0,
    }
    if "all" in last:  # one agent alone has no subsystem of two
        checks |= {
            f"one with a table <= {TABLE_GOAL:g} %": last["table"] <= TABLE_GOAL,
            "status independent of their number": last["all"]
            <= STATUS_GOAL * few["all"],
            "loss seen as with few": last["loss"] <= few["loss"] + LOSS_GOAL,
        }
    for what, good in checks.items():
        print(f"{what}: {'met' if good else 'MISSED'}")
    return all(checks.values())


def line(row: dict[str, Any]) -> str:
    """Return the figures of a number of agents as a line of a table."""
    return (
        f"| {row['agents']} | {row['cpu']:.3f} | {row['router']:.2f} "
        f"| {row['packets']:.0f} | {row['memory']:.0f} | {row['router_memory']:.0f} "
        f"| {row.get('table', 0):.2f} | {row.get('table_memory', 0):.0f} "
        f"| {row['found']:.1f} | {row.get('one', 0):.2f} | {row.get('all', 0):.2f} "
        f"| {row.get('loss', 0):.2f} |"
    )


def load() -> str:
    """Return how many processes have wanted a core in the last minute."""
    return Path("/proc/loadavg").read_text(encoding="ascii").split()[0]


def measure(given: argparse.Namespace) -> dict[str, Any]:
    """Measure everything, and print it as it comes."""
    found: dict[str, Any] = {"load": load(), "rows": []}
    routers = rig.Routers(2)
    routers.start(0)
    fleet = rig.Fleet(routers)
    print(f"load {found['load']}", *HEAD, sep="\n", flush=True)
    try:
        for count in given.agents:
            found["rows"].append(at(fleet, count, given.seconds, given.rounds))
            print(line(found["rows"][-1]), flush=True)
        found["groups"] = groups(fleet, given.seconds)
        found["faults"] = faults(fleet, given.seconds)
    finally:
        fleet.close()
        routers.close()
    print("\n| bare sessions | session % | router % | packets/s |\n|" + "---|" * 4)
    found["bare"] = [bare(count, given.seconds) for count in given.agents]
    print(f"\n| sessions | routers | groups {MANY}", "|" + "---|" * 8, sep="\n")
    found["many"] = many(given.sessions, given.seconds)
    print(f"\n{ONE_MACHINE}", "|" + "---|" * 6, sep="\n")
    found["one machine"] = one_machine(min(max(given.agents), MOST_HERE), given.seconds)
    found["load_after"] = load()
    print(f"load {found['load_after']}")
    return found


def enter_own_network() -> None:
    """Start this program again in a network of its own, as root."""
    if os.geteuid() or os.environ.get(OWN_NETWORK) or not shutil.which("unshare"):
        return
    script = 'ip link set lo up && exec "$@"'
    os.environ[OWN_NETWORK] = "1"
    words = ["unshare", "--net", "sh", "-ec", script, "sh"]
    words += [sys.executable, "-m", "benchmarks.scale", *sys.argv[1:]]
    os.execvp(words[0], words)  # noqa: S606 - itself


def main() -> None:
    """Measure and judge."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--agents", type=int, nargs="+", default=[1, 5, 20, 50, 100])
    words.add_argument("--sessions", type=int, default=1000)
    words.add_argument("--seconds", type=float, default=10.0)
    words.add_argument("--rounds", type=int, default=50)
    words.add_argument("--save", type=Path, help="write the figures as JSON")
    words.add_argument("--quick", action="store_true", help="4 agents, 40 sessions")
    given = words.parse_args()
    if given.quick:
        given.agents, given.sessions, given.seconds, given.rounds = [2, 4], 40, 1.0, 5
    enter_own_network()
    open_files.ensure("benchmarks.scale")
    found = measure(given)
    if given.save:
        given.save.write_text(json.dumps(found, indent=1))
    if not judge(found["rows"], found["faults"]) and not given.quick:
        sys.exit(3)


if __name__ == "__main__":
    main()
