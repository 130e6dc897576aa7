"""Which requests an observer may make."""

import pytest

from pbonet.xm.net import messages as m, roles


@pytest.mark.parametrize(
    "request_",
    [
        m.Display(),
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
