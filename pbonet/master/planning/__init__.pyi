from . import allocation_text as allocation_text, apply_allocation as apply_allocation
from .allocate_job import Allocation as Allocation, allocate as allocate
