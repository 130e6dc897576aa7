from . import fleet as fleet, live_table as live_table
from .otel_logs import OtelLogs as OtelLogs
