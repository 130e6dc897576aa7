"""Drake: the same law many times, as leaf systems of one diagram, in Python."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.rivals.rival import load

if TYPE_CHECKING:
    from collections.abc import Callable

PACKAGE = "drake"
PERIOD = 0.001


def chain(count: int, width: int) -> Callable[[], object]:
    """Return a step of a diagram of that many systems, each after the other.

    A system has a discrete state that is renewed once in a period, and puts it out.
    """
    framework = load("pydrake.systems.framework")
    primitives = load("pydrake.systems.primitives")
    simulator = load("pydrake.systems.analysis").Simulator

    def make() -> Any:  # noqa: ANN401 - Drake need not be installed
        system = framework.LeafSystem()
        port = system.DeclareVectorInputPort("x", width)
        state = system.DeclareDiscreteState(width)

        def renew(context: Any, discrete: Any) -> None:  # noqa: ANN401
            y = context.get_discrete_state_vector().value()
            discrete.set_value(y + 0.1 * (port.Eval(context) - y))

        system.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, renew)
        system.DeclareStateOutputPort("y", state)
        return system

    builder = framework.DiagramBuilder()
    source = builder.AddSystem(primitives.ConstantVectorSource(np.ones(width)))
    for _ in range(count):
        system = builder.AddSystem(make())
        builder.Connect(source.get_output_port(), system.get_input_port())
        source = system
    run = simulator(builder.Build())
    run.Initialize()
    context = run.get_context()

    def step() -> None:
        run.AdvanceTo(context.get_time() + PERIOD)

    return step
