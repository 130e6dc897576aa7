"""Writing measured execution times into RMODs: MINC, MAXC, and EFFC of soft tasks.

Only those lines change; comments, order and spaces of the file stay. An RMOD of the
library is not touched: it is copied beside the ``.sbs`` file, where it goes before the
library's.
"""

from __future__ import annotations

import codecs
import difflib
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import Struct, structs

from pbonet.analysis import legality
from pbonet.config import Library, bundled, load, meaning, number, parse_rmod
from pbonet.errors import (
    ConfigError,
    ConfigFileError,
    PbonetError,
    UnknownTaskError,
    did_you_mean,
)

from .saved_profiles import here, with_times
from .subsystem_files import Files, RmodSource

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from pbonet.config import Rmod

    from .saved_profiles import Saved

DIGITS = 3
"""Significant digits of what is written."""
_ANY_HZ = 1.0
"""Stands for the frequency of a class without one, until the measured one is known."""
_BEHIND = ("MAXC", "MINC", "EFFC", "PERIOD", "FREQ", "TASKTYPE")
"""Below which line a new one goes: the first of these that is there."""
_VALUE = re.compile(r"^(\s*\w+)(\s+)([^\s#]+)(.*)$", re.DOTALL)


class Adopted(Struct, frozen=True, kw_only=True):
    """The new times of one RMOD; seconds."""

    rmod: str
    file: str
    """The file that is written."""
    host: str
    cycles: int
    """That the times rest on."""
    times: dict[str, float]
    """The values by keyword."""
    diff: str
    """Empty when the file says so already."""


def adopt(
    path: str | Path,
    names: Sequence[str] = (),
    folders: Iterable[str | Path] = (),
    *,
    margin: float = 20.0,
    host: str = "",
    dry_run: bool = False,
) -> tuple[list[Adopted], list[str]]:
    """Write measured times into RMODs; return the changes and warnings.

    Args:
        path: The ``.sbs`` file, or a ``.job`` file that names it.
        names: The RMODs; all that were measured if none is named.
        folders: Of module libraries.
        margin: Per cent by which MAXC is above the longest cycle that was measured,
            and MINC below the shortest.
        host: The machine they were measured on; this one if empty.
        dry_run: Write nothing.

    Raises:
        UnknownTaskError: One that was named was not measured there.
        ConfigError: A file is missing or wrong, or cannot be written.
    """
    files = Files(path, Library(folders))
    host = host or here()
    store = files.profiles
    wanted = list(names) or sorted(p.stem for p in store.folder.glob(f"{host}/*.json"))
    if not wanted:
        raise _unmeasured("", host, store.measured())
    found: list[Adopted] = []
    warnings: list[str] = []
    for name in wanted:
        source = files.rmod(name, _ANY_HZ)
        if source.record.capacity is not None:
            if names:
                warnings.append(_no_cycle(source.record))
            continue
        info = files.library.load_rmod(source.record).info
        saved, note = store.find(source.record, host, info)
        if saved is None and not note:
            raise _unmeasured(name, host, store.measured())
        if saved is None:
            warnings.append(note)
            continue
        source = _with_file(files, source, saved.hz)
        times = measured_times(source.record, saved, margin)
        if problem := _too_long(source.record, saved, times):
            warnings.append(problem)
            continue
        found.append(_write(files, source, saved, times, dry_run=dry_run))
    return found, warnings


def _no_cycle(rmod: Rmod) -> str:
    return (
        f"{rmod.file}: not adopted: the reserve of the server {rmod.name} is its "
        "CAPACITY, whatever one event takes"
    )


def measured_times(rmod: Rmod, saved: Saved, margin: float) -> dict[str, float]:
    """Return what MINC, MAXC, and of a soft task EFFC, are to be.

    MAXC is rounded up and MINC down, and MAXC goes no further than the period that a
    hard task's longest cycle still kept.
    """
    factor = 1 + margin / 100
    most = _rounded(saved.most * factor, math.ceil)
    period = 1 / saved.hz if saved.hz else math.inf
    if not rmod.softness and saved.most <= period < most:
        most = period
    times = {"MINC": _rounded(saved.least / factor, math.floor), "MAXC": most}
    if rmod.softness:
        plain = structs.replace(rmod, effc=None, maxc=None)
        task = with_times(legality.Task(rmod=plain, rtpu=""), saved)
        soft = legality.effective(task)
        if soft is not None and soft.seconds is not None:
            times["EFFC"] = min(_rounded(soft.seconds, math.ceil), most)
    return times


def _rounded(seconds: float, whole: Callable[[float], int]) -> float:
    """Return a time with few digits, rounded by `whole`."""
    exponent = math.floor(math.log10(seconds)) - DIGITS + 1
    digits = whole(round(seconds / 10.0**exponent, 6))
    return float(f"{digits}e{exponent}")


def _too_long(rmod: Rmod, saved: Saved, times: dict[str, float]) -> str:
    """Return why the times would make the RMOD illegal, if they would."""
    hz = rmod.freq or saved.hz
    if rmod.softness or not hz or saved.most <= 1 / hz:
        return ""
    return (
        f"{rmod.file}: not adopted: a cycle of {rmod.name} took {saved.most:g} s, and "
        f"its period is {1 / hz:g} s; lower its frequency, or declare SOFTNESS"
        f" (MAXC would be {times['MAXC']:g})"
    )


def _with_file(files: Files, source: RmodSource, hz: float | None) -> RmodSource:
    """Return an RMOD with the file that it gets, where its class stands for it.

    Where the class has no frequency, that of the measurement is written.
    """
    if not source.record.file.endswith(".py"):
        return source
    file = files.path.parent / f"{source.record.name}.rmod"
    text = files.rmod(source.record.name, hz).text
    return RmodSource(parse_rmod(text, str(file)), text)


def _write(
    files: Files,
    source: RmodSource,
    saved: Saved,
    times: dict[str, float],
    *,
    dry_run: bool,
) -> Adopted:
    rmod = source.record
    before = Path(rmod.file)
    target = before if files.is_own(before) else files.path.parent / before.name
    old = load(before) if before.exists() else ""
    new = with_lines(old or source.text, rmod, times)
    _must_mean(rmod, bundled(new, files.part), times)
    diff = "".join(
        difflib.unified_diff(
            old.splitlines(keepends=True),
            new.splitlines(keepends=True),
            str(before),
            str(target),
        )
    )
    if diff and not dry_run:
        marked = bool(old) and before.read_bytes().startswith(codecs.BOM_UTF8)
        _replace(target, codecs.BOM_UTF8 * marked + new.encode())
    return Adopted(
        rmod=rmod.name,
        file=str(target),
        host=saved.host,
        cycles=saved.cycles,
        times=times,
        diff=diff,
    )


def with_lines(text: str, rmod: Rmod, times: dict[str, float]) -> str:
    """Return the text of an RMOD with new times and no other change."""
    lines = text.splitlines(keepends=True)
    missing: list[str] = []
    for keyword, value in times.items():
        place = rmod.places.get(keyword)
        if place is None:
            missing.append(keyword)
        else:
            at = place.line - 1
            lines[at] = _VALUE.sub(rf"\g<1>\g<2>{number(value)}\g<4>", lines[at])
    after = next(rmod.places[key] for key in _BEHIND if key in rmod.places).line
    like = lines[after - 1]
    end = like[len(like.rstrip("\r\n")) :] or "\n"
    column = len(found[1] + found[2]) if (found := _VALUE.match(like)) else 10
    lines[after:after] = [
        f"{keyword} ".ljust(column) + number(times[keyword]) + end
        for keyword in missing
    ]
    return "".join(lines)


def _must_mean(rmod: Rmod, text: str, times: dict[str, float]) -> None:
    """Check that the new text differs from the old one in the times only."""
    wanted = structs.replace(rmod, **{key.lower(): v for key, v in times.items()})
    again = parse_rmod(text, rmod.file)
    if meaning(again) != meaning(wanted):
        raise ConfigError(
            "the RMOD cannot be changed",
            where=rmod.file,
            expected="each of MINC, MAXC and EFFC with its value on one line",
            remedy="write the times by hand",
        )


def _replace(path: Path, data: bytes) -> None:
    """Write a file whole or not at all; its rights stay."""
    try:
        new = path.with_name(f".{path.name}.new")
        new.write_bytes(data)
        if path.exists():
            new.chmod(path.stat().st_mode & 0o777)
        new.replace(path)
    except OSError as error:
        raise ConfigFileError(
            "the RMOD cannot be written",
            where=str(path),
            got=error.strerror or str(error),
            remedy="make its folder writable",
        ) from None


def _unmeasured(name: str, host: str, measured: dict[str, list[str]]) -> PbonetError:
    known = "; ".join(f"{on}: {', '.join(rmods)}" for on, rmods in measured.items())
    return UnknownTaskError(
        f"no profile of {name or 'any RMOD'} was saved on {host}",
        got=f"saved: {known or 'none'}",
        remedy=did_you_mean(name, measured.get(host, []))
        or "'pbonet profile FILE --save' saves those of running tasks; --host names "
        "another machine",
    )
