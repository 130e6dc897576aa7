"""Words of commands: signals, values, warnings."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TypeGuard

from pbonet.errors import StateError, did_you_mean
from pbonet.master.crew import SIGNALS

log = logging.getLogger("pbonet.master")


def log_warning(text: str) -> None:
    """Take a warning and log it."""
    log.warning("%s", text)


def check_signal(signal: str) -> None:
    """Refuse a word that is no signal.

    Raises:
        StateError: It is none.
    """
    if signal not in SIGNALS:
        raise StateError(
            f"there is no signal {signal}",
            expected="one of " + " ".join(SIGNALS),
            remedy=did_you_mean(signal, SIGNALS),
        )


def is_sequence(value: object) -> TypeGuard[Sequence[object]]:
    """Tell whether a value is a list or a tuple."""
    return isinstance(value, (list, tuple))


def sequence(value: object) -> Sequence[object]:
    """Return a list or tuple as it is, anything else as the only item of one."""
    return value if is_sequence(value) else [value]


def local_words(value: object) -> str:
    """Return a parameter's value as the words of a LOCAL line."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if is_sequence(value):
        return " ".join(map(local_words, value))
    return str(value)
