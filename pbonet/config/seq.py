"""The ``.seq`` file: a program of jobs (Stewart 1994, sections 3.2 and 4.4.3).

The thesis has such programs as rows of icons in Onika; this syntax is pbonet's own. The
lines are carried out one after the other. GOTO and ELSE lead to a step by its label, or
by its job if only one step has that job.
"""

from __future__ import annotations

import re
from math import isfinite
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from pbonet.errors import did_you_mean

from . import words
from .blocks import Block, Grammar, read_block
from .conditions import parse, replaced
from .lines import WORD, Line, Word, fault, nearest, quote
from .model import (
    EndRepeat,
    Finish,
    Goto,
    Order,
    Place,
    Repeat,
    SeqFile,
    SeqLine,
    Step,
    StepEnd,
)
from .reader import Reader, load
from .write import number, same_again, text_line

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from pbonet.errors import ConfigError

GRAMMAR = Grammar(
    "SEQUENCE DESC SBS [SAFE|WAIT|WITHIN] "
    "STEP|GOTO|REPEAT|END|DONE|FAIL|SPAWN|KILL|SET|WRITE+"
)
LONGEST: Final = 1e6
"""Seconds; the longest time that a line may have."""
MOST_TURNS: Final = 1_000_000_000
FOREVER: Final = "forever"
"""Stands for no last turn, as the word of REPEAT."""
_OPTIONS: Final = ("UNTIL", "FOR", "WITHIN", "ELSE")
_TAIL: Final = "[UNTIL end [OR end]...] [FOR s] [WITHIN s]"
_STEP: Final = f"STEP [label:] job {_TAIL} [ELSE step]"
_SAFE: Final = f"SAFE job {_TAIL}"
_END: Final = "SIGNAL, task SIGNAL or (condition)"
_GOTO: Final = f"GOTO step [IF {_END}]"
_ORDERS: Final = {
    "SPAWN": (1, 2, "SPAWN rmod [rtpu]"),
    "KILL": (1, 99, "KILL task..."),
    "SET": (3, 999, "SET task parameter value..."),
    "WRITE": (2, 9999, "WRITE variable value..."),
}
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


def read_seq(path: str | Path) -> SeqFile:
    """Read the ``.seq`` file at `path`.

    Raises:
        ConfigFileError: It cannot be read.
        ConfigError: It says something that cannot be.
    """
    return parse_seq(load(path), str(path))


def parse_seq(text: str | bytes, file: str = "<text>") -> SeqFile:
    """Parse the text of a ``.seq`` file; `file` is its name in messages.

    Raises:
        ConfigError: It says something that cannot be.
    """
    reader = Reader(text, file, GRAMMAR.keywords)
    block = read_block(reader, GRAMMAR)
    found = [line for key in _LINES for line in block.all(key)]
    found.sort(key=lambda line: line.place.line)
    lines = tuple(_LINES[line.keyword](reader, line) for line in found)
    safe = block.get("SAFE")
    record = SeqFile(
        file=file,
        name=words.label(words.single(block["SEQUENCE"], "a name"), "a sequence"),
        desc=block["DESC"].rest,
        sbs=words.path(block["SBS"], "the name of a .sbs file"),
        safe=_step(reader, safe) if safe else None,
        wait=_header_time(reader, block, "WAIT") or 0.0,
        within=_header_time(reader, block, "WITHIN"),
        lines=lines,
    )
    reader.finish()
    _check(record)
    return record


# -- lines -----------------------------------------------------------------------------


class _Part(NamedTuple):
    """A word of a line, or a condition without its parentheses."""

    word: Word
    condition: bool = False

    @property
    def shown(self) -> str:
        """The text, as written."""
        return f"({self.word.text})" if self.condition else self.word.text


def _parts(line: Line) -> list[_Part]:
    """Return the words and conditions of a line, without a comment.

    Raises:
        ConfigError: A parenthesis is not closed.
    """
    found: list[_Part] = []
    at = 0
    while match := WORD.search(line.rest, at):
        if match[0].startswith("#"):
            break
        column = line.rest_column + match.start()
        place = Place(line.place.file, line.place.line, column)
        if not match[0].startswith("("):
            found.append(_Part(Word(match[0], place, line.keyword)))
            at = match.end()
            continue
        end = _closed(line.rest, match.start())
        if end < 0 or line.rest[end + 1 : end + 2].strip():
            raise fault(
                "the condition has no end",
                place,
                expected="a condition in parentheses, with a space after the last one",
                got=quote(line.rest[match.start() :]),
                remedy="close the parenthesis" if end < 0 else "write a space after it",
            )
        inner = Place(place.file, place.line, column + 1)
        found.append(
            _Part(Word(line.rest[match.start() + 1 : end], inner), condition=True)
        )
        at = end + 1
    return found


def _closed(text: str, start: int) -> int:
    """Return where the parenthesis at `start` is closed; -1: nowhere."""
    depth = 0
    for index in range(start, len(text)):
        depth += (text[index] == "(") - (text[index] == ")")
        if depth == 0:
            return index
    return -1


def _malformed(
    line: Line, expected: str, got: _Part | None, remedy: str
) -> ConfigError:
    return fault(
        f"{line.keyword} is malformed",
        got.word.place if got else line.place,
        expected=expected,
        got=f"{quote(got.shown)} here" if got else "nothing after it",
        remedy=remedy,
    )


def _step(reader: Reader, line: Line) -> Step:
    """Return the step of a STEP line, or of the SAFE line."""
    safe = line.keyword == "SAFE"
    form = _SAFE if safe else _STEP
    options = _split(line, form)
    head = options.pop("")
    label = ""
    if len(head) > 1 and head[0].word.text.endswith(":") and not safe:
        word = head.pop(0).word
        label = words.label(word._replace(text=word.text[:-1]), "a step")
    job = _head(line, head, form)
    otherwise = options.pop("ELSE", [])
    if safe and otherwise:
        raise _malformed(line, form, otherwise[0], "SAFE has no ELSE; remove it")
    step = Step(
        job=_job(job),
        label=label,
        until=_ends(reader, line, options["UNTIL"]) if "UNTIL" in options else (),
        seconds=_time(reader, line, options, "FOR"),
        within=_time(reader, line, options, "WITHIN"),
        otherwise=_single(line, otherwise, form).text if otherwise else "",
        place=line.place,
    )
    if step.within is not None and (step.seconds is not None or not step.until):
        raise fault(
            "WITHIN has nothing that could come too late",
            options["WITHIN"][0].word.place,
            expected="WITHIN after UNTIL, without FOR, which ends the step itself",
            got="FOR" if step.seconds is not None else "no UNTIL",
            remedy="remove WITHIN, or write UNTIL and what ends the step",
        )
    return step


def _head(line: Line, head: Sequence[_Part], form: str) -> Word:
    """Return the one word before the options."""
    odd = next((one for one in head if one.condition), None)
    if odd is None and len(head) > 1:
        odd = head[1]
    if odd is not None or not head:
        raise _malformed(line, form, odd, _near(odd))
    return head[0].word


def _near(got: _Part | None) -> str:
    """Return what to do about a word that is in the way."""
    if got is None:
        return "name the job to change to"
    if got.condition:
        return "write UNTIL before the condition"
    return nearest(got.word.text, _OPTIONS) or "write the options after the job"


def _split(line: Line, form: str) -> dict[str, list[_Part]]:
    """Return the parts after each option; before the first one under "".

    Raises:
        ConfigError: An option is given twice, or has nothing after it.
    """
    found: dict[str, list[_Part]] = {"": []}
    last = ""
    for part in _parts(line):
        text = part.word.text
        if part.condition or text not in _OPTIONS:
            found[last].append(part)
            continue
        if text in found:
            raise _malformed(line, form, part, f"write {text} once")
        if last and not found[last]:
            raise _malformed(line, form, part, f"write what {last} has before it")
        last = text
        found[last] = []
    if last and not found[last]:
        raise _malformed(line, form, None, f"write what {last} has, or remove it")
    return found


def _job(word: Word) -> str:
    if word.text.endswith(".job"):
        raise fault(
            "STEP names a file",
            word.place,
            expected="the name of a job, without folder and .job",
            got=quote(word.text),
            remedy=f"write {quote(word.text.rpartition('/')[2].removesuffix('.job'))}",
        )
    return words.label(word, "a job")


def _ends(reader: Reader, line: Line, parts: Sequence[_Part]) -> tuple[StepEnd, ...]:
    """Return the ends between the words OR."""
    groups: list[list[_Part]] = [[]]
    for part in parts:
        if part.shown == "OR":
            groups.append([])
        else:
            groups[-1].append(part)
    return tuple(_end(reader, line, group) for group in groups)


def _end(reader: Reader, line: Line, group: Sequence[_Part]) -> StepEnd:
    """Return one end: a condition, a signal, or a task and its signal."""
    if len(group) == 1 and group[0].condition:
        return _condition(reader, group[0].word)
    if not 1 <= len(group) <= 2 or any(one.condition for one in group):  # noqa: PLR2004
        shown = " ".join(one.shown for one in group)
        raise fault(
            f"{line.keyword} has something that is neither a signal nor a condition",
            group[0].word.place if group else line.place,
            expected=_END,
            got=quote(shown) if group else "nothing beside OR or IF",
            remedy=f"write a condition in parentheses: ({shown})"
            if re.search(r"[<>=]", shown) and "(" not in shown
            else "write several ends with OR between them",
        )
    *task, signal = (one.word for one in group)
    return StepEnd(
        signal=words.label(signal, "a signal"),
        task=words.label(task[0], "a task") if task else "",
        place=group[0].word.place,
    )


def _condition(reader: Reader, word: Word) -> StepEnd:
    """Return a condition; constants that it names are replaced by their values."""
    text = word.text.strip()
    lead = len(word.text) - len(word.text.lstrip())
    place = Place(word.place.file, word.place.line, word.place.column + lead)
    known = reader.constants.replace
    text = replaced(parse(text, place), lambda name, at: known(Word(name, at)))
    return StepEnd(condition=parse(text, place).text, place=place)


def _time(
    reader: Reader, line: Line, options: dict[str, list[_Part]], keyword: str
) -> float | None:
    """Return the seconds after an option; None without it."""
    if keyword not in options:
        return None
    word = _single(line, options[keyword], f"{keyword} and a number of seconds")
    return _seconds(reader, word._replace(keyword=keyword))


def _single(line: Line, parts: Sequence[_Part], form: str) -> Word:
    if len(parts) != 1 or parts[0].condition:
        odd = next((one for one in parts if one.condition), parts[-1])
        raise _malformed(line, form, odd, _near(odd))
    return parts[0].word


def _seconds(reader: Reader, word: Word) -> float:
    wanted = f"seconds, more than 0, at most {LONGEST:g}"
    return words.real(reader, word, wanted, high=LONGEST, open_high=False)


def _header_time(reader: Reader, block: Block, keyword: str) -> float | None:
    line = block.get(keyword)
    if line is None:
        return None
    return _seconds(reader, words.single(line, "a time in seconds"))


def _goto(reader: Reader, line: Line) -> Goto:
    parts = _parts(line)
    if not parts or parts[0].condition:
        raise _malformed(line, _GOTO, parts[0] if parts else None, "name a step first")
    step, *rest = parts
    when = None
    if rest:
        if rest[0].shown != "IF":
            raise _malformed(
                line, _GOTO, rest[0], nearest(rest[0].word.text, ("IF",)) or "write IF"
            )
        when = _end(reader, line, rest[1:])
    return Goto(step=step.word.text, when=when, place=step.word.place)


def _repeat(reader: Reader, line: Line) -> Repeat:
    word = words.single(line, f"a number of turns, or {FOREVER}")
    if word.text == FOREVER:
        return Repeat(times=0, place=line.place)
    if not word.text[0].isdigit() and (hint := did_you_mean(word.text, [FOREVER])):
        raise fault(
            f"REPEAT has {quote(word.text)}",
            word.place,
            expected=f"a number of turns, or {FOREVER}",
            remedy=hint,
        )
    return Repeat(times=words.whole(reader, word, 1, MOST_TURNS), place=line.place)


def _end_repeat(_: Reader, line: Line) -> EndRepeat:
    if line.words:
        raise fault(
            "there is text after END",
            line.words[0].place,
            expected="END alone",
            got=quote(line.rest),
            remedy="remove it",
        )
    return EndRepeat(place=line.place)


def _finish(_: Reader, line: Line) -> Finish:
    return Finish(failed=line.keyword == "FAIL", text=line.rest, place=line.place)


def _order(reader: Reader, line: Line) -> Order:
    least, most, form = _ORDERS[line.keyword]
    given = line.words
    if not least <= len(given) <= most:
        raise fault(
            f"{line.keyword} is malformed",
            given[most].place if len(given) > most else line.place,
            expected=form,
            got=f"{len(given)} words" if given else "nothing",
            remedy=f"write {form}",
        )
    command: Literal["spawn", "kill", "set", "write"] = {  # type: ignore[assignment]
        "SPAWN": "spawn",
        "KILL": "kill",
        "SET": "set",
        "WRITE": "write",
    }[line.keyword]
    texts = [word.text for word in given]
    if command in {"set", "write"}:
        names = least - 1
        values = given[names:]
        texts = [*texts[:names], *(reader.constants.replace(one) for one in values)]
    if command == "write":
        _must_be_numbers(given[1:], texts[1:])
    return Order(command=command, words=tuple(texts), place=line.place)


def _must_be_numbers(given: Sequence[Word], texts: Sequence[str]) -> None:
    for word, text in zip(given, texts, strict=True):
        if not _NUMBER.fullmatch(text) or not isfinite(float(text)):
            raise fault(
                f"WRITE cannot write {quote(text)}",
                word.place,
                expected="a finite number for each element",
                remedy="write numbers as in 2.5, -3 or 1e-3",
            )


_LINES: Final[dict[str, Callable[[Reader, Line], SeqLine]]] = {
    "STEP": _step,
    "GOTO": _goto,
    "REPEAT": _repeat,
    "END": _end_repeat,
    "DONE": _finish,
    "FAIL": _finish,
    **dict.fromkeys(_ORDERS, _order),
}


# -- the whole -------------------------------------------------------------------------


def _check(record: SeqFile) -> None:
    """Refuse steps that are not there, and loops that do not fit.

    Raises:
        ConfigError: There is one.
    """
    if not record.steps:
        raise fault(
            "the sequence has no step",
            Place(record.file, 1),
            expected=f"at least one line {_STEP}",
            remedy="write a STEP line for each job",
        )
    _unique_labels(record)
    around = loops(record)
    above: SeqLine | None = None
    for at, line in enumerate(record.lines):
        target = line.step if isinstance(line, Goto) else ""
        target = line.otherwise if isinstance(line, Step) else target
        if target:
            _must_lead(record, line, target, around[at], around)
        if isinstance(line, Goto) and line.when is not None and line.when.signal:
            _must_have_ended(line, line.when, above)
        if isinstance(line, Step | Repeat):
            above = line


def _unique_labels(record: SeqFile) -> None:
    had: dict[str, Step] = {}
    for step in record.steps:
        first = had.setdefault(step.label, step) if step.label else step
        if first is not step:
            raise fault(
                f"the label {quote(step.label)} is given twice",
                step.place or Place(record.file, 1),
                expected="one step for each label",
                got=f"another one in line {first.place.line if first.place else 0}",
                remedy="choose another label",
            )


def loops(record: SeqFile) -> list[tuple[int, ...]]:
    """Return for each line the indices of the REPEAT lines around it, outermost first.

    Raises:
        ConfigError: A REPEAT has no END, or an END no REPEAT.
    """
    found: list[tuple[int, ...]] = []
    inside: tuple[int, ...] = ()
    for at, line in enumerate(record.lines):
        found.append(inside)
        if isinstance(line, Repeat):
            inside = (*inside, at)
        elif isinstance(line, EndRepeat):
            if not inside:
                raise _unpaired(record, line, "END", "REPEAT")
            inside = inside[:-1]
    if inside:
        raise _unpaired(record, record.lines[inside[-1]], "REPEAT", "END")
    return found


def _unpaired(record: SeqFile, line: SeqLine, word: str, other: str) -> ConfigError:
    return fault(
        f"{word} without {other}",
        line.place or Place(record.file, 1),
        expected="REPEAT before the lines that are repeated, END after them",
        got=f"no {other} for it",
        remedy=f"add {other}, or remove {word}",
    )


def _must_lead(
    record: SeqFile,
    line: SeqLine,
    target: str,
    here: tuple[int, ...],
    around: Sequence[tuple[int, ...]],
) -> None:
    """Refuse a GOTO or ELSE to no step, to one of several, or into a loop."""
    place = line.place or Place(record.file, 1)
    keyword = "GOTO" if isinstance(line, Goto) else "ELSE"
    names = [step.name for step in record.steps]
    if names.count(target) != 1:
        several = names.count(target) > 1
        raise fault(
            f"{keyword} names {quote(target)}, which "
            + ("several steps have as their job" if several else "is no step"),
            place,
            expected="the label of a step, or the job of a single one",
            got=f"{names.count(target)} steps of that name",
            remedy=f"give one of them a label: STEP again: {target}"
            if several
            else did_you_mean(target[:40], names)
            or f"add STEP {target} after a DONE line, or name another step",
        )
    inner = around[record.at(target)]
    if here[: len(inner)] != inner:
        raise fault(
            f"{keyword} leads into a loop from outside",
            place,
            expected=f"a step outside, or the loop entered by its REPEAT in line "
            f"{_line(record, inner[-1])}",
            got=f"the step {target}, which is repeated",
            remedy="go to a step before the REPEAT line",
        )


def _line(record: SeqFile, at: int) -> int:
    place = record.lines[at].place
    return place.line if place else 0


def _must_have_ended(line: Goto, when: StepEnd, above: SeqLine | None) -> None:
    """Refuse IF SIGNAL where the step above cannot have ended with it."""
    ends = above.until if isinstance(above, Step) else ()
    known = [str(one) for one in ends if one.signal]
    if str(when) not in known:
        raise fault(
            f"IF names {quote(str(when))}, with which no step above can have ended",
            when.place or line.place or Place("<text>", 1),
            expected=" or ".join(known) or "a STEP with UNTIL SIGNAL directly above",
            got=quote(str(when)),
            remedy=did_you_mean(str(when)[:40], known)
            or "write the signal after UNTIL of the step above, as one of its ends",
        )


# -- writing ---------------------------------------------------------------------------


def write_seq(record: SeqFile) -> str:
    """Return the text of a ``.seq`` file with the content of `record`.

    Raises:
        ConfigError: No file can say it.
    """
    lines = [
        text_line("SEQUENCE", record.name),
        text_line("DESC", record.desc),
        text_line("SBS", record.sbs),
    ]
    if record.safe is not None:
        lines.append(text_line("SAFE", step_text(record.safe)))
    if record.wait:
        lines.append(text_line("WAIT", number(record.wait)))
    if record.within is not None:
        lines.append(text_line("WITHIN", number(record.within)))
    lines += [text_line(*line_text(line)) for line in record.lines]
    return same_again(record, "".join([*lines, "EOF\n"]), parse_seq)


def line_text(line: SeqLine) -> tuple[str, str]:
    """Return the keyword of a line, and what follows it."""
    if isinstance(line, Step):
        return "STEP", step_text(line)
    if isinstance(line, Goto):
        return "GOTO", f"{line.step} IF {line.when}" if line.when else line.step
    if isinstance(line, Repeat):
        return "REPEAT", str(line.times) if line.times else FOREVER
    if isinstance(line, EndRepeat):
        return "END", ""
    if isinstance(line, Finish):
        return "FAIL" if line.failed else "DONE", line.text
    return line.command.upper(), " ".join(line.words)


def step_text(step: Step) -> str:
    """Return what follows the keyword of a step."""
    parts = [f"{step.label}:", step.job] if step.label else [step.job]
    if step.until:
        parts += ["UNTIL", " OR ".join(map(str, step.until))]
    if step.seconds is not None:
        parts += ["FOR", number(step.seconds)]
    if step.within is not None:
        parts += ["WITHIN", number(step.within)]
    if step.otherwise:
        parts += ["ELSE", step.otherwise]
    return " ".join(parts)
