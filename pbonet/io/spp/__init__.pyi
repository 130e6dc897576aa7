from pbonet.config import SppEntry as SppEntry

from . import batches as batches, channel as channel, processors as processors
from .client import Reading as Reading, Spp as Spp
from .executive_start import ExecutiveConfig as ExecutiveConfig, Started as Started
from .requirements import require as require
from .kernel_library import Library as Library, Variable as Variable
from .execution import Execution as Execution, Loaded as Loaded
