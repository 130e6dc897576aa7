from . import guards as guards, layout as layout, table_files as table_files
from ._svar import (
    Watch as Watch,
    now_ns as now_ns,
    short_slices as short_slices,
    survive_cuts as survive_cuts,
)
from .freshness import Action as Action, Freshness as Freshness
from .guards import (
    Blamed as Blamed,
    Check as Check,
    blame as blame,
    limits_of as limits_of,
)
from .layout import (
    group_of as group_of,
    padded as padded,
    values_of as values_of,
    var_bytes as var_bytes,
)
from .local import LocalTable as LocalTable
from .result_codes import (
    ALIVE as ALIVE,
    CONSTS as CONSTS,
    FULL as FULL,
    IN as IN,
    ON as ON,
    OUT_CONSTS as OUT_CONSTS,
    PASSED_ON as PASSED_ON,
    RIVAL as RIVAL,
    VARS as VARS,
    Flags as Flags,
    Verdict as Verdict,
)
from .table import SPARE as SPARE, Table as Table
from .table_records import (
    Cause as Cause,
    Counts as Counts,
    Register as Register,
    VarInfo as VarInfo,
)
