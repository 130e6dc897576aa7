from ._bench import Bench as Bench
from ._clock import FakeClock as FakeClock
from ._replay import DivergedError as DivergedError, replay as replay, verify as verify
from ._rerun import rerun as rerun
from ._table import BenchTable as BenchTable, PortValues as PortValues
from ._trial import params_to_try as params_to_try
from ._verdict import (
    Changed as Changed,
    ChangedParam as ChangedParam,
    Divergence as Divergence,
    Replayed as Replayed,
    Verdict as Verdict,
)
