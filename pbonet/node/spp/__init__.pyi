from . import executive_process as executive_process
from .executive import Executive as Executive
