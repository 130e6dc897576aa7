from .table_carrier import TableCarrier as TableCarrier
