"""``pbonet sigmask``, made of the command table."""

from .table import verb

command = verb("sigmask")
