"""The ``.job`` file: a task set and the conditions around it (section 3.2).

The thesis says what a job is and leaves its syntax open; this one is pbonet's own.
"""

from __future__ import annotations

from math import inf
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Final

from pbonet.errors import did_you_mean

from . import words
from .blocks import Block, Grammar, read_block
from .conditions import Parsed, cost_of, parse, replaced
from .lines import Line, Word, fault, quote
from .model import Condition, JobFile, JobTask, Place, RecordLine, Restart
from .reader import Reader, load
from .timing import frequency
from .write import number, same_again, text_line

if TYPE_CHECKING:
    from pathlib import Path

GRAMMAR = Grammar("JOB DESC SBS PRE* POST* [COST] TASK+ RECORD* [OFF]")
MODES = ("off", "outputs", "all")
"""How a task can be recorded."""
LAST = "last"
"""Only the last seconds, once something goes wrong."""
_PAIR = 2
"""Words that an option is made of."""
RESTARTS: Final[tuple[Restart, ...]] = ("never", "off", "on")
"""Treatment of a task whose RTPU process or machine was lost."""
_TASK = (
    "TASK rmod [rtpu [FIXED]] [FREQ hz] [FALLBACK rmod [TAKEOVER seconds]] "
    "[RESTART never|off|on]"
)
_OPTIONS = {"FIXED", "FREQ", "FALLBACK", "RESTART"}
SHORTEST_TAKEOVER, LONGEST_TAKEOVER = 0.5, 30.0


def read_job(path: str | Path) -> JobFile:
    """Read the ``.job`` file at `path`.

    Raises:
        ConfigFileError: It cannot be read.
        ConfigError: It says something that cannot be.
    """
    return parse_job(load(path), str(path))


def parse_job(text: str | bytes, file: str = "<text>") -> JobFile:
    """Parse the text of a ``.job`` file; `file` is its name in messages.

    Raises:
        ConfigError: It says something that cannot be.
    """
    reader = Reader(text, file, GRAMMAR.keywords)
    block = read_block(reader, GRAMMAR)
    tasks: dict[str, JobTask] = {}
    for line in block.all("TASK"):
        task = _task(reader, line)
        if first := tasks.get(task.rmod):
            above = first.place.line if first.place else 0
            raise fault(
                f"the RMOD {quote(task.rmod)} is named twice",
                line.place,
                expected="one TASK line for each RMOD",
                got=f"another one in line {above}",
                remedy="remove one, or copy the .rmod under another name",
            )
        tasks[task.rmod] = task
    _check_fallbacks(reader, tasks)
    off_order = _off(block, tasks)
    record = tuple(_record(line) for line in block.all("RECORD"))
    reader.finish()
    return JobFile(
        file=file,
        name=words.label(words.single(block["JOB"], "a name"), "a job"),
        desc=block["DESC"].rest,
        sbs=words.path(block["SBS"], "the name of a .sbs file"),
        pre=tuple(_condition(reader, line) for line in block.all("PRE")),
        post=tuple(_condition(reader, line) for line in block.all("POST")),
        cost=_cost(reader, block.get("COST")),
        tasks=tuple(tasks.values()),
        off_order=off_order,
        record=record,
    )


def _condition(reader: Reader, line: Line) -> Condition:
    """Return a condition; constants that it names are replaced by their values."""
    said = _said(line)
    found = parse(said.text, said.place)
    return Condition(parse(_known(reader, found), said.place).text, said.place)


def _said(line: Line) -> Condition:
    """Return what follows the keyword, without a comment."""
    words = line.words
    if not words:
        raise fault(
            f"{line.keyword} needs a condition",
            line.place,
            expected="a condition",
            got="nothing",
            remedy="write the condition after the keyword, or remove the line",
        )
    first, last = words[0].place, words[-1]
    end = last.place.column + len(last.text) - first.column
    return Condition(line.rest[:end], first)


def _known(reader: Reader, found: Parsed) -> str:
    """Return a text whose constants are replaced by their values."""
    return replaced(
        found, lambda name, place: reader.constants.replace(Word(name, place))
    )


def _cost(reader: Reader, line: Line | None) -> Condition | None:
    """Return the error of a job; constants are replaced by their values."""
    if line is None:
        return None
    said = _said(line)
    mean, found = cost_of(said)
    cost = Condition(f"{mean}({_known(reader, found)})", said.place)
    cost_of(cost)
    return cost


def _task(reader: Reader, line: Line) -> JobTask:
    """Return the task of a TASK line."""
    rest = line.words
    if not rest:
        raise fault(
            "TASK names no RMOD",
            line.place,
            expected=_TASK,
            got="nothing",
            remedy="name the RMOD to run",
        )
    rmod = _rmod(rest.pop(0))
    rtpu = freq = fallback = None
    takeover = 0.0
    fixed = False
    restart: Restart = "off"
    if rest and rest[0].text not in _OPTIONS:
        rtpu = _rtpu(rest.pop(0))
        fixed = _is_fixed(rest)
    if (word := _taken(rest, "FREQ")) is not None:
        freq = frequency(reader, word._replace(keyword="FREQ"))
    if (word := _taken(rest, "FALLBACK")) is not None:
        fallback = _rmod(word)
        if (word := _taken(rest, "TAKEOVER")) is not None:
            takeover = _takeover(reader, word)
    if (word := _taken(rest, "RESTART")) is not None:
        restart = _restart(word)
    if rest:
        raise fault(
            "TASK is malformed",
            rest[0].place,
            expected=_TASK,
            got=f"{quote(rest[0].text)} here",
            remedy="write the RTPU first, FIXED after it, then FREQ and Hz, then "
            "FALLBACK and an RMOD, then TAKEOVER and seconds, then RESTART",
        )
    return JobTask(
        rmod=rmod,
        rtpu=rtpu,
        fixed=fixed,
        freq=freq,
        fallback=fallback,
        takeover=takeover,
        restart=restart,
        place=line.place,
    )


def _is_fixed(rest: list[Word]) -> bool:
    """Take FIXED from the words after the RTPU; return whether it was there."""
    if not rest or rest[0].text != "FIXED":
        return False
    del rest[0]
    return True


def _restart(word: Word) -> Restart:
    for known in RESTARTS:
        if word.text == known:
            return known
    raise fault(
        f"RESTART has {quote(word.text)}",
        word.place,
        expected=" or ".join(RESTARTS),
        got=quote(word.text),
        remedy=did_you_mean(word.text, RESTARTS)
        or "write 'off' to have the task spawned again, and left OFF",
    )


def _taken(rest: list[Word], keyword: str) -> Word | None:
    """Take a keyword and the word after it; return that word, or None without them."""
    if len(rest) < _PAIR or rest[0].text != keyword:
        return None
    word = rest[1]
    del rest[:_PAIR]
    return word


def _takeover(reader: Reader, word: Word) -> float:
    """Return after how many seconds a standby takes over by itself."""
    return words.real(
        reader,
        word._replace(keyword="TAKEOVER"),
        f"{SHORTEST_TAKEOVER:g} to {LONGEST_TAKEOVER:g} s",
        low=SHORTEST_TAKEOVER,
        high=LONGEST_TAKEOVER,
        open_low=False,
        open_high=False,
    )


def _check_fallbacks(reader: Reader, tasks: dict[str, JobTask]) -> None:
    """Refuse a standby that the job runs already, or that has two originals.

    Raises:
        ConfigError: There is one.
    """
    found: dict[str, JobTask] = {}
    for task in tasks.values():
        name = task.fallback
        if name is None:
            continue
        other = tasks.get(name) or found.get(name)
        if other is not None:
            place = other.place.line if other.place else 0
            raise fault(
                f"the fallback {quote(name)} of {quote(task.rmod)} is not free",
                task.place or Place(reader.file, 0),
                expected="an RMOD that stands by for this task alone",
                got=f"another use in line {place}",
                remedy="name another one, or copy the .rmod under another name",
            )
        found[name] = task


def _rmod(word: Word) -> str:
    if word.text.endswith(".rmod"):
        name = word.text.removesuffix(".rmod")
        raise fault(
            "TASK names a file",
            word.place,
            expected="the name of an RMOD, without folder and .rmod",
            got=quote(word.text),
            remedy=f"write {quote(PurePosixPath(name).name)}",
        )
    return words.label(word, "an RMOD")


def _rtpu(word: Word) -> str:
    if word.text[0].isdigit():
        raise fault(
            f"TASK has {quote(word.text)} where an RTPU is allowed",
            word.place,
            expected=_TASK,
            got=quote(word.text),
            remedy=f"for a frequency write FREQ {word.text[:10]}",
        )
    return words.label(word, "an RTPU")


def _record(line: Line) -> RecordLine:
    """Return what ``RECORD off|outputs|all [task or variable]...`` or ``last`` says."""
    mode = line.words[0].text if line.words else ""
    if mode not in {*MODES, LAST}:
        raise fault(
            "RECORD is malformed",
            line.words[0].place if line.words else line.place,
            expected="RECORD off|outputs|all [task or variable]..., or last SECONDS",
            got=quote(mode) if mode else "nothing",
            remedy=did_you_mean(mode, MODES) or "give the recording mode first",
        )
    names = tuple(word.text for word in line.words[1:])
    if mode == LAST and not (len(names) == 1 and last_seconds(names[0])):
        raise fault(
            "RECORD last is malformed",
            line.words[-1].place,
            expected="RECORD last SECONDS",
            got=quote(" ".join(names)) if names else "no seconds",
            remedy="write for example RECORD last 60",
        )
    return RecordLine(mode, names, line.place)


def last_seconds(text: str) -> float:
    """Return what follows ``last``; 0 when it is no number of seconds."""
    try:
        seconds = float(text)
    except ValueError:
        return 0.0
    return seconds if 0.0 < seconds < inf else 0.0


def _off(block: Block, tasks: dict[str, JobTask]) -> tuple[str, ...]:
    """Return the turn-off order of the OFF line."""
    line = block.get("OFF")
    if line is None:
        return ()
    order: dict[str, None] = {}
    for word in line.words:
        if word.text not in tasks or word.text in order:
            again = word.text in order
            raise fault(
                f"OFF names {quote(word.text)} twice"
                if again
                else f"OFF names {quote(word.text)}, which no TASK line does",
                word.place,
                expected="each task at most once" if again else " or ".join(tasks),
                remedy="remove one of them"
                if again
                else did_you_mean(word.text[:40], tasks) or "correct the name",
            )
        order[word.text] = None
    if not order:
        raise fault(
            "OFF names no task",
            line.place,
            expected="tasks in the order of turning them off",
            got="nothing",
            remedy="name them, or remove the line for the reverse of turning on",
        )
    return tuple(order)


def write_job(record: JobFile) -> str:
    """Return the text of a ``.job`` file with the content of `record`.

    Raises:
        ConfigError: No file can say it.
    """
    return same_again(record, job_text(record), parse_job)


def job_text(record: JobFile) -> str:
    """Return the text of a ``.job`` file, which may say another thing; see `write`."""
    lines = [
        text_line("JOB", record.name),
        text_line("DESC", record.desc),
        text_line("SBS", record.sbs),
    ]
    lines += [text_line("PRE", condition.text) for condition in record.pre]
    lines += [text_line("POST", condition.text) for condition in record.post]
    lines += [text_line("COST", record.cost.text)] if record.cost else []
    for task in record.tasks:
        freq = "" if task.freq is None else f"FREQ {number(task.freq)}"
        standby = f"FALLBACK {task.fallback}" if task.fallback else ""
        after = f"TAKEOVER {number(task.takeover)}" if task.takeover else ""
        again = "" if task.restart == "off" else f"RESTART {task.restart}"
        place = f"{task.rtpu} FIXED" if task.rtpu and task.fixed else task.rtpu or ""
        parts = (task.rmod, place, freq, standby, after, again)
        lines.append(text_line("TASK", " ".join(part for part in parts if part)))
    lines += [
        text_line("RECORD", " ".join((one.mode, *one.names))) for one in record.record
    ]
    if record.off_order:
        lines.append(text_line("OFF", " ".join(record.off_order)))
    return "".join([*lines, "EOF\n"])
