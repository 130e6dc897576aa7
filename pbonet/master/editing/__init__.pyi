from .draft_files import Draft as Draft, DraftFiles as DraftFiles
from .fitting_ports import Fit as Fit
from .job_editor import JobEditor as JobEditor
from .job_verdict import JobVerdict as JobVerdict, judge_job as judge_job
from .saved_files import FileChange as FileChange, SavedFiles as SavedFiles
from .simulated_run import (
    DraftSimulation as DraftSimulation,
    SimulatedRun as SimulatedRun,
)
from .steps import EDITS as EDITS
from .undo_history import History as History
from .wiring_offers import Offer as Offer, Step as Step
