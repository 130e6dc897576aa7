"""Commands to a subsystem are in its log, with their answers and its files."""

from __future__ import annotations

import pytest
from adding_module import ADDS
from log_of_real_tasks import TEXT, begin, end

from pbonet.config import parse_agent
from pbonet.errors import PbonetError
from pbonet.xm.net import messages as m


def test_every_command_and_its_answer_are_on_record(nodes):
    nodes.write_module("adds", ADDS)
    nodes.agent_process("arm0")
    line = nodes.master("arm0", "arm")
    path = begin(line, files={"arm.sbs": "SUBSYSTEM arm"})
    line.wait_cycles("b", 5)
    line.ask(m.Write(name="X", values=[0.25, -3.0]), m.VarValue)
    with pytest.raises(PbonetError) as refused:
        line.on("nobody")
    line.off("a")
    line.kill("a")
    text = TEXT.format(z="X", y="Y0").replace("gain 0.75", "gain 0.5")
    line.spawn("a", "adds", text=text)
    line.on("a")
    log = end(line, path)
    found = log.commands()
    ops = [one["op"] for one in found]
    first = ["claim", "claim", "record", "spawn", "spawn", "control", "control"]
    assert ops[:7] == first, "what came before the log began is in it, too"
    assert not {"status", "hello", "events", "get"} & set(ops), (
        "who looks commands nothing"
    )
    assert {one["client"] for one in found} == {line.name}
    assert all(one["begun_ns"] <= one["ended_ns"] for one in found)
    times = [one["ended_ns"] for one in found]
    assert times == sorted(times)
    write = found[ops.index("write")]
    assert write["asked"] == {"name": "X", "values": [0.25, -3.0]}
    assert write["ok"]
    (failed,) = [one for one in found if not one["ok"]]
    assert failed["asked"]["task"] == "nobody"
    assert failed["error"]["code"] == refused.value.code
    told = found[ops.index("spawn")]["asked"]["rmod"]
    assert told.startswith("MODULE adds")

    # Both RMODs of one name are there, and what the machine goes by.
    assert log.attached["a.rmod"].data.decode() == TEXT.format(z="X", y="Y0")
    assert log.attached["a-2.rmod"].data.decode() == text
    config = parse_agent(log.attached["agent.toml"].data)
    assert (config.name, config.domain) == ("arm0", nodes.domain)


def test_the_hash_covers_what_the_machine_says_and_the_rmods(nodes):
    nodes.write_module("adds", ADDS)
    hashes = set()
    for name, more, files in (
        ("arm0", {}, {"a.rmod": "one"}),
        ("arm1", {}, {"a.rmod": "two"}),
        ("arm2", {"log_mb": 7.0}, {"a.rmod": "two"}),
    ):
        nodes.agent_process(name, **more)
        line = nodes.master(name, f"s{name}")
        path = begin(line, files=files, run=f"r{name}")
        log = end(line, path)
        hashes.add(log.about["config_hash"])
    assert len(hashes) == 3
