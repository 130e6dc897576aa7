from .assignment_costs import Chain as Chain, Cost as Cost, Flow as Flow
from .assignment_problem import (
    FOLLOWS as FOLLOWS,
    LATENCY as LATENCY,
    Item as Item,
    Problem as Problem,
    allowed as allowed,
    declared as declared,
    keeps_deadlines as keeps_deadlines,
    share as share,
)
from .best_assignment import (
    SECONDS as SECONDS,
    Assignment as Assignment,
    assign as assign,
)
from .infeasibility import FIXED as FIXED
from .rate_choice import (
    Fit as Fit,
    best_periods as best_periods,
    fitted as fitted,
    harmonic as harmonic,
    in_step_rates as in_step_rates,
    rounded_down as rounded_down,
)
