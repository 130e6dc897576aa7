"""``pbonet allocate``: which RTPU runs which task of a job."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument, Option, UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pbonet.master.configuration import Place


def command(
    *,
    file: A[Path, Argument("The .job file.")],
    running: A[
        bool, Option("Ask the agents for their machines, cores and devices.")
    ] = False,
    machine: A[
        list[str] | None,
        Option(
            "The machine of an RTPU; without it, each has one of its own.", "RTPU=NAME"
        ),
    ] = None,
    fix: A[list[str] | None, Option("A task that stays where it is.", "TASK")] = None,
    limit: options.CoreShare = None,
    weight: A[
        float,
        Option(
            "Share of the cost that traffic has; the rest is age.",
            "SHARE",
            least=0.0,
            most=1.0,
        ),
    ] = 0.5,
    latency: A[
        float,
        Option(
            "Time that a value needs to another machine.",
            "SECONDS",
            least=0.0,
            most=60.0,
        ),
    ] = 0.001,
    assume: A[
        float | None,
        Option(
            "Share of its period that a cycle takes whose MAXC is unknown.",
            "SHARE",
            least=0.0,
            most=1.0,
        ),
    ] = None,
    seconds: A[
        float, Option("Time to look for the best one.", "SECONDS", least=0.1)
    ] = 10.0,
    write: A[bool, Option("Write the RTPUs into the job.")] = False,
    apply: A[
        bool, Option("Write it with copies of tasks that move, and switch to it.")
    ] = False,
    dry_run: A[
        bool, Option("With --write or --apply: only show what would be done.")
    ] = False,
    host: options.Host = "",
    place: options.ChangeTransaction,
    json_: options.Json = False,
) -> None:
    """Assign the tasks of a job to RTPUs, and show the gain.

    Every assignment keeps all deadlines, by the test of 'pbonet check'. The cheapest
    one has the least of two costs: bytes that tasks read from other machines, and the
    age of the data at the ends of the data flow. Tasks that the job marks FIXED, and
    those that open a device, stay where they can.

    It needs the execution times of all tasks: MAXC of .rmod files, or profiles.

    Examples:
        Show the best assignment of a job, with two RTPUs on one machine:
        pbonet allocate arm.job --machine arm0=left --machine arm1=left
        Write it into the job:
        pbonet allocate arm.job --running --write
        Show how the running subsystem would change to it:
        pbonet allocate arm.job --apply --dry-run
    """
    import msgspec

    from pbonet.master.planning import allocate, allocation_text

    if write and apply:
        raise UsageError("--write and --apply exclude each other: --apply writes, too")
    if dry_run and not (write or apply):
        raise UsageError("--dry-run needs --write or --apply")
    if machine and (running or apply):
        raise UsageError("--machine is for jobs whose agents are not asked")
    found, warnings = allocate(
        file,
        place,
        running=running or apply,
        machines=machine or (),
        fixed=fix or (),
        host=host,
        assume=assume,
        limit=limit,
        weight=weight,
        latency=latency,
        seconds=seconds,
    )
    lines, data = [allocation_text.text(found)], msgspec.to_builtins(found)
    if write and found.moves:
        more, about = _write(file, found.places, place, dry_run=dry_run)
        lines, data = [*lines, *more], data | about
    elif apply and found.moves:
        more, about, told = _apply(file, found.places, place, dry_run=dry_run)
        lines, data, warnings = [*lines, *more], data | about, [*warnings, *told]
    options.show_warned("\n".join(lines), data, warnings, as_data=json_)


def _write(
    file: Path, places: Mapping[str, str], place: Place, *, dry_run: bool
) -> tuple[list[str], dict[str, object]]:
    """Write the RTPUs into the job; return lines and data about it."""
    import msgspec

    from pbonet.master.planning import apply_allocation

    editor = apply_allocation.draft(file, places, place.libraries)
    changes = editor.changes()
    about: dict[str, object] = {"changes": msgspec.to_builtins(changes), "files": []}
    if dry_run:
        return [apply_allocation.changes_text(changes)], about
    written = [str(path) for path in editor.save()]
    return [f"written: {', '.join(written)}"], about | {"files": written}


def _apply(
    file: Path, places: Mapping[str, str], place: Place, *, dry_run: bool
) -> tuple[list[str], dict[str, object], list[str]]:
    """Switch to the job with moved tasks; return lines, data and warnings about it."""
    import msgspec

    from pbonet.master.console import render
    from pbonet.master.planning import apply_allocation

    editor = apply_allocation.draft_of_copies(file, places, place.libraries)
    changes = editor.changes()
    replies = apply_allocation.switch(editor, place, dry_run=dry_run)
    last = replies[-1]
    lines = [render.text(last.command, last.data)]
    if dry_run:
        lines.insert(0, apply_allocation.changes_text(changes))
    about: dict[str, object] = {
        "changes": msgspec.to_builtins(changes),
        "files": [] if dry_run else [one.file for one in changes],
        "switch": last.data,
    }
    return lines, about, [text for reply in replies for text in reply.warnings]
