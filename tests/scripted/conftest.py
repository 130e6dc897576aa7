"""Scripted agents, for what a master or a tool does without any task that runs."""

from __future__ import annotations

import secrets
import time

import pytest
from long_limits import LEASE_MS

from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.xm.net import session


@pytest.fixture
def world(run_dir, monkeypatch):  # noqa: ARG001 - it must stand first
    """One machine of fake agents, in a domain of its own, whose links stand long."""
    from fakeagent import SharedState

    monkeypatch.setattr(session, "LEASE_MS", LEASE_MS)
    monkeypatch.setattr(session, "SILENT_MS", LEASE_MS)
    monkeypatch.setattr(session, "OPEN_MS", LEASE_MS)
    return SharedState(domain=f"t{secrets.token_hex(3)}")


class Fakes(dict):
    """Fake agents by name; calling it starts some."""

    def __init__(self, world):
        super().__init__()
        self.world = world

    def __call__(self, *names, apart=False):
        from fakeagent import FakeAgent, Link

        groups = [(name,) for name in names] if apart else [names]
        for group in groups:
            link = Link(self.world, *group)
            self.update({name: FakeAgent(self.world, name, link) for name in group})
        deadline = time.monotonic() + 60.0
        while any(fake.neighbours() != sorted(self) for fake in self.values()):
            assert time.monotonic() < deadline, "the agents do not find each other"
            time.sleep(0.01)
        return self


@pytest.fixture
def agents(world):
    """Start fake agents by calling it with their names; they end with the test."""
    fakes = Fakes(world)
    yield fakes
    for fake in fakes.values():
        fake.close()


@pytest.fixture
def arm(world, agents, puma):
    """An open subsystem with both RTPUs; its warnings are in ``arm.heard``."""
    agents("arm0", "arm1")
    subsystem = Subsystem(puma, domain=world.domain)
    subsystem.heard = []
    subsystem.warned = subsystem.heard.append
    subsystem.open()
    yield subsystem
    subsystem.detach()
