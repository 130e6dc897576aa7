"""Which agents are out of sight, by their signs of life."""

from __future__ import annotations

import math
from types import SimpleNamespace

import msgspec
import pytest

from pbonet.node.agent.heartbeat import (
    ALWAYS,
    FORGET,
    HELD,
    LINGER,
    PERIOD,
    SELDOM,
    Beat,
    Change,
    Heartbeat,
)
from pbonet.node.agent.retransmission import BUSY, IDLE
from pbonet.xm.net import session

SILENT = session.SILENT_MS * 1e-3


@pytest.fixture
def now(monkeypatch):
    """The time, in a list so that a test can set it."""
    clock = [1000.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    return clock


@pytest.fixture
def changes():
    return []


class Link:
    """A session that notes what is declared and sent, by key."""

    def __init__(self):
        self.declared, self.sent = [], []
        self.info = SimpleNamespace(links=list)

    def declare_subscriber(self, key, *_args, **_more):
        return self._declare(key)

    def declare_publisher(self, key, **_more):
        return self._declare(key)

    def put(self, key, data, **_more):
        beat = msgspec.msgpack.decode(data, type=Beat)
        self.sent.append((key, "leaves" if beat.leaves else beat.heard))

    def _declare(self, key):
        self.declared.append(key)
        return SimpleNamespace(
            put=lambda data: self.put(key, data),
            undeclare=lambda: self.declared.remove(key),
        )


@pytest.fixture
def link():
    return Link()


@pytest.fixture
def met():
    return []


@pytest.fixture
def beats(now, changes, link, met):  # noqa: ARG001 - the time is set for it
    """The signs of life of arm0, which is in the group of t."""
    me = SimpleNamespace(domain="d", name="arm0", machine="here")
    found = Heartbeat(link, me, changes.append, met=met.append)
    found.join(["t"])
    return found


def sample(name, machine, sent=1.0, group="t", *, leaves=False, **heard):
    """Return a sign of life; what it has heard is in seconds, or `HELD`."""
    stamps = {who: at if at == HELD else round(at * 1e9) for who, at in heard.items()}
    beat = Beat(machine, round(sent * 1e9), stamps, leaves)
    data = msgspec.msgpack.encode(beat)
    payload = SimpleNamespace(to_bytes=lambda: data)
    return SimpleNamespace(
        key_expr=f"pbonet/d/sbs/{group}/beat/{name}", payload=payload
    )


def test_who_is_heard_is_in_sight(beats, now, changes) -> None:
    beats._note_beat(sample("arm1", "m"))
    now[0] += SILENT / 2
    beats._check(now[0])
    assert not beats.is_silent("arm1")
    assert not beats.is_silent("nobody")
    assert not changes


def test_who_is_silent_goes_out_of_sight_once_and_comes_back(
    beats, now, changes
) -> None:
    beats._note_beat(sample("arm1", "m"))
    for _ in range(3):
        now[0] += SILENT
        beats._check(now[0])
    assert changes == [Change("arm1", "m", seen=False, last=True)]
    assert beats.is_silent("arm1")
    beats._note_beat(sample("arm1", "m"))
    beats._note_beat(sample("arm1", "m"))
    assert changes[1:] == [Change("arm1", "m", seen=True, last=False)]
    assert not beats.is_silent("arm1")


def test_a_machine_is_lost_with_the_last_of_its_agents(beats, now, changes) -> None:
    beats._note_beat(sample("arm1", "m"))
    now[0] += SILENT / 2
    beats._note_beat(sample("arm2", "m"))
    beats._note_beat(sample("arm3", "other"))
    now[0] += SILENT / 2
    beats._check(now[0])
    now[0] += SILENT / 2
    beats._note_beat(sample("arm3", "other"))
    beats._check(now[0])
    assert changes == [
        Change("arm1", "m", seen=False, last=False),
        Change("arm2", "m", seen=False, last=True),
    ]


def test_silence_counts_from_the_last_sign_of_life_that_was_answered(
    beats, now
) -> None:
    now[0] += 3.0
    assert beats.silence("t", "arm1") == 3.0, "never heard: since it was joined"
    beats._note_beat(sample("arm1", "m"))
    assert beats.unanswered("arm1") == math.inf
    assert beats.silence("t", "arm1") == 3.0, "it is heard, and does not hear this one"
    beats._note_beat(sample("arm1", "m", arm0=1002.5))
    assert beats.silence("t", "arm1") == pytest.approx(0.5)
    beats._note_beat(sample("arm2", "m", arm0=1002.75))
    assert beats.silence("t", "arm1") == pytest.approx(0.25), "any agent of its machine"
    beats._note_beat(sample("arm1", "m", arm0=1002.5))
    beats._note_beat(sample("arm1", "m", arm0=5000.0))
    assert beats.silence("t", "arm1") == 0.0, "an answer from before a reboot"
    beats._note_beat(sample("arm3", "here"))
    now[0] += 1.0
    for name in ("arm0", "arm3"):
        assert beats.silence("t", name) == 0.0, "of this machine"
    assert beats.unanswered("arm1") == 1.0


def test_who_has_orders_to_carry_out_is_not_answered(beats, now) -> None:
    beats._note_beat(sample("arm1", "m", arm0=1000.0))
    beats._note_beat(sample("arm2", "m", arm0=HELD))
    now[0] += 2.0
    beats._note_beat(sample("arm1", "m", arm0=1002.0))
    assert beats.silence("t", "arm1") == 2.0, "another agent of that machine says so"
    beats._note_beat(sample("arm2", "m", arm0=1002.0))
    assert beats.silence("t", "arm1") == 0.0


def test_a_sign_of_life_answers_those_that_are_in_sight(beats, now) -> None:
    held = {"m2"}
    beats._holds = held.__contains__
    beats._note_beat(sample("arm1", "m", sent=7.0))
    beats._note_beat(sample("arm2", "m2", sent=8.0))
    answer = msgspec.msgpack.decode(beats._beat(), type=Beat)
    assert answer == Beat("here", round(now[0] * 1e9), {"arm1": 7 * 10**9, "arm2": -1})
    now[0] += SILENT
    beats._check(now[0])
    held.clear()
    beats._note_beat(sample("arm2", "m2", sent=9.0))
    answer = msgspec.msgpack.decode(beats._beat(), type=Beat)
    assert answer.heard == {"arm2": 9 * 10**9}


def test_what_is_no_sign_of_life_counts_as_none(beats) -> None:
    payload = SimpleNamespace(to_bytes=lambda: b"m")
    beats._note_beat(SimpleNamespace(key_expr="pbonet/d/sbs/t/beat/a", payload=payload))
    assert not beats._agents


def test_a_machine_was_alone_if_the_keeper_has_not_heard_it_either(beats, now) -> None:
    beats._note_beat(sample("lost", "m", sent=1.0))
    beats._note_beat(sample("keep", "k", lost=1.0))
    now[0] += 1.0
    beats._note_beat(sample("keep", "k", lost=1.5))
    now[0] += 1.0
    beats._note_beat(sample("keep", "k", lost=1.5))
    assert beats.absence("t", "lost", "keep") == 1.0, "the keeper has heard it later"
    assert beats.absence("t", "lost", "arm0") == 2.0, "the keeper is here"
    now[0] += SILENT
    beats._check(now[0])
    assert beats.absence("t", "lost", "keep") == 0.0, "the keeper is out of sight, too"
    beats._note_beat(sample("keep", "k"))
    now[0] += SILENT / 2
    assert beats.absence("t", "lost", "keep") == pytest.approx(SILENT / 2), (
        "not known before"
    )
    assert beats.absence("t", "arm0", "keep") == math.inf


def test_an_agent_that_is_not_known_was_alone_since_the_group_was_joined(
    beats, now
) -> None:
    """It was forgotten, or this agent has joined while it was away."""
    now[0] += 5.0
    assert not beats.is_seen("lost")
    assert beats.absence("t", "lost", "arm0") == 5.0, "the keeper is here"
    assert beats.absence("t", "lost", "keep") == 0.0, "the keeper is not in sight"
    beats._note_beat(sample("keep", "k"))
    now[0] += 1.0
    beats._note_beat(sample("keep", "k"))
    assert beats.absence("t", "lost", "keep") == 1.0, (
        "the keeper may have heard it before"
    )
    beats._note_beat(sample("keep", "k", lost=7.0))
    assert beats.absence("t", "lost", "keep") == 0.0, "the keeper hears it"
    beats._note_beat(sample("lost", "m"))
    assert beats.is_seen("lost")


def test_an_agent_is_on_another_machine_after_a_reboot(beats, now, changes) -> None:
    """Or its RTPU has moved; the machine where it was is lost first."""
    now[0] += 1.0
    beats._note_beat(sample("arm1", "old", arm0=1000.5))
    beats._note_beat(sample("arm1", "new"))
    assert changes == []
    assert not beats.is_here("arm1")
    now[0] += SILENT
    beats._check(now[0])
    beats._note_beat(sample("arm1", "new", arm0=1000.5))
    assert changes == [
        Change("arm1", "old", seen=False, last=True),
        Change("arm1", "new", seen=True, last=False),
    ]
    assert beats.silence("t", "arm1") == pytest.approx(0.5 + SILENT), "counts on"
    now[0] += SILENT
    beats._check(now[0])
    assert changes[2:] == [Change("arm1", "new", seen=False, last=True)]


def test_the_keeper_moves_to_another_machine(beats, now) -> None:
    """ALONE counts from then on, also where another agent of this machine goes on."""
    beats._note_beat(sample("keep", "here", arm0=1000.0))
    beats._note_beat(sample("arm2", "here", arm0=1000.0))
    assert beats.is_here("keep")
    now[0] += SILENT
    beats._note_beat(sample("arm2", "here"))
    beats._check(now[0])
    beats._note_beat(sample("keep", "other", arm0=now[0]))
    assert not beats.is_here("keep")
    now[0] += 3.0
    assert beats.silence("t", "keep") == 3.0


def test_an_agent_of_a_machine_that_is_heard_is_not_forgotten(beats, now) -> None:
    beats._note_beat(sample("arm1", "m"))
    now[0] += FORGET + 1
    beats._note_beat(sample("arm2", "m"))
    beats._check(now[0])
    assert {*beats._agents} == {"arm1", "arm2"}


def test_who_stays_away_is_forgotten(beats, now) -> None:
    beats._note_beat(sample("arm1", "m"))
    now[0] += FORGET + 1.0
    beats._check(now[0])
    assert not beats._agents


def turn(beats, now, seconds=PERIOD):
    """Let time pass, and do what is due then; return what was sent."""
    now[0] += seconds
    before = len(beats._session.sent)
    beats._turn(now[0])
    return beats._session.sent[before:]


MINE = "pbonet/d/sbs/t/beat/arm0"


def test_only_groups_get_signs_of_life_of_those_that_are_heard(
    beats, now, link, met
) -> None:
    assert link.declared == ["pbonet/d/sbs/t/beat/*", MINE]
    assert turn(beats, now) == [(MINE, {})]
    beats._note_beat(sample("arm1", "m", sent=2.0))
    beats._note_beat(sample("arm1", "m", sent=3.0))
    beats._note_beat(sample("arm2", "m", group="other"))
    assert met == ["arm1"], "once, and nobody of another subsystem"
    assert beats.partners() == {"arm1"}
    assert turn(beats, now, PERIOD / 2) == [(MINE, {"arm1": 3 * 10**9})]
    assert turn(beats, now, PERIOD / 2) == [], "not yet"
    assert turn(beats, now) == [(MINE, {"arm1": 3 * 10**9})]


def test_an_agent_without_a_table_gives_and_hears_none(now, link) -> None:
    me = SimpleNamespace(domain="d", name="arm0", machine="here")
    beats = Heartbeat(link, me, print)
    assert beats._turn(now[0]) > PERIOD, "and does not wake up for them"
    assert link.declared == link.sent == []


def test_links_on_which_nobody_depends_are_looked_after_seldom(now, link) -> None:
    """That is without a table, and without others whose messages go through here."""
    me = SimpleNamespace(domain="d", name="arm0", machine="here")
    used = []
    beats = Heartbeat(link, me, print, used=lambda: bool(used))
    due, links, finds = [IDLE], ["a router"], []
    link.info.links = lambda: links
    beats._retransmission = SimpleNamespace(
        tend=lambda: due[0], find=lambda: finds.append(now[0])
    )

    def pause():
        return beats._turn(now[0])

    assert pause() == SELDOM
    due[0] = BUSY
    assert pause() == BUSY, "something is sent again"
    due[0] = IDLE
    links.append("another agent")
    beats._on_link(None)
    assert pause() == IDLE
    assert len(finds) == 2, "when zenoh tells of a link, and not each second"
    links.pop()
    beats._on_link(None)
    assert pause() == SELDOM
    used.append("a program on another machine holds a semaphore of this one")
    assert pause() == IDLE
    assert beats.is_needed()
    used.clear()
    assert pause() == SELDOM
    beats.join(["t"])
    assert pause() <= IDLE


def test_silence_is_judged_when_it_is_due(beats, now, changes) -> None:
    """And not at the next sign of life: 0.45 s are promised."""
    turn(beats, now)
    now[0] += PERIOD / 2
    beats._note_beat(sample("arm1", "m"))
    for _ in range(10):
        now[0] += beats._turn(now[0])
        if changes:
            break
    assert changes == [Change("arm1", "m", seen=False, last=True)]
    assert now[0] - beats._agents["arm1"].heard < SILENT + 0.01


def test_one_that_joins_gives_a_sign_at_once_and_counts_silence_from_then(
    beats, now
) -> None:
    """Else a table opened an hour after the agent's start would be ALONE at once."""
    now[0] += 3600.0
    turn(beats, now)
    beats.join(["t", "u"])
    assert [key for key, _ in turn(beats, now, 0.0)] == [
        MINE,
        MINE.replace("/t/", "/u/"),
    ]
    now[0] += 1.5
    assert beats.silence("u", "keep") == 1.5
    assert beats.absence("u", "lost", "arm0") == 1.5
    assert beats.silence("t", "keep") > 3600.0
    assert beats.unanswered("keep") == math.inf


def test_the_first_sign_of_an_agent_is_answered_at_once(beats, now, link) -> None:
    """It joined later, has heard none, and must know soon if this one is lost now."""
    turn(beats, now)
    link.sent.clear()
    beats._turn(now[0])
    assert not link.sent
    beats._note_beat(sample("arm1", "m", 3.0))
    beats._turn(now[0])
    assert link.sent == [(MINE, {"arm1": 3 * 10**9})]
    beats._note_beat(sample("arm1", "m", 3.1))
    beats._turn(now[0])
    assert len(link.sent) == 1, "only the first one"


def test_an_agent_that_takes_over_has_no_answer_of_the_one_before_it(now, link) -> None:
    """Its machine may have been alone before; who was lost meanwhile is not known."""
    me = SimpleNamespace(domain="d", name="arm0", machine="here")
    beats = Heartbeat(link, me, print)
    beats.join(["t"], since=ALWAYS)
    now[0] += 1.0
    assert beats.silence("t", "keep") == math.inf
    assert beats.absence("t", "lost", "arm0") == 1.0
    beats._note_beat(sample("keep", "k", arm0=now[0]))
    assert beats.silence("t", "keep") == 0.0


def test_a_group_is_left_when_the_table_stays_away_and_not_before(
    beats, now, link
) -> None:
    """An RTPU process that was killed is given its table again."""
    beats._note_beat(sample("arm1", "m"))
    beats.join([])
    assert [key for key, _ in turn(beats, now, LINGER)] == [MINE]
    beats.join(["t"])
    assert turn(beats, now, LINGER) == [(MINE, {})]
    beats.join([])
    turn(beats, now, LINGER)
    beats._note_beat(sample("arm1", "m"))
    assert turn(beats, now) == [(MINE, "leaves")]
    assert link.declared == []
    assert beats.partners() == set()
    assert turn(beats, now) == []
    beats._note_beat(sample("arm1", "m"))  # it was on its way
    assert beats.partners() == set()


def test_who_says_goodbye_is_not_out_of_sight(beats, now, changes) -> None:
    beats.join(["t", "u"])
    for group in "tu":
        beats._note_beat(sample("arm1", "m", group=group))
    beats._note_beat(sample("arm1", "m", leaves=True))
    assert beats.is_seen("arm1"), "in the other group"
    beats._note_beat(sample("arm1", "m", group="u", leaves=True))
    beats._note_beat(sample("arm2", "m", leaves=True))
    assert not beats.is_seen("arm1")
    now[0] += SILENT
    beats._check(now[0])
    assert not beats.is_silent("arm1")
    assert changes == []


@pytest.mark.parametrize("leaves", [True, False])
def test_the_machine_of_a_keeper_without_a_table_counts(now, link, leaves) -> None:
    """Its RTPU process was lost, and nobody has given it the table again."""
    me = SimpleNamespace(domain="d", name="arm0", machine="here")
    machines = {"keep": "k", "near": "here"}
    beats = Heartbeat(link, me, print, machine_of=machines.get)
    beats.join(["t"])
    for name, machine in machines.items() if leaves else ():
        beats._note_beat(sample(name, machine))
        beats._note_beat(sample(name, machine, leaves=True))
    now[0] += 5.0
    assert beats.silence("t", "keep") == 5.0, "nobody speaks for its machine"
    beats._note_beat(sample("eye", "k", arm0=1004.5))
    assert beats.silence("t", "keep") == pytest.approx(0.5)
    assert beats.unanswered("keep") == pytest.approx(0.5)
    assert beats.absence("t", "keep", "near") == 5.0, "it has no table"
    assert beats.absence("t", "other", "keep") == 0.0, "just heard again"
    now[0] += 0.3
    assert beats.absence("t", "other", "keep") == pytest.approx(0.3)
    assert beats.is_here("near")
    assert beats.silence("t", "near") == 0.0, "never alone on its own machine"


def test_one_that_starts_again_without_a_table_can_be_asked(beats, now) -> None:
    beats._note_beat(sample("arm1", "m"))
    now[0] += SILENT
    beats._check(now[0])
    assert beats.is_silent("arm1")
    beats.token_came("arm1")
    beats.token_came("nobody")
    assert not beats.is_silent("arm1")
    assert not beats.is_seen("arm1"), "for a fallback it is lost"
    beats._note_beat(sample("arm1", "m"))
    now[0] += SILENT
    beats._check(now[0])
    assert beats.is_silent("arm1")


def test_one_that_starts_again_within_the_time_of_silence_can_be_asked(
    beats, now
) -> None:
    """Else it would not be given a stop for a minute."""
    beats._note_beat(sample("arm1", "m"))
    beats.token_came("arm1")
    now[0] += SILENT
    beats._check(now[0])
    assert not beats.is_seen("arm1")
    assert not beats.is_silent("arm1")


def test_another_agent_of_the_keepers_machine_that_shares_the_table_counts(
    beats, now
) -> None:
    beats._note_beat(sample("keep", "k", arm0=1000.0))
    now[0] += 5.0
    beats._check(now[0])
    beats._note_beat(sample("eye", "k", arm0=1004.5))
    assert not beats.is_seen("keep")
    assert beats.silence("t", "keep") == pytest.approx(0.5)
    assert beats.absence("t", "keep", "arm0") == 0.0
