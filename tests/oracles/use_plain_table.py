"""Put the plain table in the place of the native one, as a plugin: ``-p``."""

import sys

import plain_table

from pbonet import svar
from pbonet.svar import _svar

plain_table.Watch = _svar.Watch  # only sleeps, and has no other version
sys.modules["pbonet.svar._svar"] = svar._svar = plain_table


def pytest_report_header():
    """Name the table that is tested."""
    from pbonet.svar import table

    return f"table: {table.Arena.__module__}"
