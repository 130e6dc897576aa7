"""The native table, or its twin in plain Python when `PBONET_PURE=1` asks for it.

A failed import of the native part is an error and not a reason to use the twin, which
has neither its speed nor its memory ordering.
"""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING

from ._svar import Watch  # only sleeps, and has no twin

if TYPE_CHECKING or os.environ.get("PBONET_PURE") != "1":
    from ._svar import (
        CAUSES,
        CAUSES_EACH,
        STATIC_BYTES,
        VERSION,
        Arena,
        Blueprint,
        LocalTable,
        now_ns,
        process_start,
        survive_cuts,
    )
else:
    from pbonet.svar.pure import (
        CAUSES,
        CAUSES_EACH,
        STATIC_BYTES,
        VERSION,
        Arena,
        Blueprint,
        LocalTable,
        now_ns,
        process_start,
        survive_cuts,
    )

    warnings.warn(
        "PBONET_PURE=1: the state variable table is a test oracle in plain Python, "
        "slow and without a lock; use it for tests only",
        RuntimeWarning,
        stacklevel=2,
    )

__all__ = [
    "CAUSES",
    "CAUSES_EACH",
    "STATIC_BYTES",
    "VERSION",
    "Arena",
    "Blueprint",
    "LocalTable",
    "Watch",
    "now_ns",
    "process_start",
    "survive_cuts",
]
