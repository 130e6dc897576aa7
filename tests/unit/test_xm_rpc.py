"""Errors of agents: where they are said to be."""

from __future__ import annotations

import pytest

from pbonet.errors import NodeError
from pbonet.xm.rpc import placed


@pytest.mark.parametrize(
    ("where", "whole"),
    [
        ("", "arm0"),
        ("arm0", "arm0"),
        ("arm0/pid", "arm0/pid"),
        ("pid.rmod:3:1", "arm0/pid.rmod:3:1"),
        ("/lib/pid.py:12", "arm0:/lib/pid.py:12"),
        ("arm0:/lib/pid.py:12", "arm0:/lib/pid.py:12"),
        ("charm0/x", "arm0/charm0/x"),
    ],
)
def test_place_of_an_error_begins_with_its_rtpu(where, whole):
    assert placed("arm0", NodeError("it failed", where=where)).where == whole
