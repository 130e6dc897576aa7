"""Which tasks of a list can be called from another RTPU by those that they follow."""

from __future__ import annotations

import pytest
from nodekit import rmod

from pbonet.config import parse_rmod
from pbonet.master.configuration.subsystem_files import RmodSource
from pbonet.master.configuration.task_model import Member, TaskModel
from pbonet.master.subsystem import signal_list_split
from pbonet.pbo import State

TASKS = {
    "a": ("arm0", "Y0", State.ON),
    "a2": ("arm0", "Y1", State.ON),
    "c": ("arm1", "Y1", State.ON),
    "b": ("arm1", "Y0", State.OFF),
    "d": ("arm1", "Y1", State.OFF),
    "near": ("arm0", "Y0", State.OFF),
    "both": ("arm1", "Y0 Y1", State.OFF),
    "e": ("arm2", "Y1", State.ON),
    "f": ("arm0", "Y2", State.ON),
    "all": ("arm1", "Y0 Y1", State.OFF),
}
"""RTPU, outputs and state of each."""


@pytest.fixture
def model():
    made = TaskModel()
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
    ("a:off c:off both:on", {"both": ["a", "c"]}, "another one's, and its own"),
    ("a:off e:off both:on", {"both": ["a", "e"]}, "two of two RTPUs"),
    ("a:off d:off a2:off both:on", {}, "not side by side"),
    ("a:off b:on near:on", {"b": ["a"], "near": ["a"]}, "one is near, and shares it"),
    ("a:off b:on d:off a2:off all:on", {}, "it shares it with one that is left out"),
    ("a:off b:on a2:off d:on", {"b": ["a"], "d": ["a2"]}, "two pairs"),
    ("a:off b:reinit b:on", {}, "it gets another signal before"),
    ("d:off d:on", {}, "itself"),
    ("b:on a:off", {}, "in the wrong order"),
    ("near:off b:on", {}, "its predecessor is OFF already"),
]
STEPS = [
    ("a:off near:on b:on", "arm0 a near; arm1 b", "cut where the RTPU changes"),
    ("a:off c:off both:on", "arm0 a arm1 c; arm1 both", "for one heir together"),
    ("a:off e:off a2:off all:on", "arm0 a a2 arm2 e; arm1 all", "not in turns"),
    ("a:off b:on e:off d:on", "arm0 a; arm1 b; arm2 e; arm1 d", "each for its own"),
    ("f:off a:off c:off both:on d:on", "arm0 f; arm0 a arm1 c; arm1 both d", "no more"),
    ("a:off e:off both:on b:on", "arm0 a arm2 e; arm1 both b", "two heirs share"),
]


@pytest.mark.parametrize(("words", "found", "why"), CASES)
def test_who_is_called(model, words, found, why):
    items = [tuple(word.split(":")) for word in words.split()]
    assert signal_list_split.across(model, items) == found, why


@pytest.mark.parametrize(("words", "found", "why"), STEPS)
def test_what_is_sent_at_once(model, words, found, why):
    items = [tuple(word.split(":")) for word in words.split()]
    steps = signal_list_split.steps(
        model, items, signal_list_split.across(model, items)
    )
    said = [
        " ".join(
            " ".join([rtpu, *(task for task, _ in part)]) for rtpu, part in p.items()
        )
        for p in steps
    ]
    assert "; ".join(said) == found, why
