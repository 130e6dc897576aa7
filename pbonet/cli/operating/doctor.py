"""``pbonet doctor``: missing rights and settings of this machine, and leftovers."""

from __future__ import annotations

from typing import Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Option


def command(
    *,
    clean: A[bool, Option("Remove what killed processes left, and end.")] = False,
    agents: options.Agents,
    json_: options.Json = False,
) -> int:
    """Check this machine: real-time rights, cores, memory, agents, ...

    It also finds shared memory that killed processes left. Each line is PASS, WARN or
    FAIL, and says what to do. The status is 1 if one fails.

    Examples:
        Check the machine before the first run:
        pbonet doctor
        Remove the shared memory of processes that were killed:
        pbonet doctor --clean
    """
    from pbonet.master.diagnosis import Level
    from pbonet.master.tools import doctor
    from pbonet.node.rt import probe
    from pbonet.node.rtpu import cleanup
    from pbonet.xm.net import run_folder

    states = {
        run_folder.Places(path.parent.name, path.stem): cleanup.read(path)
        for path in run_folder.folder().glob("*/*.state")
    }
    dead = [at for at, state in states.items() if state and not state.alive]
    if clean:
        done = [text for places in dead for text in cleanup.clean_after(places)]
        for domain in {places.domain for places in dead}:
            run_folder.sweep_routers(domain)
        removed = [*done, *(f"{name} was removed" for name in doctor.clean())]
        text = "\n".join(removed) or "nothing to remove"
        options.show(text, removed, as_data=json_)
        return 0
    found = doctor.examine(
        agents.domain,
        probe=probe(),
        leftovers=[doctor.Leftover(at.domain, at.name) for at in dead],
        neighbours=[
            doctor.Neighbour(at.domain, at.name, state.core)
            for at, state in states.items()
            if state and state.alive and at.domain != agents.domain
        ],
        connect=agents.connect,
    )
    options.show("\n".join(map(str, found)), found, as_data=json_)
    return int(any(one.level is Level.FAIL for one in found))
