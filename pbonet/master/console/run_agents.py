"""The agents of a run, which start while the rest of `run` is loaded."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbonet.config import Library
from pbonet.master.configuration import Files
from pbonet.master.subsystem import Embedded
from pbonet.xm.net import open_files

if TYPE_CHECKING:
    from pathlib import Path

    from pbonet.master.configuration import Place


def launch_agents(
    path: str | Path, place: Place, *, runs: str | Path | None = None
) -> Embedded:
    """Start an agent for each RTPU of a run that has none, and do not wait for it.

    Args:
        path: The ``.job`` or ``.seq`` file.
        place: Domain, endpoints, libraries.
        runs: Folder of the logs of these agents; None for theirs.

    Returns:
        The agents; leaving their context ends them, as the end of this process does.

    Raises:
        ConfigError: A file is missing or wrong; nothing was started.
        UnreachableError: An endpoint that was named is not reached; nothing was
            started.
        NodeError: This process may open too few files; nothing was started.
        OSError: The system cannot create a process.
    """
    files = Files(path, Library(place.libraries))
    files.recorded_job()  # nothing is started for a job that cannot be read
    open_files.ensure("run")
    agents = Embedded(
        place.domain,
        libraries=[*map(str, files.library.folders)],
        connect=place.connect,
        runs=runs,
    )
    agents.launch(agents.missing([entry.name for entry in files.sbs.rtpus]))
    return agents
