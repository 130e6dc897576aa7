"""Commands as a log records them: the requester, the request, times, the result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, cast

import msgspec

from pbonet.xm.net import Answer

from . import rtpu_messages

if TYPE_CHECKING:
    from pbonet.xm.net import AnyRequest

LONGEST_TEXT: Final = 300
"""Maximum length of a text in a log; longer ones are files, attached to it."""
LONGEST_LIST: Final = 64
LARGEST: Final = 8192
"""Maximum bytes of a request and of an answer, because the recorder's pipe is small."""
_PLAIN: Final = frozenset({"v", "id", "client", "subsystem", "epoch", "op"})
_ANSWER: Final = msgspec.msgpack.Decoder(Answer)


def command(
    request: AnyRequest, answer: bytes, begun_ns: int, ended_ns: int
) -> rtpu_messages.Commanded:
    """Return a log's record of a command that was answered.

    Args:
        request: The request.
        answer: The packed answer.
        begun_ns: When it was received, CLOCK_MONOTONIC.
        ended_ns: When it was answered.
    """
    asked = cast("dict[str, Any]", msgspec.to_builtins(request))
    told = _ANSWER.decode(answer)
    said = {
        "op": asked.get("op", type(request).__name__.lower()),
        "client": request.client,
        "id": request.id,
        "epoch": request.epoch,
        "asked": _bounded({k: v for k, v in asked.items() if k not in _PLAIN}),
        "ok": told.ok,
        "error": _bounded(told.error),
        "warnings": _bounded(told.warnings),
        "result": _bounded(told.result),
        "begun_ns": begun_ns,
        "ended_ns": ended_ns,
    }
    return rtpu_messages.Commanded(request.subsystem, msgspec.json.encode(said))


def _bounded(value: object) -> object:
    """Return a value cut to the allowed size."""
    short = _short(msgspec.to_builtins(value))
    size = len(msgspec.json.encode(short))
    return short if size <= LARGEST else f"({size} bytes)"


def _short(value: Any) -> Any:  # noqa: ANN401 - as JSON has it
    """Return a value with long texts and lists cut."""
    if isinstance(value, str) and len(value) > LONGEST_TEXT:
        import hashlib  # brings OpenSSL, which an agent seldom needs

        digest = hashlib.sha256(value.encode()).hexdigest()
        return f"{value[:60]}... ({len(value)} characters, sha256 {digest})"
    if isinstance(value, dict):
        items = cast("dict[str, Any]", value).items()
        return {str(key): _short(one) for key, one in items}
    if isinstance(value, list):
        each = cast("list[object]", value)
        cut = [_short(one) for one in each[:LONGEST_LIST]]
        more = len(each) - len(cut)
        return [*cut, f"... ({more} more)"] if more else cut
    return value
