from .arena import (
    STATIC_BYTES as STATIC_BYTES,
    VERSION as VERSION,
    Arena as Arena,
    Blueprint as Blueprint,
)
from .flag import CAUSES as CAUSES, CAUSES_EACH as CAUSES_EACH
from .local import LocalTable as LocalTable
from .process import (
    now_ns as now_ns,
    process_start as process_start,
    survive_cuts as survive_cuts,
)
