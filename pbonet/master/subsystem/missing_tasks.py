"""Tasks of a job that are on no RTPU, and why."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from msgspec import Struct

from pbonet.errors import PbonetError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pbonet.config import JobTask
    from pbonet.master.configuration import Files
    from pbonet.xm.net import RtpuStatus


class Missing(Struct, frozen=True):
    """A task that the job names, and that no RTPU has reported."""

    task: str
    rtpu: str
    """The RTPU to which the files assign it."""
    reason: str


def find_missing(
    files: Files,
    rtpus: Iterable[RtpuStatus],
    silent: Mapping[str, PbonetError] | None = None,
) -> list[Missing]:
    """Return the tasks of the job, and their standbys, that are on no RTPU.

    Args:
        files: The subsystem's files; without a job no task is missing.
        rtpus: The status of all tasks of the RTPUs that answered.
        silent: The errors of the other RTPUs.
    """
    if files.job is None:
        return []
    answered = {status.rtpu: status for status in rtpus}
    there = {task.task for status in answered.values() for task in status.tasks}
    named = {
        name: _home(files, one, name)
        for one in files.job.tasks
        for name in (one.rmod, one.fallback)
        if name and name not in there
    }
    errors = silent or {}
    return [
        Missing(name, rtpu, _reason(rtpu, answered.get(rtpu), errors.get(rtpu)))
        for name, rtpu in named.items()
    ]


def _home(files: Files, one: JobTask, name: str) -> str:
    """Return the RTPU of a TASK line's task, or of its standby."""
    own = None
    if name != one.rmod:
        with contextlib.suppress(PbonetError):
            own = files.rtpu_of(name)
    return own or files.likely_rtpu(one.rmod)


def _reason(rtpu: str, status: RtpuStatus | None, error: PbonetError | None) -> str:
    if status is None:
        why = f": {error.what}" if error is not None else ""
        return f"not known, because RTPU {rtpu} does not answer{why}"
    if not status.scheduler:  # a claim ends with the subsystem
        reason = "no master uses the RTPU"
        since = f", whose process was started {_ago(status.age)} ago"
    else:
        reason = "it was not spawned, or was killed"
        since = f", since the RTPU process was started, {_ago(status.age)} ago"
    return reason + since if status.age else reason


def _ago(seconds: float) -> str:
    """Return a duration in its largest unit."""
    for size, unit in ((86400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
