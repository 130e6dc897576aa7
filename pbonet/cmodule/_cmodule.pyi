"""Loads shared objects of modules in C and calls their methods.

A method runs without the interpreter; what it reports is passed on when it returns.
"""

from collections.abc import Mapping
from typing import Any, Final, final

from numpy.typing import NDArray

from pbonet.pbo import Recovery, TaskContext

ABI: Final[int]
"""The number of the interface in ``pbonet.h``."""

@final
class SharedObject:
    """A shared object with a module, loaded for as long as the process lives.

    Raises:
        ModuleLoadError: It does not load, has no module, or was built for another
            pbonet.
    """

    path: str
    def __init__(self, path: str) -> None: ...
    @property
    def address(self) -> int:
        """The address of the module's description, different for each loaded file."""
    @property
    def about(self) -> dict[str, Any]:
        """Source file, description, size of the state, and class in the library."""
    @property
    def ports(self) -> list[dict[str, Any]]:
        """The rows of the port table."""
    @property
    def params(self) -> list[dict[str, Any]]:
        """The rows of the parameter table."""
    @property
    def signals(self) -> list[dict[str, Any]]:
        """The rows of the table of signals."""
    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that the module has."""

@final
class NativeState:
    """The state of one instance, with the pointers of its ports and its parameters.

    Args:
        shared: The module.
        task: The task that runs it.
        arrays: The memory of each port, by field.
        values: The value of each parameter, by field.

    Raises:
        ParameterError: A value does not fit into its field.
    """

    task: TaskContext
    def __init__(
        self,
        shared: SharedObject,
        task: TaskContext,
        arrays: Mapping[str, NDArray[Any]],
        values: Mapping[str, object],
    ) -> None: ...
    def call(self, method: str, argument: int = 0) -> object:
        """Call a method that the module has, and return its answer.

        Raises:
            TaskFailure: It failed.
        """
    def set(self, field: str, value: object) -> None:
        """Change a parameter; the old value remains if the module refuses it."""
    def timing_failure(self, kind: str) -> Recovery:
        """Call the handler of timing failures."""

@final
class NativeMethod:
    """``cycle`` or ``stable`` of an instance; the native loop calls its pointer."""

    of: NativeState
    name: str
    def __init__(self, of: NativeState, name: str) -> None: ...
    def __call__(self, dt: float) -> None:
        """Run it as from Python: on a bench, in a combination, in a replay.

        Raises:
            TaskFailure: It failed.
        """
