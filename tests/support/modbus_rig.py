"""A server of pymodbus in a thread of the test: what a bus has when a task is gone."""

from __future__ import annotations

import asyncio
import threading
from contextlib import contextmanager

from pymodbus.simulator import DataType, SimData, SimDevice

COUNT = 2300
"""Ports of each table."""


def tables(count):
    """Return what the server has: registers that tell their address, and bits."""
    numbers = [k * 7 & 0xFFFF for k in range(count)]
    bits = [k % 3 == 0 for k in range(count)]
    return (
        [SimData(0, values=bits, datatype=DataType.BITS)],
        [SimData(0, values=bits, datatype=DataType.BITS)],
        [SimData(0, values=numbers, datatype=DataType.REGISTERS)],
        [SimData(0, values=[k + 1 for k in numbers], datatype=DataType.REGISTERS)],
    )


@contextmanager
def serving(make, units=(1,), count=COUNT):
    """Run a server of pymodbus in a thread of its own; give it as `make` made it."""
    made, ready = [], threading.Event()

    async def serve():
        server = make([SimDevice(unit, simdata=tables(count)) for unit in units])
        stop = asyncio.Event()
        try:
            await server.serve_forever(background=True)
            made.extend((server, asyncio.get_running_loop(), stop))
        finally:
            ready.set()
        await stop.wait()
        await server.shutdown()

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    try:
        ready.wait()
        server, loop, stop = made
        yield server
        loop.call_soon_threadsafe(stop.set)
    finally:
        thread.join()
