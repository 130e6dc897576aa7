from .agent import (
    agent_settings as agent_settings,
    agent_text as agent_text,
    parse_agent as parse_agent,
    read_agent as read_agent,
    settings_text as settings_text,
)
from .any_file import read_any as read_any
from .bundle import Section as Section, bundled as bundled, combines as combines
from .class_rmod import own_rmod as own_rmod
from .combining import info_of as info_of
from .conditions import (
    MEANS as MEANS,
    Parsed as Parsed,
    cost_of as cost_of,
    parse as parse,
)
from .device import DRIVERS as DRIVERS, Entry as Entry
from .job import (
    LAST as LAST,
    MODES as MODES,
    last_seconds as last_seconds,
    parse_job as parse_job,
    read_job as read_job,
    write_job as write_job,
)
from .library import (
    Library as Library,
    absent as absent,
    forget_common as forget_common,
    load_common as load_common,
    no_module as no_module,
)
from .library_search import (
    Found as Found,
    Search as Search,
    described as described,
    producers as producers,
    search as search,
)
from .model import (
    AgentConfig as AgentConfig,
    Condition as Condition,
    EndRepeat as EndRepeat,
    Finish as Finish,
    Goto as Goto,
    JobFile as JobFile,
    JobTask as JobTask,
    Limit as Limit,
    LocalLine as LocalLine,
    Needs as Needs,
    Order as Order,
    Place as Place,
    Repeat as Repeat,
    Restart as Restart,
    Rmod as Rmod,
    RtpuEntry as RtpuEntry,
    SbsFile as SbsFile,
    Scheduler as Scheduler,
    SeqFile as SeqFile,
    SeqLine as SeqLine,
    Step as Step,
    StepEnd as StepEnd,
    SvarFile as SvarFile,
    TaskType as TaskType,
    Variable as Variable,
)
from .needs import (
    Missing as Missing,
    critical_action as critical_action,
    missing_methods as missing_methods,
    stale_action as stale_action,
)
from .reader import load as load
from .rewrite import (
    Rewritten as Rewritten,
    rewrite_job as rewrite_job,
    rewrite_rmod as rewrite_rmod,
    rewrite_seq as rewrite_seq,
    rewrite_svar as rewrite_svar,
)
from .rmod import (
    parse_rmod as parse_rmod,
    read_rmod as read_rmod,
    rmod_name as rmod_name,
    write_rmod as write_rmod,
)
from .sbs import (
    LONGEST_HANG as LONGEST_HANG,
    parse_sbs as parse_sbs,
    read_sbs as read_sbs,
    write_sbs as write_sbs,
)
from .seq import (
    line_text as line_text,
    loops as loops,
    parse_seq as parse_seq,
    read_seq as read_seq,
    write_seq as write_seq,
)
from .spp import SPP_DRIVERS as SPP_DRIVERS, SppEntry as SppEntry
from .svar import (
    parse_svar as parse_svar,
    read_svar as read_svar,
    write_svar as write_svar,
)
from .toml_text import toml_record as toml_record, toml_table as toml_table
from .types import (
    TYPES as TYPES,
    element_type as element_type,
    numpy_type as numpy_type,
)
from .words import MAX_LABEL as MAX_LABEL, MAX_NAME as MAX_NAME
from .write import meaning as meaning, number as number
