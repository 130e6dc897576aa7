from . import export as export, orders as orders, text as text
from .code import code_of as code_of
from .cycle_columns import HEAD_DTYPE as HEAD_DTYPE, head as head
from .cycles import COLUMNS as COLUMNS, Cycles as Cycles
from .damage import Lost as Lost
from .events import LOG_SCHEMA as LOG_SCHEMA, log_message as log_message
from .fields import field_name as field_name, variable_name as variable_name
from .groups import pack as pack, size as size, unpack as unpack
from .part import Part as Part
from .reader import (
    Log as Log,
    Message as Message,
    TaskLife as TaskLife,
    files_of as files_of,
    last_run as last_run,
)
from .records import (
    Attached as Attached,
    CodeFile as CodeFile,
    Did as Did,
    RunAbout as RunAbout,
    Step as Step,
    Table as Table,
    TaskAbout as TaskAbout,
    log_name as log_name,
)
from .rewrite import merge as merge, recover as recover
from .rows import Rows as Rows
from .scan import is_complete as is_complete
from .schema import (
    CDR as CDR,
    COMMITS as COMMITS,
    HELD as HELD,
    RECORD as RECORD,
    SAFE as SAFE,
    STABLE as STABLE,
    StepSchema as StepSchema,
)
from .series import Series as Series
from .states import Stretch as Stretch, not_on as not_on, timelines as timelines
from .writer import LogWriter as LogWriter
