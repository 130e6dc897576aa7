"""Put the plain table in the place of the native one, as a plugin: ``-p``."""

import sys

import plain_table

from pbonet import svar
from pbonet.svar import _svar

# These do nothing with a table, and have no other version.
plain_table.Watch, plain_table.short_slices = _svar.Watch, _svar.short_slices
sys.modules["pbonet.svar._svar"] = svar._svar = plain_table


def pytest_report_header():
    """Name the table that is tested."""
    from pbonet.svar import table

    return f"table: {table.Arena.__module__}"
