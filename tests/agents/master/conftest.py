"""The PUMA subsystem on two real RTPUs."""

import pytest

from pbonet.master.subsystem.subsystem import Subsystem


@pytest.fixture
def two(nodes):
    """Two real RTPUs on one core, as processes of their own."""
    nodes.agent_processes("arm0", "arm1")
    return nodes


@pytest.fixture
def arm(two, puma):
    """The PUMA subsystem, open; warnings are in ``arm.heard``."""
    subsystem = Subsystem(puma, domain=two.domain, libraries=[two.library])
    subsystem.heard = []
    subsystem.warned = subsystem.heard.append
    subsystem.open()
    yield subsystem
    if subsystem._task_set is not None:
        subsystem.finish()
