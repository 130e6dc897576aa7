"""``pbonet tune``: how often each task of a job should run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument, Option, UsageError

if TYPE_CHECKING:
    from pbonet.master.configuration import Place
    from pbonet.master.planning import Tuning


def command(
    *,
    file: A[Path, Argument("The .job file.")],
    cost: A[
        str,
        Option(
            "The error, such as 'rms(Q_REF - Q_MEZ)'; that of the job if left out.",
            "COST",
        ),
    ] = "",
    task: A[
        list[str] | None,
        Option(
            "A task whose rate is chosen; all that are not CRITICAL if left out.",
            "TASK",
        ),
    ] = None,
    keep: A[
        list[str] | None, Option("A task whose rate stays as it is.", "TASK")
    ] = None,
    from_log: A[
        list[Path] | None,
        Option(
            "A recorded run, or its folder, in place of runs in virtual time.", "FILE"
        ),
    ] = None,
    factor: A[
        list[float] | None,
        Option(
            "A rate of the grid, as a multiple of the present one.",
            "FACTOR",
            least=0.01,
            most=100,
        ),
    ] = None,
    seconds: A[
        float | None,
        Option("Virtual time of each run; 5 if left out.", "SECONDS", least=0.1),
    ] = None,
    settle: A[
        float, Option("Time of each run before its error counts.", "SECONDS", least=0.0)
    ] = 1.0,
    limit: options.CoreShare = None,
    assume: A[
        float | None,
        Option(
            "Share of its period that a cycle takes whose MAXC is unknown.",
            "SHARE",
            least=0.0,
            most=1.0,
        ),
    ] = None,
    svg: A[Path | None, Option("Draw the errors into a file.", "FILE")] = None,
    write: A[bool, Option("Write the rates into the job.")] = False,
    apply: A[
        bool, Option("Set them where it runs, and write them into a copy of the job.")
    ] = False,
    dry_run: A[
        bool, Option("With --write or --apply: only show what would be done.")
    ] = False,
    running: A[
        bool, Option("Ask the agents what their cores grant, less dispatching.")
    ] = False,
    host: options.Host = "",
    place: options.ChangeTransaction,
    json_: options.Json = False,
) -> None:
    """Choose the rates of a job's tasks by the error that they lead to.

    The job runs in virtual time with its modules, over a grid of rates: those of each
    task alone, and of all at once. Cycles take MAXC, so the error has the delays of
    the schedule. The error is fitted over the periods; the rates with the least error
    within the load are run, too, and the best run is proposed.

    Modules must not depend on devices; what is not simulated cannot be tuned in
    virtual time. With --from-log the errors are those of recorded runs, made at
    different rates, and the fit's own proposals are predictions.

    Examples:
        Choose rates for the error that the job's COST line names:
        pbonet tune arm.job
        Choose those of two tasks with at most half of each core, and draw it:
        pbonet tune arm.job --task pid --task diff --limit 0.5 --svg tune.svg
        Choose them by three recorded runs at different rates:
        pbonet tune arm.job --from-log runs/a --from-log runs/b --from-log runs/c
        Write them into the job:
        pbonet tune arm.job --cost 'rms(Q_REF - Q_MEZ)' --write
        Set them where it runs, and write them into arm_tuned.job:
        pbonet tune arm.job --apply
    """
    import msgspec

    from pbonet.master.planning import FACTORS, SECONDS, tune, tuning_text

    if write and apply:
        raise UsageError("--write and --apply exclude each other: choose one")
    if from_log and (factor or seconds):
        raise UsageError("--factor and --seconds are for runs in virtual time")
    if dry_run and not (write or apply):
        raise UsageError("--dry-run needs --write or --apply")
    found, warnings = tune(
        file,
        place,
        cost=cost,
        tasks=task or (),
        keep=keep or (),
        logs=from_log or (),
        factors=factor or FACTORS,
        seconds=seconds or SECONDS,
        settle=settle,
        limit=limit,
        running=running or apply,
        host=host,
        assume=assume,
        told=_progress,
    )
    lines, data = [tuning_text.text(found)], msgspec.to_builtins(found)
    if svg is not None:
        tuning_text.write_svg(found, svg)
        lines.append(str(svg))
    data |= {"rates": found.rates, "plot": str(svg or "")}
    if (write or apply) and found.rates:
        more, about = _write(file, found, place, dry_run=dry_run, apply=apply)
        lines, data = [*lines, *more], data | about
    options.show_warned("\n".join(lines), data, warnings, as_data=json_)


def _progress(done: int, every: int) -> None:
    """Show on a terminal how many runs have ended."""
    if sys.stderr.isatty():
        end = "\n" if done == every else ""
        sys.stderr.write(f"\r{done} of {every} runs{end}")
        sys.stderr.flush()


def _write(
    file: Path, found: Tuning, place: Place, *, dry_run: bool, apply: bool
) -> tuple[list[str], dict[str, object]]:
    """Write the rates, and set them where the job runs; return lines and data."""
    import msgspec

    from pbonet.master.planning import apply_allocation, apply_rates

    editor = apply_rates.draft(file, found.rates, place.libraries)
    changes = editor.changes()
    about: dict[str, object] = {"changes": msgspec.to_builtins(changes), "files": []}
    if dry_run:
        return [apply_allocation.changes_text(changes)], about
    replies, paths = (
        apply_rates.set_rates(file, found, place, lambda: apply_rates.save_copy(editor))
        if apply
        else ([], editor.save())
    )
    written = [str(path) for path in paths]
    lines = [f"written: {', '.join(written)}"]
    lines += [f"set: {task} {hz:g} Hz" for task, hz in replies]
    return lines, about | {"files": written, "set": dict(replies)}
