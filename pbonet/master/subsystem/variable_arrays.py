"""Values of variables as numpy arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from pbonet.config import Variable


def array_of(values: Sequence[float] | bytes, variable: Variable) -> NDArray[Any]:
    """Return the values that an RTPU has sent, with the type of the table.

    Args:
        values: Its elements; of structs their bytes.
        variable: The variable.

    Returns:
        Shape ``(n,)``, or ``()`` of a variable with one element.
    """
    dtype = np.dtype(variable.dtype)
    if isinstance(values, bytes):
        made = np.frombuffer(values, dtype).copy()
    else:
        made = np.array(values, dtype)
    return made.reshape(()) if variable.nelem == 1 else made
