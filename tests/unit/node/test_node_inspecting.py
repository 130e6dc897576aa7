"""Many that ask for modules: one inspector at a time, and one answer for all alike."""

from __future__ import annotations

import asyncio

import pytest

from pbonet.errors import ModuleLoadError, ProtocolError
from pbonet.node.rtpu import module_inspection


class Slow(module_inspection.ModuleInspection):
    """Inspects when it is told to."""

    def __init__(self):
        super().__init__(None)
        self.go = asyncio.Event()
        self.begun: list[str | None] = []
        self.at_once = 0

    async def _inspect(self, name):
        self.begun.append(name)
        self.at_once += 1
        assert self.at_once == 1
        await self.go.wait()
        self.at_once -= 1
        if name == "bad":
            raise ModuleLoadError("it does not load")
        return [], [f"{name} {len(self.begun)}"]


def run(what):
    asyncio.run(asyncio.wait_for(what, 10.0))


def test_those_alike_share_one_inspector():
    async def ask():
        slow = Slow()
        first = asyncio.create_task(slow.modules(None))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert slow.begun == [None]
        later = [asyncio.create_task(slow.modules(n)) for n in [None, "a", "bad"] * 30]
        await asyncio.sleep(0)
        slow.go.set()
        found = await asyncio.gather(first, *later, return_exceptions=True)
        assert slow.begun == [None, None, "a", "bad"]
        assert found[:3] == [([], ["None 1"]), ([], ["None 2"]), ([], ["a 3"])]
        assert all(isinstance(one, ModuleLoadError) for one in found[3::3])

    run(ask())


def test_names_that_wait_are_bounded():
    async def ask():
        slow = Slow()
        names = [f"m{n}" for n in range(module_inspection.WAITING + 1)]
        waiting = [asyncio.create_task(slow.modules(name)) for name in names[:-1]]
        await asyncio.sleep(0)
        with pytest.raises(ProtocolError, match="too many modules are asked for"):
            await slow.modules(names[-1])
        slow.go.set()
        await asyncio.gather(*waiting)
        assert (await slow.modules(names[-1]))[1]

    run(ask())
