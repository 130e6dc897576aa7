"""An executive and its clients in one process: what is half done on either side."""

from __future__ import annotations

import pytest

from pbonet.io.spp import Execution, SppEntry, batches, channel
from pbonet.node.spp.executive import Executive
from pbonet.xm.ipc import names

LIBRARY = """
from pbonet.io.spp import Library
library = Library()
library.variable("x")
@library.routine("numpy")
def go(m): ...
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    home = names.home()
    made = channel.Place(home.domain, home.rtpu, f"half-{tmp_path.name}")
    yield made
    made.remove()


@pytest.fixture
def executive(place):
    execution = Execution(SppEntry(driver="numpy"), "half")
    return Executive(place, execution, channel.Executive(place), 10.0)


@pytest.fixture
def client(place, tmp_path):
    path = tmp_path / "library.py"
    path.write_text(LIBRARY)
    hello = channel.Hello(library=str(path), pid=1, owner="")
    made = channel.ClientMemory(place, "1-1", hello)
    yield made
    made.destroy()


def hand_over(buffers, number):
    batch = batches.Batch(100, "half")
    batch.call(0, ())
    buffers.submit(number, batch.end(number), 0, holds=False)


def test_a_batch_of_the_time_before_is_not_carried_out_twice(executive, client):
    buffers = client.make_buffers(2, 5000, 5000)
    hand_over(buffers, 1)
    assert buffers.handed_over.try_p()  # its client is just before the V
    executive.begin()
    buffers.handed_over.v()
    for _ in range(3):
        executive.serve()
    assert (buffers.begun, buffers.finished) == (1, 1)
    hand_over(buffers, 2)
    executive.serve()
    assert batches.unpack_result(buffers.result(2)).number == 2


def test_buffers_without_their_sizes_are_not_there_yet(executive, client):
    buffers = client.make_buffers(2, 5000, 5000)
    at = slice(channel._SIZES, channel._SLOTS_AT)
    sizes = bytes(buffers._memory[at])
    buffers._memory[at] = bytes(len(sizes))  # the client is just before it writes them
    executive.begin()
    executive.serve()
    buffers._memory[at] = sizes
    hand_over(buffers, 1)
    executive.serve()
    assert buffers.finished == 1


def test_a_library_that_ended_an_executive_is_not_loaded_by_the_next(executive, client):
    client.say_loading(is_loading=True)
    executive.begin()
    assert "ended while it loaded" in client.manifest(0)["error"]["what"]
    assert not executive.state.libraries


def test_a_client_that_left_while_its_library_was_loaded_is_forgotten(
    executive, client, monkeypatch
):
    load = executive._execution.load
    monkeypatch.setattr(
        executive._execution, "load", lambda one: (load(one), client.destroy())[0]
    )
    executive.begin()
    assert not executive.state.libraries


def test_many_libraries_are_told(executive):
    executive.state.libraries = [f"/a/long/folder/library_{i}.py" for i in range(500)]
    executive.begin()
    assert executive._door.state() == executive.state
