from . import live_table as live_table
