"""iceoryx2: a blackboard with one entry, and publish-subscribe with a buffer of one.

A blackboard keeps each entry whole by itself, so that all arrays are one entry: with
one for each a reader could get arrays of different sets.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from benchmarks.rivals.rival import (
    Reader,
    Rival,
    Writer,
    alone,
    load,
    one_array,
    whole,
)


class Iceoryx2(Rival):
    """What both patterns share."""

    package = "iceoryx2"

    def _node(self) -> tuple[Any, Any]:
        iceoryx2 = load("iceoryx2")
        iceoryx2.set_log_level(iceoryx2.LogLevel.Error)
        node = iceoryx2.NodeBuilder.new().create(iceoryx2.ServiceType.Ipc)
        name = iceoryx2.ServiceName.new(f"{self.tag}/{type(self).__name__}")
        return node, node.service_builder(name)

    def _payload(self) -> type[ctypes.Structure]:
        fields = [("data", ctypes.c_double * self.floats)]
        return type("Set", (ctypes.Structure,), {"_fields_": fields})


class Iceoryx2Blackboard(Iceoryx2):
    """`update_with_copy` and `get`: a register, as pbonet's is one."""

    name = "iceoryx2 blackboard"

    def writer(self) -> Writer:
        """Create the blackboard."""
        node, builder = self._node()
        payload = self._payload()
        key, value = ctypes.c_uint64(0), payload()
        service = builder.blackboard_creator(ctypes.c_uint64).add(key, value).create()
        port = service.writer_builder().create()
        entry = port.entry(key, payload)
        update = entry.update_with_copy

        def publish(keep: object = (node, service, port)) -> None:  # noqa: ARG001
            update(value)

        return Writer(one_array(value), publish)

    def reader(self) -> Reader:
        """Open the blackboard."""
        node, builder = self._node()
        key = ctypes.c_uint64(0)
        service = builder.blackboard_opener(ctypes.c_uint64).open()
        port = service.reader_builder().create()
        get = port.entry(key, self._payload()).get
        frombuffer = np.frombuffer

        def take(keep: object = (node, service, port)) -> object:  # noqa: ARG001
            return frombuffer(get().data)

        return Reader(take, alone)


class Iceoryx2PubSub(Iceoryx2):
    """Loan, copy, send; receive, copy. A slow reader loses the older set."""

    name = "iceoryx2 pub/sub"

    def _service(self) -> tuple[Any, Any, type[ctypes.Structure]]:
        node, builder = self._node()
        payload = self._payload()
        service = (
            builder
            .publish_subscribe(payload)
            .subscriber_max_buffer_size(1)
            .enable_safe_overflow(True)  # noqa: FBT003 - as it is
            .open_or_create()
        )
        return node, service, payload

    def writer(self) -> Writer:
        """Open a publisher."""
        node, service, payload = self._service()
        own, move, size = payload(), ctypes.memmove, ctypes.sizeof(payload)
        port = service.publisher_builder().create()
        loan, source = port.loan_uninit, ctypes.addressof(own)

        def publish(keep: object = (node, service, own)) -> None:  # noqa: ARG001
            sample = loan()
            move(sample.payload_ptr, source, size)
            sample.assume_init().send()

        return Writer(one_array(own), publish)

    def reader(self) -> Reader:
        """Open a subscriber."""
        node, service, payload = self._service()
        own, move, size = payload(), ctypes.memmove, ctypes.sizeof(payload)
        port = service.subscriber_builder().buffer_size(1).create()
        receive, to = port.receive, ctypes.addressof(own)
        numbers = one_array(own)

        def take(keep: object = (node, service, own)) -> object:  # noqa: ARG001
            sample = receive()
            if sample is None:
                return None
            move(to, sample.payload_ptr, size)
            return numbers

        return Reader(take, whole)
