"""What a log carries: files of one name and other content, agent.toml, commands."""

from __future__ import annotations

import msgspec
import pytest

from pbonet.config import Entry, agent_text, parse_agent
from pbonet.config.model import AgentConfig
from pbonet.log import Attached, Log, LogWriter, RunAbout
from pbonet.log.records import free_name
from pbonet.log.rewrite import merge
from pbonet.node.wire.command_record import LARGEST, command
from pbonet.xm.net import messages as m


def write(path, *files, **about):
    named = {"run": "r", "job": "j", "subsystem": "s", "domain": "d", "rtpu": "a"}
    writer = LogWriter(path, RunAbout(**(named | about)))
    for name, text in files:
        writer.attach(Attached(name, text.encode()))
    writer.close()


def test_files_of_one_name_are_told_apart(tmp_path) -> None:
    same = [("a.rmod", "1"), ("a.rmod", "1"), ("a.rmod", "2"), ("a.rmod", "1")]
    write(tmp_path / "a.mcap", *same, ("LICENSE", "x"), ("LICENSE", "y"))
    write(tmp_path / "b.mcap", ("a.rmod", "3"), ("a.rmod", "2"), rtpu="b")
    found = {name: one.data.decode() for name, one in Log(tmp_path).attached.items()}
    merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "both.mcap")
    both = Log(tmp_path / "both.mcap").attached
    assert {name: one.data.decode() for name, one in both.items()} == found
    assert found == {
        "a.rmod": "1",
        "a-2.rmod": "2",
        "a-3.rmod": "3",
        "LICENSE": "x",
        "LICENSE-2": "y",
    }


def test_a_free_name_stays_when_it_is_of_the_same_content() -> None:
    assert free_name("a.b", 1, {}) == "a.b"
    assert free_name("a.b", 1, {"a.b": 1}) == "a.b"
    assert free_name("a.b", 1, {"a.b": 2, "a-2.b": 1}) == "a-2.b"
    assert free_name("a.b", 1, {"a.b": 2, "a-2.b": 3}) == "a-3.b"


@pytest.mark.parametrize(
    "config",
    [
        AgentConfig(),
        AgentConfig(
            name="arm0",
            core=1,
            listen=("tcp/127.0.0.1:7447",),
            libraries=('a "quoted" folder', "b\\c"),
            keys="anna",
            runs_mb=12.5,
            insecure=True,
            events={"queue": "a/key"},
        ),
        AgentConfig(
            name="arm0",
            device={
                "line": Entry(
                    driver="serial",
                    address="/dev/ttyUSB0",
                    settings={"baud": 19200, "map": [{"at": 1.5, "names": ["a", "b"]}]},
                ),
                "other": Entry(driver="their.package:Driver", address="x"),
                "line-2": Entry(driver="file", address="/dev/mem", first=2, ports=8),
            },
        ),
    ],
)
def test_what_an_agent_goes_by_is_read_back(config) -> None:
    assert parse_agent(agent_text(config)) == config


def told(request, answer):
    return msgspec.json.decode(
        command(request, msgspec.msgpack.encode(answer), 1, 2).data
    )


def test_long_texts_and_answers_are_cut_in_a_command() -> None:
    text = "x" * 5000
    who = {"id": "1", "client": "c", "subsystem": "s"}
    request = m.Spawn(**who, task="t", rmod=text, rmod_name="t")
    found = told(request, m.Answer(id="1", ok=True, result=["y" * 200] * 1000))
    assert found["op"] == "spawn"
    assert found["asked"]["rmod"].startswith("x" * 60 + "... (5000 characters, sha256 ")
    assert found["asked"]["task"] == "t"
    assert found["result"].endswith(" bytes)")
    found = told(request, m.Answer(id="1", ok=True, result=list(range(100))))
    assert found["result"][-1] == "... (36 more)"
    assert len(msgspec.json.encode(found)) < 3 * LARGEST
    assert (found["client"], found["begun_ns"], found["ended_ns"]) == ("c", 1, 2)
