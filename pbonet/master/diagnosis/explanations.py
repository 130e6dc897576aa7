"""From facts to a chain of causes. Pure: it asks nothing and changes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from . import (
    explain_flag,
    explain_miss,
    explain_rtpu,
    explain_start,
    explain_task,
    explain_variable,
)
from .cause_chain import Explanation
from .follow_causes import Chain
from .healthy_state import healthy

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from .facts import Facts
    from .follow_causes import Told
    from .question import Question


_PARTS: Final[Mapping[str, Callable[[Chain, str], Told]]] = {
    "task": explain_task.task,
    "variable": explain_variable.variable,
    "rtpu": explain_rtpu.rtpu,
    "miss": explain_miss.missed,
}


def explain(facts: Facts, asked: Question) -> Explanation:
    """Return why something is as it is.

    Args:
        facts: What is known.
        asked: The question.

    Raises:
        StateError: The subsystem has nothing of that name.
    """
    asked = asked.resolved(facts)
    chain = Chain(facts, _PARTS)
    name = asked.name
    match asked.kind:
        case "flag":
            what, causes = explain_flag.flag(chain)
        case "start":
            what, causes = explain_start.start(chain, name)
        case "miss":
            what, causes = explain_miss.missed(chain, name, asked.cycle)
        case _:
            what, causes = chain.explained(asked.kind, name)
    well = () if causes else healthy(facts, asked)
    return Explanation(
        kind=asked.kind,
        name=name,
        what=what,
        causes=tuple(causes),
        healthy=well,
        unknown=tuple(facts.unknown),
    )
