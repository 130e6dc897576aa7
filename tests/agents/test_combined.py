"""Combined tasks over real agents (Stewart 1994, section 3.8.1)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from c_modules import put_misbehaving
from virtual_job import simulate
from watching import wait_for

from pbonet.errors import ParameterError
from pbonet.master.subsystem.subsystem import Subsystem

EXAMPLE = Path(__file__).parents[2] / "examples" / "servoing"


@pytest.fixture
def arm(nodes):
    nodes.agent_processes("arm0", "arm1")
    with Subsystem(EXAMPLE / "combined.job", domain=nodes.domain) as found:
        yield found


def cycles(arm, task, more=20):
    goal = arm.status(task).cycle + more
    wait_for(lambda: arm.status(task).cycle >= goal, f"cycles of {task}")


def test_a_controller_in_one_task(arm):
    arm.start()
    cycles(arm, "servo")
    status = arm.status("servo")
    assert status.module == "forward_kin+damped_ls+reference_integrator"
    writers = {one.name: one.writer for one in arm.display()}
    assert writers["Q_REF"] == writers["SIGMA"] == "servo"
    assert not {writers[name] for name in ("X_MEZ", "J_MEZ", "Q^_CMD")} - {"", None}
    names = [one.name for one in arm.get("servo")]
    assert {"forward_kin.length", "damped_ls.gain", "qrint.lower"} <= set(names)
    assert arm.set("servo", "damped_ls.gain", 2.5)[0].value == 2.5
    with pytest.raises(ParameterError, match=r"damped_ls\.gain is out of bounds"):
        arm.set("servo", "damped_ls.gain", -1.0)
    cycles(arm, "servo")


def test_it_takes_over_from_its_parts_and_gives_back_while_the_arm_moves(arm):
    arm.start(EXAMPLE / "damped.job")
    arm.spawn("servo")
    cycles(arm, "qrint")
    parts = ["forward_kin", "damped_ls", "qrint"]
    arm.swap(parts, ["servo"])
    cycles(arm, "servo")
    (reference,) = arm.display(["Q_REF"])
    assert reference.writer == "servo"
    arm.swap(["servo"], parts)
    cycles(arm, "qrint")
    states = {one.task: one.state for one in arm.status_all()}
    assert states["servo"] == "OFF"
    assert all(states[part] == "ON" for part in parts)


def test_in_virtual_time_it_does_to_the_last_bit_what_its_parts_do():
    apart, combined = (
        simulate(EXAMPLE / f"{job}.job", 4.0) for job in ("damped", "combined")
    )
    for name in ("Q_REF", "Q_MEZ", "SIGMA", "T_GRAV"):
        one, other = apart.series(name)[-1], combined.series(name)[-1]
        assert len(one) > 90
        assert np.array_equal(one, other), name
    one, other = (
        [text.partition(": ")[2] for text in made.about["events"]]
        for made in (apart, combined)
    )
    assert one == other, "and says the same"


RMOD = (
    "MODULE {}\nDESC\n{}INCONST none\nOUTCONST none\nINVAR {}\nOUTVAR {}\n"
    "TASKTYPE periodic\nFREQ 200\n{}EOF\n"
)


def combined(first, second, local=""):
    """Return the text of two test modules as one task, the first one's Y inner."""
    head = RMOD.replace("MODULE", "COMBINE").format(
        "first second", "", "none", "Y0", local
    )
    parts = [
        f"PART {name}\n" + RMOD.format(module, f"SVARALIAS Y={out}\n", "none", "Y", "")
        for name, module, out in (("first", first, "Y1"), ("second", second, "Y0"))
    ]
    return head + "".join(parts)


def test_a_part_that_raises_is_named_and_the_rest_of_the_rtpu_goes_on(nodes):
    nodes.agent("arm0")
    master = nodes.master("arm0", "two")
    master.spawn("whole", "", text=combined("counts", "raises_in_cycle"))
    master.on("whole")
    event = master.wait_event("METHOD", "whole")
    assert event.text.startswith("whole.second.cycle: ")
    assert master.status("whole").state == "ERROR"
    assert "second" in master.status("whole").error


LONG = (
    "MODULE c_overruns\nDESC\nSVARALIAS Y={}\nINCONST none\nOUTCONST none\nINVAR none\n"
    "OUTVAR Y\nTASKTYPE periodic\nFREQ 50\nLOCAL\nANSWER 0\nEVERY 3\nEOF\n"
)


def test_each_part_in_c_sees_that_its_cycle_must_end(nodes):
    """The first part is long and then sees it; the second sees it when it begins."""
    put_misbehaving(nodes.library)
    nodes.agent("arm0")
    master = nodes.master("arm0", "two")
    text = (
        "COMBINE first second\nDESC\nINCONST none\nOUTCONST none\nINVAR none\n"
        "OUTVAR Y2\nTASKTYPE periodic\nFREQ 50\nMAXC 0.005\nEOF\n"
        f"PART first\n{LONG.format('Y1')}PART second\n{LONG.format('Y2')}"
    )
    master.spawn("whole", "", text=text)
    master.on("whole")
    wait_for(
        lambda: (
            len([w for w in master.events("WARNING", "whole") if "early" in w.text])
            == len(("first", "second"))
        ),
        "a warning of each part",
    )
