from pbonet.config import SppEntry as SppEntry

from . import (
    batches as batches,
    channel as channel,
    executive_start as executive_start,
    processors as processors,
)
from .client import Reading as Reading, Spp as Spp
from .execution import Execution as Execution, Loaded as Loaded
from .executive_start import ExecutiveConfig as ExecutiveConfig, Started as Started
from .kernel_library import Library as Library, Variable as Variable
from .requirements import require as require
