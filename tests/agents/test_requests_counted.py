"""How many requests a verb sends to real agents; others are counted with played ones.

`scripted/test_requests_per_verb.py` says which they are, and why.
"""

from __future__ import annotations

from collections import Counter

import pytest
from nodekit import rmod, svar

from pbonet.master.configuration import Place
from pbonet.master.console import oneshot
from pbonet.master.subsystem import Subsystem
from pbonet.xm.net import rpc


@pytest.fixture
def verb(nodes, tmp_path, monkeypatch):
    """Give one-shot verbs to tasks on two RTPUs; each returns what it sent, by RTPU."""
    (tmp_path / "t.sbs").write_text(
        "SUBSYSTEM t\nSVARFILE t.svar\nRTPU arm0\nRTPU arm1\nEOF\n"
    )
    (tmp_path / "t.svar").write_text(svar())
    texts = {
        "stays": rmod("soft", "Y0", local={"PLAN": 0.0001}),
        "old": rmod("counts", "Y1"),
    }
    for name, text in (texts | {"new": texts["old"]}).items():
        (tmp_path / f"{name}.rmod").write_text(text)
    libraries = tuple(map(str, nodes.config("arm0").libraries))
    place = Place(domain=nodes.domain, libraries=libraries)
    nodes.agent_processes("arm0", "arm1")
    with Subsystem(
        tmp_path / "t.sbs",
        domain=nodes.domain,
        libraries=libraries,
        warned=lambda _: None,
        record="off",
    ) as arm:
        for task, rtpu in (("stays", "arm0"), ("old", "arm1"), ("new", "arm1")):
            arm.spawn(task, rtpu)
        arm.reconfig([("stays", "on"), ("old", "on")])
        arm.detach()
    sent = []
    exchange = rpc.Client._exchange

    def counted(self, rtpu, request, timeout):
        sent.append(rtpu)
        return exchange(self, rtpu, request, timeout)

    monkeypatch.setattr(rpc.Client, "_exchange", counted)

    def give(command, **args):
        sent.clear()
        oneshot.run(tmp_path / "t.sbs", command, args, place)
        return dict(Counter(sent))

    yield give
    Subsystem(
        tmp_path / "t.sbs", domain=nodes.domain, libraries=libraries
    ).open().stop()


def test_a_verb_asks_only_those_concerned_and_once(verb):
    assert verb("get", task="stays") == {"arm0": 1}
    assert verb("freq", task="stays") == {"arm0": 1}
    assert verb("freq", task="stays", hz=20.0) == {"arm0": 2}
    assert verb("set", task="stays", param="PLAN", value=["0.0002"]) == {"arm0": 2}
    assert verb("status") == {"arm0": 1, "arm1": 1}
    both = {"arm0": 1, "arm1": 2}
    assert verb("off", task=["old"]) == both, "tasks of arm0 might read what it writes"
    assert verb("on", task=["old"]) == both
    assert verb("swap", old="old", new="new") == both
