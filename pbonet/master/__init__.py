"""The master: it controls and monitors a subsystem (Stewart 1994, chapter 4).

`Subsystem` is the autonomous interface of section 4.4.4; `new_job` writes the files of
one. The prompt, the verbs, scripts
and the network interface are made of one command table and act on it. This package
loads zenoh when `Subsystem` is first asked for, so that tools which only judge files
start quickly.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pbonet.master.console import Subsystem
    from pbonet.master.tools import new_job

__all__ = ["Subsystem", "new_job"]


def __getattr__(name: str) -> object:
    """Load `Subsystem` or `new_job` when it is asked for."""
    if name == "new_job":
        from pbonet.master.tools import new_job

        return new_job
    if name != "Subsystem":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pbonet.master.console import Subsystem

    return Subsystem
