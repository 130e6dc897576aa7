"""The page on commands says what the table and the fields say."""

from __future__ import annotations

from pathlib import Path

import pytest

from pbonet.cli import verbs
from pbonet.master.console.commands import COMMANDS
from pbonet.master.subsystem.status_fields import FIELDS

PAGE = (Path(__file__).parents[3] / "docs" / "commands.md").read_text()


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_command_is_on_the_page(command):
    assert f"| `{command.usage}` | {command.help} |\n" in PAGE


def test_page_has_no_command_that_is_not_there():
    rows = PAGE.split("## Commands")[1].split("## Fields")[0].splitlines()
    rows = [row for row in rows if row.startswith("| `")]
    assert len(rows) == len(COMMANDS)


@pytest.mark.parametrize("field", FIELDS, ids=lambda field: field.name)
def test_field_is_on_the_page(field):
    unit = f" {field.unit}" if field.unit else ""
    assert f"| `{field.name}` |{unit} | {field.doc} |\n" in PAGE


def test_verbs_are_on_the_page():
    for verb in verbs.NAMES:
        assert f"`{verb}" in PAGE or f"pbonet {verb}" in PAGE, verb
