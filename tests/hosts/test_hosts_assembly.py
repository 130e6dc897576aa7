"""The PUMA example as it stands: two RTPUs on two machines, the master on a third."""

from __future__ import annotations

from pathlib import Path

import pytest
from watching import wait_for

from pbonet.master import Subsystem

PUMA = Path(__file__).parents[2] / "examples" / "puma"


@pytest.fixture(scope="module")
def clocks():
    return {"b": 7000.0}


@pytest.fixture
def arm(lab):
    """The subsystem, steered from host c, whose agent has no part in it."""
    lab.start("desk", "c", wait=False)
    for name, host in (("arm0", "a"), ("arm1", "b")):
        lab.start(name, host, connect=[lab.endpoint("c", host)], wait=False)
    lab.wait_all()
    socket = lab.run_dirs["c"] / lab.domain / "desk.sock"
    way = [f"unixsock-stream/{socket}"]
    with Subsystem(PUMA / "puma.job", domain=lab.domain, connect=way) as found:
        yield found


def test_the_example_runs_on_two_machines(arm):
    """Constants, inputs and outputs cross the cable, in both directions."""
    arm.start()
    wait_for(lambda: arm.status("puma_pidg").cycle > 50, "cycles of the arm", 20.0)
    assert {one.state for one in arm.status()} == {"ON"}
    values = {one.name: one for one in arm.display()}
    assert values["Q_MEZ"].writer == "puma_pidg"
    assert values["Q_REF"].writer == "jttrace@host-b"
    assert not values["Q_REF"].stale
    assert not values["T_GRAV"].stale
    assert 0 <= values["T_GRAV"].age < 1.0  # by clocks that are hours apart
    (reference,) = arm.display("Q_REF", writer="jttrace")
    assert reference.name == "Q_REF"
