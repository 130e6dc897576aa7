"""Damage in logs: parts of files whose checksum does not fit, and what is missing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .clocks import Clock
    from .part import Part


class Lost(Struct, kw_only=True):
    """A part of a log that cannot be read, because its checksum does not fit."""

    path: str
    """The file."""
    what: str
    """``chunk`` (a group of messages), ``attachment``, ``description`` of the run,
    ``index`` (without which all messages are found), or ``region`` (of the file, in
    which there is no record)."""
    at: int
    """Its offset in the file."""
    size: int
    """Its size in bytes."""
    begin: float | None
    """When the first message that may be missing was recorded, in seconds of the run;
    None: not known."""
    end: float | None
    """When the last one was."""

    def __str__(self) -> str:
        """Return a sentence about it."""
        text = f"{self.path}: damaged {self.what}, {self.size} bytes at {self.at}"
        if self.what in {"attachment", "description"}:
            return text
        if self.what == "index":
            return f"{text}: all messages were found without it"
        begin = "the beginning" if self.begin is None else f"{self.begin:.3f} s"
        end = "the end" if self.end is None else f"{self.end:.3f} s"
        return f"{text}: what was recorded from {begin} to {end} of the run is missing"


def lost_in(parts: Sequence[Part], clocks: Sequence[Clock]) -> list[Lost]:
    """Return the damage in files, with times of the run by the first file's clock."""
    spans = [
        part.span_ns[0] + clock.shift(part.span_ns[0])
        for part, clock in zip(parts, clocks, strict=True)
        if part.span_ns is not None
    ]
    begin = min(spans, default=0)
    found: list[Lost] = []
    for part, clock in zip(parts, clocks, strict=True):
        for one in part.damage:
            since, until = (
                None if at is None else (at + clock.shift(at) - begin) * 1e-9
                for at in (one.begin_ns, one.end_ns)
            )
            lost = Lost(
                path=str(part.path),
                what=one.what,
                at=one.at,
                size=one.size,
                begin=since,
                end=until,
            )
            found.append(lost)
    return found
