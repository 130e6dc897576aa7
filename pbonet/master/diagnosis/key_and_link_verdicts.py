"""Verdicts on keys and links, which `doctor` lists and `explain` has as causes."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from pbonet.xm.net import credentials

if TYPE_CHECKING:
    from pbonet.xm.net import messages as m

_QUIET: Final = 1.0
"""A link whose last record is older, in seconds, is reported."""


class Level(StrEnum):
    """How bad a finding is."""

    PASS = "PASS"  # noqa: S105 - no password
    WARN = "WARN"
    FAIL = "FAIL"


class Finding(Struct, frozen=True):
    """One check and its result."""

    level: Level
    what: str
    remedy: str = ""

    def __str__(self) -> str:
        """Return it as one line."""
        tail = f"; {self.remedy}" if self.remedy else ""
        return f"{self.level:4} {self.what}{tail}"


def link_verdict(link: m.TbufStatus, text: str) -> tuple[Level, str, str]:
    """Return the verdict on a link."""
    if not link.writer:
        return Level.WARN, text, f"start the writer of {link.name}, or its agent"
    if not link.reader:
        return Level.WARN, text, "start its reader, or the agent"
    if link.age is None or link.age > _QUIET:
        return (
            Level.WARN,
            text,
            "check that its writer is ON and its input is not stale",
        )
    return Level.PASS, text, ""


def keys_of(info: m.AgentInfo, left: float) -> Finding:
    """Judge how long the keys of an agent are good for."""
    return keys_term(
        f"{info.name}: its keys",
        left,
        "make others with `pbonet keys agent`, put them where the old ones are, "
        f"and `kill -HUP {info.pid}` on {info.host}; its tasks go on",
    )


def keys_term(whose: str, left: float, remedy: str) -> Finding:
    """Judge how long keys are good for."""
    if left <= 0:
        return Finding(Level.FAIL, f"{whose} have expired", remedy)
    text = f"{whose} are valid for {credentials.days(left)}"
    if left < credentials.SOON:
        return Finding(Level.WARN, text, remedy)
    return Finding(Level.PASS, text)
