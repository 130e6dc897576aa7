"""A dispatcher in the test's own process, which ranks one task there.

It works under ``park``, so that no level of this process is touched.
"""

import pytest

from pbonet.node.rt import _rt


@pytest.fixture
def core(tmp_path, monkeypatch):
    """Return a core table with a dispatcher."""
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    core = _rt.CoreTable(1)
    dispatcher = _rt.Dispatcher(core, "park")
    dispatcher.start()
    yield core
    dispatcher.stop()
    core.close()


@pytest.fixture
def slot(core):
    """Return the slot of a task of 500 Hz."""
    i = core.alloc("r", "t")
    core.configure(i, period_ns=2_000_000, crit=5)
    slot = _rt.Slot(core, i)
    yield slot
    slot.disarm()
