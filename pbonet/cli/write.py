"""``pbonet write``, made of the command table."""

from .table import verb

command = verb("write")
