"""Reasons why agents cannot be reached, as reported by agents that saw them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from pbonet.errors import PbonetError, UnreachableError, did_you_mean

from . import credentials, run_folder

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from .agents import AgentInfo, Lost

_TOGETHER: Final = 3.0
"""Seconds within which a neighbour and the agents behind it are lost."""
_DIGITS: Final = "0123456789"


def loss(by: AgentInfo, lost: Lost) -> str:
    """Return which agent no longer sees which other one, and since when."""
    text = f"{by.name} of {by.host} has not seen {lost.rtpu} of {lost.host} for "
    return text + f"{lost.ago:.0f} s" + (", to which it had a link" * lost.near)


def remedy(by: AgentInfo, lost: Lost) -> str:
    """Return what to do about it."""
    runs = f"whether {lost.rtpu} runs on {lost.host}"
    if by.host == lost.host:
        return f"see {runs}; 'pbonet agent --name {lost.rtpu}' starts it"
    return (
        f"check the network between {by.host} and {lost.host}, and {runs}; they link "
        "again by themselves"
    )


def grouped(losses: Sequence[Lost]) -> Iterator[tuple[Lost, list[Lost]]]:
    """Yield each independent loss, with the losses that it explains.

    Agents that were reached through a neighbour are lost together with it.
    """
    near = [one for one in losses if one.near]
    rest = [one for one in losses if not one.near]
    for one in near:
        behind = [two for two in rest if abs(two.ago - one.ago) < _TOGETHER]
        rest = [two for two in rest if two not in behind]
        yield one, behind
    for one in rest:
        yield one, []


def first(rtpu: str, infos: Iterable[AgentInfo]) -> tuple[AgentInfo, Lost] | None:
    """Return the best explanation why an agent cannot be reached, if any.

    Returns:
        The reporting agent, and the loss: of the agent itself, or of the neighbour
        through which it was reached.
    """
    found = [
        (info, one)
        for info in infos
        for one, behind in grouped(info.lost)
        if rtpu in {one.rtpu, *(two.rtpu for two in behind)}
    ]
    return min(
        found,
        key=lambda pair: (not pair[1].near, pair[1].rtpu != rtpu, -pair[1].ago),
        default=None,
    )


def unreachable(
    rtpu: str, domain: str, names: list[str], loss: tuple[str, str] = ("", "")
) -> UnreachableError:
    """Return the error for an RTPU that is not among `names`.

    Args:
        rtpu: Its name.
        domain: Its domain.
        names: RTPUs that can be reached.
        loss: Which agent no longer sees it, and the remedy, if known.
    """
    pid = run_folder.agent_processes(domain).get(rtpu, 0)
    if pid:
        return _cut_off(rtpu, pid)
    there = ", ".join(names) or "none"
    if loss[0]:
        return UnreachableError(
            "the agent cannot be reached",
            where=rtpu,
            got=f"{loss[0]}; RTPUs that can be reached: {there}",
            remedy=loss[1],
        )
    stem = rtpu.rstrip(_DIGITS)  # arm1 is not a misspelt arm0
    hint = did_you_mean(rtpu, [n for n in names if n.rstrip(_DIGITS) != stem])
    start = f"pbonet agent --name {rtpu}"
    if domain != "default":
        start += f" --domain {domain}"
    start = (not names and _bad_keys()) or f"start it with '{start}'"
    return UnreachableError(
        "no agent of this name can be reached",
        where=rtpu,
        got=f"RTPUs of the domain {domain} that can be reached: {there}",
        remedy=f"{hint} else {start}" if hint else start,
    )


def _bad_keys() -> str:
    """Return what is wrong with the client's keys; empty if nothing is."""
    try:
        if (folder := credentials.named()) is not None:
            credentials.prove(folder)
    except PbonetError as error:
        return f"your keys: {error}"
    return ""


def _cut_off(rtpu: str, pid: int) -> UnreachableError:
    """Return the error for an agent whose process runs here but does not answer."""
    stopped = run_folder.is_stopped(pid)
    return UnreachableError(
        "the agent cannot be reached, although its process runs",
        where=rtpu,
        got=f"process {pid}" + (", which is stopped" if stopped else ""),
        remedy=(
            f"'kill -CONT {pid}' resumes it; else "
            if stopped
            else "if it has just started, or the machine is busy, wait and try again; "
            "else "
        )
        + f"end it with 'kill -9 {pid}' and start it again",
    )
