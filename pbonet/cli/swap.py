"""``pbonet swap``, made of the command table."""

from pbonet.cli.table import verb

command = verb("swap")
