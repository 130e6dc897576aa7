"""Devices that a task names: its RTPU has them, else the change is refused."""

import pytest
from msgspec import structs
from verify_parts import configuration, module, task

from pbonet.analysis import legality
from pbonet.config import Place
from pbonet.config.model import LocalLine
from pbonet.pbo import ParamInfo

HAVE = {
    "arm0": {"device": ["dac0", "adc1"]},
    "arm1": {"device": ["adc0"]},
    "old": {},
}
DEVICE = ParamInfo(
    name="device",
    type="str",
    unit="none",
    doc="",
    required=False,
    default="adc0",
    names="device",
)


def reads(rtpu: str, name: str = "", *, job: int = 0) -> legality.Task:
    """Return a task with a device; its default is adc0."""
    line = {"DEVICE": LocalLine((name,), Place("reads.rmod", 9))} if name else {}
    info = structs.replace(module(), params=(DEVICE,))
    made = task("reads", info=info, rtpu=rtpu, local=line)
    places = {"TASK": Place("arm.job", job)} if job else {}
    return structs.replace(made, job_places=places)


def problems(change: legality.Change, *standing: legality.Task):
    now = structs.replace(configuration(*standing), names=HAVE)
    found = legality.judge(now, change).problems
    return [one for one in found if one.code is legality.Code.NOT_ON_RTPU]


def test_a_device_of_another_machine_names_that_machine() -> None:
    (one,) = problems(legality.job([reads("arm0", "adc0", job=4)]))
    assert one.severity is legality.Severity.REFUSE
    assert legality.as_text(one) == (
        "arm.job:4:1: arm0 has no device adc0, which reads opens (expected a device of "
        "arm0: adc1 dac0, got adc0 (reads.rmod:9:1)); adc0 stands on arm1; put the "
        "task there: TASK reads arm1"
    )


def test_a_device_that_nobody_has_names_similar_ones() -> None:
    (one,) = problems(legality.spawn(reads("arm1", "adc2")))
    assert one.where == "reads.rmod:9:1"
    assert one.severity is legality.Severity.REFUSE
    assert one.remedy.startswith("no RTPU of the subsystem has it: write [device.adc2]")
    assert "adc1 (on arm0)" in one.remedy
    assert "adc0 (on arm1)" in one.remedy


@pytest.mark.parametrize(
    "there",
    [
        reads("arm1"),
        reads("arm1", "ADC0".lower()),
        reads("arm0", "dac0"),
        reads("old"),
        reads("unknown"),
        task("plain", rtpu="arm0"),
        task("far", rtpu="arm0", info=None),
    ],
    ids=["default", "its own", "another", "older agent", "no agent", "none", "no code"],
)
def test_other_tasks_are_not_refused(there: legality.Task) -> None:
    assert not problems(legality.job([there]))


def test_a_default_counts_and_a_task_that_stands_has_opened_its_device() -> None:
    (one,) = problems(legality.job([reads("arm0")]))
    assert "adc0 (the default of device)" in one.got
    assert not problems(legality.job([reads("arm0")]), reads("arm0"))


def test_a_task_without_an_rtpu_goes_to_the_one_that_has_its_device() -> None:
    asked = reads("", "adc0")
    wanted = legality.named_things(asked.rmod, asked.info)
    assert legality.only_home(wanted, [*HAVE], HAVE) == "arm1"
    assert not legality.only_home(wanted, ["arm0", "old"], HAVE)
    assert not legality.only_home([], [*HAVE], HAVE)
