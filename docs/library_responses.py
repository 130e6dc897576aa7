"""Draw the responses of the library's modules.

``docs/conf.py`` calls `draw` when the documentation is built; by hand it is
``python docs/library_responses.py FOLDER``. Each module runs on a bench as its
``.rmod`` or an example configures it, so the pictures are of the code. Of a module with
one input and one output the step response is drawn, and the frequency response if it is
linear; of others how the outputs move after a step of one input, or after ``on``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from figures import new_figure, save

from pbonet.config import Library
from pbonet.ports import Kind
from pbonet.testing import Bench

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pbonet.config.library import LoadedModule
    from pbonet.ports import Port

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent))
from benchmarks.library_benches import (  # noqa: E402 - found there
    bench as usual_bench,
    surroundings,
)

CYCLES = 400
SHORT = 200
"""Cycles of a module with several inputs or outputs."""
STEP = 0.05
"""How far one of several inputs steps, in its unit; the place of a pose, in metres."""
STILL = 1e-12
"""An output that moves no further does not respond."""
GOALS = "_DES", "_REF", "_CMD"
"""Ends of the names of variables that are stepped before others."""
QUIET = {"constant", "deadman", "ft300_sim", "join_min"}
"""Modules whose outputs stay while nobody changes a parameter or holds a button."""
MOST_SHOWN = 4
"""Outputs in one picture."""
OUTSIDE = {"link", "device", "processor", "spp", "library"}
"""Parameters of modules that ask something outside."""
_BEFORE = 5
"""Cycles before the step."""
_SETTLED = 1e-3
"""An impulse response that has ended is below this part of its maximum."""


class Response(NamedTuple):
    """How a module answers a unit step, and what follows from that."""

    time: NDArray[np.float64]
    """Seconds since the step."""
    output: NDArray[np.float64]
    """One element of the output, without that at no input."""
    freq: NDArray[np.float64]
    """Hz; empty where the law is not linear, or its impulse response does not end."""
    gain: NDArray[np.float64]


class Reaction(NamedTuple):
    """How outputs of a module with several ports move."""

    time: NDArray[np.float64]
    """Seconds since the step, or since ``on``."""
    outputs: dict[str, NDArray[np.float64]]
    """The element of each variable that moves most."""
    cause: str
    """The input that steps, and by how much; empty where there is none."""


def reacts(module: LoadedModule) -> bool:
    """Return whether a module that does not `respond` has a law of its own.

    One over a device, a link or a processor has its answer from there.
    """
    _, outputs = _ports(module)
    outside = any(param.names or param.name in OUTSIDE for param in module.info.params)
    return (
        not responds(module)
        and not outside
        and not module.info.name.startswith("mav_")
        and module.info.name not in QUIET
        and any(port.type.startswith("float") for port in outputs)
    )


def reaction(module: LoadedModule, folder: Path) -> Reaction:
    """Return how the outputs of a module move after a step of one input.

    Args:
        module: One that `reacts`.
        folder: That of `surroundings`.

    Raises:
        ValueError: Nothing moves.
    """
    inputs, _ = _ports(module)
    floats = [port.name for port in inputs if port.type.startswith("float")]
    floats.sort(key=lambda name: not name.endswith(GOALS))
    for stepped in floats or [""]:
        found = _after_step(module, folder, stepped)
        if found.outputs:
            return found
    msg = f"{module.info.name} does not react; name it in QUIET"
    raise ValueError(msg)


def _after_step(module: LoadedModule, folder: Path, stepped: str) -> Reaction:
    """Return how the outputs of a module move after a step of this input."""
    made = usual_bench(module, folder)
    _, outputs = _ports(module)
    names = [port.name for port in outputs if port.type.startswith("float")]
    seen: dict[str, list[NDArray[np.float64]]] = {name: [] for name in names}
    for cycle in range(_BEFORE + SHORT):
        if cycle == _BEFORE and stepped:
            made[stepped] = _stepped(np.array(made[stepped], dtype=np.float64))
        made.step()
        for name in names:
            seen[name].append(np.ravel(np.array(made[name], dtype=np.float64)))
    made.kill()
    rows = {name: np.array(values) for name, values in seen.items()}
    most = {name: int(np.argmax(np.ptp(one, axis=0))) for name, one in rows.items()}
    moved = {name: one[:, most[name]] for name, one in rows.items()}
    time = (np.arange(_BEFORE + SHORT) - _BEFORE * bool(stepped)) / made.task.freq
    return Reaction(
        time,
        {name: one for name, one in moved.items() if np.ptp(one) > STILL},
        f"{stepped} by {STEP:g}" if stepped else "",
    )


def _stepped(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an input after its step: all elements, and of a pose its x."""
    value[(0, 3) if value.shape == (3, 4) else ...] += STEP
    return value


def responds(module: LoadedModule) -> bool:
    """Return whether a module has one input and one output, of one shape.

    A module that needs a constant beside the sizes, such as a robot's geometry, or a
    robot's file, and one over a device, has no response of its own.
    """
    inputs, outputs = _ports(module)
    sizes = {dim for port in module.info.ports for dim in port.shape}
    consts = [port for port in module.info.ports if port.kind is Kind.INCONST]
    return (
        len(inputs) == len(outputs) == 1
        and sizes.issuperset(port.attr for port in consts)
        and not any(param.name == "urdf" or param.names for param in module.info.params)
        and inputs[0].shape == outputs[0].shape
        and {inputs[0].type, outputs[0].type} <= {"float", "float64", "float64[]"}
    )


def _ports(module: LoadedModule) -> tuple[list[Port], list[Port]]:
    ports = module.info.ports
    return (
        [port for port in ports if port.kind is Kind.INVAR],
        [port for port in ports if port.kind is Kind.OUTVAR],
    )


def response(module: LoadedModule) -> Response:
    """Return how a module answers a step of its input.

    Raises:
        PbonetError: Its RMOD does not run with three elements.
    """
    rest, one, two = (_run(module, height) for height in (0.0, 1.0, 2.0))
    hz = _bench(module).task.freq
    output = one - rest
    impulse = np.diff(output[_BEFORE - 1 :])
    linear = np.allclose(two - rest, 2 * output, rtol=1e-9, atol=1e-9)
    peak = np.max(np.abs(impulse))
    ended = np.max(np.abs(impulse[-CYCLES // 4 :])) < _SETTLED * peak
    time = (np.arange(len(output)) - _BEFORE) / hz
    if not (linear and ended):
        none = np.zeros(0)
        return Response(time, output, none, none)
    gain = np.abs(np.fft.rfft(impulse))[1:].astype(np.float64)
    freq = np.fft.rfftfreq(len(impulse), 1 / hz)[1:]
    return Response(time, output, freq.astype(np.float64), gain)


def _run(module: LoadedModule, height: float) -> NDArray[np.float64]:
    """Return the output while the input steps from 0 to a height."""
    (given,), (taken,) = _ports(module)
    bench = _bench(module)
    bench.on()
    seen: list[float] = []
    for cycle in range(_BEFORE + CYCLES):
        if cycle == _BEFORE:
            bench[given.name] = np.full(np.shape(bench[given.name]), height)
        bench.step()
        seen.append(float(np.ravel(bench[taken.name])[0]))
    return np.array(seen)


def _bench(module: LoadedModule) -> Bench[Any]:
    sizes = {dim for port in module.info.ports for dim in port.shape}
    return Bench.of(
        module.path.with_suffix(".rmod"),
        {dim: 3 for dim in sizes if isinstance(dim, str)},
    )


def draw(folder: Path) -> None:
    """Write a picture of every module that responds into `folder`, as SVG."""
    folder.mkdir(parents=True, exist_ok=True)
    library = Library()
    with surroundings() as files:
        for name, path in library.files().items():
            if not path.is_relative_to(HERE.parent):
                continue
            module = library.load(name)
            if responds(module):
                _picture(response(module), folder / f"response-{name}.svg")
            elif reacts(module):
                found = reaction(module, files)
                _picture_of_reaction(found, folder / f"response-{name}.svg")


def _picture(found: Response, path: Path) -> None:
    columns = 2 if len(found.freq) else 1
    figure, axes = new_figure(1, columns, height=2.4)
    step, *rest = np.ravel(axes)
    step.step(1e3 * found.time, found.output, where="post", color="#2f6f9f")
    step.set_xlabel("time since a step of 1 at the input (ms)")
    step.set_ylabel("output")
    step.grid(visible=True, alpha=0.3)
    for axis in rest:
        level = 20 * np.log10(np.maximum(found.gain, 1e-6))
        axis.semilogx(found.freq, level, color="#2f6f9f")
        axis.set_xlabel("frequency (Hz)")
        axis.set_ylabel("gain (dB)")
        axis.grid(visible=True, alpha=0.3)
    save(figure, path)


def _picture_of_reaction(found: Reaction, path: Path) -> None:
    shown = list(found.outputs.items())[:MOST_SHOWN]
    figure, axes = new_figure(1, len(shown), height=2.4)
    cause = f"a step of {found.cause}" if found.cause else "it was turned on"
    panels: list[Any] = np.ravel(axes).tolist()
    for axis, (name, values) in zip(panels, shown, strict=True):
        axis.step(1e3 * found.time, values, where="post", color="#2f6f9f")
        axis.set_title(name, fontsize=9)
        axis.grid(visible=True, alpha=0.3)
    figure.supxlabel(f"time since {cause} (ms)", fontsize=9)
    save(figure, path)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
