"""What a module says is told or counted, whatever it is, and its state always is."""

import pytest
from watching import wait_for

from pbonet.errors import PbonetError
from pbonet.xm.net import messages as m


@pytest.mark.parametrize(
    ("local", "said"),
    [
        ({"TEXT": "odd"}, "cannot read /nowhere/\\udcff.dat"),
        ({"TEXT": "odd", "WARNINGS": 3000}, "cannot read"),
        ({"TEXT": "long"}, "xxx"),
        ({"TEXT": "mute"}, "MuteError"),
    ],
    ids=["no Unicode", "a flood before it", "without end", "no text"],
)
def test_an_error_is_known_whatever_it_says(arm, local, said):
    tid = arm.spawn("bad", "says_odd", local=local).tid
    arm.on("bad")
    status = wait_for(
        lambda: (now := arm.status("bad")).state != "ON" and now, "its error"
    )
    assert (status.state, status.tid) == ("ERROR", tid)
    assert said in status.error
    assert arm.control("bad", "clear").state == "OFF"


def test_get_gives_numpy_s_numbers_and_refuses_what_is_none(arm):
    tid = arm.spawn("bad", "says_odd", local={"TEXT": "nothing"}).tid
    arm.on("bad")
    (value,) = arm.ask(m.Get(task="bad", name="warnings"), list[m.ParamValue])
    assert value.value == 1.5
    error = arm.refused(PbonetError, arm.ask, m.Get(task="bad", name="text"))
    assert "cannot be sent" in str(error)
    assert "`get`" in str(error)
    now = arm.wait_cycles("bad", 5)
    assert (now.state, now.tid) == ("ON", tid)
