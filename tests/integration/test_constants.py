"""Constants that change under real tasks: a tool is replaced while the arm is held.

tool --MASS--> weigh --WEIGHT--> hold --F-->
   \\------------LENGTH-----------/
"""

from __future__ import annotations

import pytest
from watching import wait_for

from pbonet.errors import MethodError, PbonetError, ReconfigError, VerificationError
from pbonet.master.subsystem import Subsystem

SVAR = """
NAME MASS
TYPE double
DESC mass of the tool
UNITS kg
NELEM 1

NAME LENGTH
TYPE double
DESC length of the tool
UNITS m
NELEM 1

NAME WEIGHT
TYPE double
DESC weight of the tool
UNITS N
NELEM 1

NAME BIAS
TYPE double
DESC set by hand
UNITS N*m
NELEM 1
INIT 0

NAME F
TYPE double
DESC torque that holds the tool
UNITS N*m
NELEM 1

NAME SIZE
TYPE int
DESC elements of P
UNITS none
NELEM 1

NAME P
TYPE double
DESC as many as SIZE
UNITS none
NELEM 2
EOF
"""
SBS = "SUBSYSTEM tools\nSVARFILE tools.svar\nRTPU arm0\nEOF\n"
TOOL = """
    from typing import Annotated as A
    from pbonet import OutConst, Params, PortBasedObject, param

    class Of(Params):
        mass: A[float, param("kg", "mass", ge=0)] = 1.0
        length: A[float, param("m", "length", ge=0)] = 1.0

    class Tool(PortBasedObject[Of]):
        '''What is at the end of the arm.'''

        mass: A[float, OutConst("MASS", "1", "kg", "mass")]
        length: A[float, OutConst("LENGTH", "1", "m", "length")]

        def init(self) -> None:
            self.reinit()

        def reinit(self) -> None:
            self.mass, self.length = self.params.mass, self.params.length

        def cycle(self, dt: float) -> None:
            pass
"""
WEIGH = """
    from typing import Annotated as A
    from pbonet import InConst, OutConst, Params, PortBasedObject

    class Weigh(PortBasedObject[Params]):
        '''Weight of a mass.'''

        mass: A[float, InConst("MASS", "1", "kg", "mass")]
        weight: A[float, OutConst("WEIGHT", "1", "N", "weight")]

        def init(self) -> None:
            self.reinit()

        def reinit(self) -> None:
            if self.mass > 100.0:
                self.task.fail("too heavy")
            self.weight = 10.0 * self.mass

        def cycle(self, dt: float) -> None:
            pass
"""
HOLD = """
    from typing import Annotated as A
    from pbonet import InConst, OutVar, Params, PortBasedObject

    class Hold(PortBasedObject[Params]):
        '''Torque against the weight.'''

        weight: A[float, InConst("WEIGHT", "1", "N", "weight")]
        length: A[float, InConst("LENGTH", "1", "m", "length")]
        bias: A[float, InConst("BIAS", "1", "N*m", "bias")]
        f: A[float, OutVar("F", "1", "N*m", "torque")]

        def init(self) -> None:
            self.times = 0
            self.reinit()

        def reinit(self) -> None:
            self.torque = self.weight * self.length + self.bias
            if self.task.state == "ON":
                self.times += 1
                self.task.warn(f"reinit {self.times}")

        def cycle(self, dt: float) -> None:
            self.f = self.torque
"""
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


def rmod(folder, name, module, *, local="", **ports):
    """Write an RMOD; `ports` are its lists."""
    lists = {
        key: ports.get(key, "none")
        for key in ("INCONST", "OUTCONST", "INVAR", "OUTVAR")
    }
    lines = [f"MODULE {module}", "DESC a test", *(f"{k} {v}" for k, v in lists.items())]
    lines += ["TASKTYPE periodic", "FREQ 200"]
    lines += ["LOCAL", local] if local else []
    (folder / f"{name}.rmod").write_text("\n".join([*lines, "EOF", ""]))


@pytest.fixture
def files(nodes, tmp_path):
    """The folder of the subsystem, its modules in the library of the agent."""
    nodes.write_module("tool", TOOL)
    nodes.write_module("weigh", WEIGH)
    nodes.write_module("hold", HOLD)
    folder = tmp_path / "tools"
    folder.mkdir()
    (folder / "tools.svar").write_text(SVAR)
    (folder / "tools.sbs").write_text(SBS)
    for name, local in (("grip", "MASS 2\nLENGTH 0.5"), ("drill", "MASS 3\nLENGTH 1")):
        rmod(folder, name, "tool", OUTCONST="MASS LENGTH", local=local)
    rmod(folder, "anvil", "tool", OUTCONST="MASS LENGTH", local="MASS 500")
    rmod(folder, "weigh", "weigh", INCONST="MASS", OUTCONST="WEIGHT")
    rmod(folder, "hold", "hold", INCONST="WEIGHT LENGTH BIAS", OUTVAR="F")
    (folder / "tools.job").write_text(
        "JOB tools\nDESC hold a tool\nSBS tools.sbs\n"
        "TASK hold\nTASK weigh\nTASK grip\nEOF\n"
    )
    return folder


@pytest.fixture
def arm(nodes, files):
    nodes.agent_process("arm0")
    subsystem = Subsystem(
        files / "tools.sbs", domain=nodes.domain, libraries=[nodes.library]
    )
    subsystem.heard = []
    subsystem.warned = subsystem.heard.append
    subsystem.open()
    yield subsystem
    if subsystem._crew is not None:
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
    arm.start("tools")
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
    assert "drill" not in held.picture
    wait_torque(held, 10.0)


def test_producers_of_equal_constants_take_each_others_place(held, files):
    (files / "twin.rmod").write_text((files / "grip.rmod").read_text())
    held.spawn("twin")  # the same mass and length
    held.control("grip", "kill")
    assert held.control("twin", "reinit").state == "OFF"
    wait_torque(held, 10.0)


def test_a_second_producer_that_is_not_verified_is_refused_by_its_value(nodes, files):
    nodes.agent("arm0")
    master = nodes.master("arm0", "tools", table=False)
    master.open_table(SVAR)
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
    circle = WEIGH.replace("MASS", "WEIGHT", 1).replace(
        'OutConst("WEIGHT"', 'OutConst("MASS"'
    )
    nodes.write_module(
        "back", circle.replace("self.mass", "1.0").replace("class Weigh", "class Back")
    )
    rmod(files, "back", "back", INCONST="WEIGHT", OUTCONST="MASS")
    job = (files / "tools.job").read_text()
    (files / "tools.job").write_text(job.replace("TASK grip", "TASK back"))
    with pytest.raises(VerificationError) as caught:
        arm.start("tools")
    assert "wait for each other's constants" in str(caught.value)
    assert "weigh --WEIGHT--> back --MASS--> weigh" in str(caught.value)
    assert len(arm.picture.names) == 0


def test_a_size_cannot_change_under_a_task(arm, nodes, files):
    give = SIZED.format(
        kind="OutConst", name="Give", port="", init="self.size = self.params.size"
    )
    port = 'p: A[Vector, OutVar("P", "size", "none", "values")]'
    use = SIZED.format(kind="InConst", name="Use", port=port, init="pass")
    nodes.write_module("give", give)
    nodes.write_module("use", use)
    rmod(files, "two", "give", OUTCONST="SIZE")
    rmod(files, "three", "give", OUTCONST="SIZE", local="SIZE 3")
    rmod(files, "use", "use", INCONST="SIZE", OUTVAR="P")
    arm.spawn("two")
    arm.spawn("use")
    arm.control("use", "on")
    arm.control("two", "kill")
    with pytest.raises(PbonetError, match="is not the size of the ports") as caught:
        arm.spawn("three")
    assert "this task has the old SIZE" in str(caught.value)
    assert arm.status("use").state == "ON", "it goes on with the old one"
