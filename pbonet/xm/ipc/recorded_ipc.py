"""Semaphores and queues of a recorded module: each answer is written to its tape.

In a replay the same objects return the recorded answers, and nothing is opened.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from pbonet.outside import Outside, using

from . import names
from ._ipc import Full, Policy, Queue, Semaphore, Taken
from .queue_receive import Receiving

if TYPE_CHECKING:
    from collections.abc import Callable

    from _typeshed import ReadableBuffer

    from .names import Name


def opened(
    make: Callable[..., Semaphore | Queue], name: str | Name, settings: dict[str, Any]
) -> RecordedSemaphore | RecordedQueue:
    """Return the object that `make` opens, wrapped to record its answers."""
    kind = RecordedQueue if make in {Queue.create, Queue.attach} else RecordedSemaphore
    return kind(make, name, settings)


class _Heard:
    """Base of recorded semaphores and queues."""

    _WHAT = ""
    _SETTINGS: tuple[str, ...] = ()

    def __init__(
        self, make: Callable[..., Any], name: str | Name, settings: dict[str, Any]
    ) -> None:
        found = name if isinstance(name, names.Name) else names.parse(name)
        self._name = str(found)
        self._outside = Outside(f"{self._WHAT} {self._name}")
        self._inner: Any = None
        self._told: list[Any] = self._outside.ask(self._open, make, name, settings)

    def _open(
        self, make: Callable[..., Any], name: str | Name, settings: dict[str, Any]
    ) -> list[Any]:
        with using(None):
            self._inner = make(name, **settings)
        path = str(self._inner.path)
        return [path, *(int(getattr(self._inner, one)) for one in self._SETTINGS)]

    def _recorded(self, what: str, *args: Any, default: Any, **more: Any) -> Any:  # noqa: ANN401
        """Return the recorded result of a method."""
        return self._outside.ask(self._do, what, args, more, default=default)

    def _do(self, what: str, args: tuple[Any, ...], more: dict[str, Any]) -> Any:  # noqa: ANN401
        return getattr(self._inner, what)(*args, **more)

    def _property(self, what: str, default: Any = None) -> Any:  # noqa: ANN401
        return self._outside.ask(lambda: getattr(self._inner, what), default=default)

    def __repr__(self) -> str:
        return f"<{self._WHAT.capitalize()} {self._name}>"

    @property
    def name(self) -> str:
        return self._name

    @property
    def path(self) -> str:
        return str(self._told[0])

    @property
    def waiting(self) -> int:
        return int(self._property("waiting", 0))

    def close(self) -> None:
        self._recorded("close", default=None)

    def destroy(self) -> None:
        self._recorded("destroy", default=None)


class RecordedSemaphore(_Heard, Semaphore):
    """A semaphore whose answers are recorded."""

    _WHAT = "semaphore"
    _SETTINGS: tuple[str, ...] = ("maximum", "binary")

    @property
    def maximum(self) -> int:
        return int(self._told[1])

    @property
    def binary(self) -> bool:
        return bool(self._told[2])

    @property
    def value(self) -> int:
        return int(self._property("value", 0))

    @property
    def holder(self) -> int | None:
        return cast("int | None", self._property("holder"))

    def p(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        still: Callable[[], bool] | None = None,
    ) -> Taken:
        out = Taken.TIMED_OUT
        got = self._recorded("p", until_ns, priority=priority, still=still, default=out)
        return Taken(got)

    def try_p(self) -> Taken:
        return Taken(self._recorded("try_p", default=Taken.TIMED_OUT))

    def v(self, *, answer: bool = True) -> bool:
        return bool(self._recorded("v", answer=answer, default=True))


class RecordedQueue(Receiving, _Heard, Queue):
    """A message queue whose answers are recorded."""

    _WHAT = "queue"
    _MOST = 0xFFFFFFFE
    _SETTINGS: tuple[str, ...] = ("policy", "messages", "blocks", "block")
    _last = 0

    @property
    def policy(self) -> Policy:
        return Policy(self._told[1])

    @property
    def messages(self) -> int:
        return int(self._told[2])

    @property
    def blocks(self) -> int:
        return int(self._told[3])

    @property
    def block(self) -> int:
        return int(self._told[4])

    @property
    def free(self) -> tuple[int, int]:
        return cast("tuple[int, int]", self._property("free"))

    @property
    def sent(self) -> int:
        return int(self._property("sent", 0))

    @property
    def dropped(self) -> int:
        return int(self._property("dropped", 0))

    @property
    def last_priority(self) -> int:
        return self._last

    def __len__(self) -> int:
        return int(self._recorded("__len__", default=0))

    def send(
        self,
        data: ReadableBuffer,
        priority: int = 0,
        *,
        full: Full = Full.REFUSE,
        until_ns: int | None = 0,
        wait_priority: int | None = None,
        still: Callable[[], bool] | None = None,
        answer: bool = True,
    ) -> bool:
        return bool(
            self._recorded(
                "send",
                data,
                priority,
                full=full,
                until_ns=until_ns,
                wait_priority=wait_priority,
                still=still,
                answer=answer,
                default=True,
            )
        )

    def letter(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        most: int = _MOST,
        still: Callable[[], bool] | None = None,
    ) -> tuple[bytes, int] | None:
        got = self._recorded(
            "letter",
            until_ns,
            priority=priority,
            most=most,
            still=still,
            default=None,
        )
        if got is not None:
            self._last = got[1]
        return cast("tuple[bytes, int] | None", got)

    def wait(
        self,
        until_ns: int | None = None,
        *,
        priority: int | None = None,
        still: Callable[[], bool] | None = None,
    ) -> bool:
        return bool(
            self._recorded(
                "wait", until_ns, priority=priority, still=still, default=False
            )
        )
