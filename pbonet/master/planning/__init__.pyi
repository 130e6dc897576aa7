from . import (
    allocation_text as allocation_text,
    apply_allocation as apply_allocation,
    apply_rates as apply_rates,
    tuning_text as tuning_text,
)
from .allocate_job import Allocation as Allocation, allocate as allocate
from .tune_job import (
    FACTORS as FACTORS,
    SECONDS as SECONDS,
    Tuning as Tuning,
    tune as tune,
)
