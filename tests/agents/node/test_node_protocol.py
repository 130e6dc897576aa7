"""The page about the protocol: it is complete, and its program runs as it stands."""

import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import msgspec
import pytest

from pbonet.errors import PbonetError, _tree
from pbonet.xm.net import key_expressions, messages as m, run_folder

PAGE = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text()
RECORDS = [
    m.AgentInfo,
    m.LinkReport,
    m.Way,
    m.TableNews,
    m.Claimed,
    m.Recorded,
    m.TaskStatus,
    m.RtpuStatus,
    m.Reconfigured,
    m.ParamValue,
    m.VarValue,
    m.Stopped,
    m.Event,
]
NODE = Path(__file__).parents[3] / "pbonet" / "node"


def section(title):
    """Return the text of a section of the third level."""
    return re.split(r"\n##+ ", PAGE.split(f"\n### `{title}`\n")[1])[0]


def words(text):
    """Return what stands in backquotes."""
    return set(re.findall(r"`([^`\n]+)`", text))


def first_cells(text):
    """Return what stands in backquotes in the first column of the tables."""
    return words("\n".join(re.findall(r"^\|([^|]*)\|", text, re.MULTILINE)))


def tag(kind):
    return kind.__struct_config__.tag


@pytest.mark.parametrize("kind", get_args(m.AnyRequest), ids=tag)
def test_every_argument_is_on_the_page(kind):
    common = {field.name for field in msgspec.structs.fields(m.Request)}
    own = {field.name for field in msgspec.structs.fields(kind)} - common
    assert first_cells(section(tag(kind))) == own
    envelope = PAGE.split("## Requests and answers")[1].split("### Errors")[0]
    assert common <= words(envelope)


@pytest.mark.parametrize("record", RECORDS, ids=lambda one: one.__name__)
def test_every_field_of_a_record_is_on_the_page(record):
    fields = {field.name for field in msgspec.structs.fields(record)}
    found = first_cells(section(record.__name__).split("\n\n| code")[0])
    assert found == fields


def test_every_operation_on_the_page_exists():
    operations = PAGE.split("\n## Operations\n")[1].split("\n## Records\n")[0]
    listed = set(re.findall(r"^### `(\w+)`", operations, re.MULTILINE))
    assert listed == {tag(kind) for kind in get_args(m.AnyRequest)}


def test_every_error_that_an_agent_sends_is_on_the_page():
    sent = set()
    for path in [*NODE.rglob("*.py"), *NODE.parent.rglob("svar/*.py")]:
        sent |= set(re.findall(r"\b(\w+Error)\(", path.read_text()))
    codes = {kind.code for kind in _tree(PbonetError) if kind.__name__ in sent}
    table = PAGE.split("### Errors")[1].split("## Claims")[0]
    elsewhere = {"UNREACHABLE", "DUPLICATE_NAME", "SVAR_EXISTS", "PBONET"}
    assert codes - elsewhere <= words(table)


def test_every_event_code_is_on_the_page():
    codes = set()
    for path in NODE.rglob("*.py"):
        for text in re.findall(
            r"(?:events\.add|\.notice|rtpu_messages\.(?:Note|Notice))\((.{0,200})",
            path.read_text(),
            re.DOTALL,
        ):
            codes |= set(re.findall(r'"([A-Z][A-Z_]+)"', text))
    assert codes >= {"STATE", "TASK_DIED", "CLAIM", "RTPU_DIED"}  # the search works
    assert codes <= words(section("Event"))


def test_the_program_on_the_page(nodes, tmp_path):
    """With only zenoh and msgpack: pbonet is not even within its reach."""
    nodes.agent("arm0")
    program = tmp_path / "program.py"
    program.write_text(re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1])
    guard = "import sys; sys.modules['pbonet'] = None; "
    guard += "exec(compile(open(sys.argv[1]).read(), 'program', 'exec'))"
    run = guard.replace("exec(compile", "path = sys.argv.pop(1); exec(compile")
    run = run.replace("open(sys.argv[1])", "open(path)")
    endpoint = run_folder.Places(nodes.domain, "arm0").endpoint
    for _ in range(2):  # the agent remembers what the first one asked
        done = subprocess.run(
            [
                *(sys.executable, "-W", "ignore::ResourceWarning", "-c", run),
                *(str(program), endpoint, nodes.domain, "arm0", "counts"),
            ],
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
            cwd=tmp_path,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        lines = done.stdout.splitlines()
        assert lines[0].startswith("backend ")
        assert re.fullmatch(r"state ON after \d+ cycles", lines[1])
        assert re.fullmatch(r"Y \[\d+\.0, \d+\.0\]", lines[2])
        assert lines[3] == "stopped {'off': ['t'], 'killed': [], 'failed': {}}"


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        (
            *("LEVEL", "20"),
            {
                "what": "parameter level is out of bounds",
                "expected": "float, >= -10 and <= 10",
                "got": "20",
                "remedy": "choose a value within the bounds",
            },
        ),
        (
            *("LEVL", "2"),
            {
                "what": "Setting has no parameter LEVL",
                "expected": "one of level, ready",
                "remedy": "did you mean level?",
            },
        ),
    ],
)
def test_the_answer_names_a_refused_parameter_in_words(arm, name, value, error):
    """A client that is not pbonet's reads the message as it is."""
    arm.spawn("a", "holds", invar="X", local={"LEVEL": 1})
    request = m.Set(task="a", name=name, value=value)
    request.id, request.client = "raw", "somebody"
    request.subsystem, request.epoch = "arm", arm.epoch
    key = key_expressions.rtpu(arm.nodes.domain, "arm0", "sbs")
    payload = msgspec.msgpack.encode(request)
    (reply,) = arm.nodes.session.get(key, payload=payload)
    answer = msgspec.msgpack.decode(reply.ok.payload.to_bytes())
    assert not answer["ok"]
    assert answer["error"] == {"code": "PARAMETER", "where": "a"} | error
