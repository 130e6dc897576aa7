"""Requests that are asked again: carried out once, answered each time."""

from pbonet.node.agent import idempotency


def test_a_request_is_carried_out_once_and_answered_each_time():
    told = []
    known = idempotency.RepeatedRequests()
    assert known.begin(("c", "1"), told.append)
    assert not known.begin(("c", "1"), told.append), "under way"
    assert known.begin(("d", "1"), told.append), "of another client"
    known.end(("c", "1"), b"done")
    assert told == [b"done", b"done"]
    assert not known.begin(("c", "1"), told.append)
    assert told == [b"done", b"done", b"done"]


def test_what_is_kept_is_bounded(monkeypatch):
    monkeypatch.setattr(idempotency, "KEPT", 3 * (idempotency.OVERHEAD + 10))
    known = idempotency.RepeatedRequests()
    for n in range(5):
        assert known.begin(("c", str(n)), lambda _: None)
        known.end(("c", str(n)), bytes(10))
    assert [known.begin(("c", str(n)), lambda _: None) for n in (2, 3, 4)] == [
        False
    ] * 3
    assert known.begin(("c", "1"), lambda _: None), "forgotten"


def test_an_answer_that_is_too_long_to_keep_is_given_all_the_same(monkeypatch):
    monkeypatch.setattr(idempotency, "KEPT", 100)
    told = []
    known = idempotency.RepeatedRequests()
    assert known.begin(("c", "1"), told.append)
    known.end(("c", "1"), bytes(200))
    assert told == [bytes(200)]
    assert known.begin(("c", "1"), told.append)
