"""The page on the protocol lists the codes of events that the node tells, no others."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
CODE = re.compile(r"[A-Z][A-Z_]+")
TELLING = {"add", "notice", "Notice", "Note", "_say"}


def told():
    """Return every code that stands as a word in a call that tells an event."""
    found = set()
    for path in (ROOT / "pbonet" / "node").glob("*.py"):
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
    assert told() == listed()
