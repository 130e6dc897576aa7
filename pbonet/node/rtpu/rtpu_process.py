"""The RTPU process: no network, little code, alive when its agent is not.

It starts as one thread that has loaded what tasks need, and forks the fork server. What
only the SBS server needs is loaded after that, so that no task has it in its memory.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import msgspec

from pbonet.errors import PbonetError
from pbonet.lazy import load_without
from pbonet.node.task import fork_server
from pbonet.node.wire import rtpu_messages

if TYPE_CHECKING:
    from collections.abc import Callable
    from socket import socket


def main(argv: list[str]) -> int:
    """Run the RTPU process that the first argument describes, as JSON."""
    config = msgspec.json.decode(argv[0], type=rtpu_messages.RtpuConfig)
    try:
        forks = fork_server.beside(config.core, close=config.ready_fd)
        return load_rest()(config, *forks)
    except PbonetError as error:
        rtpu_messages.report_ready(config.ready_fd, error)
        print(error, file=sys.stderr)  # noqa: T201 - the log in the runtime folder
        return 1


def load_rest() -> Callable[[rtpu_messages.RtpuConfig, int, socket], int]:
    """Load the SBS server, and asyncio without the encryption of networks.

    Returns:
        Its `main`.
    """
    load_without("ssl", "asyncio")
    from . import sbs_server

    return sbs_server.main


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
