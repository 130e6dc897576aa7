"""The graph of a subsystem as data: of a job's files, and of an open subsystem."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from pbonet.config import Library
from pbonet.master import Subsystem
from pbonet.master.configuration import Files, job_graph

EXAMPLES = Path(__file__).parents[3] / "examples"
SOURCE = '''
from typing import Annotated as A
from pbonet import OutVar, Params, PortBasedObject, Vector, param
class Source(Params):
    on: A[str, param("none", "where it is", device=True)] = "ball0"
    gain: A[float, param("m/s", "speed", ge=0, lt=2.5)] = 1.5
    words: A[tuple[str, ...], param("none", "names")] = ("1", "two")
    must: A[tuple[float, float], param("m", "place")]
class Made(PortBasedObject[Source]):
    """Writes."""
    z: A[Vector, OutVar("Z", "n", "none", "what it writes")]
    def cycle(self, dt): ...
'''
SVAR = """
NAME NDOF
TYPE int
DESC size
UNITS none
NELEM 1
NAME Z
TYPE double
DESC the <result>
UNITS none
NELEM 3
NAME Z1
TYPE double
DESC one
UNITS none
NELEM 3
NAME Z2
TYPE double
DESC other
UNITS none
NELEM 3
EOF
"""


def graph(job: Path, **more) -> dict:
    """Return what JSON carries of a job's graph."""
    made = job_graph(Files(job, Library([job.parent])), **more)
    return json.loads(msgspec.json.encode(made))


def by_name(found: list[dict]) -> dict[str, dict]:
    return {one["name"]: one for one in found}


def wires(found: dict) -> set[tuple]:
    return {
        (one["from"], one["variable"], one["to"], one["constant"])
        for one in found["wires"]
    }


@pytest.fixture
def joined(tmp_path):
    """Two writers of one kind, of which one has a fallback, and a join connector."""
    (tmp_path / "made.py").write_text(SOURCE)
    (tmp_path / "table.svar").write_text(SVAR)
    (tmp_path / "arm.sbs").write_text(
        "SUBSYSTEM arm\nSVARFILE table.svar\nMASTER b\n"
        "RTPU a\nSCHEDULER EDF\nRTPU b\nEOF\n"
    )

    def rmod(name, alias, *, local="MUST 1 -2e-3\n", module="made"):
        (tmp_path / f"{name}.rmod").write_text(
            f"MODULE {module}\nDESC makes {name}\nSVARALIAS Z={alias}\nINCONST none\n"
            "OUTCONST none\nINVAR none\nOUTVAR Z\nTASKTYPE periodic\nFREQ 50\n"
            f"CRIT 3\n\nLOCAL\n{local}EOF\n"
        )

    rmod("one", "Z1")
    rmod("spare", "Z1", local="MUST 0 0\nON other ball\nGAIN 2\n")
    rmod("two", "Z2")

    def job(*tasks):
        path = tmp_path / "arm.job"
        lines = "".join(f"TASK {task}\n" for task in tasks)
        path.write_text(f"JOB arm\nDESC d\nSBS arm.sbs\n{lines}EOF\n")
        return path

    job.rmod = rmod
    return job


def test_the_puma_and_its_wires():
    found = graph(EXAMPLES / "puma" / "puma.job")
    assert (found["name"], found["job"]) == ("puma", "teleop")
    assert found["rtpus"] == [
        {"name": "arm0", "scheduler": "MUF", "keeper": True},
        {"name": "arm1", "scheduler": "MUF", "keeper": False},
    ]
    assert wires(found) >= {
        ("puma_pidg", "Q_MEZ", "grav_comp", False),
        ("grav_comp", "T_GRAV", "puma_pidg", False),
        ("puma_pidg", "DH", "grav_comp", True),
        ("jttrace", "Q_REF", "qrdiff", False),
    }
    task = by_name(found["tasks"])["puma_pidg"]
    assert task["class"] == "robot interface"
    assert (task["rtpu"], task["freq"], task["type"]) == ("arm0", 500.0, "periodic")
    assert task["critical"]
    dh = next(port for port in task["outs"] if port["port"] == "DH")
    assert dh["shape"] == [6, 4]
    assert dh["constant"]
    kp = by_name(task["params"])["kp"]
    assert kp["shape"] == [6]
    assert kp["value"][:2] == [2400, 3000]
    assert (kp["unit"], kp["low"], kp["high"]) == ("N*m/rad", 0, None)
    measured = by_name(found["variables"])["Q_MEZ"]
    assert (measured["unit"], measured["n"], measured["shape"]) == ("rad", 6, [6])
    assert measured["writers"] == ["puma_pidg"]
    assert set(measured["readers"]) >= {"grav_comp"}
    assert not measured["constant"]
    assert found["faults"] == []


def test_joins_fallbacks_devices_and_parameters(joined):
    found = graph(joined("one a FALLBACK spare", "two", "join_first b"))
    tasks = by_name(found["tasks"])
    assert list(tasks) == ["one", "spare", "two", "join_first"]
    assert tasks["spare"]["fallback_of"] == "one"
    assert tasks["spare"]["rtpu"] == "a"
    assert tasks["join_first"]["rtpu"] == "b"
    assert wires(found) == {
        ("one", "Z1", "join_first", False),
        ("spare", "Z1", "join_first", False),
        ("two", "Z2", "join_first", False),
    }
    out = tasks["one"]["outs"][0]
    assert (out["port"], out["variable"], out["shape"]) == ("Z", "Z1", [3])
    assert tasks["one"]["crit"] == "3"
    assert tasks["one"]["devices"] == ["ball0"]
    assert tasks["spare"]["devices"] == ["other", "ball"]
    params = by_name(tasks["one"]["params"])
    assert (params["gain"]["value"], params["gain"]["high"]) == ([1.5], 2.5)
    assert params["gain"]["bounds"] == ">= 0 and < 2.5"
    assert params["words"]["value"] == ["1", "two"]
    assert (params["must"]["value"], params["must"]["shape"]) == ([1, -0.002], [2])
    assert [one["keeper"] for one in found["rtpus"]] == [False, True]


def test_faults_name_what_they_are_about(joined):
    joined.rmod("again", "Z1")
    found = graph(joined("one", "again"))
    fault = next(one for one in found["faults"] if one["variables"] == ["Z1"])
    assert set(fault["tasks"]) == {"one", "again"}
    assert fault["severity"] == "refuse"
    assert "both write Z1" in fault["text"]
    assert fault["remedy"]
    assert fault["remedy"] in fault["text"]


def test_a_variable_that_the_table_lacks_is_there_without_a_type(joined):
    joined.rmod("odd", "NOT_THERE")
    found = graph(joined("odd"))
    odd = by_name(found["variables"])["NOT_THERE"]
    assert (odd["type"], odd["n"], odd["writers"]) == ("", 0, ["odd"])
    assert any("NOT_THERE" in one["variables"] for one in found["faults"])


def test_a_task_that_cannot_be_described_is_drawn_with_its_fault(joined):
    joined.rmod("bad", "Z1", local="MUST 1 2\nGIAN 1\n")
    joined.rmod("gone", "Z2", module="no_such_module")
    found = graph(joined("bad", "gone", "no_rmod"))
    tasks = by_name(found["tasks"])
    assert list(tasks) == ["bad", "gone"]
    assert tasks["bad"]["outs"][0]["variable"] == "Z1"
    assert by_name(tasks["bad"]["params"])["gian"]["value"] == [1]
    texts = "\n".join(one["text"] for one in found["faults"])
    assert "GIAN" in texts
    assert "no_such_module" in texts
    assert "no_rmod" in texts


def test_without_code_ports_are_as_the_table_says(joined):
    found = graph(joined("one"), code=False)
    (task,) = found["tasks"]
    assert task["outs"][0]["shape"] == [3]
    assert task["outs"][0]["type"] == "double"
    assert by_name(task["params"])["must"]["value"] == [1, -0.002]
    assert by_name(task["params"])["must"]["unit"] == ""


def test_a_combination_names_its_parts():
    found = graph(EXAMPLES / "servoing" / "combined.job")
    servo = by_name(found["tasks"])["servo"]
    assert servo["parts"] == ["forward_kin", "damped_ls", "qrint"]
    assert by_name(servo["params"])["damped_ls.gain"]["value"] == [4]
    assert ("target", "X_DES", "servo", False) in wires(found)


def test_links_between_subsystems():
    (out,) = graph(EXAMPLES / "two_hosts" / "vision.job")["links"]
    assert out == {
        "name": "target", "task": "tell", "variable": "X_DES", "direction": "out",
        "from": "", "to": "",
    }  # fmt: skip
    (into,) = graph(EXAMPLES / "two_hosts" / "arm.job")["links"]
    assert (into["name"], into["from"]) == ("vision:target", "vision")
    assert (into["task"], into["variable"]) == ("seen", "X_DES")
    assert into["direction"] == "in"


def test_a_subsystem_without_a_job_has_its_table_only():
    found = graph(EXAMPLES / "puma" / "puma.sbs")
    assert found["job"] == ""
    assert found["tasks"] == []
    assert {"Q_REF", "NDOF"} <= set(by_name(found["variables"]))


def test_an_open_subsystem_has_the_graph_of_its_tasks():
    job = EXAMPLES / "puma" / "puma.job"
    subsystem = Subsystem(job, virtual=True)
    planned = msgspec.to_builtins(subsystem.graph())
    assert len(planned["tasks"]) == 4
    with subsystem:
        assert subsystem.graph().tasks == []
        subsystem.start()
        now = msgspec.to_builtins(subsystem.graph())
        assert by_name(now["tasks"]) == by_name(planned["tasks"])
        assert wires(now) == wires(planned)
        assert now["faults"] == []
        subsystem.off("grav_comp")
        faults = subsystem.graph().faults
        assert any(one.variables == ["T_GRAV"] for one in faults)
