"""The PUMA example as it stands: two RTPUs on two machines, the master on a third.

The two machines have one host name, as robots of one image have.
No cable is pulled: links and requests outlive a machine that stands still.
"""

from __future__ import annotations

from pathlib import Path

import long_limits
import pytest
from watching import wait_for

from pbonet.errors import ClaimError, SeveralError
from pbonet.master import Subsystem

PUMA = Path(__file__).parents[2] / "examples" / "puma"
MASTER = """
import json, sys
from pbonet.master import Subsystem
told = json.loads(sys.argv[1])
sys.path.append(told["tests"])
import long_limits, pytest
long_limits.be_patient(pytest.MonkeyPatch())
arm = Subsystem(told["job"], domain=told["domain"], connect=told["way"]).open()
arm.start()
print("ready", flush=True)
sys.stdin.read()
"""
HOLD = """
MODULE    constant
DESC      a reference that stands
SVARALIAS Y=Q_REF
INCONST   NDOF
OUTCONST  none
INVAR     none
OUTVAR    Y
TASKTYPE  periodic
FREQ      50
LOCAL
VALUE     0.1
SLEW      0.5
EOF
"""
TASKS = {"puma_pidg", "grav_comp", "qrdiff", "jttrace"}


@pytest.fixture(scope="module", autouse=True)
def lease():
    with pytest.MonkeyPatch.context() as patch:
        long_limits.be_patient(patch)
        yield long_limits.LEASE_MS


@pytest.fixture(scope="module")
def clocks():
    return {"b": 7000.0}


@pytest.fixture(scope="module")
def hostnames():
    return {"a": "robot", "b": "robot"}


@pytest.fixture(scope="module")
def way(lab):
    """How masters on host c come in: by an agent that has no part in the subsystem."""
    lab.start("desk", "c", wait=False)
    for name, host in (("arm0", "a"), ("arm1", "b")):
        lab.start(name, host, connect=[lab.endpoint("c", host)], wait=False)
    lab.wait_all()
    return [f"unixsock-stream/{lab.run_dirs['c'] / lab.domain / 'desk.sock'}"]


@pytest.fixture(scope="module")
def arm(lab, way, tmp_path_factory):
    """The subsystem: a master has started it and was killed, and this one took over."""
    library = tmp_path_factory.mktemp("library")
    (library / "hold.rmod").write_text(HOLD)
    told = {
        "job": str(PUMA / "puma.job"),
        "tests": str(Path(long_limits.__file__).parent),
    }
    first = lab.program("c", MASTER, way=way, **told)
    first.kill()
    found = Subsystem(
        PUMA / "puma.job", domain=lab.domain, connect=way, libraries=[library]
    )
    wait_for(lambda: taken_over(found), "the end of the first master's claim")
    try:
        yield found
    finally:
        found.finish()
    lab.wait_no_orphans()


def taken_over(subsystem):
    """Open a subsystem, unless it still has a master."""
    try:
        return subsystem.open()
    except (ClaimError, SeveralError):
        return None


def test_a_master_that_is_killed_changes_nothing(arm):
    """Its tasks go on, and the next master finds them as they are."""
    assert {one.task for one in arm.status()} == TASKS
    assert {one.state for one in arm.status()} == {"ON"}
    before = arm.status("puma_pidg")
    wait_for(lambda: arm.status("puma_pidg").cycle > before.cycle + 50, "cycles")
    assert not any(rtpu.illegal for rtpu in arm.rtpu_status())
    assert arm.status("puma_pidg").tid == before.tid


def test_the_example_runs_on_two_machines(arm):
    """Constants, inputs and outputs cross the cable, in both directions."""

    def fresh():
        values = {one.name: one for one in arm.display()}
        assert values["Q_MEZ"].writer == "puma_pidg"
        assert values["Q_REF"].writer == "jttrace@robot"
        assert values["T_GRAV"].age >= 0  # by clocks that are hours apart
        crossed = values["Q_REF"], values["T_GRAV"]
        return all(not one.stale and one.age < 1.0 for one in crossed)

    wait_for(fresh, "news from the other machine")
    (reference,) = arm.display("Q_REF", writer="jttrace")
    assert reference.name == "Q_REF"


def test_parameters_and_rates_from_a_third_host(arm):
    arm.set("puma_pidg", "KD", [180, 220, 50, 10, 9, 11])
    assert arm.get("puma_pidg", "KD")[0].value == [180, 220, 50, 10, 9, 11]
    assert arm.freq("qrdiff", 200.0) == 200.0
    assert arm.status("qrdiff").ref_f == pytest.approx(200.0)
    first = arm.display("Q^_REF")[0].cycle
    wait_for(lambda: arm.display("Q^_REF")[0].cycle > first + 20, "its news")


def test_a_swap_and_a_list_from_a_third_host(arm):
    """The reference comes from host b, from host a, and from b again."""
    done = arm.swap("jttrace", "hold", rtpu="arm0")
    assert done.states == {"jttrace": "OFF", "hold": "ON"}
    assert arm.display("Q_REF")[0].writer == "hold"
    first = apart(arm)
    wait_for(lambda: apart(arm) < first - 0.05, "the reference to go there")
    states = arm.reconfig([("hold", "off"), ("jttrace", "on")])
    assert states == {"hold": "OFF", "jttrace": "ON"}
    assert arm.display("Q_REF")[0].writer == "jttrace@robot"
    wait_for(lambda: not any(rtpu.illegal for rtpu in arm.rtpu_status()), "no flag")
    assert {one.task for one in arm.status() if one.state == "ON"} == TASKS


def apart(arm):
    """Return how far the reference is from where `hold` goes."""
    return max(abs(value - 0.1) for value in arm.display("Q_REF")[0].values)
