"""When an agent answers what has changed a table that stands on other machines, too."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from pbonet.config.model import Variable
from pbonet.node.mirrors import Carried, Mirrors
from pbonet.node.tables import table_name
from pbonet.svar import Table


class Network(MagicMock):
    """A session that keeps what is asked; others answer when a test says so."""

    def get(self, _key, handler, **_options):
        self.asked = handler

    def answers(self, data):
        """Have another machine answer, and tell that no more answers come."""
        payload = SimpleNamespace(to_bytes=lambda: data)
        self.asked.callback(SimpleNamespace(ok=SimpleNamespace(payload=payload)))
        self.asked.drop()


def turn(mirrors):
    """Do what the carrier's thread has to do."""
    while not mirrors._todo.empty():
        mirrors._todo.get()()


@pytest.mark.parametrize(
    ("take", "in_order"), [(True, [b"state", "done"]), (False, ["done", b"state"])]
)
def test_a_table_is_open_when_the_others_states_are_taken(monkeypatch, take, in_order):
    """The carrier's thread comes late; only who opens a table waits for it."""
    happened = []
    monkeypatch.setattr(Carried, "_take", lambda _, data: happened.append(data))
    variables = [Variable(name="Q", type="double", nelem=3)]
    table = Table.create(table_name("d", "arm"), variables)
    network = Network()
    mirrors = Mirrors(network, "d", lambda _: None)
    try:
        mirrors.carry({"arm": True})
        mirrors.spread("arm", lambda: happened.append("done"), take=take)
        turn(mirrors)
        network.answers(b"state")
        turn(mirrors)
        assert happened == in_order
    finally:
        mirrors.carry({})
        turn(mirrors)
        table.destroy()
