"""Which tasks of a list can be called from another RTPU by those that they follow."""

from __future__ import annotations

import pytest
from nodekit import rmod

from pbonet.config import parse_rmod
from pbonet.master import lists
from pbonet.master.files import RmodSource
from pbonet.master.picture import Member, Picture
from pbonet.pbo import State

TASKS = {
    "a": ("arm0", "Y0", State.ON),
    "a2": ("arm0", "Y1", State.ON),
    "c": ("arm1", "Y1", State.ON),
    "b": ("arm1", "Y0", State.OFF),
    "d": ("arm1", "Y1", State.OFF),
    "near": ("arm0", "Y0", State.OFF),
    "both": ("arm1", "Y0 Y1", State.OFF),
}
"""RTPU, outputs and state of each."""


@pytest.fixture
def picture():
    made = Picture()
    for name, (rtpu, outputs, state) in TASKS.items():
        text = rmod("counts", "Y0").replace("SVARALIAS Y=Y0\n", "")
        text = text.replace("OUTVAR Y", f"OUTVAR {outputs}")
        source = RmodSource(parse_rmod(text, f"{name}.rmod"), text)
        made.add(Member(source=source, rtpu=rtpu, freq=200.0, state=state))
    return made


CASES = [
    ("a:off b:on", {"b": ["a"]}, "another RTPU"),
    ("a:off near:on", {}, "its own RTPU"),
    ("a:off a2:off both:on", {"both": ["a", "a2"]}, "two of one RTPU"),
    ("a:off c:off both:on", {}, "two of two RTPUs"),
    ("a:off d:off a2:off both:on", {}, "not side by side"),
    ("a:off b:on near:on", {}, "one heir is near, and shares the predecessor"),
    ("a:off b:on a2:off d:on", {"b": ["a"], "d": ["a2"]}, "two pairs"),
    ("a:off b:reinit b:on", {}, "it gets another signal before"),
    ("d:off d:on", {}, "itself"),
    ("b:on a:off", {}, "in the wrong order"),
    ("near:off b:on", {}, "its predecessor is OFF already"),
]


@pytest.mark.parametrize(("words", "found", "why"), CASES)
def test_who_is_called(picture, words, found, why):
    items = [tuple(word.split(":")) for word in words.split()]
    assert lists.across(picture, items) == found, why
