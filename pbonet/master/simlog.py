"""Puts a run in virtual time into a log, where a run in real time would be."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from pbonet.config.library import Library
from pbonet.errors import LogError
from pbonet.log import Attached
from pbonet.master.files import Files
from pbonet.master.logbook import Logbook
from pbonet.master.recording import Recording

if TYPE_CHECKING:
    from pbonet.master.oneshot import Place
    from pbonet.master.run import Outcome


def save(
    outcome: Outcome,
    path: str | Path,
    place: Place,
    *,
    record: str | None,
    runs: str | Path | None,
) -> None:
    """Write the log of a simulated run; that it cannot be is a fault of the run.

    Args:
        outcome: What the run came to; is told where the log is.
        path: The ``.job`` file.
        place: Where RMODs are found.
        record: ``off``, ``outputs``, ``all`` or ``last SECONDS``; None for what the job
            says.
        runs: Folder of the logs; None for PBONET_RUNS, else ``runs`` here.

    Raises:
        LogError: There is no such way to record.
        ConfigError: The job names what is neither one of its tasks nor a variable.
    """
    book = Logbook(record)
    files = Files(path, Library(place.libraries))
    job = files.read_job()
    book.of(job, files)
    recording = outcome.recording
    if not isinstance(recording, Recording):
        return
    tasks = [task for task in recording.tasks if book.mode_of(task) != "off"]
    if not tasks:
        return
    recording.about |= {"job": outcome.job, "subsystem": files.sbs.subsystem}
    folder = Path(runs or os.environ.get("PBONET_RUNS", "runs")).absolute()
    log = folder / book.named(outcome.job) / "run.mcap"
    texts = book.texts(files)
    attached = [Attached(name, text.encode()) for name, text in texts.items()]
    libraries = [str(Path(folder).absolute()) for folder in place.libraries]
    try:
        recording.save(log, attached, libraries, tasks=tasks, hidden=book.hidden)
    except LogError as error:
        outcome.faults.append(str(error))
        return
    outcome.log = str(log.parent)
