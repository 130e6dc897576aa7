from . import packets as packets
from .mirror_outbox import MARK as MARK
from .table_mirror import Mirror as Mirror
