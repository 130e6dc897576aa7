from . import fleet as fleet, live_table as live_table
