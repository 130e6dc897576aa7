"""Options that many verbs have, declared once, and what they print alike."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated as A, NamedTuple

from pbonet.master.configuration import Place

from .parser import Argument, Compound, Option, parameter

File = A[
    Path, Argument("The subsystem's .sbs file, or a .job file that names it.", "FILE")
]
Json = A[bool, Option("Print data as JSON, errors too.")]
Debug = A[bool, Option("Add the stack to an error's message.")]
Domain = A[str, Option("The domain of the RTPUs.", "NAME", env="PBONET_DOMAIN")]
Connect = A[
    list[str] | None,
    Option(
        "An agent on another machine, such as tcp/10.0.0.2:7447.",
        "ENDPOINT",
        env="PBONET_CONNECT",
    ),
]
Keys = A[
    Path | None,
    Option("Your folder of certificates (pbonet keys).", "FOLDER", env="PBONET_KEYS"),
]
Library = A[
    list[Path] | None,
    Option(
        "A folder with modules and .rmod files of your own.",
        "FOLDER",
        env="PBONET_LIBRARY",
    ),
]
Host = A[
    str,
    Option(
        "The machine whose measured execution times count; this one if left out.",
        "NAME",
    ),
]
CoreShare = A[
    float | None,
    Option(
        "Share of a core that tasks may use; what it grants if left out.",
        "SHARE",
        least=0.01,
        most=1.0,
    ),
]
TakeOver = A[bool, Option("Take the subsystem over from a master that still runs.")]
Yes = A[bool, Option("Take over CRITICAL tasks that are ON without a question.")]


class Reach(NamedTuple):
    """Where agents are found."""

    domain: str
    connect: tuple[str, ...]


def _reach(*, domain: str, connect: list[str] | None, keys: Path | None) -> Reach:
    if keys is not None:
        os.environ["PBONET_KEYS"] = str(keys.absolute())
    return Reach(domain, tuple(connect or ()))


def _place(
    *,
    domain: str,
    connect: list[str] | None,
    keys: Path | None,
    library: list[Path] | None,
    take_over: bool = False,
    yes: bool = False,
) -> Place:
    reach = _reach(domain=domain, connect=connect, keys=keys)
    return Place(
        domain=reach.domain,
        connect=reach.connect,
        libraries=tuple(map(str, library or ())),
        take_over=take_over,
        confirm=_agree if yes else _ask,
    )


def _agree(_: str) -> bool:
    """Return that the user agrees, as said by --yes."""
    return True


def _ask(question: str) -> bool:
    """Return whether the user agrees, who is asked only at a terminal."""
    if not sys.stdin.isatty():
        return False
    sys.stderr.write(f"{question} [y/N] ")
    sys.stderr.flush()
    return sys.stdin.readline().strip().lower() in {"y", "yes"}


_REACH = (
    parameter("domain", Domain, "default"),
    parameter("connect", Connect),
    parameter("keys", Keys),
)
_PLACE = (*_REACH, parameter("library", Library))
TO_WATCH = Compound(_PLACE, _place)
TO_CHANGE = Compound(
    (
        *_PLACE,
        parameter("take_over", TakeOver, default=False),
        parameter("yes", Yes, default=False),
    ),
    _place,
)

Agents = A[Reach, Compound(_REACH, _reach)]
Watching = A[Place, TO_WATCH]
ChangeTransaction = A[Place, TO_CHANGE]


def show(text: str, data: object, *, as_data: bool) -> None:
    """Print data as JSON, or else a text."""
    if as_data:
        import msgspec

        text = msgspec.json.encode(data).decode()
    if text:
        print(text)


def warn(warnings: Iterable[object]) -> None:
    """Print warnings."""
    for warning in warnings:
        sys.stderr.write(f"WARNING> {warning}\n")


def show_warned(
    text: str,
    data: Mapping[str, object],
    warnings: Sequence[str],
    *,
    as_data: bool,
) -> None:
    """Print a text and its warnings, or data that has both."""
    warn(() if as_data else warnings)
    show(text, {**data, "warnings": warnings}, as_data=as_data)


def show_files(
    paths: Sequence[Path], warnings: Sequence[str] = (), *, as_data: bool
) -> None:
    """Print which files a verb has written, and what it warns of."""
    names = list(map(str, paths))
    show_warned("\n".join(names), {"files": names}, warnings, as_data=as_data)
