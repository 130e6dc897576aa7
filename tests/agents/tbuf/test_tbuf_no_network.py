"""Tasks that have an end of a link have nothing of the network in their processes."""

from contextlib import suppress
from pathlib import Path

from pbonet.xm.net import messages as m

RMOD = """
MODULE {module}
DESC an end of a link
SVARALIAS Z={variable}
INCONST none
OUTCONST none
INVAR {takes}
OUTVAR {gives}
TASKTYPE periodic
FREQ 200
LOCAL
LINK arm:there
EOF
"""


def libraries(pid):
    """Return the names of the files that a process has mapped as code."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return {Path(line.split(None, 5)[-1]).name for line in lines if "r-xp" in line}


def internet_sockets(pid):
    """Return the sockets of a process that reach beyond this machine."""
    inodes = {
        line.split()[9]
        for name in ("tcp", "tcp6", "udp", "udp6")
        for line in Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:]
    }
    held = set()
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):  # it was closed meanwhile
            held.add(str(one.readlink()))
    return {one for one in held if one.startswith("socket:") and one[8:-1] in inodes}


def of_network(names):
    return {name for name in names if "zenoh" in name}


def test_no_task_with_an_end_of_a_link_has_anything_of_the_network(nodes):
    agent = nodes.agent_process("arm0", listen=("tcp/127.0.0.1:0",))
    arm = nodes.master("arm0", "arm")
    send = RMOD.format(module="tbuf_send", variable="X", takes="Z", gives="none")
    receive = RMOD.format(module="tbuf_receive", variable="Y0", takes="none", gives="Z")
    arm.spawn("send", "tbuf_send", text=send)
    arm.spawn("receive", "tbuf_receive", text=receive)
    for task in ("receive", "send"):
        arm.on(task)
    for task in ("send", "receive"):
        pid = arm.wait_cycles(task, 20).tid
        mapped = libraries(pid)
        assert any("_tbuf" in name for name in mapped), "it is a task with a link"
        assert of_network(mapped) == set()
        assert internet_sockets(pid) == set()
    assert arm.value("Y0").values == [1.0, 2.0], "the link works"
    (link,) = arm.ask(m.Status(), m.RtpuStatus).tbufs
    assert link.name == "arm:there"
    assert of_network(libraries(agent.pid)), "the agent has, so it would be seen"
    assert internet_sockets(agent.pid)
