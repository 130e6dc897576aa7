"""An RTPU's part of the request ``record``.

The RTPU process only keeps the request, so that it outlives an agent; the agent lets a
recorder carry it out.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import LogError
from pbonet.node.wire import rtpu_messages
from pbonet.xm.net import Recorded, run_folder

if TYPE_CHECKING:
    from pbonet.xm.net import Record

    from .rtpu_state import Rtpu

MODES = ("off", "outputs", "all")
LONGEST = 3600.0
"""Most seconds that are kept in memory."""
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+\-]{0,120}")


def begin(rtpu: Rtpu, request: Record) -> Recorded:
    """Keep what is to be recorded, and tell the agent.

    Raises:
        LogError: A name or a mode cannot be.
    """
    _check(request)
    if request.mode == "off" and not set(request.tasks.values()) - {"off"}:
        end(rtpu, request.subsystem)
        return Recorded(path="", machine=run_folder.machine())
    folder = Path(rtpu.config.runs, request.run)
    rtpu.recordings[request.subsystem] = rtpu_messages.Recording(
        domain=rtpu.config.domain,
        rtpu=rtpu.name,
        subsystem=request.subsystem,
        core=rtpu.config.core,
        folder=str(folder),
        file=request.file,
        run=request.run,
        job=request.job,
        mode=request.mode,
        tasks=request.tasks,
        hidden=request.hidden,
        files=request.files,
        last=request.last,
    )
    rtpu.publish_claims()
    path = str(folder / f"{request.file}.mcap")
    return Recorded(path=path, machine=run_folder.machine())


def keep_losses(rtpu: Rtpu, recorder: rtpu_messages.Recorder) -> None:
    """Keep what a recorder has lost for the recorder of the next agent.

    That of an earlier run may still say so when another run has begun.
    """
    recording = rtpu.recordings.get(recorder.subsystem)
    if recording is not None and recording.run == recorder.run:
        rtpu.recordings[recorder.subsystem] = msgspec.structs.replace(
            recording, lost=recorder.handed_on
        )


def end(rtpu: Rtpu, subsystem: str) -> None:
    """Let the recording of a subsystem be finished."""
    if rtpu.recordings.pop(subsystem, None) is not None:
        rtpu.publish_claims()


def _check(request: Record) -> None:
    for mode in (request.mode, *request.tasks.values()):
        if mode not in MODES:
            raise LogError(
                "this is not a recording mode",
                expected=" or ".join(MODES),
                got=mode[:40],
                remedy="correct it",
            )
    if not 0.0 <= request.last <= LONGEST:
        raise LogError(
            "this many seconds cannot be kept",
            expected=f"0 to {LONGEST:g}",
            got=f"{request.last:g}",
            remedy="record everything where more is wanted",
        )
    if request.mode == "off" and not request.tasks:
        return
    for name in (request.run, request.file):
        if not _NAME.fullmatch(name):
            raise LogError(
                "this is not a valid name for a run or a log",
                expected="at most 121 letters, digits, '_-+.', no '.' first",
                got=repr(name[:60]),
                remedy="choose another name",
            )
