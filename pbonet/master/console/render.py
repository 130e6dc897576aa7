"""The data of commands as text for a terminal: plain, without colours."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any, Final

from pbonet.analysis import legality
from pbonet.errors import PbonetError, Severity
from pbonet.master.subsystem import is_sequence, status_fields
from pbonet.versions import REMEDY
from pbonet.xm.net import Event, convert, messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from pbonet.master.configuration import Adopted

Data = dict[str, Any]

_PREFIXES: Final = ((1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"))
_UNITS: Final = {field.name: field.unit for field in status_fields.FIELDS}
_WIDEST_VALUES: Final = 8
_BELOW: Final = {
    "STANDBY": "standby",
    "RESTART": "restarted",
    "WARNING": "warning",
    "TIMING": "timing",
    "WAITS": "waits",
    "ERROR": "error",
}
"""Marks of lines below a task, and their texts."""


def text(command: str, data: Data) -> str:
    """Return what a command gave, as lines for a terminal; may be empty."""
    return _RENDER.get(command, _states)(data)


def warning(message: str) -> str:
    """Return a warning's line, marked as in section 4.4.1."""
    return f"WARNING> {message}"


def error(fault: PbonetError, *, debug: bool = False) -> str:
    """Return an error's lines; with `debug`, followed by those of its cause."""
    lines = f"ERROR> {fault}"
    return f"{lines}\n{fault.debug.rstrip()}" if debug and fault.debug else lines


def print_line(text: str) -> None:
    """Print a line of output."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def print_error(text: str) -> None:
    """Print a line beside the output."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def seconds(value: float | None) -> str:
    """Return a time with a unit that suits it, such as ``1.25 ms``."""
    if value is None:
        return "-"
    if value == 0:
        return "0 s"
    for size, prefix in _PREFIXES:
        if abs(value) >= size * 0.9995:
            return f"{_short(value / size)} {prefix}s"
    return f"{_short(value / 1e-9)} ns"


def stall_text(stalls: int, stalled: float, age: float | None) -> str:
    """Return how often a core stood still, when last, and whether it does now.

    Args:
        stalls: Number of stalls that have ended.
        stalled: Their duration, in seconds.
        age: Seconds since the last one ended; 0 while one lasts, None if none has.

    Returns:
        Nothing if it never stood still.
    """
    parts = ["stands still now"] if age == 0 else []
    if stalls:
        times = "once" if stalls == 1 else f"{stalls} times"
        parts.append(f"stood still {times}, {seconds(stalled)} in all")
        if age:
            parts.append(f"last {seconds(age)} ago")
    return "; ".join(parts)


def _short(value: float) -> str:
    """Return three digits and a bit, never an exponent."""
    if abs(value) >= 1000:  # noqa: PLR2004 - no decimals from there on
        return f"{value:.0f}"
    return f"{value:.3g}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return columns, padded to their widest cell; numbers are right-aligned."""
    cells = [list(head), *map(list, rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    numeric = [
        len(cells) > 1 and all(_is_number(row[n]) for row in cells[1:])
        for n in range(len(head))
    ]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in cells
    )


def _is_number(cell: str) -> bool:
    return cell[:1] in "-+.0123456789"


def cell(name: str, value: status_fields.Value) -> str:
    """Return one field of status as text."""
    if value is None:
        return "-"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    unit = _UNITS.get(name, "")
    if unit == "s":
        return seconds(value)
    if unit == "%":
        return f"{value:.1f}%"
    if unit == "Hz":
        return _short(value)
    return str(value)


def _status(data: Data) -> str:
    fields: list[str] = data["fields"]
    profiles: list[Data] = data["tasks"]
    lines: list[str] = []
    if profiles:
        rows = [[cell(n, one["fields"][n]) for n in fields] for one in profiles]
        head, *body = table(fields, rows).splitlines()
        lines.append(head)
        for one, row in zip(profiles, body, strict=True):
            lines.append(row)
            lines += [
                f"{mark}> {one['task']}: {one[key]}"
                for mark, key in _BELOW.items()
                if one[key]
            ]
    else:
        lines.append("no tasks")
    lines += [
        f"NOT-CREATED> {one['task']} on {one['rtpu']}: {one['reason']}"
        for one in data["missing"]
    ]
    lines += [f"VERSIONS> {text}: {REMEDY}" for text in data.get("versions", ())]
    lines += [f"HELD> {text}: {m.HELD_REMEDY}" for text in data.get("held", ())]
    raised: dict[str, list[str]] = {}  # RTPUs of one machine share one flag
    for rtpu in data["rtpus"]:
        for cause in rtpu["illegal"]:
            raised.setdefault(cause, []).append(rtpu["rtpu"])
    lines += [f"ILLEGAL> {', '.join(at)}: {cause}" for cause, at in raised.items()]
    lines += [
        f"STALLED> {rtpu['rtpu']}: its core {text}"
        for rtpu in data["rtpus"]
        if (text := stall_text(rtpu["stalls"], rtpu["stalled"], rtpu["stall_age"]))
    ]
    links = {  # RTPUs of one machine see the same
        (link["name"], link["writer"], link["reader"]): f"LINK> {link_line(link)}"
        for rtpu in data["rtpus"]
        for link in rtpu["tbufs"]
    }
    lines += [
        f"SPP> {rtpu['rtpu']}: {processor_line(one)}"
        for rtpu in data["rtpus"]
        for one in rtpu.get("spps", ())
    ]
    return "\n".join([*lines, *links.values()])


def processor_line(one: Data) -> str:
    """Return a special purpose processor as one line."""
    if one["error"] or not one["back_end"]:
        return f"{one['name']} does not run: {one['error'] or 'it starts'}"
    used = f": {', '.join(one['libraries'])}" if one["libraries"] else ""
    return (
        f"{one['name']} runs {one['back_end']} on {one['device']}, process "
        f"{one['pid']}, {one['batches']} batches{used}"
    )


def link_line(link: Data) -> str:
    """Return a link between subsystems as one line."""
    age = "nothing yet" if link["age"] is None else f"{seconds(link['age'])} old"
    return (
        f"{link['name']}: written by {link['writer'] or 'nobody'}, read by "
        f"{link['reader'] or 'nobody'}, record {link['number']}, {age}"
    )


def _status_set(data: Data) -> str:
    rows = [
        ["*" if field["name"] in data["shown"] else "", field["name"], field["doc"]]
        for field in data["known"]
    ]
    return table(("", "field", "what it says (* is shown)"), rows)


_FIGURES: Final = (
    *(
        "ptime",
        "cycle",
        "miss",
        "failed",
        "refF",
        "mezF",
        "refT",
        "mezT",
        "totC",
        "minC",
    ),
    *("avgC", "maxC", "firstC", "nowC", "minU", "avgU", "maxU", "tick"),
)
"""The figures of section 6.7.1 in the order in which they are shown."""


def _profile(data: Data) -> str:
    tasks: list[Data] = data["tasks"]
    if not tasks:
        return "no tasks"
    if len(tasks) == 1:
        return "\n".join([*_profile_of(tasks[0]), *_profile_rtpus(data["rtpus"])])
    names = (
        "cycle",
        "miss",
        "failed",
        "mezF",
        "minC",
        "avgC",
        "maxC",
        "minU",
        "avgU",
        "maxU",
    )
    rows = [
        [
            task["task"],
            task["rtpu"],
            *(cell(name, task["figures"][name]) for name in names),
            *(seconds(task["quantiles"][name]) for name in ("p50", "p99")),
            seconds(task["declared"]["maxc"]),
        ]
        for task in tasks
    ]
    head = ("task", "rtpu", *names, "p50", "p99", "MAXC")
    return "\n".join([table(head, rows), *_profile_rtpus(data["rtpus"])])


def _profile_of(task: Data) -> list[str]:
    """Return the lines about one task: figures, declarations, curve."""
    docs = {field.name: field.doc for field in status_fields.FIELDS}
    rows = [[n, cell(n, task["figures"][n]), docs[n]] for n in _FIGURES]
    spread = {"least": task["least"], **task["quantiles"], "most": task["most"]}
    lines = [
        f"{task['task']} on {task['rtpu']}",
        table(("figure", "value", "what it says"), rows),
        f"CPU time of {task['counted']} cycles since it was spawned: " + _times(spread),
        "delay from release to cycle: " + _times(task["delays"]),
        f"ended late {task['late']}, failed {task['failed']}",
        _failures(task),
        "declared: " + _declared(task),
    ]
    lines += [
        f"section {name}: {one['count']} times, "
        + _times({
            "least": one["min"],
            "mean": one["total"] / one["count"] if one["count"] else None,
            "most": one["max"],
        })
        for name, one in task["sections"].items()
    ]
    if task["psi"]:
        from . import profile_plot

        lines += [
            "share of the cycles within a CPU time:",
            profile_plot.as_text(task["psi"]),
        ]
    return lines


def _failures(task: Data) -> str:
    """Return the line about timing failures (section 6.3)."""
    found = {**task["failures"], "reserve used up": task["overruns"]}
    found |= {"aborted": task["aborted"], "skipped": task["skipped"]}
    told = ", ".join(f"{what} {count}" for what, count in found.items())
    if not any(found.values()):
        return "timing failures: none"
    return f"timing failures: {told}; longest delivery {seconds(task['delivery_max'])}"


def _times(named: dict[str, float | None]) -> str:
    return ", ".join(f"{name} {seconds(value)}" for name, value in named.items())


def _declared(task: Data) -> str:
    known = task["declared"]
    times = {key.upper(): known[key] for key in ("minc", "maxc", "effc")}
    parts = [_times({key: value}) for key, value in times.items() if value is not None]
    if known["softness"]:
        parts.append(f"SOFTNESS {known['softness']:g}")
        parts.append(f"E {seconds(task['effective'])}")
    return ", ".join(parts) or "nothing"


def _profile_rtpus(rtpus: list[Data]) -> list[str]:
    return [
        f"RTPU {one['rtpu']} ({one['scheduler']} over {one['backend']}): "
        f"{one['tasks']} tasks, {one['cycle']} cycles, {one['miss']} missed, "
        f"{one['failed']} failed, CPU "
        f"{seconds(one['totC'])}; a cycle {seconds(one['minC'])} to "
        f"{seconds(one['maxC'])}, mean {seconds(one['avgC'])}; load "
        f"{cell('minU', one['minU'])} to {cell('maxU', one['maxU'])}, mean "
        f"{cell('avgU', one['avgU'])}; tasks {one['util']:.1%}, dispatcher "
        f"{one['dispatcher']:.1%} of the core since its dispatcher began"
        for one in rtpus
    ]


def _profile_save(data: Data) -> str:
    lines = [
        f"{one['task']}: {one['cycles']} cycles, {seconds(one['least'])} to "
        f"{seconds(one['most'])}, in {one['file']}"
        for one in data["saved"]
    ]
    return "\n".join(lines) or "nothing was saved"


def adopted(one: Adopted, *, dry_run: bool = False) -> str:
    """Return what became of an RMOD's times: the change, and a line about it."""
    times = ", ".join(f"{key} {seconds(value)}" for key, value in one.times.items())
    done = "unchanged" if not one.diff else "not written" if dry_run else "written"
    return f"{one.diff}{one.file}: {times} from {one.cycles} cycles: {done}"


def values(numbers: object, *, most: int = _WIDEST_VALUES) -> str:
    """Return the elements of a variable, shortened."""
    if not is_sequence(numbers):
        return str(numbers)
    shown = " ".join(
        f"{number:.6g}" if isinstance(number, float) else str(number)
        for number in numbers[:most]
    )
    return shown if len(numbers) <= most else f"{shown} ... ({len(numbers)})"


def _display(data: Data) -> str:
    if not data["variables"]:
        return "no variables"
    rows = [
        [
            one["name"],
            one["writer"] or "-",
            ("stale " if one["stale"] else "") + seconds(one["age"]),
            one["units"],
            values(one["values"]),
        ]
        for one in data["variables"]
    ]
    return table(("variable", "writer", "age", "units", "value"), rows)


def _params(data: Data) -> str:
    rows = [
        [
            one["name"],
            values(one["value"], most=16),
            one["unit"],
            one["bounds"],
            one["doc"],
        ]
        for one in data["params"]
    ]
    if not rows:
        return f"{data['task']} has no parameters"
    return table(("parameter", "value", "unit", "bounds", "what it is"), rows)


def _library(data: Data) -> str:
    """Return the modules that were found; the only one in full."""
    if len(data["modules"]) == 1:
        from pbonet.pbo import ModuleInfo, render as render_module

        (one,) = data["modules"]
        rmods = " ".join(one["rmods"])
        text = render_module(convert(one, ModuleInfo))
        return f"{text}RMODs     {rmods}" if rmods else text.rstrip()
    rows = [
        (
            one["name"],
            one["module_class"] or "-",
            *(_port_names(one, kinds) for kinds in _SIDES),
            one["doc"],
        )
        for one in data["modules"]
    ]
    text = table(("module", "class", "reads", "writes", "what it does"), rows)
    generic = [one["name"] for one in data["modules"] if one["generic"]]
    return f"{text}\n{_GENERIC.format(' '.join(generic))}" if generic else text


_GENERIC: Final = "ports of the unit any take every variable, by SVARALIAS: {}"
_SIDES: Final = (("in-const", "in-var"), ("out-const", "out-var"))


def _port_names(module: Data, kinds: tuple[str, str]) -> str:
    """Return the names of a module's ports of two kinds, with their units."""
    return " ".join(
        port["name"] if port["unit"] == "none" else f"{port['name']}[{port['unit']}]"
        for port in module["ports"]
        if port["kind"] in kinds
    )


def _check(data: Data) -> str:
    reports = convert(data["rtpus"], list[legality.RtpuReport])
    verdict = "legal"
    if not data["legal"]:
        verdict = error(PbonetError.from_wire(data["error"]))
    told = [warning(text) for text in data["warnings"]]
    return "\n".join([legality.report_text(reports), *told, verdict]).lstrip("\n")


def _freq(data: Data) -> str:
    return f"{data['task']}: {data['hz']:g} Hz"


def _stop(data: Data) -> str:
    parts = [
        f"{what}: {' '.join(data[key])}"
        for key, what in (("off", "turned off"), ("killed", "ended by force"))
        if data[key]
    ]
    return "; ".join(parts) or "nothing was ON"


def _states(data: Data) -> str:
    states: dict[str, str] = data.get("states", {})
    return "  ".join(f"{task} {state}" for task, state in states.items())


def _transition(data: Data) -> str:
    lines = [f"spawn {task} on {rtpu}" for task, rtpu in data["spawns"].items()]
    lines += [
        f"{new} gives the constants of {', '.join(olds)}"
        for new, olds in data["replaces"].items()
    ]
    lines += [f"{signal} {task}" for task, signal in data["items"]]
    lines += [f"kill {task}" for task in data["kills"]]
    lines = [*data["conditions"], *(lines or ["nothing to do"])]
    lines.append("stays ON: " + (", ".join(data["stays"]) or "nothing"))
    if data["states"]:
        lines.append(_states(data))
    return "\n".join(lines)


def printed(one: Event) -> str:
    """Return a line that a module printed, after the name of its task."""
    return f"{one.task}> {one.text}"


def event(one: Event) -> str:
    """Return an event as one line, or more if its text has more.

    The line of code, if known, ends the first of them.
    """
    clock = time.strftime("%H:%M:%S", time.localtime(one.wall))
    clock += f".{int(one.wall % 1 * 1000):03d}"
    severity = Severity(one.severity).name
    place = "/".join(filter(None, (one.rtpu, one.task)))
    cycle = f" cycle={one.cycle}" if one.cycle else ""
    number = f" errnum={one.errnum}" if one.errnum else ""
    first, more, rest = one.text.partition("\n")
    from pbonet.node.task import placed

    said = f"{placed(first, one.place)}{more}{rest}"
    return f"{clock} {severity:7} {place} {one.code}{cycle}{number} {said}"


def _events(data: Data) -> str:
    found = convert(data["events"], list[Event])
    return "\n".join(map(event, found)) or "no events"


def _events_count(data: Data) -> str:
    rows = [
        [one["rtpu"], one["task"] or "-", one["code"], str(one["count"])]
        for one in data["counts"]
    ]
    return table(("rtpu", "task", "event", "count"), rows) if rows else "no events"


def _explain(data: Data) -> str:
    from pbonet.master.diagnosis import Explanation

    return str(convert(data, Explanation))


def _sigwait(data: Data) -> str:
    sent = data["sent"]
    times = f" ({sent['count']} times)" if sent["count"] > 1 else ""
    return f"{sent['task']} {sent['signal']}{times}"


def _sigmask(data: Data) -> str:
    rows = [
        [task or "(subsystem)", " ".join(names) or "none"]
        for task, names in sorted(data["masks"].items())
    ]
    return table(("task", "masked signals"), rows) if rows else "no signal is masked"


def _help(data: Data) -> str:
    commands: list[Data] = data["commands"]
    rows = [[one["usage"], one["help"]] for one in commands]
    lines = [table(("command", "what it does"), rows)]
    if len(commands) == 1:
        lines.extend(
            f"  {arg['name']:10} {arg['kind']:12} {arg['doc']}"
            + "; the last one used if left out" * arg["last"]
            for arg in commands[0]["args"]
        )
        lines.extend(f"  {line:32}  # {use}" for line, use in commands[0]["examples"])
    return "\n".join(lines)


def _nothing(_: Data) -> str:
    return ""


_RENDER: Final[dict[str, Callable[[Data], str]]] = {
    "status": _status,
    "status set": _status_set,
    "profile": _profile,
    "profile save": _profile_save,
    "display": _display,
    "write": _display,
    "get": _params,
    "set": _params,
    "library": _library,
    "check": _check,
    "freq": _freq,
    "stop": _stop,
    "swap": _transition,
    "switch": _transition,
    "events": _events,
    "explain": _explain,
    "events count": _events_count,
    "sigmask": _sigmask,
    "sigwait": _sigwait,
    "help": _help,
    "network": _nothing,
    "quit": _nothing,
    "wait": _nothing,
}
