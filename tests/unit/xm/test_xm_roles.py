"""Which requests an observer may make, and which an agent makes for its tasks."""

import pytest

from pbonet.errors import AccessError
from pbonet.xm.net import messages as m, resource_messages as r, roles


@pytest.mark.parametrize(
    "request_",
    [
        m.Display(),
        m.Devices(),
        m.Status(),
        m.Freq(task="a"),
        m.Sigmask(),
        m.Sigmask(task="a"),
        m.Job(),
    ],
    ids=repr,
)
def test_what_only_asks_is_for_everybody(request_):
    assert roles.leaf(request_) == "status"


@pytest.mark.parametrize(
    "request_",
    [
        m.Freq(task="a", hz=5.0),
        m.Sigmask(names=[]),
        m.Sigmask(unset=True),
        m.Job(told=m.Standing(name="a", file="a.job")),
        m.Job(forget=True),
        m.Write(name="X", values=[1.0]),
        m.Status(reset=True),
    ],
    ids=repr,
)
def test_what_changes_something_is_not(request_):
    assert roles.leaf(request_) == "sbs"
    for leaf in ("mail", "status", "*", "**"):
        with pytest.raises(AccessError, match="accepts only requests"):
            roles.check(request_, f"pbonet/d/rtpu/arm0/{leaf}")


def test_requests_of_tasks_have_a_key_of_their_own():
    give = r.Give(handle=1)
    assert roles.leaf(give) == "mail"
    for leaf in ("mail", "sbs"):
        roles.check(give, f"pbonet/d/rtpu/arm0/{leaf}")
    with pytest.raises(AccessError):
        roles.check(give, "pbonet/d/rtpu/arm0/status")
