"""The verbs in their groups, each loaded when it is asked for.

A verb is the function ``command`` of the file of its name; a family of verbs has
several functions there, in ``COMMANDS``. A verb without a file is made of the command
table of the master.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Final, NamedTuple

from . import options
from .parser import UsageError, Verb, parameter, verb_of

if TYPE_CHECKING:
    from collections.abc import Iterable

GROUPS: Final = {
    "Write and check files (no agent needed)": (
        *("library", "new", "check", "graph", "simulate", "adopt"),
        *("allocate", "tune"),
    ),
    "Run a subsystem": ("run", "prompt", "start", "switch", "stop"),
    "Change its tasks": (
        *("spawn", "on", "off", "kill", "clear"),
        *("reinit", "reconfig", "swap"),
    ),
    "Watch and tune it": (
        *("status", "top", "profile", "freq", "get", "set", "display", "write"),
        *("events", "explain", "sigwait", "sigmask", "web", "view", "ros2"),
    ),
    "Express mail": ("sem", "queue", "mailbox", "file"),
    "Recordings": ("log", "replay"),
    "Machines and this program": (
        *("agent", "router", "fleet", "devices", "doctor", "keys", "completion"),
    ),
    "Install on machines over ssh": ("deploy", "upgrade", "backup", "restore"),
}
"""The verbs as the help shows them."""
NAMES: Final = tuple(name for names in GROUPS.values() for name in names)
_OWN: Final = {
    *("new", "check", "graph", "simulate", "adopt", "run", "prompt", "stop"),
    *("profile", "display", "library", "web", "view", "ros2", "log"),
    *("replay", "agent", "keys", "completion"),
}
"""Verbs with a file of their own."""
_FOLDERS: Final = {
    "deploy": ("deploy", "upgrade", "backup", "restore"),
    "operating": ("devices", "doctor", "events", "explain", "fleet", "router", "top"),
    "planning": ("allocate", "tune"),
    "xm": ("sem", "queue", "mailbox", "file"),
}
"""Folders with the files of verbs."""


class Family(NamedTuple):
    """Verbs under one name, such as ``pbonet log``."""

    name: str
    help: str
    verbs: dict[str, Verb]


_DEBUG: Final = parameter("debug", options.Debug, default=False)


def load(name: str) -> Verb | Family:
    """Return the verb, or family of verbs, of a name.

    Raises:
        UsageError: There is none of that name.
    """
    if name not in NAMES:
        raise _unknown(f"there is no verb {name}", name, NAMES, "see 'pbonet --help'")
    folder = next((f"{f}." for f, names in _FOLDERS.items() if name in names), "")
    if not folder and name not in _OWN:
        from . import table

        return _with_debug(table.verb(name))
    module = import_module(f"pbonet.cli.{folder}{name}")
    functions = getattr(module, "COMMANDS", None)
    if functions is None:
        return _with_debug(verb_of(module.command, name))
    made = [verb_of(one, f"{name} {one.__name__}") for one in functions]
    verbs = {one.name.split()[1]: _with_debug(one) for one in made}
    return Family(name, module.HELP, verbs)


def _with_debug(verb: Verb) -> Verb:
    own = any(one.name == "debug" for one in verb.parameters)
    return verb if own else verb._replace(shared=(_DEBUG,))


def find(words: list[str]) -> tuple[Verb | Family, list[str]]:
    """Return the verb that the first words name, and the other words.

    Raises:
        UsageError: There is no such verb.
    """
    found = load(words[0])
    if isinstance(found, Verb) or len(words) == 1 or words[1].startswith("-"):
        return found, words[1:]
    name = words[1]
    if name not in found.verbs:
        text = f"pbonet {words[0]} has no verb {name}"
        raise _unknown(text, name, found.verbs, f"it has {', '.join(found.verbs)}")
    return found.verbs[name], words[2:]


def summary(name: str) -> str:
    """Return what a verb does, in one line."""
    found = load(name)
    return found.summary if isinstance(found, Verb) else found.help


def _unknown(text: str, name: str, known: Iterable[str], rest: str) -> UsageError:
    from pbonet.errors import did_you_mean

    return UsageError(f"{text}; {did_you_mean(name, known) or rest}")
