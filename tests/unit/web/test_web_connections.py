"""Connections that say nothing, or too slowly: they end, and keep nobody away."""

from __future__ import annotations

import asyncio
import contextlib

import pytest
import uvicorn
from uvicorn.server import ServerState

from pbonet.master.web import connections


async def app(_scope, _receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"here"})


@contextlib.asynccontextmanager
async def serving():
    """Serve `app`; yield what opens a connection."""
    config = uvicorn.Config(app, log_config=None)
    config.load()
    state = ServerState()
    server = await asyncio.get_running_loop().create_server(
        lambda: connections.Connection(config, state, {}), "127.0.0.1", 0
    )
    opened = []

    async def connect():
        reader, writer = await asyncio.open_connection(
            *server.sockets[0].getsockname()[:2]
        )
        opened.append(writer)
        return reader, writer

    try:
        yield connect
    finally:
        for writer in opened:
            writer.close()
        server.close()
        await server.wait_closed()


async def page_of(connect):
    reader, writer = await connect()
    writer.write(b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
    return await reader.read()


def test_the_oldest_of_too_many_connections_ends(monkeypatch):
    monkeypatch.setattr(connections, "MOST", 5)

    async def many():
        async with serving() as connect:
            idle = [await connect() for _ in range(9)]
            assert b"here" in await page_of(connect)
            with contextlib.suppress(ConnectionError):  # aborted, not closed in order
                assert await idle[0][0].read() == b""
            assert not idle[-1][0].at_eof()

    asyncio.run(many())


@pytest.mark.parametrize("said", [b"", b"GET / HTTP/1.1\r\nHost: x\r\n"])
def test_a_connection_without_a_whole_request_ends(monkeypatch, said):
    monkeypatch.setattr(connections, "TIME", 0.05)

    async def wait():
        async with serving() as connect:
            reader, writer = await connect()
            writer.write(said)
            with contextlib.suppress(ConnectionError):
                assert await reader.read() == b""

    asyncio.run(wait())


def test_nothing_is_logged_of_requests_that_are_none(caplog):
    connections.leave_out_junk()

    async def junk():
        async with serving() as connect:
            for said in (
                b"\x00\r\n\r\n",
                b"POST / HTTP/1.1\r\nContent-Length: x\r\n\r\n",
            ):
                reader, writer = await connect()
                writer.write(said)
                assert b"400" in await reader.read()

    asyncio.run(junk())
    assert not caplog.records
