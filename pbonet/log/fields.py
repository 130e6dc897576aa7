"""Names of variables as names of fields, and back.

A field of a ``ros2msg`` schema is made of small letters, digits and single underscores,
with a letter first and no underscore last; ``Q^_MEZ`` is none. So:

* a capital letter becomes the small one, and a digit stays;
* an underscore stays before a capital letter or a digit;
* everything else becomes ``_xHH``, HH being the character's code in hexadecimal digits,
  and at the very beginning ``xHH``;
* so does what would read like that by accident: the underscore of ``A_X41``, and the X
  of ``X41`` at the beginning.

``Q_MEZ`` is ``q_mez``, and ``Q^_MEZ`` is ``q_x5e_mez``.
"""

from __future__ import annotations

import re

_PLAIN = re.compile(r"[A-Z0-9]|_(?=[A-Z0-9])(?!X[0-9A-F]{2})")
_FIRST = re.compile(r"(?!X[0-9A-F]{2})[A-Z]")
_CODE = re.compile(r"(?:^|_)x([0-9a-f]{2})")


def field_name(variable: str) -> str:
    """Return the field that stands for a variable."""
    parts = [
        char.lower()
        if (_PLAIN if at else _FIRST).match(variable, at)
        else f"{'_' if at else ''}x{ord(char):02x}"
        for at, char in enumerate(variable)
    ]
    return "".join(parts)


def variable_name(field: str) -> str:
    """Return the variable that a field stands for."""
    parts: list[str] = []
    at = 0
    for code in _CODE.finditer(field):
        parts += [field[at : code.start()].upper(), chr(int(code[1], 16))]
        at = code.end()
    return "".join([*parts, field[at:].upper()])
