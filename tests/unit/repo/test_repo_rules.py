"""Rules of the house that a tool can check over the whole tree."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import tokenize
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).resolve().parents[3]
CODE = {".py", ".pyx", ".pxd", ".pyi", ".h", ".c", ".js", ".ts"}


def tracked() -> list[Path]:
    """Return the files of the checkout: what git would commit, or all outside git."""
    git = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if git.returncode:
        pytest.skip("not a git checkout, so build products cannot be told from sources")
    return [path for name in git.stdout.splitlines() if (path := ROOT / name).is_file()]


def test_native_headers_compile_without_python() -> None:
    headers = [path for path in tracked() if path.suffix == ".h"]
    assert headers
    for header in headers:
        assert "Python.h" not in header.read_text(), header


def test_no_path_of_a_builders_machine_is_committed() -> None:
    private = re.compile(r"(?<![\w.])/(?:home/\w+|root)/\w")
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in tracked()
        if path.suffix in CODE | {".md", ".toml", ".svar", ".rmod", ".sbs", ".job"}
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if private.search(line)
    ]
    assert found == []


def test_every_decision_says_whether_it_holds() -> None:
    pages = sorted((ROOT / "docs" / "decisions").glob("[0-9]*.md"))
    assert pages
    for page in pages:
        text = page.read_text()
        assert re.search(r"^Status: \w+", text, re.MULTILINE), page.name
        for part in ("## Context", "## Decision", "## Consequences"):
            assert part in text, f"{page.name} has no {part}"


def test_nothing_that_keeps_time_looks_at_the_clock_on_the_wall() -> None:
    """It may be set at any moment; only people are told the time of day."""
    wall = re.compile(
        r"CLOCK_REALTIME|gettimeofday|\btime\.time(_ns)?\b|\bdatetime\b|\blocaltime\b"
        r"|\btime\(\s*(NULL|0)?\s*\)"
    )
    parts = ("node", "analysis", "svar", "xm", "pbo", "io")
    found = {
        "/".join(path.relative_to(ROOT).parts[1:])
        for path in tracked()
        if path.suffix in CODE | {".pxi"}
        and path.relative_to(ROOT).parts[0] == "pbonet"
        and path.relative_to(ROOT).parts[1] in parts
        and wall.search(path.read_text())
    }
    assert found == {
        "io/drivers/gpio_driver.py",  # how long a line is quiet, as gpiod has it
        "io/mavlink_signing.py",  # with it signatures of MAVLink begin
        "node/agent/machine_state.py",  # a machine's clock, for people
        "node/wire/core_trace.py",  # the date of a miss, for people
        "node/wire/event_log.py",  # the date of an event, for people
        "node/recorder/log_rotation.py",  # when a log begins
        "node/rtpu/rtpu_state.py",  # a number for claims that is new
        "xm/net/credentials.py",  # how long a certificate still holds
        "xm/ipc/filesystem.py",  # when a file was changed, for people
        "xm/net/pki.py",  # from when to when a certificate holds
        "svar/lock.h",  # where the C library cannot wait by another clock
    }


def test_docstrings_begin_with_what_the_thing_is() -> None:
    odd = re.compile(r'"""(Who|Whoever|Whose|Those|What)\b')
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in tracked()
        if path.suffix in {".py", ".pyi"}
        and path.relative_to(ROOT).parts[0] == "pbonet"
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if odd.search(line)
    ]
    assert found == []


def comments(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a file's comments and docstrings, with their numbers."""
    text = path.read_text()
    if path.suffix in {".py", ".pyi"}:
        parts = [
            (token.start[0], token.string)
            for token in tokenize.generate_tokens(io.StringIO(text).readline)
            if token.type == tokenize.COMMENT
        ]
        for node in ast.walk(ast.parse(text)):
            match node:
                case ast.Expr(value=ast.Constant(value=str() as words)):
                    parts.append((node.lineno, words))
                case _:
                    pass
    else:
        kind = r"/\*.*?\*/|//[^\n]*" if path.suffix == ".h" else r'""".*?"""|#[^\n]*'
        parts = [
            (text.count("\n", 0, found.start()) + 1, found[0])
            for found in re.finditer(kind, text, re.DOTALL)
        ]
    for first, words in parts:
        yield from enumerate(words.splitlines(), first)


def test_comments_name_who_acts() -> None:
    """They name the task, process or user that acts, and use the usual terms."""
    odd = re.compile(
        r"\b(?:somebody|nobody|whoever|anew|tell whether|looks at|looked at|has it that"
        r"|all the same|(?:is|are|was|were|be|been) told"
        r"|tells (?:of|which|how|why|that)|who (?:waits|asks|calls|writes|reads))\b",
        re.IGNORECASE,
    )
    found = [
        f"{name}:{number}: {words[0]}"
        for path in tracked()
        if (name := path.relative_to(ROOT).as_posix()).startswith("pbonet/")
        and path.suffix in {".py", ".pyi", ".pyx", ".pxd", ".pxi", ".h"}
        for number, line in comments(path)
        if (words := odd.search(line))
    ]
    assert found == []


def test_functions_are_named_by_what_they_do() -> None:
    """`look`, `tell` and `heard` say neither what is read nor who receives what."""
    odd = re.compile(
        r"^\s*(?:async )?def _?(?:look|tell|heard|told|hear|glance)(?:_\w+)?\("
    )
    found = [
        f"{name}:{number}: {line.strip()}"
        for path in tracked()
        if (name := path.relative_to(ROOT).as_posix()).startswith("pbonet/")
        and path.suffix == ".py"
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if odd.search(line) and line.strip() != "def tell(self) -> int:"  # as a file's
    ]
    assert found == []


def test_no_merge_was_left_halfway() -> None:
    mark = re.compile(rf"^({'<' * 7}|{'>' * 7}) ", re.MULTILINE)
    found = [
        str(path.relative_to(ROOT))
        for path in tracked()
        if path.suffix in CODE | {".md", ".toml", ".pxi", ".rmod", ".job"}
        and mark.search(path.read_text())
    ]
    assert found == []


def test_pages_hold_nothing_that_only_sphinx_understands() -> None:
    """They are read on GitHub, too, where a role or a label is raw text."""
    raw = re.compile(r"\{(doc|ref|term|numref)\}`|^\([\w-]+\)=$", re.MULTILINE)
    found = [
        f"{path.relative_to(ROOT)}: {one[0]}"
        for path in tracked()
        if path.suffix == ".md"
        for one in raw.finditer(path.read_text())
    ]
    assert found == [], "write [text](page.md), which Sphinx follows, too"


def test_the_product_imports_no_oracle() -> None:
    oracles = {path.stem for path in (ROOT / "tests" / "oracles").iterdir()}
    assert {"plain_dispatcher", "plain_table", "reference"} <= oracles
    imported = re.compile(r"^\s*(?:from|import)\s+(?:[.\w]*\.)?(\w+)", re.MULTILINE)
    found = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in (
            *(ROOT / "pbonet").rglob("*.py"),
            *(ROOT / "examples").rglob("*.py"),
        )
        for name in imported.findall(path.read_text())
        if name in oracles
    }
    assert found == set()
