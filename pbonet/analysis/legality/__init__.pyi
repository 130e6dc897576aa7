from .condition_fit import Fit as Fit, fit as fit
from .conditions import (
    Outcome as Outcome,
    amounts as amounts,
    check_conditions as check_conditions,
    check_cost as check_cost,
    evaluate as evaluate,
    named as named,
)
from .demands import (
    Figure as Figure,
    Source as Source,
    effective as effective,
    least as least,
    worst as worst,
)
from .devices_on_rtpus import (
    Named as Named,
    named_things as named_things,
    only_home as only_home,
)
from .freshness import max_age as max_age, passes as passes
from .joins import CONNECTORS as CONNECTORS, intermediate as intermediate
from .order import (
    change_order as change_order,
    flow_order as flow_order,
    off_order as off_order,
    on_order as on_order,
    spawn_order as spawn_order,
    spawn_steps as spawn_steps,
    user_priorities as user_priorities,
)
from .records import (
    Code as Code,
    Configuration as Configuration,
    Problem as Problem,
    Severity as Severity,
    Task as Task,
)
from .reports import (
    Outlook as Outlook,
    RtpuReport as RtpuReport,
    ServerReport as ServerReport,
    TaskReport as TaskReport,
    report as report,
    report_data as report_data,
    report_head as report_head,
    report_text as report_text,
)
from .shapes import constant_sizes as constant_sizes
from .shared_cores import Sharing as Sharing, sharing as sharing
from .timing import (
    Load as Load,
    criticalities as criticalities,
    loads as loads,
)
from .traffic import bytes_per_second as bytes_per_second
from .units import (
    conversion as conversion,
    factor as factor,
    same_unit as same_unit,
)
from .verdict import (
    ENDING as ENDING,
    Change as Change,
    Verdict as Verdict,
    as_error as as_error,
    as_text as as_text,
    check as check,
    frequency as frequency,
    job as job,
    judge as judge,
    reconfig as reconfig,
    signal as signal,
    spawn as spawn,
)
from .virtual import (
    JobOutcome as JobOutcome,
    ModuleCode as ModuleCode,
    Times as Times,
    simulate_job as simulate_job,
)
from .wiring import producers as producers
