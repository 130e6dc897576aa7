"""Names of variables as names of fields, and back.

A field of a ``ros2msg`` schema consists of lower-case letters, digits and single
underscores, with a letter first and no underscore last; ``Q^_MEZ`` is not valid. So:

* a capital letter becomes lower case, and a digit is kept;
* an underscore is kept before a capital letter or a digit;
* any other character becomes ``_xHH``, HH being its code in hexadecimal digits, and
  ``xHH`` at the beginning;
* so does a character that would look like such a code: the underscore of ``A_X41``, and
  the X of ``X41`` at the beginning;
* and the first letter of a variable that would be called as a field of every message
  (`OWN`) is: ``NUMBER`` is ``x4eumber``.

``Q_MEZ`` is ``q_mez``, and ``Q^_MEZ`` is ``q_x5e_mez``.
"""

from __future__ import annotations

import re
from typing import Final

OWN: Final = frozenset({
    *("cycle", "release_ns", "start_ns", "end_ns", "dt_ns", "cpu_ns", "register"),
    *("number", "lost", "flags", "kind", "consumed", "inputs", "heard"),
    "cycles_before",
})
"""Fields that a message of cycles has beside the variables."""
_PLAIN = re.compile(r"[A-Z0-9]|_(?=[A-Z0-9])(?!X[0-9A-F]{2})")
_FIRST = re.compile(r"(?!X[0-9A-F]{2})[A-Z]")
_CODE = re.compile(r"(?:^|_)x([0-9a-f]{2})")


def field_name(variable: str) -> str:
    """Return the field name of a variable."""
    parts = [
        char.lower()
        if (_PLAIN if at else _FIRST).match(variable, at)
        else f"{'_' if at else ''}x{ord(char):02x}"
        for at, char in enumerate(variable)
    ]
    name = "".join(parts)
    return f"x{ord(variable[0]):02x}{name[1:]}" if name in OWN else name


def variable_name(field: str) -> str:
    """Return the variable of a field name."""
    parts: list[str] = []
    at = 0
    for code in _CODE.finditer(field):
        parts += [field[at : code.start()].upper(), chr(int(code[1], 16))]
        at = code.end()
    return "".join([*parts, field[at:].upper()])
