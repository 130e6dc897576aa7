"""The ``.rmod`` file: a module configured for use (section 3.8)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from msgspec import structs

from pbonet.errors import did_you_mean
from pbonet.ports import Stale

from . import words
from .blocks import Block, Grammar, read_block
from .bundle import Section, bundled, split
from .lines import Line, Word, fault, quote
from .model import LocalLine, Needs, Place, Rmod, TaskType
from .reader import Reader, decode, load
from .timing import criticality, read_timing
from .write import number, same_again, text_line

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

GRAMMAR = Grammar(
    "MODULE|COMBINE DESC SVARALIAS* INCONST OUTCONST INVAR OUTVAR TASKTYPE "
    "[FREQ|PERIOD] "
    "[CRITICAL|CAPACITY|MINC|MAXC|EFFC|SOFTNESS|CRIT|HANDLER|STALE|SAFE|RTPU|NEEDS]",
    after=("LOCAL", "EOF"),
    either=(("MODULE", "COMBINE"), ("FREQ", "PERIOD")),
)
NUMBERS = (
    "FREQ",
    "CAPACITY",
    "MINC",
    "MAXC",
    "EFFC",
    "SOFTNESS",
    "CRIT",
    "HANDLER",
)
LISTS = ("INCONST", "OUTCONST", "INVAR", "OUTVAR")


def read_rmod(path: str | Path) -> Rmod:
    """Read the ``.rmod`` file at `path`; parts are beside it.

    Raises:
        ConfigFileError: It, or a part of a combination, cannot be read.
        ConfigError: It says something that cannot be.
    """
    folder = Path(path).parent

    def beside(name: str) -> Section:
        part = folder / f"{name}.rmod"
        return Section(load(part), str(part))

    return parse_rmod(bundled(load(path), beside), str(path))


def parse_rmod(text: str | bytes, file: str) -> Rmod:
    """Parse the text of a ``.rmod`` file.

    Args:
        text: The text; that of a combination holds its parts (`bundled`).
        file: Its name, for messages; its last part without ``.rmod`` is the
            RMOD's name.

    Raises:
        ConfigError: It says something that cannot be.
    """
    main, parts = split(decode(text, file) if isinstance(text, bytes) else text)
    record = _parse(main, file, parts)
    # that which a class makes has no lines in a file
    return structs.replace(record, places={}) if file.endswith(".py") else record


def _parse(
    text: str, file: str, sections: Mapping[str, Section], above: tuple[str, ...] = ()
) -> Rmod:
    """Return one RMOD; `above` are the combinations that it is a part of."""
    reader = Reader(
        text,
        file,
        (*GRAMMAR.keywords, "LOCAL"),
        stray="correct it; parameters of the module are below the line LOCAL",
    )
    name = _name(file)
    block = read_block(reader, GRAMMAR)
    ports = {keyword: _ports(block[keyword]) for keyword in LISTS}
    aliases = _aliases(block, ports)
    tasktype = words.choice(
        words.single(block["TASKTYPE"], "one task type"), TaskType, "a task type"
    )
    times = read_timing(reader, block, tasktype)
    stale, settle = _stale(reader, block)
    local, places = _local(reader)
    reader.finish()
    module, parts = _code(block, sections, (*above, name))
    return Rmod(
        name=name,
        file=file,
        module=module,
        parts=parts,
        desc=block["DESC"].rest,
        aliases=aliases,
        inconst=_texts(ports["INCONST"]),
        outconst=_texts(ports["OUTCONST"]),
        invar=_texts(ports["INVAR"]),
        outvar=_texts(ports["OUTVAR"]),
        tasktype=tasktype,
        critical=_critical(block),
        crit=criticality(reader, block, "CRIT"),
        handler=criticality(reader, block, "HANDLER"),
        stale=stale,
        settle=settle,
        safe_at=_safe_at(block),
        rtpu=_rtpu(block),
        needs=_needs(block),
        local=local,
        places={**block.places, **places},
        **times._asdict(),
    )


def _code(
    block: Block, sections: Mapping[str, Section], above: tuple[str, ...]
) -> tuple[str, tuple[Rmod, ...]]:
    """Return the module, or those of the parts, and the parts."""
    line, other = block.get("COMBINE"), block.get("MODULE")
    if line is None:
        return words.module(words.single(block["MODULE"], "the module's name")), ()
    if other is not None:
        raise fault(
            "both MODULE and COMBINE are given",
            max(line.place, other.place),
            expected="one of them",
            got=f"the other in line {min(line.place, other.place).line}",
            remedy="remove one of them",
        )
    names = [words.label(word, "an RMOD") for word in line.words]
    if len(names) < 2:  # noqa: PLR2004 - a word for it would say no more
        raise fault(
            "COMBINE needs at least two RMODs",
            line.place,
            expected="their names, in the order in which they run",
            got=quote(line.rest) if line.rest else "nothing",
            remedy="name them, or spawn the one by itself",
        )
    parts: list[Rmod] = []
    for word in line.words:
        if word.text in above or names.count(word.text) > 1:
            raise fault(
                f"COMBINE names {quote(word.text)} "
                + ("within itself" if word.text in above else "twice"),
                word.place,
                expected="each RMOD once, and not the one that is combined",
                remedy="remove it, or copy the .rmod file under another name",
            )
        if word.text not in sections:
            raise fault(
                f"the part {quote(word.text)} is not here",
                word.place,
                expected=f"a line PART {word.text} below EOF, and its .rmod file",
                remedy="read the combination from its file, beside those of its parts",
            )
        section = sections[word.text]
        part = _parse(section.text, section.file, sections, above)
        parts.append(structs.replace(part, name=word.text))
    return "+".join(part.module for part in parts), tuple(parts)


def rmod_name(file: str) -> str:
    """Return the RMOD's name that belongs to a file name.

    That of a module stands for the RMOD that its class makes.
    """
    return Path(file).name.removesuffix(".rmod").removesuffix(".py")


def _name(file: str) -> str:
    return words.label(Word(rmod_name(file), Place(file, 1)), "an RMOD (its file name)")


def _texts(ports: Iterable[Word]) -> tuple[str, ...]:
    return tuple(port.text for port in ports)


def _ports(line: Line) -> tuple[Word, ...]:
    """Return the ports a list names; ``none`` for an empty one."""
    found = line.words
    if not found:
        raise fault(
            f"{line.keyword} is empty",
            line.place,
            expected="names of ports, or none",
            got="nothing",
            remedy=f"write {line.keyword} none",
        )
    if [word.text for word in found] == ["none"]:
        return ()
    seen: set[str] = set()
    for word in found:
        if word.text == "none":
            raise fault(
                f"{line.keyword} has both none and names",
                word.place,
                expected="names of ports, or none alone",
                got=f"{len(found)} words",
                remedy="remove none",
            )
        if words.variable(word, "a port") in seen:
            raise fault(
                f"{line.keyword} names {quote(word.text)} twice",
                word.place,
                expected="each port once",
                remedy="remove one of them",
            )
        seen.add(word.text)
    return tuple(found)


class _Alias(NamedTuple):
    port: Word
    variable: str


def _aliases(block: Block, ports: dict[str, tuple[Word, ...]]) -> dict[str, str]:
    """Return the variable of each port."""
    listed = {word.text for found in ports.values() for word in found}
    aliases: dict[str, _Alias] = {}
    for line in block.all("SVARALIAS"):
        alias = _alias(line)
        port = alias.port.text
        if first := aliases.get(port):
            raise fault(
                f"the port {quote(port)} has two aliases",
                alias.port.place,
                expected="one SVARALIAS line for each port",
                got=f"another one in line {first.port.place.line}",
                remedy="remove one of them",
            )
        if port not in listed:
            raise fault(
                f"SVARALIAS for the unknown port {quote(port)}",
                alias.port.place,
                expected=f"a port of {', '.join(LISTS[:3])} or {LISTS[3]}",
                got=quote(port),
                remedy=did_you_mean(port, sorted(listed))
                or "remove the line, or write PORT=VARIABLE with the module's own name "
                "first",
            )
        aliases[port] = alias
    names = {port: alias.variable for port, alias in aliases.items()}
    for direction in (("INCONST", "INVAR"), ("OUTCONST", "OUTVAR")):
        _refuse_collision(direction, ports, names)
    return names


def _alias(line: Line) -> _Alias:
    """Return the port and the variable of ``SVARALIAS PORT=VARIABLE``."""
    text = "".join(word.text for word in line.words)
    if text.count("=") != 1:
        raise fault(
            "SVARALIAS is malformed",
            line.place,
            expected="PORT=VARIABLE",
            got=quote(line.rest),
            remedy="write one on each line: the module's name of the port, =, and the "
            "variable",
        )
    joined = Word(text, Place(line.place.file, line.place.line, line.rest_column))
    port, variable = text.split("=")
    at = joined.place.column + line.rest.index("=") + 1
    behind = Place(joined.place.file, joined.place.line, at)
    return _Alias(
        Word(words.variable(Word(port, joined.place), "a port"), joined.place),
        words.variable(Word(variable, behind)),
    )


def _refuse_collision(
    direction: tuple[str, ...],
    ports: dict[str, tuple[Word, ...]],
    aliases: dict[str, str],
) -> None:
    """Refuse two ports of one direction that stand for the same variable."""
    user: dict[str, Word] = {}
    for word in (word for keyword in direction for word in ports[keyword]):
        variable = aliases.get(word.text, word.text)
        if first := user.get(variable):
            raise fault(
                f"the ports {quote(first.text)} and {quote(word.text)} are both "
                f"connected to the variable {quote(variable)}",
                word.place,
                expected=f"one port of {' and '.join(direction)} for each variable",
                remedy="give one of them another variable by SVARALIAS",
            )
        user[variable] = word


def _critical(block: Block) -> bool:
    """Return whether the task is marked; CRITICAL alone means yes."""
    line = block.get("CRITICAL")
    return line is not None and (not line.words or words.yes(line))


def _stale(reader: Reader, block: Block) -> tuple[str | None, float | None]:
    """Return the action while an input is too old, and for how long it lasts on."""
    line = block.get("STALE")
    if line is None:
        return None, None
    if not 1 <= len(line.words) <= 2:  # noqa: PLR2004 - as the message says
        raise fault(
            "STALE needs an action, and may have seconds",
            line.place,
            expected=f"{' or '.join(Stale)}, and how long all inputs must have been "
            "fresh before the task goes on",
            got=quote(line.rest) if line.rest else "nothing",
            remedy="write such as: STALE hold, or STALE stable 0.2",
        )
    action = words.choice(line.words[0], Stale, "an action").value
    if len(line.words) == 1:
        return action, None
    return action, words.real(
        reader, line.words[1], "seconds, 0 or more", open_low=False
    )


def _safe_at(block: Block) -> tuple[str, ...]:
    """Return the timing failures at which the out-vars get their safe values."""
    line = block.get("SAFE")
    if line is None:
        return ()
    from pbonet.pbo import TimingFailure  # brings numpy

    found = [
        words.choice(word, TimingFailure, "a timing failure").value
        for word in line.words
    ]
    if not found or len(set(found)) < len(found):
        raise fault(
            "SAFE needs the kinds of timing failure, each once",
            line.place,
            expected=" or ".join(TimingFailure),
            got=quote(line.rest) if line.rest else "nothing",
            remedy="write such as: SAFE deadline, or SAFE deadline maxexec",
        )
    return tuple(found)


def _rtpu(block: Block) -> str | None:
    line = block.get("RTPU")
    return words.label(words.single(line, "an RTPU"), "an RTPU") if line else None


def _needs(block: Block) -> Needs | None:
    """Return what a special purpose processor must have: ``NEEDS spp WHAT``."""
    line = block.get("NEEDS")
    if line is None:
        return None
    if len(line.words) != 2 or line.words[0].text != "spp":  # noqa: PLR2004
        raise fault(
            "NEEDS is malformed",
            line.place,
            expected=f"spp, and {' or '.join(Needs)}",
            got=quote(line.rest) if line.rest else "nothing",
            remedy="write NEEDS spp cuda",
        )
    return words.choice(line.words[1], Needs, "a device or back end")


def _local(reader: Reader) -> tuple[dict[str, LocalLine], dict[str, Place]]:
    """Return the lines of the LOCAL part, which ends at EOF, and where it begins."""
    head = reader.peek()
    if head.keyword != "LOCAL":
        return {}, {}
    reader.take()
    if head.words:
        raise fault(
            "there is text after LOCAL on its line",
            head.words[0].place,
            expected="LOCAL alone, and below it one parameter a line",
            got=quote(head.rest),
            remedy="move them to a line of their own",
        )
    local: dict[str, LocalLine] = {}
    while (line := reader.peek()).keyword != "EOF":
        reader.take()
        if first := local.get(line.keyword):
            where = f"another one in line {first.place.line}" if first.place else ""
            raise fault(
                f"the LOCAL parameter {quote(line.keyword)} is given twice",
                line.place,
                expected="one line for each parameter",
                got=where,
                remedy="remove one of them",
            )
        values = tuple(reader.constants.replace(word) for word in line.words)
        local[line.keyword] = LocalLine(values, line.place)
    return local, {"LOCAL": head.place}


def write_rmod(record: Rmod) -> str:
    """Return the text of a ``.rmod`` file with the content of `record`.

    Raises:
        ConfigError: No file can say it, such as a DESC of two lines.
    """
    return same_again(record, rmod_text(record), parse_rmod)


def rmod_text(record: Rmod) -> str:
    """Return the text of an RMOD, with those of its parts below it; see `write`."""
    names = " ".join(part.name for part in record.parts)
    first = ("COMBINE", names) if names else ("MODULE", record.module)
    lines = [text_line(*first), text_line("DESC", record.desc)]
    lines += [text_line("SVARALIAS", f"{p}={v}") for p, v in record.aliases.items()]
    for keyword in LISTS:
        ports: tuple[str, ...] = getattr(record, keyword.lower())
        lines.append(text_line(keyword, " ".join(ports) or "none"))
    lines.append(text_line("TASKTYPE", record.tasktype.value))
    for keyword in NUMBERS:
        value: float | int | None = getattr(record, keyword.lower())
        if value is not None:
            lines.append(text_line(keyword, number(value)))
    if record.critical:
        lines.append(text_line("CRITICAL", "yes"))
    if record.stale is not None:
        after = "" if record.settle is None else f" {number(record.settle)}"
        lines.append(text_line("STALE", record.stale + after))
    if record.safe_at:
        lines.append(text_line("SAFE", " ".join(record.safe_at)))
    if record.rtpu is not None:
        lines.append(text_line("RTPU", record.rtpu))
    if record.needs is not None:
        lines.append(text_line("NEEDS", f"spp {record.needs}"))
    if record.local:
        lines.append("\nLOCAL\n")
        lines += [text_line(key, " ".join(v.words)) for key, v in record.local.items()]
    below = {part.name: Section(rmod_text(part), part.file) for part in record.parts}
    return bundled("".join([*lines, "EOF\n"]), below.__getitem__)
