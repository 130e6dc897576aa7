"""The application that answers browsers: the page's files, and its messages."""

from __future__ import annotations

import asyncio
import contextlib
import mimetypes
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from starlette.applications import Starlette
from starlette.responses import FileResponse, PlainTextResponse
from starlette.routing import Route, WebSocketRoute

from pbonet.errors import PbonetError
from pbonet.master.console import described
from pbonet.master.subsystem import status_fields

from .access import COOKIE_TIME, Access, Rate, Role
from .browsers import MOST, MOST_WATCHED, Browser, Browsers
from .orders import Play, Seek, Stop, Watch, decode, refusal
from .recorded_run import RecordedRun

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable, Coroutine

    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp, Message, Receive, Scope as AsgiScope, Send
    from starlette.websockets import WebSocket

    from .orders import Orders, Wish
    from .recorded_questions import RecordedQuestions
    from .source import Source

    Data = dict[str, Any]

DIST: Final = Path(__file__).parent / "dist"
"""The built page: ``index.html`` and what it loads."""
NOT_BUILT: Final = (
    "The page is not built in this checkout: run 'npm ci && npm run build' in web/. "
    "Everything but the page is served.\n"
)
_HEADERS: Final = {
    "content-security-policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; object-src 'none'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
LONGEST: Final = 64 * 1024
"""Bytes of a message from a browser."""
_SEND_TIME: Final = 10.0
"""Seconds in which a browser must take a message; then it is let go."""
_REQUESTS: Final = (50.0, 100)
"""Messages a second of one browser, and how many at once."""
_MANY: Final = "too many messages a second; this one was left out"
_LINKS: Final = (2.0, 20)
"""Attempts a second to open the page by nothing valid, and how many at once."""
_CLOSED_FOREIGN: Final = 4403
_CLOSED_FULL: Final = 4429
_CLOSED_SLOW: Final = 4408
"""Codes with which a connection is closed; the page tells what they mean."""


class Page:
    """The server of one page.

    Args:
        source: What the page shows.
        orders: Makes what carries out commands, with what tells all browsers; None
            where nothing can be steered.
        access: Who may do what.
        linked: Called with a role and its new link when the one before was used.
    """

    def __init__(
        self,
        source: Source,
        orders: Callable[[Callable[[Data], None]], Orders | RecordedQuestions],
        access: Access,
        *,
        linked: Callable[[Role, str], None],
    ) -> None:
        self._source = source
        self._orders = orders(self.send_to_all)
        self._access = access
        self._linked = linked
        self._browsers = Browsers(source.want)
        self._attempts = Rate(*_LINKS)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._running: set[asyncio.Task[None]] = set()

    def app(self) -> ASGIApp:
        """Return the application that a web server runs."""
        routes = [
            Route("/", self._index),
            Route("/{name}", self._asset),
            WebSocketRoute("/ws", self._socket),
        ]
        made = Starlette(routes=routes, lifespan=self._lifespan)
        return _Guard(made, self._access)

    @contextlib.asynccontextmanager
    async def _lifespan(self, _: object) -> AsyncGenerator[None]:
        self._loop = asyncio.get_running_loop()
        self._source.start(self.send_to_all)
        try:
            yield
        finally:
            await asyncio.to_thread(self._orders.close)
            await asyncio.to_thread(self._source.close)

    @property
    def left(self) -> list[str]:
        """Sentences about what is still being carried out after the end."""
        return self._orders.left

    def send_to_all(self, message: Data) -> None:
        """Send a message to all browsers; any thread may call it."""
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._browsers.send, message)

    # -- files ------------------------------------------------------------------------

    async def _index(self, request: Request) -> Response:
        token = request.query_params.get("token", "")
        cookie = request.cookies.get(self._access.cookie, "")
        known = self._access.role(cookie)
        opens = token and request.method == "GET"  # HEAD only looks
        role = self._access.use(token) if opens else None
        if role is None and known is None and not self._attempts.allows():
            return PlainTextResponse("too many attempts; wait\n", 429)
        if role is not None:
            self._linked(role, self._access.renew(role))
        role = role or known
        if role is None:
            text = "open a link that 'pbonet web' printed; each works once\n"
            return PlainTextResponse(text, 401)
        index = DIST / "index.html"
        response: Response = PlainTextResponse(NOT_BUILT)
        if index.is_file():
            response = FileResponse(index)
        if role is not known:
            response.set_cookie(
                self._access.cookie,
                self._access.sign(role),
                max_age=round(COOKIE_TIME),
                httponly=True,
                samesite="strict",
                secure=self._access.secure,
            )
        return response

    async def _asset(self, request: Request) -> Response:
        name = request.path_params["name"]
        there = {one.name for one in DIST.glob("*")}
        if name not in there:
            return PlainTextResponse("there is no such file\n", 404)
        kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
        return FileResponse(DIST / name, media_type=kind)

    # -- messages ---------------------------------------------------------------------

    async def _socket(self, socket_: WebSocket) -> None:
        origin = socket_.headers.get("origin", "")
        cookie = socket_.cookies.get(self._access.cookie, "")
        role = self._access.role(cookie)
        if role is None or not self._access.is_origin(origin):
            await socket_.close(_CLOSED_FOREIGN, "open the page by its link")
            return
        if self._browsers.are_full(role):
            await socket_.close(_CLOSED_FULL, f"{MOST} browsers are served at most")
            return
        browser = Browser(role)
        self._browsers.add(browser)
        sending = None
        try:
            await socket_.accept()
            running = self._orders.first()
            for message in (self._hello(role), *self._source.first(), *running):
                browser.put(msgspec.json.encode(message))
            sending = asyncio.create_task(_send(socket_, browser))
            receiving = asyncio.create_task(self._receive(socket_, browser))
            await asyncio.wait(
                (sending, receiving), return_when=asyncio.FIRST_COMPLETED
            )
            receiving.cancel()
        finally:
            if sending is not None:
                sending.cancel()
            self._browsers.remove(browser)

    async def _receive(self, socket_: WebSocket, browser: Browser) -> None:
        rate = Rate(*_REQUESTS)
        while True:
            message = await socket_.receive()
            if message["type"] == "websocket.disconnect":
                return
            text = message.get("text")
            allowed = rate.allows()
            if text is None:
                browser.put(_encoded(kind="refused", text="messages are JSON as text"))
            else:
                self._take(text, browser, allowed=allowed)

    def _take(self, text: str, browser: Browser, *, allowed: bool) -> None:
        """Carry out one message of a browser; of too many a second only a stop."""
        try:
            request = decode(text)
        except PbonetError as error:
            browser.put(_encoded(kind="refused", text=str(error) if allowed else _MANY))
            return
        if not allowed and not isinstance(request, Stop):
            if isinstance(request, Watch | Seek | Play):
                browser.put(_encoded(kind="refused", text=_MANY))
            else:  # the browser waits for an answer
                browser.put(_encoded(**refusal(request.id, _MANY)))
        elif isinstance(request, Watch):
            self._watch(request, browser)
        elif isinstance(request, Seek | Play):
            self._move(request, browser)
        else:
            self._command(request, browser)

    def _command(self, request: Wish, browser: Browser) -> None:
        orders = self._orders

        async def carry_out() -> None:
            answer = await orders.answer(
                request, browser.role, lambda told: browser.put(_encoded(**told))
            )
            browser.put(_encoded(**answer))

        self._begin(carry_out())

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        """Have something done beside the messages that come."""
        task = asyncio.create_task(work)
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    def _move(self, request: Seek | Play, browser: Browser) -> None:
        if not isinstance(self._source, RecordedRun):
            text = "only a recorded run can be shown at another time"
            browser.put(_encoded(kind="refused", text=text))
        elif isinstance(request, Seek):
            self._source.seek(request.t)
        else:
            self._source.play(request.speed)

    def _watch(self, request: Watch, browser: Browser) -> None:
        wanted = frozenset(request.variables)
        if len(wanted) > MOST_WATCHED:
            text = f"a page may watch {MOST_WATCHED} variables, not {len(wanted)}"
            browser.put(_encoded(kind="refused", text=text))
            return
        wanted &= self._source.variables
        begun = bool(browser.unheard)
        browser.unheard |= wanted - browser.watched
        browser.watched = wanted
        self._browsers.rewatch()
        if not begun:
            self._begin(self._send_history(browser))

    async def _send_history(self, browser: Browser) -> None:
        """Tell what was before, in a thread: no stop waits for all these numbers.

        It is one at a time for each browser, however often it watches other variables.
        """

        def history(names: list[str]) -> list[bytes]:
            return [msgspec.json.encode(one) for one in self._source.history(names)]

        while True:
            names = sorted(browser.unheard & browser.watched)
            try:
                texts = await asyncio.to_thread(history, names)
            except PbonetError as error:
                texts = [_encoded(kind="refused", text=str(error))]
            for text in texts:
                browser.put(text)
            browser.unheard -= {*names}
            browser.unheard &= browser.watched
            if not browser.unheard or browser.lost:
                return

    def _hello(self, role: Role) -> Data:
        return {
            "kind": "hello",
            "role": str(role),
            "now": time.time(),
            "commands": described(self._orders.commands),
            "fields": [
                {"name": one.name, "unit": one.unit, "doc": one.doc}
                for one in status_fields.FIELDS
            ],
            **self._source.about,
        }


class _Guard:
    """Refuses requests under a foreign name, and adds headers to every answer.

    Args:
        app: Answers what is let through.
        access: Knows the server's names.
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: AsgiScope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        hosts = [v.decode("latin-1") for k, v in scope["headers"] if k == b"host"]
        if len(hosts) != 1 or not self._access.is_host(hosts[0]):
            await _refuse_host(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                added = [(k.encode(), v.encode()) for k, v in _HEADERS.items()]
                message["headers"] = [*message.get("headers", []), *added]
            await send(message)

        await self._app(scope, receive, send_guarded)


async def _refuse_host(scope: AsgiScope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": _CLOSED_FOREIGN})
        return
    text = "this server is not called by that name; --name adds one\n"
    await PlainTextResponse(text, 403)(scope, receive, send)


async def _send(socket_: WebSocket, browser: Browser) -> None:
    """Send what waits for a browser, until it is lost."""
    while not browser.lost:
        for text in await browser.take():
            sent = socket_.send_text(text.decode())
            try:
                async with asyncio.timeout(_SEND_TIME):
                    await sent
            except (TimeoutError, RuntimeError, OSError):
                return
    with contextlib.suppress(RuntimeError, OSError):
        await socket_.close(_CLOSED_SLOW, "it did not read")


def _encoded(**message: object) -> bytes:
    return msgspec.json.encode(message)
