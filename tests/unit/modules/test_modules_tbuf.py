"""`tbuf_send` and `tbuf_receive`: one module each, on a bench; links are real."""

import numpy as np
import pytest

from pbonet import Signal, State, tbuf, xm
from pbonet.errors import MethodError, XmNameError
from pbonet.io import no_devices
from pbonet.modules.subsystem_interfaces.tbuf_receive import NEVER, TbufReceive
from pbonet.modules.subsystem_interfaces.tbuf_send import TbufSend
from pbonet.testing import Bench


@pytest.fixture(autouse=True)
def home():
    xm.live_on("arm0", domain="d", subsystem="arm")
    yield
    xm.live_on("local")


def sender(**more):
    return Bench(TbufSend, params={"link": "x"}, n=3, **more)


def receiver(**params):
    return Bench(TbufReceive, params={"link": "arm:x", **params}, n=3)


def steps(bench, count):
    for _ in range(count):
        bench.step()


def test_what_one_sends_the_other_has():
    one, other = sender(), receiver()
    one.on()
    other.on()
    one.inputs.z = [1, 2, 3]
    one.step()
    other.step()
    assert other.outputs.z.tolist() == [1, 2, 3]
    assert other.task.stamp_ns > NEVER
    one.kill()
    other.kill()


def test_a_stale_variable_is_not_sent():
    one = sender()
    with tbuf.Reader("arm:x") as reader:
        one.on()
        one.step()
        assert reader.read()
        one.stale = {"z"}
        one.step()
        one.step()
        assert not reader.read()
        assert one.task.nwarnings == 1
        one.stale = set()
        one.step()
        assert reader.read()
    one.kill()


def test_outputs_stay_until_something_came():
    other = receiver()
    other.outputs.z = [7, 8, 9]
    other.on()
    other.step()
    assert other.outputs.z.tolist() == [7, 8, 9]
    assert other.task.stamp_ns == NEVER, "and are as old as can be"
    other.kill()


def written(now_ns, value=1.0):
    """Write one record, as if at that time."""
    with tbuf.Writer("x", ("f8", 3)) as writer:
        writer.value[:] = value
        writer.write(now_ns)


def test_what_is_too_old_is_warned_of_once():
    other = receiver(maxage=0.1)
    other.on()
    written(other.task.now)
    for _ in range(5):
        other.step()
    assert other.task.nwarnings == 0
    for _ in range(20):
        other.step()
    assert other.task.nwarnings == 1
    assert "nothing arrived for 0.1" in other.task.errmsg
    assert other.state is State.ON
    assert other.outputs.z.tolist() == [1.0] * 3
    assert other.task.signals & Signal.WARNING
    written(other.task.now, 2.0)
    other.step()
    assert other.outputs.z.tolist() == [2.0] * 3
    for _ in range(20):
        other.step()
    assert other.task.nwarnings == 2, "and again, when it is lost again"
    other.kill()


def test_what_is_too_old_may_be_an_error():
    other = receiver(maxage=0.1, fail=True)
    other.on()
    for _ in range(8):
        other.step()
    with pytest.raises(MethodError, match="check its sender"):
        steps(other, 20)
    assert other.state is State.ERROR
    other.clear()
    written(other.task.now, 3.0)
    other.on()
    assert other.outputs.z.tolist() == [3.0] * 3
    other.step()
    assert other.state is State.ON
    other.kill()


def test_turned_on_again_it_has_what_came_last():
    other = receiver()
    written(1000, 4.0)
    other.on()
    other.off()
    other.outputs.z = [0, 0, 0]
    other.on()
    assert other.outputs.z.tolist() == [4.0] * 3
    assert other.task.stamp_ns == 1000
    other.kill()


def test_a_simulation_opens_no_link(shared_memory):
    with no_devices("this is a simulation"):
        one, other = sender(), receiver(maxage=0.01)
    for bench in (one, other):
        bench.on()
        for _ in range(5):
            bench.step()
        assert bench.state is State.ON
    assert list(shared_memory.iterdir()) == []
    assert np.all(other.outputs.z == 0)


def test_a_name_that_cannot_be_is_refused_when_the_task_is_made():
    with pytest.raises(MethodError) as refused:
        Bench(TbufSend, params={"link": "vision:x"}, n=3)
    assert isinstance(refused.value.__cause__, XmNameError)
