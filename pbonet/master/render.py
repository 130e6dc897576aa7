"""How the data of commands reads on a terminal: plain text, no colours."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from pbonet.errors import PbonetError, Severity
from pbonet.master import profile
from pbonet.master.words import is_sequence
from pbonet.xm.messages import Event

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

Data = dict[str, Any]

_PREFIXES: Final = ((1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"))
_UNITS: Final = {field.name: field.unit for field in profile.FIELDS}
_WIDEST_VALUES: Final = 8


def text(command: str, data: Data) -> str:
    """Return what a command gave, as lines for a terminal; may be empty."""
    return _RENDER.get(command, _states)(data)


def warning(message: str) -> str:
    """Return a warning's line, marked as in section 4.4.1."""
    return f"WARNING> {message}"


def error(fault: PbonetError, *, debug: bool = False) -> str:
    """Return an error's lines; with `debug`, those of its cause behind it."""
    lines = f"ERROR> {fault}"
    return f"{lines}\n{fault.debug.rstrip()}" if debug and fault.debug else lines


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


def _short(value: float) -> str:
    """Return three digits and a bit, never an exponent."""
    if abs(value) >= 1000:  # noqa: PLR2004 - no decimals from there on
        return f"{value:.0f}"
    return f"{value:.3g}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return columns, padded to their widest cell; numbers stand to the right."""
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


def cell(name: str, value: profile.Value) -> str:
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
            lines += [f"WARNING> {one['task']}: {one['warning']}"] * bool(
                one["warning"]
            )
            lines += [f"ERROR> {one['task']}: {one['error']}"] * bool(one["error"])
    else:
        lines.append("no tasks")
    raised: dict[str, list[str]] = {}  # RTPUs of one machine share one flag
    for rtpu in data["rtpus"]:
        for cause in rtpu["illegal"]:
            raised.setdefault(cause, []).append(rtpu["rtpu"])
    lines += [f"ILLEGAL> {', '.join(at)}: {cause}" for cause, at in raised.items()]
    return "\n".join(lines)


def _status_set(data: Data) -> str:
    rows = [
        ["*" if field["name"] in data["shown"] else "", field["name"], field["doc"]]
        for field in data["known"]
    ]
    return table(("", "field", "what it says (* is shown)"), rows)


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


def _module(data: Data) -> str:
    if "module" in data:
        from pbonet.pbo import ModuleInfo
        from pbonet.pbo import render as render_module

        return render_module(msgspec.convert(data["module"], ModuleInfo)).rstrip()
    rows = [[one["name"], one["version"], one["doc"]] for one in data["modules"]]
    modules = table(("module", "version", "what it does"), rows)
    return f"{modules}\n\nRMODs: {' '.join(data['rmods'])}"


def _check(data: Data) -> str:
    if data["legal"]:
        return "legal"
    return error(PbonetError.from_wire(data["error"]))


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


def event(one: Event) -> str:
    """Return an event as one line, or more if its text has more."""
    clock = time.strftime("%H:%M:%S", time.localtime(one.wall))
    clock += f".{int(one.wall % 1 * 1000):03d}"
    severity = Severity(one.severity).name
    place = "/".join(filter(None, (one.rtpu, one.task)))
    cycle = f" cycle={one.cycle}" if one.cycle else ""
    return f"{clock} {severity:7} {place} {one.code}{cycle} {one.text}"


def _events(data: Data) -> str:
    found = msgspec.convert(data["events"], list[Event])
    return "\n".join(map(event, found)) or "no events"


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
    return "\n".join(lines)


def _nothing(_: Data) -> str:
    return ""


_RENDER: Final[dict[str, Callable[[Data], str]]] = {
    "status": _status,
    "status set": _status_set,
    "display": _display,
    "write": _display,
    "get": _params,
    "set": _params,
    "module": _module,
    "check": _check,
    "freq": _freq,
    "stop": _stop,
    "events": _events,
    "help": _help,
    "network": _nothing,
    "quit": _nothing,
    "wait": _nothing,
}
