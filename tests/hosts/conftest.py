"""Three hosts for the tests of a module; see `lan` and `hostkit`."""

from __future__ import annotations

import functools

import pytest
from hostkit import LEASE_MS, OWN_PORT, Lab

from pbonet.testing.lan import Lan, missing
from pbonet.xm.net import session

_missing = functools.cache(missing)


@pytest.fixture(scope="module", autouse=True)
def lease():
    """Links of this process and of the agents stand so long, in ms; a module's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "LEASE_MS", LEASE_MS)
        patch.setattr(session, "SILENT_MS", LEASE_MS)
        yield LEASE_MS


@pytest.fixture(scope="module")
def clocks():
    """By host, the seconds by which its clock is ahead; a module may say otherwise."""
    return {}


@pytest.fixture(scope="module")
def hostnames():
    """By host, what it calls itself; a module may say otherwise."""
    return {}


@pytest.fixture(scope="module")
def lan(clocks, hostnames):
    """Three hosts with a cable between any two."""
    if reason := _missing():
        pytest.skip(reason)
    made = Lan(clocks, hostnames)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def lab(lan, lease):
    """Agents on the three hosts, which the module starts as it needs them."""
    made = Lab(lan, lease_ms=lease)
    try:
        yield made
    finally:
        lan.heal_all()
        made.close()


@pytest.fixture
def own_lab(lan):
    """The same for one test, in a domain and on a port of its own."""
    lan.heal_all()
    made = Lab(lan, OWN_PORT)
    try:
        yield made
    finally:
        lan.heal_all()
        made.close()
