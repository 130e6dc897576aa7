"""Can every machine's memory bear the traffic of its tasks? (equations 6 and 7)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.analysis.schedule import transfers
from pbonet.config import element_type

from .records import Code, Configuration, Problem, Task

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence


def bytes_per_second(configuration: Configuration) -> dict[str, float]:
    """Return the bytes a second that each task that is ON moves (equation 6).

    The locking overhead of the equation is zero here, as the table has no lock. Tasks
    without a frequency count as nothing.
    """
    size = _sizes(configuration)
    return {
        task.name: transfers.rate(
            [size.get(name, 0) for name in (*task.inputs, *task.outputs)],
            1.0 / task.hz,
        )
        if task.hz
        else 0.0
        for task in configuration.running
    }


def _sizes(configuration: Configuration) -> dict[str, int]:
    """Return the bytes of each variable."""
    return {
        variable.name: variable.nelem * kind.size
        for variable in configuration.svar.variables
        if (kind := element_type(variable.type))
    }


def read_sizes(configuration: Configuration, tasks: Iterable[Task]) -> list[int]:
    """Return the bytes that each task copies in before a cycle."""
    size = _sizes(configuration)
    return [sum(size.get(name, 0) for name in task.inputs) for task in tasks]


def check_traffic(configuration: Configuration) -> Iterator[Problem]:
    """Yield a problem for each machine whose tasks move more than its memory can.

    That is equation 7 (Stewart 1994, section 5.5). RTPUs of which the machine is not
    known count as one.
    """
    machines: dict[str, list[Task]] = {}
    for task in configuration.running:
        machines.setdefault(configuration.machines.get(task.rtpu, ""), []).append(task)
    for tasks in machines.values():
        yield from _traffic_problems(configuration, tasks)


def _traffic_problems(
    configuration: Configuration, tasks: Sequence[Task]
) -> Iterator[Problem]:
    moved = bytes_per_second(configuration)
    total = transfers.bandwidth(moved[task.name] for task in tasks)
    speed = min(configuration.copies(task.rtpu) for task in tasks)
    if total <= speed:
        return
    most = max((task.name for task in tasks), key=lambda name: (moved[name], name))
    yield Problem(
        code=Code.BANDWIDTH,
        what="the tasks transfer more data than the table can carry",
        where=most,
        expected=f"at most {speed / 1e6:.6g} MB/s (equation 7)",
        got=f"{total / 1e6:.6g} MB/s, of which {most} {moved[most] / 1e6:.6g} MB/s",
        remedy=f"lower the frequency of {most}, or combine it with the tasks that "
        "use it",
        tasks=(most,),
    )
