"""``pbonet log``: what was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated as A

from . import options
from .parser import Argument, Option

HELP = "Read, compare, plot and repair the logs of runs."

File = A[
    Path | None,
    Argument("A log, or a run's folder; the newest in the folder runs if left out."),
]
Out = A[Path, Option("The new file.", "FILE", names=("--out", "-o"))]


def _written(
    out: Path, json_: bool, messages: int | None = None, clocks: Sequence[str] = ()
) -> None:
    data = {"file": str(out), "messages": messages, "clocks": clocks}
    text = str(out) if messages is None else f"{out}: {messages} messages"
    options.show("\n".join([text, *clocks]), data, as_data=json_)


def info(
    *,
    file: File = None,
    json_: options.Json = False,
) -> None:
    """Show what a log holds: duration, tasks, rates, misses, events.

    Examples:
        Show the newest run:
        pbonet log info
        Show another one:
        pbonet log info runs/2026-05-04T10-00-00-teleop
    """
    from pbonet.log import Log, last_run, text

    data = text.info(Log(file or last_run()))
    options.show(text.info_text(data), data, as_data=json_)


def cat(
    *,
    file: A[Path, Argument("A log, or a run's folder.")],
    task: A[str, Argument("The task.")],
    variables: A[
        list[str] | None, Argument("Which variables; all that it writes if left out.")
    ] = None,
    out: A[
        Path | None,
        Option(
            "Write a file, in the format of its ending: .csv, .json, .npz or .parquet.",
            "FILE",
            names=("--out", "-o"),
        ),
    ] = None,
    json_: options.Json = False,
) -> None:
    """Print or export the values of a task, one row a cycle.

    Examples:
        Print the joint angles that a task wrote, as CSV:
        pbonet log cat runs/teleop jttrace Q_REF
        Export all that it wrote for numpy:
        pbonet log cat runs/teleop jttrace -o jttrace.npz
    """
    import sys

    from pbonet.log import Log, export, text

    form = export.form_of(out) if out is not None else None
    log = Log(file)
    table = text.columns(log, task, variables or ())
    options.warn(log.damage)
    if out is not None and form is not None:
        export.write_file(table, out, form, log, task)
        _written(out, json_)
        return
    write = export.write_json if json_ else export.write_csv
    write(table, sys.stdout)


def events(
    *,
    file: File = None,
    task: A[str | None, Option("Only events of this task.", "TASK")] = None,
    code: A[str | None, Option("Only this kind, such as WARNING.", "CODE")] = None,
    severity: A[
        str | None,
        Option("This and worse: debug, info, warning, error or fatal.", "LEVEL"),
    ] = None,
    json_: options.Json = False,
) -> None:
    """Show the events of a run.

    Examples:
        Show what went wrong in the newest run:
        pbonet log events --severity warning
        Show the events of one task:
        pbonet log events runs/teleop --task jttrace
    """
    import msgspec

    from pbonet.log import Log, last_run
    from pbonet.master.console import render
    from pbonet.master.subsystem import EventFilter
    from pbonet.xm.net import Event

    wanted = EventFilter.of({"task": task, "code": code, "severity": severity})
    log = Log(file or last_run())
    found = [msgspec.convert(one, Event) for one in log.events()]
    options.warn(log.damage)
    chosen = [event for event in found if wanted(event)]
    if doubt := wanted.doubt(found):
        render.print_error(render.warning(doubt))
    text = "\n".join(map(render.event, chosen))
    options.show(text, {"events": chosen}, as_data=json_)


def commands(
    *,
    file: File = None,
    task: A[
        str | None,
        Option("Only those that name this task or stop everything.", "TASK"),
    ] = None,
    op: A[str | None, Option("Only this kind, such as control.", "KIND")] = None,
    refused: A[bool, Option("Only those that were not carried out.")] = False,
    json_: options.Json = False,
) -> None:
    """Show the commands of a run, who gave them, and their results.

    Examples:
        Show which commands were refused in the newest run:
        pbonet log commands --refused
        Show those about one task, as data:
        pbonet log commands runs/teleop --task jttrace --json
    """
    import sys

    from pbonet.log import Log, last_run, orders

    log = Log(file or last_run())
    found = log.commands()
    options.warn(log.damage)
    chosen = orders.chosen(found, task=task, op=op, refused=refused)
    if not (chosen or json_):
        sys.stderr.write(f"{orders.none_of(log.about, found)}\n")
    text = "\n".join(map(orders.line, chosen))
    options.show(text, {"commands": chosen}, as_data=json_)


def plot(
    *,
    file: A[Path, Argument("A log, or a run's folder.")],
    variables: A[list[str], Argument("Which variables, each in a plot of its own.")],
    out: Out = Path("log.png"),
    json_: options.Json = False,
) -> None:
    """Plot variables over time into a picture.

    Examples:
        Plot measured and wanted joint angles:
        pbonet log plot runs/teleop Q_MEZ Q_REF
        Plot one variable into a drawing:
        pbonet log plot runs/teleop Q_MEZ -o q.svg
    """
    from pbonet.log import Log
    from pbonet.master.tools import log_plot

    log = Log(file)
    log_plot.draw(log, variables, out)
    options.warn(log.damage)
    _written(out, json_)


def diff(
    *,
    one: A[Path, Argument("A log, or a run's folder.")],
    other: A[Path, Argument("Another log or folder.")],
    task: A[list[str] | None, Option("Only this task.", "TASK")] = None,
    json_: options.Json = False,
) -> int:
    """Compare two runs: the first cycle in which each variable differs.

    The status is 1 if one differs.

    Examples:
        Compare two runs:
        pbonet log diff runs/before runs/after
        Compare what one task did:
        pbonet log diff runs/before runs/after --task jttrace
    """
    from pbonet.log import Log, text

    logs = Log(one), Log(other)
    rows = text.diff(*logs, task or ())
    options.warn([*logs[0].damage, *logs[1].damage])
    options.show(text.diff_text(rows), rows, as_data=json_)
    return int(any(row["first"] is not None for row in rows))


def merge(
    *,
    files: A[list[Path], Argument("Logs, or folders of runs.")],
    out: Out,
    json_: options.Json = False,
) -> None:
    """Merge several logs into one, ordered by time.

    Examples:
        Merge the logs of two RTPUs (executors):
        pbonet log merge runs/arm0 runs/arm1 -o arm.mcap
        Merge all logs of a folder:
        pbonet log merge runs/* -o day.mcap
    """
    from pbonet.log import merge as do

    done = do(files, out)
    options.warn(done.damage)
    _written(
        out, json_, done.messages, [str(one) for one in done.clocks if one.matters]
    )


def export(
    *,
    file: A[Path, Argument("A log, or a run's folder.")],
    rosbag2: A[Path, Option("Write a bag of ROS 2: a new folder.", "FOLDER")],
    topics: A[
        Path | None,
        Option("Which topics (docs/ros2.md); all variables if left out.", "FILE"),
    ] = None,
    json_: options.Json = False,
) -> None:
    """Write a run as a bag of ROS 2, which its tools open.

    'pbonet log cat --out' exports one task for spreadsheets, numpy and Parquet.

    Examples:
        Write all variables of a run:
        pbonet log export runs/teleop --rosbag2 teleop-bag
        Write the topics that a bridge publishes by its file:
        pbonet log export runs/teleop --rosbag2 teleop-bag --topics arm.toml
    """
    from pbonet import ros2
    from pbonet.log import Log

    log = Log(file)
    wanted = None if topics is None else ros2.topics_file.read_topics(topics)
    counts = ros2.rosbag2.export(log, rosbag2, wanted)
    options.warn(log.damage)
    text = "\n".join(f"{name}: {count} messages" for name, count in counts.items())
    data = {"file": str(rosbag2), "topics": counts}
    options.show(f"{rosbag2}\n{text}", data, as_data=json_)


def recover(
    *,
    file: A[Path, Argument("A log that is damaged or was cut short.")],
    out: Out,
    json_: options.Json = False,
) -> None:
    """Repair a log that is damaged, or cut short by a power failure.

    Examples:
        Write what can be read into a new log:
        pbonet log recover runs/teleop/log.mcap -o whole.mcap
        Repair one and say how many messages it has, as data:
        pbonet log recover broken.mcap -o whole.mcap --json
    """
    from pbonet.log import recover as do

    done = do(file, out)
    options.warn(done.damage)
    _written(out, json_, done.messages)


COMMANDS = (info, cat, events, commands, plot, diff, merge, export, recover)
