"""The ``.sbs`` file: how a subsystem's hardware is set up (sections 4.3, 4.5.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.errors import did_you_mean

from . import words
from .blocks import Block, Grammar, read_block
from .lines import fault, quote
from .model import ErrPrint, RtpuEntry, SbsFile, Scheduler, Usage
from .reader import Reader, load
from .write import number, same_again, text_line

if TYPE_CHECKING:
    from pathlib import Path

HEAD = Grammar("SUBSYSTEM SVARFILE [MASTER|STRICT|ALONE]", after=("RTPU",))
RTPU = Grammar(
    "RTPU [SCHEDULER|USAGE|ERRPRINT|MINFREQ|MAXFREQ|HANGTIME]", after=("RTPU", "EOF")
)
LONGEST_HANG = 3600.0
"""Seconds; the largest HANGTIME."""
NEVER = "never"
"""Stands for no limit, as the word of ALONE."""
SHORTEST_ALONE, LONGEST_ALONE = 0.5, 3600.0
"""Seconds; an agent is out of sight after 0.4 s, so less cannot be noticed."""


def read_sbs(path: str | Path) -> SbsFile:
    """Read the ``.sbs`` file at `path`.

    Raises:
        ConfigFileError: It cannot be read.
        ConfigError: It says something that cannot be.
    """
    return parse_sbs(load(path), str(path))


def parse_sbs(text: str | bytes, file: str = "<text>") -> SbsFile:
    """Parse the text of a ``.sbs`` file; `file` is its name in messages.

    Raises:
        ConfigError: It says something that cannot be.
    """
    reader = Reader(text, file, (*HEAD.keywords, *RTPU.keywords))
    head = read_block(reader, HEAD)
    rtpus: dict[str, RtpuEntry] = {}
    while reader.peek().keyword != "EOF":
        entry = _rtpu(reader, rtpus)
        rtpus[entry.name] = entry
    reader.finish()
    return SbsFile(
        file=file,
        subsystem=words.label(words.single(head["SUBSYSTEM"], "a name"), "a subsystem"),
        svarfile=words.path(head["SVARFILE"], "the name of a .svar file"),
        master=_master(head, rtpus),
        strict=(line := head.get("STRICT")) is not None and words.yes(line),
        alone=_alone(reader, head),
        rtpus=tuple(rtpus.values()),
    )


def _master(head: Block, rtpus: dict[str, RtpuEntry]) -> str | None:
    line = head.get("MASTER")
    if line is None:
        return None
    word = words.single(line, "the name of an RTPU")
    if word.text not in rtpus:
        raise fault(
            f"MASTER names {quote(word.text)}, which no RTPU line does",
            word.place,
            expected=" or ".join(rtpus),
            got=quote(word.text),
            remedy=did_you_mean(word.text[:40], rtpus)
            or "add an RTPU line for it, or name a listed one",
        )
    return word.text


def _alone(reader: Reader, head: Block) -> float:
    line = head.get("ALONE")
    if line is None:
        return 2.0
    word = words.single(line, "a time in seconds")
    if word.text == NEVER:
        return 0.0
    wanted = f"{SHORTEST_ALONE:g} to {LONGEST_ALONE:g} s, or {NEVER}"
    return words.real(
        reader,
        word,
        wanted,
        low=SHORTEST_ALONE,
        high=LONGEST_ALONE,
        open_low=False,
        open_high=False,
    )


def _rtpu(reader: Reader, former: dict[str, RtpuEntry]) -> RtpuEntry:
    """Read the block of an RTPU, which begins at the reader's next line."""
    block = read_block(reader, RTPU)
    name = words.single(block["RTPU"], "the name of an RTPU")
    words.label(name, "an RTPU")
    if first := former.get(name.text):
        above = first.place.line if first.place else 0
        raise fault(
            f"the RTPU {quote(name.text)} is named twice",
            name.place,
            expected="one RTPU line for each RTPU",
            got=f"another one in line {above}",
            remedy="remove one of them",
        )
    entry = RtpuEntry(
        name=name.text,
        scheduler=_option(block, "SCHEDULER", Scheduler.MUF, "a scheduler"),
        usage=_option(block, "USAGE", Usage.EXCLUSIVE, "a usage"),
        errprint=_option(block, "ERRPRINT", ErrPrint.WARNINGS, "a kind of messages"),
        minfreq=_hertz(reader, block, "MINFREQ", 1.0),
        maxfreq=_hertz(reader, block, "MAXFREQ", 1000.0),
        hangtime=_hangtime(reader, block),
        place=name.place,
    )
    if entry.minfreq >= entry.maxfreq:
        line = block.get("MAXFREQ") or block["MINFREQ"]
        told = {"MINFREQ", "MAXFREQ"} & block.lines.keys()
        assumed = {"MINFREQ", "MAXFREQ"} - told
        raise fault(
            "MINFREQ is not below MAXFREQ",
            line.place,
            expected=f"MINFREQ below MAXFREQ = {entry.maxfreq:g} Hz",
            got=f"MINFREQ = {entry.minfreq:g} Hz",
            remedy=f"add a {assumed.pop()} line; the default applies here"
            if assumed
            else "exchange the values or correct one",
        )
    return entry


def _option(
    block: Block, keyword: str, default: words.Choice, what: str
) -> words.Choice:
    line = block.get(keyword)
    if line is None:
        return default
    return words.choice(words.single(line, what), type(default), what)


def _hertz(reader: Reader, block: Block, keyword: str, default: float) -> float:
    line = block.get(keyword)
    if line is None:
        return default
    return words.real(reader, words.single(line, "a frequency in Hz"), "Hz above 0")


def _hangtime(reader: Reader, block: Block) -> float:
    line = block.get("HANGTIME")
    if line is None:
        return 0.1
    word = words.single(line, "a CPU time in seconds")
    wanted = f"a CPU time above 0, up to {LONGEST_HANG:g} s"
    return words.real(reader, word, wanted, high=LONGEST_HANG, open_high=False)


def write_sbs(record: SbsFile) -> str:
    """Return the text of a ``.sbs`` file with the content of `record`.

    Raises:
        ConfigError: No file can say it.
    """
    lines = [
        text_line("SUBSYSTEM", record.subsystem),
        text_line("SVARFILE", record.svarfile),
    ]
    if record.master is not None:
        lines.append(text_line("MASTER", record.master))
    if record.strict:
        lines.append(text_line("STRICT", "yes"))
    lines.append(text_line("ALONE", number(record.alone) if record.alone else NEVER))
    for rtpu in record.rtpus:
        lines += [
            "\n",
            text_line("RTPU", rtpu.name),
            text_line("SCHEDULER", rtpu.scheduler.value),
            text_line("USAGE", rtpu.usage.value),
            text_line("ERRPRINT", rtpu.errprint.value),
            text_line("MINFREQ", number(rtpu.minfreq)),
            text_line("MAXFREQ", number(rtpu.maxfreq)),
            text_line("HANGTIME", number(rtpu.hangtime)),
        ]
    return same_again(record, "".join([*lines, "EOF\n"]), parse_sbs)
