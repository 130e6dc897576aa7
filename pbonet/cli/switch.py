"""``pbonet switch``, made of the command table."""

from pbonet.cli.table import verb

command = verb("switch")
