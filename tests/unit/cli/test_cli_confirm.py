"""Questions before a take-over: --yes, a terminal, and neither."""

import io

import pytest

from pbonet.cli import options


class Terminal(io.StringIO):
    def isatty(self):
        return True


def place(**given):
    return options.TO_CHANGE.make(
        domain="d", connect=None, keys=None, library=None, **given
    )


@pytest.mark.parametrize(
    ("line", "agreed"),
    [("y\n", True), ("Yes\n", True), ("n\n", False), ("\n", False), ("", False)],
)
def test_the_question_is_asked_at_a_terminal(monkeypatch, capsys, line, agreed):
    monkeypatch.setattr("sys.stdin", Terminal(line))
    assert place(take_over=True).confirm("Take over?") is agreed
    assert capsys.readouterr().err == "Take over? [y/N] "


def test_without_a_terminal_nothing_is_asked_and_only_yes_agrees(monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert not place(take_over=True).confirm("Take over?")
    assert place(take_over=True, yes=True).confirm("Take over?")
    assert capsys.readouterr().err == ""
