"""Packets of other machines that wait to be taken: bounded, and counted when lost."""

from __future__ import annotations

import threading

from pbonet.node.mirror.packet_queue import PacketQueue


def test_taken_in_order_and_rung_once():
    rings = []
    incoming = PacketQueue(lambda: rings.append(1))
    for n in range(3):
        incoming.put("a", b"%d" % n)
    assert (len(rings), incoming.taken()) == (1, [b"0", b"1", b"2"])
    assert incoming.taken() == []
    incoming.put("a", b"3")
    assert (len(rings), incoming.taken()) == (2, [b"3"])


def test_the_oldest_go_and_are_counted_by_machine():
    incoming = PacketQueue(lambda: None, room=3)
    for machine, n in (("a", 0), ("b", 1), ("a", 2), ("b", 3), ("b", 4)):
        incoming.put(machine, b"%d" % n)
    assert incoming.taken() == [b"2", b"3", b"4"]
    assert incoming.lost == {"a": 1, "b": 1}


def test_several_threads_of_zenoh():
    """All that is heard is taken or counted, and the last ring comes behind it."""
    room, each = 8, 5000
    rung = threading.Event()
    incoming = PacketQueue(rung.set, room)
    taken = 0

    def hear(machine):
        for _ in range(each):
            incoming.put(machine, b"")

    threads = [threading.Thread(target=hear, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads) or rung.is_set():
        if rung.wait(0.01):
            rung.clear()
            got = len(incoming.taken())
            assert got <= room
            taken += got
    assert taken + incoming.lost.total() == 2 * each
