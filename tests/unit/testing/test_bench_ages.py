"""A bench follows the rules of old inputs that real tasks follow."""

import math
from typing import Annotated as A

import pytest

from pbonet import InVar, OutVar, PortBasedObject, State
from pbonet.errors import DeclarationError
from pbonet.testing import Bench


class Robot(PortBasedObject):
    """Do what is told."""

    u: A[float, InVar("U", "1", "N", "force", max_age=0.05, stale="stable")]
    ref: A[float, InVar("REF", "1", "N", "any age will do")]
    y: A[float, OutVar("Y", "1", "N", "force", safe=-2.0)]

    def cycle(self, dt: float) -> None:  # noqa: ARG002
        self.y = self.u

    def stable(self, dt: float) -> None:  # noqa: ARG002
        self.y = -1.0


def bench(**more) -> Bench[Robot]:
    made = Bench(Robot, **more)
    made.inputs.u = 5.0
    made.on()
    made.step()
    assert made.outputs.y == 5.0
    return made


@pytest.mark.parametrize(
    ("action", "y"), [("", -1.0), ("hold", 5.0), ("safe", -2.0), ("stable", -1.0)]
)
def test_the_action_runs_until_inputs_are_fresh_for_two_cycles(action, y) -> None:
    robot = bench(on_stale=action)
    robot.inputs.u = 6.0
    robot.ages["u"] = 0.06
    robot.step(n=3)
    assert robot.outputs.y == y
    robot.ages["u"] = 0.0
    seen = []
    for _ in range(4):
        robot.step()
        seen.append(robot.outputs.y)
    assert seen == [y, y, 6.0, 6.0]


def test_a_declared_time_passes_first() -> None:
    robot = bench(settle=0.05)
    robot.ages["u"] = math.inf
    robot.step()
    del robot.ages["u"]
    robot.step(n=5)
    assert robot.outputs.y == -1.0
    robot.step()
    assert robot.outputs.y == 5.0


def test_an_error_names_the_input() -> None:
    robot = bench(on_stale="error")
    robot.ages["u"] = 0.2
    with pytest.raises(
        Exception, match=r"the input U is too old .*at most 0.05 s, got"
    ):
        robot.step()
    assert robot.state is State.ERROR


def test_outputs_have_the_age_of_the_input_that_has_a_limit() -> None:
    robot = bench()
    robot.ages["u"] = 0.03
    robot.step()
    assert robot.output_age == pytest.approx(0.03)
    assert robot.task.age("u") == pytest.approx(0.03)
    robot.ages["u"] = 0.3
    robot.step()
    assert robot.output_age == 0.0, "what stable writes is new"


def test_a_critical_task_without_stable_writes_its_safe_values() -> None:
    class Safe(PortBasedObject):
        "Safe."

        y: A[float, OutVar("Y", "1", "N", "force", safe=-2.0)]

        def cycle(self, dt: float) -> None:  # noqa: ARG002
            self.y = 1.0

    with Bench(Safe, critical=True) as made:
        made.on()
        made.step()
        made.illegal = True
        made.step()
        assert made.outputs.y == -2.0


def test_options_that_do_not_fit_are_refused_at_once() -> None:
    with pytest.raises(DeclarationError, match="Y is new information and Z is not"):

        class Mixed(PortBasedObject):
            "Mixed."

            y: A[float, OutVar("Y", "1", "N", "force", new=True)]
            z: A[float, OutVar("Z", "1", "N", "force")]

            def cycle(self, dt: float) -> None: ...

    with pytest.raises(DeclarationError, match="needs a safe value of Y"):

        class Unsafe(PortBasedObject):
            "Unsafe."

            x: A[float, InVar("X", "1", "N", "force", max_age=1.0, stale="safe")]
            y: A[float, OutVar("Y", "1", "N", "force")]

            def cycle(self, dt: float) -> None: ...
