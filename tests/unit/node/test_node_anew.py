"""Which configuration an agent that restarts may have, and the core it stays on."""

from __future__ import annotations

import os
import socket

import pytest

from pbonet.config import Entry
from pbonet.config.model import AgentConfig
from pbonet.errors import PbonetError
from pbonet.node.agent import restart_check, start_rtpu
from pbonet.node.rtpu import cleanup
from pbonet.node.wire import process_setup
from pbonet.xm.net import run_folder

OLD = AgentConfig(name="arm0", domain="lab", listen=("tcp/127.0.0.1:7447",))


def config(**more):
    return AgentConfig(**{"name": "arm0", "domain": "lab", "listen": OLD.listen} | more)


@pytest.mark.parametrize(
    "new",
    [
        OLD,
        config(core=1),
        config(listen=()),
        config(connect=("tcp/10.0.0.1:7447",), grace=2.0),
        config(listen=("unixsock-stream//tmp/x.sock", *OLD.listen)),
        config(listen=("tcp/0.0.0.0:7447",), insecure=True),
    ],
)
def test_what_may_be(new):
    restart_check.check(OLD, new, 1)


STAYS = "put it back, or end the agent and start it again: its tasks turn OFF"


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"name": "arm1"}, "keeps its name (expected name arm0, got arm1); " + STAYS),
        ({"domain": "d"}, "keeps its domain (expected domain lab, got d); " + STAYS),
        ({"core": 0}, "keeps its core (expected core 1, got 0); " + STAYS),
        ({"name": None}, "keeps its name (expected name arm0, got None); " + STAYS),
        ({"listen": ("tcp/127.0.0.1",)}, "this is not an endpoint"),
        ({"listen": ("tcp/127.0.0.1:65536",)}, "this is not an endpoint"),
        ({"listen": ("tcp/x..y:80",), "insecure": True}, "be listened on"),
        ({"listen": ("tcp/0.0.0.0:7447",)}, "beyond this machine is not protected"),
        ({"listen": ("tcp/192.0.2.1:7448",), "insecure": True}, "be listened on"),
        ({"connect": ("tls/10.0.0.1:7447",)}, "TLS needs keys"),
        ({"keys": "/nowhere"}, "with keys every link over a network is TLS"),
        ({"keys": "/nowhere", "listen": ()}, "this is not a key folder"),
        (
            {"files": "/nowhere"},
            "the folder of files for other machines does not exist",
        ),
    ],
)
def test_what_may_not_be(more, words):
    with pytest.raises(PbonetError) as error:
        restart_check.check(OLD, config(**more), 1)
    assert words in str(error.value)


def test_a_port_that_is_taken_is_found_out():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        one.listen()
        endpoint = f"tcp/127.0.0.1:{one.getsockname()[1]}"
        with pytest.raises(PbonetError) as error:
            restart_check.check(OLD, config(listen=(endpoint,)), 1)
    assert str(error.value) == (
        f"{endpoint}: the endpoint cannot be listened on (got Address already in use); "
        "name an address of this machine, and a free port"
    )


def test_what_reaches_the_rtpu_process_later():
    device = {"mem": Entry(driver="file", address="x")}
    new = config(libraries=("x",), awake=True, grace=1.0, device=device)
    assert restart_check.kept(OLD, new) == ["libraries", "awake", "device"]


def test_an_rtpu_that_goes_on_stays_on_its_core(run_dir, monkeypatch):  # noqa: ARG001 - an empty folder
    """Whoever takes it over would choose another one, as its own is used."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    places, other = run_folder.Places("d", "arm0"), run_folder.Places("lab", "arm0")
    assert start_rtpu.choose_core(places) == 3
    started = process_setup.start_time(os.getpid())
    cleanup.write(
        places.state, cleanup.Leftovers(pid=os.getpid(), started=started, core=3)
    )
    assert start_rtpu.choose_core(places) == 3
    assert start_rtpu.choose_core(other) == 2
