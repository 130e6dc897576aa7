"""``pbonet replay``: run what was recorded again, or play it to others."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated as A, Final

from . import options
from .parser import Argument, Option

UNPROVEN: Final = 3
"""The status if nothing differs, but not everything could be run again."""


def command(
    *,
    run: A[Path, Argument("A log, or a run's folder.")],
    tasks: A[
        list[str] | None, Argument("Which tasks; all if left out.", "TASK")
    ] = None,
    verify: A[
        bool,
        Option("Run each task alone on recorded inputs, to its first difference."),
    ] = False,
    out: A[
        Path | None,
        Option("Record this run into a new log.", "FILE", names=("--out", "-o")),
    ] = None,
    rtol: A[
        float, Option("Relative difference up to which numbers are equal.", least=0.0)
    ] = 0.0,
    set_: A[
        list[tuple[str, str, str]] | None,
        Option("Try this value of a parameter.", "TASK PARAM VALUE", words=3),
    ] = None,
    params_from: A[
        list[Path] | None, Option("Try the parameters of an .rmod file.", "FILE")
    ] = None,
    plot: A[
        Path | None, Option("Draw what differs, with its recorded values.", "FILE")
    ] = None,
    play: A[
        str | None,
        Option("Write what these tasks wrote into a running subsystem.", "TASK,..."),
    ] = None,
    rate: A[float, Option("Speed of --play, 1 as recorded.", least=1e-3)] = 1.0,
    start: A[
        float, Option("Where --play starts in the run.", "SECONDS", least=0.0)
    ] = 0.0,
    end: A[
        float | None, Option("Where --play ends in the run.", "SECONDS", least=0.0)
    ] = None,
    loop: A[bool, Option("Repeat --play until Ctrl-C.")] = False,
    subsystem: A[
        str, Option("The subsystem of --play; that of the log if left out.", "NAME")
    ] = "",
    strict: A[
        bool, Option("Count a log that was not finished as one that proves nothing.")
    ] = False,
    domain: options.Domain = "default",
    library: options.Library = None,
    json_: options.Json = False,
) -> int:
    """Run recorded tasks again and compare, or play back their values.

    Without an option the tasks run together, as they did; with --verify each one runs
    alone. The status is 1 if a value differs from the recorded one, and 3 if none
    does, but something could not be run again: records are lost or damaged.

    With --set or --params-from the task runs with other parameters, on the recorded
    outputs of the tasks that are not named. The largest differences are shown; they do
    not count for the status.

    Examples:
        Check whether changed code still gives what was recorded:
        pbonet replay runs/teleop puma_pidg --verify
        Try another gain on the recorded inputs, and draw the difference:
        pbonet replay runs/teleop --set puma_pidg KP 200 --plot kp.png
        Feed a recorded sensor to a running subsystem, at half speed:
        pbonet replay runs/teleop --play camera --rate 0.5
    """
    from pbonet import testing
    from pbonet.log import Log
    from pbonet.master.tools import playback

    span = playback.Span(rate=rate, start=start, end=end, loop=loop)
    names = [name for task in (play or "").split(",") if (name := task.strip())]
    tries = set_ or params_from or plot
    others = verify or tasks or out or strict or tries or not names
    _refuse_first(
        (
            play is not None and others,
            "--play takes only a rate and a part of the run",
            "pbonet replay RUN --play TASK,...",
            f"pbonet replay {run} --play {','.join(names) or 'TASK'}",
        ),
        (
            play is None and (span != playback.Span() or subsystem),
            "--rate, --start, --end, --loop and --subsystem need --play",
            "pbonet replay RUN --play TASK,... --rate 2",
            "leave them out: code is run again completely, at full speed",
        ),
        (
            verify and out,
            "--out and --verify exclude each other: verifying writes no log",
            "pbonet replay RUN --out FILE, or pbonet replay RUN --verify",
            f"pbonet replay {run} --out {out}",
        ),
        (
            verify and tries,
            "--verify excludes --set, --params-from and --plot: it compares only up to "
            "the first difference",
            "pbonet replay RUN --set TASK PARAM VALUE, or pbonet replay RUN --verify",
            "leave --verify out",
        ),
    )
    if play is not None:
        for one in (signal.SIGINT, signal.SIGTERM):  # a shell may have ignored one
            signal.signal(one, signal.default_int_handler)
        played = playback.play(run, names, span, domain=domain, subsystem=subsystem)
        options.show("\n".join(map(str, played)), played, as_data=json_)
        return 0
    libraries, log = library or (), Log(run)
    result: list[testing.Verdict] | testing.Replayed
    if verify:
        result = testing.verify(log, tasks or (), libraries=libraries, rtol=rtol)
    else:
        files, sets = params_from or (), set_ or ()
        params = testing.params_to_try(log, files, sets, tasks or (), libraries)
        result = testing.rerun(
            log,
            tasks or (),
            libraries=libraries,
            rtol=rtol,
            out=out,
            params=params,
            plot=plot,
        )
    verdicts = result if isinstance(result, list) else result.tasks
    text = "\n".join(map(str, result if isinstance(result, list) else [result]))
    options.show(text, result, as_data=json_)
    damage = log.check()
    warnings = list(map(str, damage))
    if not log.complete:
        warnings.append(
            f"{log.path} was not finished: what happened after its last record is not "
            "verified"
        )
    options.warn(warnings)
    if any(one.differs for one in verdicts):
        return 1
    missing = [one for one in damage if one.what != "index"]
    proven = all(one.good for one in verdicts) and not missing
    return 0 if proven and (log.complete or not strict) else UNPROVEN


def _refuse_first(*cases: tuple[object, str, str, str]) -> None:
    """Refuse the first case that applies: message, what is expected, and a remedy."""
    from pbonet.errors import StateError

    for applies, message, expected, remedy in cases:
        if applies:
            raise StateError(message, expected=expected, remedy=remedy)
