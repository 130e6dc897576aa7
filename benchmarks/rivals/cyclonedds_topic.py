"""CycloneDDS: best effort, the last sample kept, bytes in place of numbers.

Python packs an array of bytes faster than one of float64.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from benchmarks.rivals.rival import Reader, Rival, Writer, alone, load


class CycloneDdsTopic(Rival):
    """`write` and `take`."""

    name = "cyclonedds"
    package = "cyclonedds"

    def _topic(self) -> tuple[Any, Any, Any, Any]:
        domain, core = load("cyclonedds.domain"), load("cyclonedds.core")
        idl, types = load("cyclonedds.idl"), load("cyclonedds.idl.types")
        data = types.array[types.uint8, 8 * self.floats]
        words = {"__annotations__": {"data": data}}
        made: Any = type("Set", (idl.IdlStruct,), words, typename="Set")
        kind: Any = dataclasses.dataclass(made)
        quality = core.Qos(
            core.Policy.Reliability.BestEffort, core.Policy.History.KeepLast(1)
        )
        participant = domain.DomainParticipant(0)
        name = self.tag.replace("-", "_")
        topic = load("cyclonedds.topic").Topic(participant, name, kind, qos=quality)
        return participant, topic, kind, quality

    def writer(self) -> Writer:
        """Make a data writer."""
        participant, topic, kind, quality = self._topic()
        port = load("cyclonedds.pub").DataWriter(participant, topic, qos=quality)
        own = np.zeros(self.floats)
        write, pack = port.write, own.tobytes

        def publish(keep: object = (participant, topic)) -> None:  # noqa: ARG001
            write(kind(pack()))

        return Writer([own], publish)

    def reader(self) -> Reader:
        """Make a data reader."""
        participant, topic, _, quality = self._topic()
        sub, core = load("cyclonedds.sub"), load("cyclonedds.core")
        port = sub.DataReader(participant, topic, qos=quality)
        unread = core.ReadCondition(
            port, core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any
        )
        waits = core.WaitSet(participant)
        waits.attach(unread)
        read, frombuffer = port.take, np.frombuffer

        def take(keep: object = (participant, topic)) -> object:  # noqa: ARG001
            samples = read(N=1)
            if not samples or not hasattr(samples[0], "data"):
                return None
            return frombuffer(samples[0].data)

        def wait() -> object:
            waits.wait(100_000_000)
            return take()

        return Reader(take, alone, wait)
