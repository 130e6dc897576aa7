"""``pbonet doctor``: what this machine lacks, and what was left on it."""

from __future__ import annotations

from typing import Annotated as A

import typer

from . import options


def command(
    *,
    clean: A[
        bool, typer.Option("--clean", help="Remove what killed processes left.")
    ] = False,
    json_: options.Json = False,
    domain: options.Domain = "default",
    connect: options.Connect = None,
    keys: options.Keys = None,  # noqa: ARG001 - acts when it is read
    debug: options.Debug = False,  # noqa: ARG001 - acts when it is read
) -> None:
    """Look at real-time rights, cores, memory, agents, leftovers. Status 1: FAIL."""
    import msgspec

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
        removed = [*done, *(f"{name} was removed" for name in doctor.clean())]
        print(
            msgspec.json.encode(removed).decode()
            if json_
            else "\n".join(removed) or "nothing to remove"
        )
        return
    found = doctor.examine(
        domain,
        probe=probe(),
        leftovers=[doctor.Leftover(at.domain, at.name) for at in dead],
        neighbours=[
            doctor.Neighbour(at.domain, at.name, state.core)
            for at, state in states.items()
            if state and state.alive and at.domain != domain
        ],
        connect=connect or (),
    )
    if json_:
        print(msgspec.json.encode(found).decode())
    else:
        print("\n".join(map(str, found)))
    raise typer.Exit(int(any(one.level is doctor.Level.FAIL for one in found)))
