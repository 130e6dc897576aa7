"""Constants that change under real tasks: a tool is replaced while the arm is held.

tool --MASS--> weigh --WEIGHT--> hold --F-->
   \\------------LENGTH-----------/
"""

from __future__ import annotations

import pytest
import tool_constants
from watching import wait_for

from pbonet.errors import MethodError, PbonetError, ReconfigError, VerificationError
from pbonet.master.subsystem.subsystem import Subsystem

SIZED = """
    from typing import Annotated as A
    from pbonet import {kind}, OutVar, Params, PortBasedObject, Vector, param

    class Size(Params):
        size: A[int, param("none", "size", ge=0)] = 2

    class {name}(PortBasedObject[Size]):
        '''Something with a size.'''

        size: A[int, {kind}("SIZE", "1", "none", "elements")]
        {port}

        def init(self) -> None:
            {init}

        def cycle(self, dt: float) -> None:
            pass
"""


@pytest.fixture
def files(nodes, tmp_path):
    """The folder of the subsystem, its modules in the library of the agent."""
    folder = tmp_path / "tools"
    tool_constants.write(folder, nodes.library)
    return folder


@pytest.fixture
def arm(nodes, files):
    nodes.agent_process("arm0")
    subsystem = Subsystem(
        files / "tools.sbs",
        domain=nodes.domain,
        libraries=[nodes.library],
        record="off",
    )
    subsystem.heard = []
    subsystem.warned = subsystem.heard.append
    subsystem.open()
    yield subsystem
    if subsystem._task_set is not None:
        subsystem.finish()


def wait_torque(arm, wanted):
    """Wait until the running task holds with `wanted`."""
    wait_for(lambda: arm.display(["F"])[0].values == [wanted], f"F = {wanted}")


def renewed(arm):
    return [text for text in arm.heard if "re-initialized" in text]


def reinits(arm, task="hold"):
    """Return how often a task said that it was re-initialized while it was ON."""
    return [e.text for e in arm.events() if e.task == task and "reinit " in e.text]


@pytest.fixture
def held(arm):
    """The grip is held: 20 N at 0.5 m."""
    arm.start("grip")
    wait_torque(arm, 10.0)
    assert renewed(arm) == [], "the job spawns in the order of the constants"
    return arm


def test_a_tool_is_changed_while_its_users_run(held):
    before = held.status("hold")
    held.control("grip", "kill")
    wait_torque(held, 10.0)  # the values of the constants stand
    held.spawn("drill")
    wait_torque(held, 30.0)
    assert renewed(held) == ["drill gives MASS and LENGTH: re-initialized weigh, hold"]
    after = held.status("hold")
    assert (after.tid, after.state) == (before.tid, "ON"), "it never stopped"
    assert after.cycle > before.cycle
    assert len(reinits(held)) == 1, "once, behind weigh, with everything new"


def test_a_value_that_changes_goes_as_far_as_it_is_used(held):
    held.set("grip", "length", 2.0)
    held.control("grip", "reinit")
    wait_torque(held, 40.0)
    assert renewed(held) == ["reinit of grip: re-initialized hold"]
    held.control("grip", "reinit")
    assert len(renewed(held)) == 1, "nothing had changed"
    held.set("grip", "mass", 4.0)
    held.control("grip", "reinit")
    wait_torque(held, 80.0)
    assert renewed(held)[1] == "reinit of grip: re-initialized weigh, hold"


def test_a_list_renews_nobody_twice(held):
    held.set("grip", "mass", 4.0)
    held.reconfig([("grip", "reinit"), ("weigh", "reinit"), ("hold", "reinit")])
    wait_torque(held, 20.0)
    assert renewed(held) == []
    assert len(reinits(held)) == 1
    held.set("grip", "mass", 6.0)
    held.reconfig([("weigh", "reinit"), ("hold", "reinit"), ("grip", "reinit")])
    wait_torque(held, 30.0)
    assert renewed(held) == ["reinit of weigh and grip: re-initialized weigh, hold"]


def test_a_list_that_gets_stuck_has_renewed_what_it_changed(held):
    held.set("grip", "mass", 4.0)
    with pytest.raises(ReconfigError, match="item 2 of 2, clear hold"):
        held.reconfig([("grip", "reinit"), ("hold", "clear")])
    wait_torque(held, 20.0)
    assert renewed(held) == ["reinit of grip: re-initialized weigh, hold"]


def test_a_constant_that_is_set_by_hand_is_taken_in(held):
    held.write("BIAS", [7.0])
    wait_torque(held, 17.0)
    held.write("BIAS", [7.0])
    assert renewed(held) == ["BIAS was set: re-initialized hold"]


def test_who_cannot_take_a_value_is_named_and_the_others_have_it(held):
    held.control("grip", "kill")
    with pytest.raises(PbonetError) as caught:
        held.spawn("anvil")
    assert "weigh" in str(caught.value)
    assert "too heavy" in str(caught.value)
    assert "anvil gives MASS and LENGTH all the same" in str(caught.value)
    assert "this task has the old MASS" in str(caught.value)
    states = {status.task: status.state for status in held.status_all()}
    assert states == {"anvil": "OFF", "weigh": "ERROR", "hold": "ON"}
    wait_torque(held, 20.0)  # the old weight at the new length, 1 m
    held.control("anvil", "kill")
    held.spawn("drill")
    wait_torque(held, 30.0)
    assert held.control("weigh", "clear").state == "OFF"


def test_a_second_producer_of_another_value_is_refused_at_once(held):
    with pytest.raises(MethodError, match="gives the constant MASS another value"):
        held.spawn("drill")
    assert "drill" not in held.model
    wait_torque(held, 10.0)


def test_producers_of_equal_constants_take_each_others_place(held, files):
    (files / "twin.rmod").write_text((files / "grip.rmod").read_text())
    held.spawn("twin")  # the same mass and length
    held.control("grip", "kill")
    assert held.control("twin", "reinit").state == "OFF"
    wait_torque(held, 10.0)


def test_switch_changes_the_tool_while_its_users_run(held):
    before = held.status("hold")
    plan = held.switch("drill", dry_run=True)
    assert plan.replaces == {"drill": ["grip"]}
    wait_torque(held, 10.0)
    held.switch("drill")
    wait_torque(held, 30.0)
    assert renewed(held) == ["drill gives MASS and LENGTH: re-initialized weigh, hold"]
    after = held.status("hold")
    assert (after.tid, after.state) == (before.tid, "ON"), "it never stopped"
    assert {one.task for one in held.status_all()} == {"drill", "weigh", "hold"}


def test_tools_are_swapped_there_and_back(held):
    held.swap("grip", "drill")
    wait_torque(held, 30.0)
    assert held.swap("drill", "grip").replaces == {"grip": ["drill"]}
    wait_torque(held, 10.0)
    states = {status.task: status.state for status in held.status_all()}
    assert (states["grip"], states["drill"]) == ("ON", "OFF")
    with pytest.raises(PbonetError, match="drill gives the constant MASS another"):
        held.control("drill", "reinit")  # it leaves nobody's place
    wait_torque(held, 10.0)


def test_a_tool_that_somebody_cannot_take_is_put_back(held):
    with pytest.raises(PbonetError, match="too heavy"):
        held.switch("anvil")
    states = {status.task: status.state for status in held.status_all()}
    assert states == {"grip": "ON", "weigh": "ERROR", "hold": "ON"}
    wait_torque(held, 10.0)
    assert [held.display([name])[0].values for name in ("MASS", "LENGTH")] == [
        [2.0],
        [0.5],
    ]
    assert held.display(["MASS"])[0].writer == "grip"


def test_a_second_producer_that_is_not_verified_is_refused_by_its_value(nodes, files):
    nodes.agent("arm0")
    master = nodes.master("arm0", "tools", table=False)
    master.open_table(tool_constants.SVAR)
    text = (files / "grip.rmod").read_text()
    master.spawn("one", "", text=text)
    other = text.replace("MASS 2", "MASS 2.5")
    error = master.refused(MethodError, master.spawn, "two", "", text=other)
    assert "two gives the constant MASS another value than its owner" in str(error)
    assert "kill one first" in str(error)
    assert set(master.status()) == {"one"}
    assert master.value("MASS").values == [2.0]
    master.spawn("same", "", text=text)  # two grips of one kind are no conflict


def test_constants_in_a_circle_are_refused_and_drawn(arm, nodes, files):
    circle = tool_constants.WEIGH.replace("MASS", "WEIGHT", 1).replace(
        'OutConst("WEIGHT"', 'OutConst("MASS"'
    )
    nodes.write_module(
        "back", circle.replace("self.mass", "1.0").replace("class Weigh", "class Back")
    )
    tool_constants.rmod(files, "back", "back", INCONST="WEIGHT", OUTCONST="MASS")
    job = (files / "grip.job").read_text()
    (files / "grip.job").write_text(job.replace("TASK grip", "TASK back"))
    with pytest.raises(VerificationError) as caught:
        arm.start("grip")
    assert "wait for each other's constants" in str(caught.value)
    assert "weigh --WEIGHT--> back --MASS--> weigh" in str(caught.value)
    assert len(arm.model.names) == 0


def test_a_size_cannot_change_under_a_task(arm, nodes, files):
    give = SIZED.format(
        kind="OutConst", name="Give", port="", init="self.size = self.params.size"
    )
    port = 'p: A[Vector, OutVar("P", "size", "none", "values")]'
    use = SIZED.format(kind="InConst", name="Use", port=port, init="pass")
    nodes.write_module("give", give)
    nodes.write_module("use", use)
    tool_constants.rmod(files, "two", "give", OUTCONST="SIZE")
    tool_constants.rmod(files, "three", "give", OUTCONST="SIZE", local="SIZE 3")
    tool_constants.rmod(files, "use", "use", INCONST="SIZE", OUTVAR="P")
    arm.spawn("two")
    arm.spawn("use")
    arm.control("use", "on")
    arm.control("two", "kill")
    with pytest.raises(PbonetError, match="is not the size of the ports") as caught:
        arm.spawn("three")
    assert "this task has the old SIZE" in str(caught.value)
    assert arm.status("use").state == "ON", "it goes on with the old one"
