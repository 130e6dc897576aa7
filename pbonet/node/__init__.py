"""The machine's side: agent, RTPU process, fork server, tasks (Stewart 1994, 4.5, 6).

The agent has the network and no real time; the RTPU process has the dispatcher and no
network; each task is a process of its own. docs/node.md draws them.
"""

from pbonet.lazy import load_without

load_without("typing_extensions", "msgspec")  # it is as `typing` has it, and slow
