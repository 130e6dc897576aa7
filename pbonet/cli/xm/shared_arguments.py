"""Arguments that the verbs of express mail share, and tables of resources."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated as A

from pbonet.cli import options
from pbonet.cli.parser import Argument, Option, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from pbonet.master.tools import express_mail

Rtpus = A[list[str] | None, Argument("Which RTPUs; all if left out.", "RTPU")]
Wait = A[float, Option("How long it waits.", "SECONDS", least=0.0, most=1e8)]
LEAST, MOST = -(2**31), 2**31 - 1
"""Priorities have 32 bits."""
Priority = A[
    int,
    Option(
        "Its place among those that wait: higher ones are served first.",
        least=LEAST,
        most=MOST,
    ),
]


def settle(reach: options.Reach) -> None:
    """Have names of resources be those of the domain that is asked for."""
    from pbonet.master.tools import express_mail

    express_mail.settle_in(reach.domain, reach.connect)


def message(text: str | None, file: Path | None, digits: str | None) -> bytes:
    """Return the message that one of three arguments gives.

    Raises:
        UsageError: None of them does, or several do.
        ConfigFileError: The file cannot be read.
    """
    if sum(one is not None for one in (text, file, digits)) != 1:
        raise UsageError("give the message once: TEXT, --file or --hex")
    if text is not None:
        return text.encode()
    if digits is not None:
        try:
            return bytes.fromhex(digits)
        except ValueError:
            raise UsageError(
                f"--hex must be pairs of hexadecimal digits (got {digits!r})"
            ) from None
    from pbonet.master.tools import remote_files

    return remote_files.read_bytes(str(file))


def show_list(
    kind: str,
    rtpus: Sequence[str] | None,
    reach: options.Reach,
    head: Sequence[str],
    row: Callable[[express_mail.Listed], Sequence[object]],
    *,
    as_data: bool,
) -> None:
    """Print the resources of a kind.

    Args:
        kind: ``sem``, ``queue`` or ``mailbox``.
        rtpus: The RTPUs; all if none is named.
        reach: Where agents are found.
        head: Titles of the columns after the name.
        row: Returns these columns for a resource.
        as_data: Print JSON.
    """
    import msgspec

    from pbonet.master.console import render
    from pbonet.master.tools import express_mail

    settle(reach)
    found, warnings = express_mail.listed(kind, rtpus or ())
    rows = [
        (one.name, *(map(_cell, row(one)) if not one.error else [one.error]))
        for one in found
    ]
    width = len(head) + 1
    padded = [(*cells, *[""] * (width - len(cells))) for cells in rows]
    text = render.table(("name", *head), padded) if found else ""
    data = {"resources": msgspec.to_builtins(found)}
    options.show_warned(text, data, warnings, as_data=as_data)


def _cell(value: object) -> str:
    return "-" if value is None else str(value)
