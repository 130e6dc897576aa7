"""The clock of this machine, and the disk on which runs are recorded."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from pbonet.xm.net import messages as m


def machine_info(runs: str) -> m.MachineInfo:
    """Return the time of day, and the space in a folder that may not exist yet.

    Args:
        runs: The folder.
    """
    folder = Path(runs)
    for place in (folder, *folder.parents):
        try:
            usage = shutil.disk_usage(place)
        except OSError:
            continue
        return m.MachineInfo(
            wall=time.time(), runs=runs, disk_free=usage.free, disk_size=usage.total
        )
    return m.MachineInfo(wall=time.time(), runs=runs)
