from .executive import Executive as Executive
from .executive_supervisor import Executives as Executives
