"""Layout of a record as text, which is sent with the records.

The text has the format of numpy's own files, a description and a shape, so it names
every field with its type, byte order and size.
"""

from __future__ import annotations

import ast
import contextlib
from typing import TYPE_CHECKING, Any

from pbonet.errors import XmLayoutError

from ._tbuf import LONGEST_TEXT

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import DTypeLike

_NO_LAYOUT = (
    *(ValueError, TypeError, SyntaxError, OverflowError),
    *(MemoryError, RecursionError),  # raised by malicious texts
)
LARGEST = 1 << 20
"""Maximum size of a record in bytes: it is copied within a cycle."""


def _npy() -> Any:  # noqa: ANN401 - its functions have types only from numpy 2.4 on
    """Return numpy's part for files; an agent without links loads no numpy."""
    from numpy.lib import format as npy

    return npy


def describe(dtype: np.dtype[Any]) -> bytes:
    """Return the text that describes records of a type.

    Raises:
        XmLayoutError: Records of that type cannot be sent.
    """
    base, shape = dtype.subdtype or (dtype, ())
    if dtype.hasobject or not 0 < dtype.itemsize <= LARGEST:
        raise XmLayoutError(
            "records of this type cannot be sent",
            expected=f"plain numbers, 1 to {LARGEST} bytes in all",
            got=f"{dtype}, {dtype.itemsize} bytes",
            remedy="send fields of fixed size; no Python objects",
        )
    text = repr((_npy().dtype_to_descr(base), shape)).encode()
    if len(text) > LONGEST_TEXT:
        raise XmLayoutError(
            "the description of the record is too long",
            expected=f"at most {LONGEST_TEXT} bytes",
            got=f"{len(text)} bytes",
            remedy="use fewer fields, or shorter names",
        )
    return text


def parse(text: bytes) -> np.dtype[Any]:
    """Return the type that a text describes.

    Raises:
        XmLayoutError: It does not describe a type.
    """
    import numpy as np

    with contextlib.suppress(*_NO_LAYOUT):
        descr, shape = ast.literal_eval(text.decode())
        return np.dtype((_npy().descr_to_dtype(descr), tuple(shape)))
    raise XmLayoutError(
        "the description of the record is not understood",
        got=repr(text[:100]),
        remedy="run the same version of pbonet on every machine",
    )


def as_dtype(dtype: DTypeLike) -> np.dtype[Any]:
    """Return `dtype` as a numpy dtype; ``("f8", 6)`` is six numbers."""
    import numpy as np

    return np.dtype(dtype)


def same_values(one: np.dtype[Any], other: np.dtype[Any]) -> bool:
    """Return whether two types differ at most in byte order."""
    return one.newbyteorder("=") == other.newbyteorder("=")


def room(dtype: np.dtype[Any]) -> np.ndarray[Any, Any]:
    """Return zeroed memory for one record."""
    import numpy as np

    return np.zeros((), dtype)


def refuse(where: str, wanted: np.dtype[Any], got: np.dtype[Any]) -> XmLayoutError:
    """Return the error for two ends with different records."""
    return XmLayoutError(
        "the two ends of the link have different records",
        where=where,
        expected=str(wanted),
        got=str(got),
        remedy="give writer and reader the same fields and sizes",
    )
