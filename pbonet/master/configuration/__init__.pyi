from . import (
    environment as environment,
    graph_svg as graph_svg,
    graph_text as graph_text,
)
from .adopt_times import Adopted as Adopted, adopt as adopt
from .check_files import (
    Findings as Findings,
    check_file as check_file,
    judged as judged,
    planned as planned,
    planned_tasks as planned_tasks,
    sequence_findings as sequence_findings,
)
from .clock import Clock as Clock, RealClock as RealClock
from .conditions import (
    Asked as Asked,
    must_be_answerable as must_be_answerable,
    must_hold as must_hold,
)
from .environment import Place as Place
from .failures import (
    all_stopped as all_stopped,
    already as already,
    failed_at_end as failed_at_end,
    forced as forced,
    must_be_stopped as must_be_stopped,
    next_steps as next_steps,
    stuck as stuck,
)
from .graph_of_log import recorded_graph as recorded_graph
from .recording_plan import RecordingPlan as RecordingPlan
from .saved_profiles import Saved as Saved, here as here, profile_of as profile_of
from .subsystem_files import (
    Files as Files,
    Producers as Producers,
    RmodSource as RmodSource,
)
from .subsystem_graph import (
    Graph as Graph,
    GraphFault as GraphFault,
    GraphParam as GraphParam,
    GraphPort as GraphPort,
    GraphRtpu as GraphRtpu,
    GraphTask as GraphTask,
    GraphVariable as GraphVariable,
    Link as Link,
    Wire as Wire,
    fault as fault,
    graph_of as graph_of,
    job_graph as job_graph,
    planned_graph as planned_graph,
    unread as unread,
    with_planned as with_planned,
)
from .task_model import Member as Member, TaskModel as TaskModel
