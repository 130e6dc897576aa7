from .table_carrier import TableCarrier as TableCarrier
from .takeover import Takeovers as Takeovers
