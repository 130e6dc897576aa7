"""Writes a sequence of jobs as a program in Python that does the same."""

from __future__ import annotations

import keyword
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pbonet.config import (
    EndRepeat,
    Finish,
    Goto,
    Order,
    Repeat,
    SeqFile,
    Step,
    line_text,
    loops,
    read_seq,
)
from pbonet.errors import ConfigError

from .write_new_files import write_files

if TYPE_CHECKING:
    from pbonet.config import SeqLine

_HEAD: Final = '''\
"""{title}

Made from {source} by 'pbonet new program'. Run it with

    python {name}          # in real time, with agents of its own where there are none
    python {name} --sim    # in virtual time
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet import Subsystem
from pbonet.errors import PbonetError

if TYPE_CHECKING:
    from collections.abc import Callable

HERE = {here}
WAIT = {wait}
"""Seconds that PRE and POST may take to become true when a step begins."""
'''
_ENTER: Final = '''\
def enter(cell: Subsystem, job: str, *, failed: bool) -> None:
    """Change to a job; after an error the present one is given up without its POST."""
    cell.switch(HERE / f"{job}.job", wait=WAIT, abandon=failed)
'''
_RUN: Final = '''\
def run(cell: Subsystem) -> None:
    """Go from step to step; an error leads to the step that stands for it in ELSE."""
    step: Callable | None = {first}
    failed = False
    while step is not None:
        print(f"{{cell.clock.now():10.2f}} s  {{step.__name__}}", flush=True)
        try:
            step, failed = step(cell, failed=failed), False
        except PbonetError as error:
            if step not in ELSE:
                raise
            print(f"{{step.__name__}}: {{error}}", flush=True)
            step, failed = ELSE[step], True
'''
_MAIN: Final = '''\
def main() -> None:
    """Run the sequence, and end its tasks."""
    words = argparse.ArgumentParser(description=(__doc__ or "").split("\\n\\n")[0])
    words.add_argument("--sim", action="store_true", help="in virtual time")
    sim = words.parse_args().sim
    try:
        with Subsystem(HERE / {sbs}, embed=not sim, virtual=sim) as cell:
            try:
                run(cell)
            except (PbonetError, KeyboardInterrupt) as error:
                print("the sequence is given up", flush=True)
                safe(cell)
                sys.exit(f"{name}: {{error or 'interrupted'}}")
    except PbonetError as error:
        sys.exit(f"{name}: {{error}}")


if __name__ == "__main__":
    main()
'''
_NUMBER: Final = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?")
_TAKEN: Final = {
    *("argparse", "sys", "Path", "TYPE_CHECKING", "Subsystem", "PbonetError"),
    *("Callable", "HERE", "WAIT", "ELSE", "TURNS", "enter", "run", "main", "safe"),
    *("begin", "cell", "failed", "ended", "annotations", "print", "float"),
}
"""Names that the program has itself."""


def new_program(path: Path, program: Path | None, *, force: bool = False) -> list[Path]:
    """Write the program of a ``.seq`` file.

    Args:
        path: The ``.seq`` file.
        program: The program; None: beside the file, with its name.
        force: Replace one that exists.

    Returns:
        The program's file.

    Raises:
        ConfigError: The file is missing or wrong, or the program exists already.
    """
    if path.suffix != ".seq":
        raise ConfigError(
            "a program is made from a sequence",
            where=str(path),
            expected="a .seq file",
            remedy="name one",
        )
    seq = read_seq(path)
    target = program or path.with_suffix(".py")
    return write_files({target: program_text(seq, target)}, force=force)


def program_text(seq: SeqFile, target: Path) -> str:
    """Return the text of the program of a sequence.

    Args:
        seq: The sequence.
        target: Where the program is to stand.
    """
    return _Program(seq).text(target)


class _Program:
    """The program of one sequence: a function for each step and each loop's begin."""

    def __init__(self, seq: SeqFile) -> None:
        self._seq = seq
        self._around = loops(seq)
        self._begins = self._blocks()

    def text(self, target: Path) -> str:
        """Return the program's text."""
        seq = self._seq
        folder = os.path.relpath(
            Path(seq.file).resolve().parent, target.resolve().parent
        )
        here = "Path(__file__).resolve().parent"
        if folder != ".":
            here += f" / {_quoted(folder)}"
        title = f"{seq.name}: {seq.desc}" if seq.desc else seq.name
        title = title.replace("\\", "\\\\").replace('"', "'")
        parts = [
            _HEAD.format(
                title=title if title.endswith((".", "!", "?")) else f"{title}.",
                source=Path(seq.file).name,
                name=target.name,
                here=here,
                wait=repr(seq.wait),
            )
        ]
        if any(isinstance(line, Repeat) for line in seq.lines):
            parts[0] += (
                'TURNS: dict[str, int] = {}\n"""How often each loop was run."""\n'
            )
        parts.append(_ENTER)
        parts += [self._function(at, name) for at, name in self._begins.items()]
        parts += [self._else(), _RUN.format(first=self._begins[0]), self._safe()]
        parts.append(
            _MAIN.format(
                sbs=_quoted(seq.sbs),
                name=seq.name,
            )
        )
        return "\n\n".join(parts)

    def _blocks(self) -> dict[int, str]:
        """Return the lines with which functions begin, and the functions' names."""
        found: dict[int, str] = {}
        taken = set(_TAKEN)
        for at, line in enumerate(self._seq.lines):
            if isinstance(line, Step):
                found[at] = _free(line.name, taken)
            elif at == 0:
                found[at] = "begin"
            elif isinstance(self._seq.lines[at - 1], Repeat):
                found[at] = _free(f"loop_{at}", taken)
        return found

    def _function(self, begin: int, name: str) -> str:
        """Return the function of a step, or of what is before the first one."""
        lines = self._seq.lines
        body: list[str] = []
        at = begin
        while True:
            body += self._statements(at, begin)
            at += 1
            over = isinstance(lines[at - 1], Finish) or _always_leaves(lines[at - 1])
            if over or at >= len(lines) or at in self._begins:
                break
        if not over:
            body.append(
                f"return {self._begins[at]}" if at < len(lines) else "return None"
            )
        first = lines[begin]
        doc = _shown(first) if isinstance(first, Step) else "Lines before the next step"
        doc = doc.replace("\\", "\\\\").replace('"', "'")
        head = (
            f"def {name}(cell: Subsystem, *, failed: bool) -> Callable | None:\n"
            f'    """{doc}."""\n'
        )
        return head + "".join(f"    {line}\n" for line in body)

    def _statements(self, at: int, begin: int) -> list[str]:
        """Return the statements of one line."""
        line = self._seq.lines[at]
        if isinstance(line, Step):
            return self._step(line, "failed", used=self._asks_end(begin))
        if isinstance(line, Order):
            return [_order(line)]
        if isinstance(line, Goto):
            return self._goto(line)
        return _finish(line) if isinstance(line, Finish) else self._loop(at, line)

    def _goto(self, line: Goto) -> list[str]:
        target = self._begins[self._seq.at(line.step)]
        if line.when is None:
            return [f"return {target}"]
        asked = f"ended == {_quoted(str(line.when))}"
        if line.when.condition:
            asked = f"cell.holds({_quoted(line.when.condition)})"
        return [f"if {asked}:", f"    return {target}"]

    def _loop(self, at: int, line: SeqLine) -> list[str]:
        """Return the statements of a REPEAT or END line."""
        if isinstance(line, Repeat):
            return [f"TURNS[{_quoted(self._begins[at + 1])}] = 0"]
        if not isinstance(line, EndRepeat):
            raise TypeError(line)
        start = self._around[at][-1]
        name = self._begins[start + 1]
        times = getattr(self._seq.lines[start], "times", 0)
        if not times:
            return [f"return {name}"]
        key = f"TURNS[{_quoted(name)}]"
        return [f"{key} += 1", f"if {key} < {times}:", f"    return {name}"]

    def _step(self, step: Step, failed: str, *, used: bool = False) -> list[str]:
        """Return the statements of a step.

        Args:
            step: The step.
            failed: What tells whether an error led to it.
            used: Whether a GOTO asks how it has ended.
        """
        found = [f"enter(cell, {_quoted(step.job)}, failed={failed})"]
        if not step.waits:
            return found
        ends = [_quoted(str(one)) for one in step.until]
        given = ends if len(ends) == 1 else [f"[{', '.join(ends)}]"] if ends else []
        if step.seconds is not None:
            given.append(f"seconds={step.seconds!r}")
        within = self._seq.within if step.within is None else step.within
        if within is not None and step.until and step.seconds is None:
            given.append(f"timeout={within!r}")
        call = f"cell.until({', '.join(given)})"
        return [*found, f"ended = {call}" if used else call]

    def _asks_end(self, begin: int) -> bool:
        """Return whether a line of a function asks how its step has ended."""
        for at in range(begin + 1, len(self._seq.lines)):
            line = self._seq.lines[at]
            if at in self._begins:
                return False
            if isinstance(line, Goto) and line.when is not None and line.when.signal:
                return True
        return False

    def _else(self) -> str:
        """Return the table of the steps that follow errors."""
        rows: list[str] = []
        above: Step | None = None
        for at, line in enumerate(self._seq.lines):
            above = line if isinstance(line, Step) else above
            if at in self._begins and above is not None and above.otherwise:
                target = self._begins[self._seq.at(above.otherwise)]
                rows.append(f"    {self._begins[at]}: {target},\n")
        table = "{\n" + "".join(rows) + "}" if rows else "{}"
        return (
            f"ELSE: dict[Callable, Callable] = {table}\n"
            '"""The step that follows an error in another one."""\n'
        )

    def _safe(self) -> str:
        step = self._seq.safe
        if step is None:
            doc = "Do nothing: the sequence has no SAFE job; all tasks are turned off"
            body = ["del cell"]
        else:
            doc, body = f"SAFE {_shown(step)[5:]}", self._step(step, "True")
        doc = doc.replace("\\", "\\\\").replace('"', "'")
        return f'def safe(cell: Subsystem) -> None:\n    """{doc}."""\n' + "".join(
            f"    {line}\n" for line in body
        )


def _always_leaves(line: SeqLine) -> bool:
    return isinstance(line, Goto) and line.when is None


def _finish(line: Finish) -> list[str]:
    if line.failed:
        return [f"sys.exit({_quoted(line.text or 'the sequence has failed')})"]
    told = [f"print({_quoted(line.text)}, flush=True)"] if line.text else []
    return [*told, "return None"]


def _order(line: Order) -> str:
    first, *rest = line.words
    if line.command == "spawn":
        return f"cell.spawn({', '.join(map(_quoted, line.words))}, keep=True)"
    if line.command == "kill":
        tasks = ", ".join(map(_quoted, line.words))
        return f"cell.kill([{tasks}])" if rest else f"cell.kill({tasks})"
    if line.command == "write":
        values = ", ".join(repr(float(one)) for one in rest)
        return f"cell.write({_quoted(first)}, [{values}])"
    given = [one if _NUMBER.fullmatch(one) else _quoted(one) for one in rest[1:]]
    value = given[0] if len(given) == 1 else f"[{', '.join(given)}]"
    return f"cell.set({_quoted(first)}, {_quoted(rest[0])}, {value})"


def _shown(line: SeqLine) -> str:
    return " ".join(filter(None, line_text(line)))


def _quoted(text: str) -> str:
    """Return a string as Python has it, in double quotes where that is simple."""
    plain = '"' not in text and "\\" not in text and text.isprintable()
    return f'"{text}"' if plain else repr(text)


def _free(name: str, taken: set[str]) -> str:
    """Return a name for a function that nothing else has."""
    name = re.sub(r"\W", "_", name)
    if keyword.iskeyword(name) or name in taken:
        name = next(
            other
            for number in range(2, len(taken) + 3)
            if (other := f"{name}_{number}") not in taken
        )
    taken.add(name)
    return name
