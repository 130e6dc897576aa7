"""What verification says of a combination (Stewart 1994, sections 3.3.1 and 3.8.1)."""

from __future__ import annotations

import pytest
from combined_modules import ONE, TWO, Folder

from pbonet.analysis import legality
from pbonet.config import parse_svar
from pbonet.config.library import Library
from pbonet.master.configuration.check_files import check_file

SVAR = "".join(
    f"NAME {name}\nTYPE {kind}\nDESC\nUNITS {unit}\nNELEM {size}\n"
    for name, kind, unit, size in (
        ("NDOF", "int", "none", 1),
        ("X", "double", "rad", 3),
        ("Z", "double", "rad", 3),
    )
)


@pytest.fixture
def folder(tmp_path):
    made = Folder(tmp_path)
    made.module("one", ONE)
    made.module("two", TWO)
    return made


def problems(folder, path, svar=SVAR):
    """Return what is wrong with a combination on a table, as text by code."""
    library = Library([folder.path])
    rmod = library.read_rmod(path)
    info = library.load_rmod(rmod).info
    table = parse_svar(f"{svar}EOF\n", "a.svar")
    task = legality.Task(rmod=rmod, info=info, rtpu="arm0")
    source = legality.Task(rmod=folder_source(folder, library), rtpu="arm0")
    found = legality.check(
        legality.Configuration(
            svar=table, tasks=(task, source), on=frozenset({"both", "source"})
        )
    )
    return {one.code.value: legality.as_text(one) for one in found}


def folder_source(folder, library):
    """Return an RMOD that writes what the combination reads."""
    path = folder.rmod("source", "MODULE source", OUTCONST="NDOF", OUTVAR="X")
    return library.read_rmod(path)


def told(folder, path):
    """Return what `pbonet check` says of the file, without its folder."""
    found = check_file(path, [folder.path])
    return [line.replace(f"{folder.path}/", "") for line in found.lines()]


def test_a_combination_is_legal_though_no_table_has_its_inner_variable(folder):
    assert problems(folder, folder.both()) == {}
    assert told(folder, folder.both()) == [
        "both.rmod: RMOD both of module one+two: legal"
    ]


def test_the_lists_are_those_of_the_parts_without_what_is_inner(folder):
    path = folder.both(INVAR="X Y", OUTVAR="Z W", INCONST="none")
    assert told(folder, path) == [
        "ERROR> both.rmod:3:1: INCONST does not list NDOF, an in-const of the module "
        "one+two (expected NDOF, got none); add NDOF to INCONST",
        "ERROR> both.rmod:5:1: INVAR lists Y, which is not a port of that kind in "
        "module "
        "one+two (expected X, got X Y); take it out; 'pbonet library both.rmod' shows "
        "the ports",
        "ERROR> both.rmod:6:1: OUTVAR lists W, which is not a port of that kind in "
        "module "
        "one+two (expected Z, got Z W); take it out; 'pbonet library both.rmod' shows "
        "the ports",
        "both.rmod: RMOD both of module one+two: 3 faults",
    ]


def test_units_within(folder):
    folder.module("two", TWO.replace('"Y", "n", "rad"', '"Y", "n", "deg"'))
    assert told(folder, folder.both())[0] == (
        "ERROR> both.rmod:1:1: one.Y and two.Y, which the inner variable Y connects, "
        "have different units (expected rad as one.Y has, got deg); 1 rad is 57.2958 "
        "deg; insert a module that converts"
    )


def test_types_and_sizes_within(folder):
    folder.module(
        "one",
        """
    x: A[Vector, InVar("X", "3", "rad", "in")]
    y: A[Vector, OutVar("Y", "3", "rad", "out")]
""",
    )
    folder.module("two", TWO.replace('"Y", "n"', '"Y", "4"'))
    (line, _) = told(folder, folder.both())
    assert "different sizes (expected 3 as one.Y has, got 4)" in line
    folder.module("two", TWO.replace('"Y", "n"', '"Y", "1"'))
    text = (folder.path / "two.py").read_text()
    (folder.path / "two.py").write_text(text.replace("y: A[Vector,", "y: A[int,"))
    line, size, _ = told(folder, folder.both())
    assert "different types (expected float64[] as one.Y has, got int)" in line
    assert "different sizes (expected 3 as one.Y has, got 1)" in size


def test_a_size_within_that_only_the_table_gives(folder):
    """One part sees a matrix where the other one sees a vector."""
    folder.module("one", ONE.replace('"Y", "ndof"', '"Y", "ndof,2"'))
    (text,) = problems(folder, folder.both()).values()
    assert "the inner variable Y has two sizes" in text
    assert "(expected 6 elements as one.y has, got 3 as two.y has)" in text


def test_sizes_go_through_the_inner_variable(folder):
    wrong = SVAR.replace("NAME Z\nTYPE double\nDESC\nUNITS rad\nNELEM 3", "NAME Z\n"
                         "TYPE double\nDESC\nUNITS rad\nNELEM 4")  # fmt: skip
    (text,) = problems(folder, folder.both(), wrong).values()
    assert "expected ndof = 3 from port x (X)" in text or "4" in text
    assert "both.rmod:5:1: both: " in text
    assert "(X " in text, "the line of the variable"


@pytest.mark.parametrize(("unit", "wrong"), [("rad", False), ("deg", True)])
def test_a_connector_within_joins_variables_of_one_unit(folder, unit, wrong):
    """Also one within a combination within the combination."""
    folder.module("two", TWO.replace('"Z", "n", "rad"', f'"Y2", "n", "{unit}"'))
    lists = {"INCONST": "NDOF", "OUTVAR": "Z"}
    folder.rmod("join", "MODULE join_max", alias="Z1=Y Z2=Y2", INVAR="Z1 Z2", **lists)
    folder.rmod("inner", "COMBINE two join", INVAR="Y", **lists)
    for parts, at in (("two join", "both.join"), ("inner", "both.inner.join")):
        both = folder.rmod("both", f"COMBINE one {parts}", INVAR="X", **lists)
        found = problems(folder, both)
        assert set(found) == ({"unit"} if wrong else set())
        assert not wrong or (
            f"{at} joins variables of different units (expected one unit for Z1, Z2, "
            "Z, got Z1=Y in rad, Z2=Y2 in deg, Z=Z in rad)" in found["unit"]
        )


def test_two_parts_read_one_variable_but_not_in_one_unit(folder):
    folder.module("two", TWO.replace('"Y", "n", "rad"', '"X", "n", "deg"'))
    found = problems(folder, folder.both(OUTVAR="Y Z"), SVAR + "NAME Y\nTYPE double\n"
                     "DESC\nUNITS rad\nNELEM 3\n")  # fmt: skip
    assert set(found) == {"unit"}
    assert "two.X within task both does not fit the variable X" in found["unit"]


def test_writers_within_are_judged_like_two_tasks(folder):
    folder.module("two", TWO.replace('OutVar("Z"', 'OutVar("Y"').replace(
        'InVar("Y"', 'InVar("X"'))  # fmt: skip
    (line, _) = told(folder, folder.both(OUTVAR="Y"))
    assert "the parts one and two both write Y" in line
    (fault,) = check_file(folder.both(OUTVAR="Y"), [folder.path]).errors
    assert fault["code"] == "VERIFICATION"


def test_two_that_wait_and_critical_without_stable(folder):
    wait = "    def sync(self): pass"
    folder.module("one", ONE, more=wait)
    folder.module("two", TWO, more=wait)
    (line, _) = told(folder, folder.both())
    assert "the parts one and two both write sync" in line
    folder.module("two", TWO)
    path = folder.both(TASKTYPE="TASKTYPE synchronous")
    assert told(folder, path)[-1].endswith("legal")
    path.write_text(path.read_text().replace("FREQ 100", "FREQ 100\nCRITICAL"))
    (line, _) = told(folder, path)
    assert "task both is CRITICAL, but its module one+two has no stable()" in line


def test_a_parameter_of_a_part_is_named_by_its_place(folder):
    (line, _) = told(folder, folder.both("two.GAIN 0"))
    assert line.startswith("ERROR> both.rmod:10:1: parameter two.gain is out of bounds")
    (line, _) = told(folder, folder.both("three.GAIN 1"))
    assert "both has no parameter three.GAIN" in line
    assert "did you mean one.gain?" in line or "two.gain" in line


def test_a_part_that_is_wrong_is_named_by_its_own_file(folder):
    path = folder.both()
    text = (folder.path / "two.rmod").read_text()
    (folder.path / "two.rmod").write_text(text.replace("EOF\n", ""))
    (line, _) = told(folder, path)
    assert line.startswith("ERROR> two.rmod:8:1: EOF is missing: file cut short?")
