"""The page on the protocol, and the master, list the codes that the node tells."""

import ast
import re
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest

from pbonet.errors import DeviceError
from pbonet.master.subsystem.event_filter import EventFilter
from pbonet.node.wire import lifecycle
from pbonet.pbo import State
from pbonet.xm.net import event_codes

ROOT = Path(__file__).parents[3]
CODE = re.compile(r"[A-Z][A-Z_]+")
TELLING = {"add", "notice", "Notice", "Note", "_say", "_add", "say"}


def told():
    """Return every code that stands as a word in a call that tells an event."""
    found = set()
    for path in (ROOT / "pbonet" / "node").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in TELLING:
                words = [*node.args, *(key.value for key in node.keywords)]
                found |= {word for one in words for word in constants(one)}
    return found


def constants(node):
    if isinstance(node, ast.IfExp):
        return constants(node.body) | constants(node.orelse)
    word = getattr(node, "value", "")
    known = isinstance(node, ast.Constant) and isinstance(word, str)
    return {word} if known and CODE.fullmatch(word) else set()


def listed():
    page = (ROOT / "docs" / "protocol.md").read_text()
    table = page.split("| code | when |")[1].split("\n\n")[0]
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    return {word for row in rows for word in re.findall(r"`([A-Z_]+)`", row)}


def test_every_code_is_on_the_page_and_only_those():
    assert told() == listed() == event_codes.TOLD


@pytest.mark.parametrize(
    ("code", "remedy"),
    [
        ("WARNNG", "did you mean WARNING?"),
        ("warning", "did you mean WARNING?"),
        ("TASK_DIE", "did you mean TASK_DIED?"),
        ("OTHER_NEW", "did you mean OTHER_NEWS?"),
        ("Q", "events without --code show theirs"),
    ],
)
def test_a_code_that_no_event_can_have_is_doubted(code, remedy):
    told = [SimpleNamespace(code="OTHER_NEWS")]
    assert (
        EventFilter(code=code).doubt(told) == f"no event has the code {code}; {remedy}"
    )


@pytest.mark.parametrize(
    "code", [None, "WARNING", "OTHER_NEWS", DeviceError.code, "7", "-7"]
)
def test_one_that_an_event_has_or_may_have_is_not(code):
    """Also one that a node of another version has told, and a number of a module."""
    assert EventFilter(code=code).doubt([SimpleNamespace(code="OTHER_NEWS")]) == ""


@pytest.mark.parametrize("signal", lifecycle.FROM_OUTSIDE)
@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("failed", ["", "no encoder"])
def test_what_a_signal_has_done_is_a_sentence_without_doubled_words(
    signal, state, failed
):
    text = event_codes.signal_text(signal, state, failed)
    words = re.findall(r"[a-z-]+", text.lower())
    assert not any(a == b for a, b in pairwise(words)), text
    assert failed in text
    done = {event_codes.TURNED_OFF, event_codes.KILLED, event_codes.CLEARED}
    assert not (failed and text in done)
