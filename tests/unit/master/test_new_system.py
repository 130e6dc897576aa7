"""What `pbonet new svar` and `pbonet new job` write: it is legal as it stands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pbonet.config import read_job, read_sbs, read_svar

CLASS = '''"""A module of a test."""

from typing import Annotated as A

import numpy as np
from numpy.typing import NDArray

from pbonet import InConst, InVar, OutConst, OutVar, PortBasedObject, Vector


class M(PortBasedObject):
    """A module of a test."""

{ports}

    def cycle(self, dt: float) -> None: ...
'''
RMOD = """MODULE    {name}
DESC      a task
{alias}INCONST   {inconst}
OUTCONST  {outconst}
INVAR     {invar}
OUTVAR    {outvar}
TASKTYPE  periodic
FREQ      100
EOF
"""
PLANT = {
    "ports": """    ndof: A[int, OutConst("NDOF", "1", "number of joints")]
    tau: A[Vector, InVar("T_REF", "2", "N*m", "torque")]
    q: A[Vector, OutVar("Q_MEZ", "2", "rad", "position")]
    there: A[bool, OutVar("THERE", "1", "none", "whether it is there")]""",
    "outconst": "NDOF",
    "invar": "T_REF",
    "outvar": "Q_MEZ THERE",
}
LAW = {
    "ports": """    n: A[int, InConst("N", "1", "number of joints")]
    q: A[Vector, InVar("Q", "n", "any", "what is to be held")]
    tau: A[Vector, OutVar("T", "n", "N*m", "torque of each joint")]
    jac: A[NDArray[np.float32], OutVar("JAC", "n,3", "none", "three of each")]""",
    "alias": "SVARALIAS N=NDOF\nSVARALIAS Q=Q_MEZ\nSVARALIAS T=T_REF\n",
    "inconst": "N",
    "invar": "Q",
    "outvar": "T JAC",
}


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Write a module and its RMOD, and go to where they are."""
    monkeypatch.chdir(tmp_path)

    def written(name, ports, **more):
        kinds = dict.fromkeys(("inconst", "outconst", "invar", "outvar"), "none")
        (tmp_path / f"{name}.py").write_text(CLASS.format(ports=ports))
        text = RMOD.format(name=name, **({"alias": ""} | kinds | more))
        (tmp_path / f"{name}.rmod").write_text(text)

    return written


def test_a_job_with_its_subsystem_is_legal_as_it_is_written(call, write, tmp_path):
    write("plant", **PLANT)
    write("law", **LAW)
    status, out, err = call("new", "job", "arm", "plant", "law")
    assert (status, out.split(), err) == (0, ["arm.svar", "arm.sbs", "arm.job"], "")
    found = {one.name: one for one in read_svar("arm.svar").variables}
    told = {n: (v.type, v.nelem, v.units, v.desc) for n, v in found.items()}
    assert told == {
        "NDOF": ("int", 1, "none", "number of joints"),
        "T_REF": ("double", 2, "N*m", "torque of each joint"),
        "Q_MEZ": ("double", 2, "rad", "position"),
        "THERE": ("bool", 1, "none", "whether it is there"),
        "JAC": ("float", 6, "none", "three of each"),
    }
    assert next(iter(told)) == "NDOF", "constants come first"
    assert read_sbs("arm.sbs").svarfile == "arm.svar"
    assert [task.rmod for task in read_job("arm.job").tasks] == ["plant", "law"]
    status, out, _ = call("check", "arm.job", "--library", tmp_path)
    assert status == 0, out
    assert out.endswith("arm.job: job arm of 2 tasks: legal\n")


def test_a_constant_that_the_class_gives_a_value_is_a_size(call, write, tmp_path):
    plant = {**PLANT, "ports": PLANT["ports"].replace('joints")', 'joints", value=2)')}
    plant["ports"] = plant["ports"].replace('"2"', '"ndof"')
    write("plant", **plant)
    write("law", **LAW)
    assert call("new", "job", "arm", "law", "plant")[::2] == (0, "")
    sizes = {one.name: one.nelem for one in read_svar("arm.svar").variables}
    assert sizes == {"NDOF": 1, "Q_MEZ": 2, "T_REF": 2, "JAC": 6, "THERE": 1}
    assert "INIT" not in (tmp_path / "arm.svar").read_text(), "plant gives it"
    assert call("check", "arm.job", "--library", tmp_path)[0] == 0
    more = ("--seconds", 0.1, "--library", ".")
    status, out, err = call("run", "arm.job", "--sim", *more)
    assert status == 0, out + err


def test_a_constant_that_no_task_produces_has_the_value_of_its_size(call, write):
    write("law", **LAW)
    status, _, err = call("new", "job", "arm", "law", "--size", "NDOF=3")
    assert status == 0, err
    (ndof, *_) = read_svar("arm.svar").variables
    assert (ndof.name, ndof.init) == ("NDOF", (3,))
    text = call("check", "arm.job", "--library", ".")[1]
    assert "no task produces the constant NDOF" in text
    assert "it has the value of its INIT line" in text


def test_a_constant_without_a_value_is_named(call, write):
    ports = """    table: A[Vector, InConst("TABLE", "3", "m", "where it stands")]
    y: A[float, OutVar("Y", "1", "m", "height")]"""
    write("table", ports, inconst="TABLE", outvar="Y")
    _, out, _ = call("new", "svar", "arm", "table", "--json")
    assert json.loads(out)["warnings"] == [
        "no task produces the constant TABLE: give it a value by INIT"
    ]


def test_variables_are_added_to_a_table(call, write, tmp_path):
    write("plant", **PLANT)
    write("law", **LAW)
    assert call("new", "svar", "arm", "plant")[0] == 0
    path = tmp_path / "arm.svar"
    before = "# mine\n" + path.read_text().replace("DESC      torque", "DESC   T")
    path.write_text(before)
    status, _, err = call("new", "svar", "arm", "plant", "law")
    assert status == 1
    assert "a file exists there already" in err
    assert "--add" in err
    assert call("new", "svar", "arm", "law", "--add")[::2] == (0, "")
    assert path.read_text().startswith(before.removesuffix("EOF\n"))
    found = {one.name: one.nelem for one in read_svar("arm.svar").variables}
    assert found == {"NDOF": 1, "T_REF": 2, "Q_MEZ": 2, "THERE": 1, "JAC": 6}
    after = path.read_text()
    status, _, err = call("new", "svar", "arm", "law", "plant", "--add")
    assert (status, path.read_text()) == (0, after)
    assert "arm.svar has every variable of these tasks" in err
    status, _, err = call("new", "svar", "leg", "law", "--add")
    assert status == 1
    assert "the file cannot be read" in err


def test_a_size_that_no_port_has_is_asked_for_and_taken(call, write):
    write("law", **LAW)
    status, _, err = call("new", "svar", "arm", "law")
    assert status == 1
    assert err == (
        "pbonet: law: no port determines the size of NDOF (expected a size for "
        "NDOF); say "
        "--size NDOF=6\n"
    )
    status, _, err = call("new", "svar", "arm", "law", "--size", "NDFO=3")
    assert "no port has the size NDFO" in err
    assert "did you mean NDOF?" in err
    status, out, _ = call("new", "svar", "arm", "law", "--size", "NDOF=3", "--json")
    assert status == 0
    told = json.loads(out)
    assert told["files"] == ["arm.svar"]
    assert told["warnings"] == [
        "no module declares the unit of Q_MEZ: correct UNITS none"
    ]
    sizes = {one.name: one.nelem for one in read_svar("arm.svar").variables}
    assert sizes == {"NDOF": 1, "Q_MEZ": 3, "T_REF": 3, "JAC": 9}


def test_the_unit_of_a_rate_follows_from_its_name(call, write):
    """`^` is the rate of the variable without it, also where the table has that."""
    write("plant", **PLANT)
    write(
        "wave",
        ports="""    y: A[Vector, OutVar("Y", "2", "any", "position")]
    v: A[Vector, OutVar("Y^", "2", "any", "velocity")]
    a: A[Vector, OutVar("Y^^", "2", "any", "acceleration")]""",
        alias="SVARALIAS Y=T_REF\nSVARALIAS Y^=T^_REF\nSVARALIAS Y^^=Q^^_MEZ\n",
        outvar="Y Y^ Y^^",
    )
    status, _, err = call("new", "svar", "arm", "plant", "wave")
    assert status == 0
    assert "the unit of Q^^_MEZ: correct" in err, "nothing says that of Q^_MEZ"
    units = {one.name: one.units for one in read_svar("arm.svar").variables}
    assert (units["T^_REF"], units["Q^^_MEZ"]) == ("N*m/s", "none")
    text = Path("wave.rmod").read_text().replace("T^_REF", "Q^_MEZ")
    Path("wave.rmod").write_text(text)
    status, _, err = call("new", "svar", "arm", "wave", "--add")
    assert (status, err) == (0, "")
    units = {one.name: one.units for one in read_svar("arm.svar").variables}
    assert units["Q^_MEZ"] == "rad/s"
    Path("arm.svar").unlink()
    status, _, err = call("new", "svar", "arm", "plant", "wave")
    assert (status, err) == (0, "")
    units = {one.name: one.units for one in read_svar("arm.svar").variables}
    assert (units["Q^_MEZ"], units["Q^^_MEZ"]) == ("rad/s", "rad/s^2")


@pytest.mark.parametrize("size", ["NDOF", "NDOF=", "NDOF=x", "NDOF=0", "=3"])
def test_a_size_of_another_form_is_refused(call, write, size):
    write("law", **LAW)
    status, _, err = call("new", "svar", "arm", "law", "--size", size)
    assert status == 1
    assert f"(expected NAME=NUMBER, such as NDOF=6, got {size})" in err


def test_a_job_of_a_subsystem_that_stands_writes_nothing_else(call, write, tmp_path):
    write("plant", **PLANT)
    assert call("new", "job", "arm", "plant")[0] == 0
    more = ("--sbs", tmp_path / "arm.sbs", "--folder", tmp_path / "jobs")
    status, out, err = call("new", "job", "two.job", "plant", *more, "--library", ".")
    assert (status, out) == (0, f"{tmp_path}/jobs/two.job\n"), err
    assert read_job(tmp_path / "jobs" / "two.job").sbs == "../arm.sbs"
    assert (
        "file cannot be read" in call("new", "job", "x", "plant", "--sbs", "n.sbs")[2]
    )


def test_nothing_is_written_over_and_nothing_elsewhere(call, write, tmp_path):
    write("plant", **PLANT)
    (tmp_path / "arm.sbs").write_text("mine")
    status, _, err = call("new", "job", "arm", "plant")
    assert status == 1
    assert "arm.sbs: a file exists there already" in err
    assert not (tmp_path / "arm.job").exists()
    assert call("new", "job", "arm", "plant", "--force")[0] == 0
    for name in ("../arm", ".svar", ""):
        said = call("new", "svar", name, "plant")[2]
        assert "this is not a valid name for a file" in said


def test_a_structure_has_no_length_that_a_module_knows(call, write):
    port = '    raw: A[NDArray[np.void], OutVar("RAW", "n", "none", "a frame")]'
    write("camera", port, outvar="RAW")
    status, _, err = call("new", "svar", "cam", "camera", "--size", "n=1")
    assert status == 1
    assert "the length of the structure RAW is unknown" in err
    assert "(expected TYPE struct[BYTES]); write the .svar file by hand" in err
