"""Messages that docs/symptoms.md quotes are those of the program."""

import ast
import re
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "symptoms.md").read_text(encoding="utf-8")
QUOTED = [
    message
    for message in re.findall(r"^\| `([^`]+)`", PAGE, re.MULTILINE)
    if message not in {"stale", "missed"}
]


@pytest.fixture(scope="module")
def texts():
    """Return every text that stands in the source, docstrings among them."""
    trees = (
        ast.parse(path.read_text(encoding="utf-8"))
        for path in (ROOT / "pbonet").rglob("*.py")
    )
    return "\n".join(
        node.value
        for node in chain.from_iterable(map(ast.walk, trees))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


@pytest.mark.parametrize("message", QUOTED)
def test_a_message_is_one_of_the_program(message, texts):
    for part in message.split("…"):
        assert part.strip() in texts
