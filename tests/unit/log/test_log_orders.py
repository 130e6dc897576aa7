"""Commands of a log as ``pbonet log commands`` shows and chooses them."""

from __future__ import annotations

import json

import pytest
from made_logs import run

from pbonet.errors import StateError
from pbonet.log import Log, LogWriter
from pbonet.node.wire.command_record import command
from pbonet.xm.net import codec, messages as m

REFUSED = StateError("it is OFF already").to_wire()
COMMANDS = [
    (m.Claim(client="anna"), m.Claimed(epoch=1), None),
    (
        m.Spawn(client="anna", task="pid", rmod="MODULE x" * 99, rmod_name="pid.rmod"),
        None,
        None,
    ),
    (m.Control(client="anna", task="pid", signal="on"), None, None),
    (m.Control(client="bert", task="pid", signal="off"), None, REFUSED),
    (
        m.Reconfig(client="bert", items=[("pid", "off"), ("other", "on")]),
        m.Reconfigured(done=1, error=REFUSED),
        None,
    ),
    (
        m.Control(client="bert", task="other", signal="on", arg="a  b"),
        {"state": "ON", "error": "of the task, from an hour ago"},
        None,
    ),
    (m.Write(client="anna", name="Q", values=[0.1] * 9999), None, None),
    (m.Stop(client="anna"), m.Stopped(off=["pid"], killed=["pid"]), None),
]


@pytest.fixture
def path(tmp_path):
    writer = LogWriter(tmp_path / "run.mcap", run(epoch_ns=10**18))
    pack = codec.Codec().pack
    for n, (request, result, error) in enumerate(COMMANDS):
        answer = m.Answer(id="1", ok=error is None, result=result, error=error)
        told = command(request, pack(answer), n * 10**9, n * 10**9 + 1_500_000)
        writer.add_command(json.loads(told.data))
    writer.close()
    return writer.path


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ((), [0, 1, 2, 3, 4, 5, 6, 7]),
        (("--task", "pid"), [1, 2, 3, 4, 7]),
        (("--task", "other"), [4, 5, 7]),
        (("--op", "control"), [2, 3, 5]),
        (("--refused",), [3, 4]),
        (("--refused", "--task", "other", "--op", "reconfig"), [4]),
        (("--task", "nobody", "--op", "spawn"), []),
    ],
)
def test_commands_are_chosen(call, path, words, wanted) -> None:
    status, out, _ = call("log", "commands", path, *words, "--json")
    assert status == 0
    found = json.loads(out)["commands"]
    assert [one["begun_ns"] // 10**9 for one in found] == wanted
    walls = [one["wall"] for one in found]
    assert walls == pytest.approx([1e9 + n + 0.0015 for n in wanted], abs=1e-6)
    assert len(call("log", "commands", path, *words)[1].splitlines()) == len(wanted)


def test_a_line_says_who_asked_for_what_and_what_came_of_it(call, path) -> None:
    lines = call("log", "commands", path)[1].splitlines()
    assert [line.split(" ", 1)[1] for line in lines[2:6]] == [
        "arm0 anna control task=pid signal=on timeout=5.0: done in 1.5 ms",
        "arm0 bert control task=pid signal=off timeout=5.0: "
        "refused, STATE: it is OFF already",
        'arm0 bert reconfig items=[["pid","off"],["other","on"]] timeout=5.0: '
        "refused, STATE: it is OFF already",
        "arm0 bert control task=other signal=on arg=a b timeout=5.0: done in 1.5 ms",
    ]
    assert len(lines[1]) < 200, "a long text is cut"


def test_a_log_of_an_older_version_says_not_of_which_rtpu(tmp_path) -> None:
    writer = LogWriter(tmp_path / "run.mcap", run(epoch_ns=10**18))
    writer._put(
        writer._channel("commands", "pbonet.Command", {"type": "object"}),
        10**18 + 5 * 10**9,
        b'{"op": "stop", "ended_ns": 5}',
        10**18 + 5 * 10**9,
    )
    writer.close()
    (found,) = Log(tmp_path).commands()
    wall = pytest.approx(1e9 + 5)
    assert found == {"rtpu": "", "wall": wall, "op": "stop", "ended_ns": 5}
