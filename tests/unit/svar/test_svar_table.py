"""The table as one process sees it: values, names, provenance, what it refuses."""

import math
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

import pbonet.svar
from pbonet.config.model import Limit, Variable
from pbonet.config.types import TYPES
from pbonet.errors import (
    SvarAccessError,
    SvarDamagedError,
    SvarError,
    SvarExistsError,
    SvarFullError,
    SvarLayoutError,
    SvarMissingError,
    SvarOwnerError,
    UnknownVariableError,
)
from pbonet.svar import Table, VarInfo, layout

ALL_TYPES = [*TYPES, "struct[24]"]

PLAIN = [
    Variable(name="Q_REF", type="double", units="rad", nelem=6, init=(1.5, -2.0)),
    Variable(name="NDOF", type="int", init=(6,)),
    Variable(name="RAW", type="struct[32]", nelem=4),
    Variable(name="OLD", type="float", nelem=3, maxage=0.5),
    Variable(name="FREE", type="double", finite=False),
    Variable(
        name="TORQUE",
        type="double",
        units="N*m",
        nelem=2,
        min=(-1.0, -2.0),
        max=(1.0, 2.0),
        limit=Limit.ERROR,
    ),
]


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))


@pytest.fixture
def table():
    with Table.create("arm", PLAIN) as made:
        yield made


def test_public_names_are_exported_and_sorted():
    assert pbonet.svar.__all__ == sorted(
        pbonet.svar.__all__, key=lambda n: (not n.isupper(), n)
    )
    for name in pbonet.svar.__all__:
        assert hasattr(pbonet.svar, name)


def test_file_is_the_users_own_and_named_after_the_table(table, tmp_path):
    assert table.path == tmp_path / f"pbonet.{os.geteuid()}.arm.svar"
    assert table.path.stat().st_mode & 0o777 == 0o600
    assert [p.name for p in tmp_path.iterdir()] == [table.path.name]


def test_pages_of_the_file_are_allocated(table):
    status = table.path.stat()
    assert status.st_blocks * 512 >= status.st_size


def test_initial_values_are_init_then_zeros(table):
    assert table.read("Q_REF").tolist() == [1.5, -2, 0, 0, 0, 0]
    assert table.read("NDOF").tolist() == [6]
    assert table.read("OLD").tolist() == [0, 0, 0]
    assert table.read("RAW").tobytes() == bytes(128)


@pytest.mark.parametrize("kind", ALL_TYPES)
def test_every_type_keeps_its_values(kind):
    variable = Variable(name="X", type=kind, nelem=3)
    dtype = np.dtype(variable.dtype)
    with Table.create("types", [Variable(name="A", type="byte"), variable]) as table:
        if dtype.kind == "V":
            raw = bytes(range(72))
            table.write("X", raw)
            assert table.read("X").tobytes() == raw
            assert table.read("X").shape == (3,)
            return
        values = [0, 1, 1] if dtype.kind == "b" else [0, 1, 100]
        table.write("X", values)
        assert table.read("X").dtype == dtype
        assert table.read("X").tolist() == values


@given(st.sampled_from(sorted(TYPES)), st.data())
def test_values_are_stored_as_numpy_has_them(kind, data):
    type_ = TYPES[kind]
    low, high = type_.low, type_.high
    if type_.is_float:
        number = st.floats(low, high, width=8 * type_.size)
    else:
        number = st.integers(low, high)
    values = data.draw(st.lists(number, max_size=5))
    variable = Variable(name="X", type=kind, nelem=5)
    expected = np.zeros(5, variable.dtype)
    expected[: len(values)] = values
    assert layout.values_of(variable, values, where="X").tobytes() == expected.tobytes()


@pytest.mark.parametrize(
    ("kind", "value", "got"),
    [
        ("byte", 256, "unsigned byte integer is greater than maximum"),
        ("byte", -1, "unsigned byte integer is less than minimum"),
        ("int", math.nan, "cannot convert float NaN to integer"),
        ("int", 0.5, "a value that the type cannot hold exactly"),
        ("bool", 2, "a value that the type cannot hold exactly"),
        ("double", "1", "must be real number, not str"),
    ],
)
def test_what_a_type_cannot_hold_is_refused(kind, value, got):
    variable = Variable(name="X", type=kind)
    with pytest.raises(SvarLayoutError, match=f"values of type {kind}, got {got}"):
        layout.values_of(variable, [value], where="INIT")


def test_a_large_variable_is_read_whole():
    n = 200_000
    with Table.create(
        "big", [Variable(name="MAP", type="double", nelem=n)], spare=1
    ) as t:
        t.write("MAP", np.arange(n, dtype=float))
        assert (t.read("MAP") == np.arange(n)).all()


def test_a_table_without_variables_is_a_table():
    with Table.create("empty", []) as table:
        assert table.names() == []
        with Table.attach("empty") as other:
            assert other.layout == table.layout


def test_names_indices_and_records_translate_into_each_other(table):
    assert table.names() == [v.name for v in PLAIN]
    for index, variable in enumerate(PLAIN):
        assert table.index(variable.name) == index
        assert table.variable(index) == table.variable(variable.name) == variable
        assert table.read(index).tobytes() == table.read(variable.name).tobytes()


def test_unknown_name_says_the_nearest(table):
    with pytest.raises(
        UnknownVariableError,
        match=r"arm: the table has no variable Q_REV; did you mean Q_REF\?",
    ):
        table.read("Q_REV")


@pytest.mark.parametrize("index", [-1, 6])
def test_unknown_index_says_the_range(table, index):
    with pytest.raises(UnknownVariableError, match="expected 0 to 5, got"):
        table.read(index)


def test_operator_sets_a_variable_and_provenance_says_so(table):
    before = table.info("Q_REF")
    assert before == VarInfo(None, None, 0, None, 0, before.seq, 0, stale=False)
    table.write("Q_REF", [1, 2, 3, 4, 5, 6])
    table.write(0, [1, 2, 3, 4, 5, 7])
    after = table.info("Q_REF")
    assert table.read("Q_REF").tolist() == [1, 2, 3, 4, 5, 7]
    assert after.owner is None
    assert after.writer is None
    assert after.cycle == 2
    assert after.seq == before.seq + 2
    assert 0 <= after.age_ns < 10**10
    assert table.info("NDOF").time_ns == 0, "setting one variable is no news of another"


def test_maxage_makes_what_was_never_written_stale(table):
    assert table.info("OLD").stale
    table.write("OLD", [1, 2, 3])
    assert not table.info("OLD").stale
    assert not table.info("Q_REF").stale


def test_operator_may_not_set_what_a_task_owns(table):
    with table.local("pid", os.getpid(), outvar=["Q_REF"]) as task:
        task.claim()
        with pytest.raises(
            SvarOwnerError,
            match=r"arm: Q_REF cannot be set: a task writes it \(expected a variable "
            r"that no task owns, got owner pid\); turn pid off first",
        ):
            table.write("Q_REF", [0] * 6)
        task.release()
        table.write("Q_REF", [9] * 6)
    assert table.read("Q_REF").tolist() == [9] * 6


@pytest.mark.parametrize(
    ("name", "values", "error", "text"),
    [
        ("Q_REF", [1, 2], SvarLayoutError, "expected 6 values, got 2 values"),
        ("RAW", b"abc", SvarLayoutError, "expected 128 bytes, got 3 bytes"),
        ("RAW", [0] * 4, SvarLayoutError, "expected none for a struct"),
        ("NDOF", [2**40], SvarLayoutError, "the value of NDOF does not fit"),
        ("Q_REF", [float("nan")] * 6, SvarError, "Q_REF takes finite values only"),
        ("Q_REF", [float("inf")] * 6, SvarError, "Q_REF takes finite values only"),
        (
            "TORQUE",
            [0, 2.5],
            SvarError,
            r"outside its limits \(expected \[-1.0, -2.0\] to",
        ),
    ],
)
def test_operator_values_are_judged(table, name, values, error, text):
    before = table.read(name).tobytes()
    with pytest.raises(error, match=text):
        table.write(name, values)
    assert table.read(name).tobytes() == before


def test_finite_no_admits_nan(table):
    table.write("FREE", [float("nan")])
    assert np.isnan(table.read("FREE")).all()


# -- layouts --------------------------------------------------------------------------


def changed(**fields):
    base = {"name": "X", "type": "double", "units": "m", "nelem": 2, "init": (1.0,)}
    return Table.layout_of([Variable(**{**base, **fields})])


def test_layout_is_that_of_earlier_versions():
    """Machines of two versions share a subsystem only if theirs are equal."""
    kinds = ["byte", "char", "word", "short", "unsigned", "int", "float", "double"]
    kinds += ["int64", "uint64", "bool"]
    bounds = {"init": (1, 0, 1), "min": (0, 0, 0), "max": (1, 1, 1)}
    variables = [
        *(
            Variable(name=f"V{n}", type=kind, nelem=3, **bounds)
            for n, kind in enumerate(kinds)
        ),
        Variable(name="F", type="float", init=(0.1, 1e-50, 3e38), nelem=4, units="m"),
        Variable(name="D", type="double", init=(-0.0, 0.1), nelem=2, maxage=0.5),
        Variable(name="S", type="struct[12]", nelem=2),
        Variable(name="BIG", type="uint64", init=(2**64 - 1,)),
        Variable(name="NEG", type="char", init=(-128, 127), nelem=2),
    ]
    assert Table.layout_of(variables) == "123975956a510556c8ec3e33f253abee"


def test_layout_is_equal_for_tables_that_mean_the_same():
    assert changed() == changed(desc="new")
    assert changed(init=(1, 0)) == changed(init=(1.0,))


@pytest.mark.parametrize(
    "fields",
    [
        {"name": "Y"},
        {"type": "float"},
        {"units": "mm"},
        {"nelem": 3},
        {"init": (2.0,)},
        {"min": (0.0, 0.0), "max": (0.0, 0.0)},
        {"maxage": 0.1},
        {"limit": Limit.CLIP},
        {"finite": False},
    ],
)
def test_layout_differs_for_tables_that_do_not(fields):
    assert changed(**fields) != changed()


def test_attach_compares_the_layout_when_asked(table):
    Table.attach("arm", layout=table.layout).close()
    with pytest.raises(SvarLayoutError, match="exists with another layout"):
        Table.attach("arm", layout=changed())


@pytest.mark.parametrize(
    ("variables", "text"),
    [
        ([Variable(name="X", type="int")] * 2, "the variable X is defined twice"),
        ([Variable(name="", type="int")], "expected 1 to 15 characters"),
        ([Variable(name="N" * 16, type="int")], "expected 1 to 15 characters, got 16"),
        ([Variable(name="X", type="int", nelem=0)], "has no elements"),
        ([Variable(name="X", type="int", init=(1, 2))], "INIT of X does not fit"),
    ],
)
def test_variables_that_cannot_be_a_table_are_refused(variables, text):
    with pytest.raises(SvarLayoutError, match=text):
        Table.create("bad", variables)


# -- files ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "x" * 101, "a b"])
def test_names_that_cannot_be_files_are_refused(name):
    with pytest.raises(SvarError, match="cannot be the name of a table"):
        Table.create(name, [])


def test_missing_table_is_said():
    with pytest.raises(SvarMissingError, match="there is no such table"):
        Table.attach("nobody")


def test_a_table_in_use_is_not_made_again(table):
    table.write("NDOF", [7])
    with pytest.raises(SvarExistsError, match="already exists and is in use"):
        Table.create("arm", PLAIN)
    assert table.read("NDOF").tolist() == [7]


def test_a_leftover_is_replaced(table):
    table.write("NDOF", [7])
    table.close()
    with Table.create("arm", PLAIN) as fresh:
        assert fresh.read("NDOF").tolist() == [6]


def test_use_of_a_closed_table_is_an_error(table):
    table.close()
    table.close()
    with pytest.raises(SvarError, match="the table was closed"):
        table.read("NDOF")


def test_removed_file_goes_on_for_those_attached(table):
    reader = Table.attach("arm")
    writer = table.local("w", os.getpid(), outvar=["NDOF"])
    writer.claim()
    table.path.unlink()
    writer.array("NDOF")[0] = 4
    assert writer.commit() == 0
    assert reader.read("NDOF").tolist() == [4]
    with pytest.raises(SvarMissingError):
        Table.attach("arm")
    table.destroy()


def test_no_room_is_an_error_and_leaves_nothing(tmp_path):
    script = (
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))\n"
        "from pbonet.svar import Table\n"
        "from pbonet.errors import SvarFullError\n"
        "try:\n    Table.create('full', [])\n"
        "except SvarFullError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert "there is no room for the table in shared memory" in done.stdout
    assert list(tmp_path.iterdir()) == []


def patch(path: Path, at: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(data)


def test_another_magic_is_no_table(table):
    patch(table.path, 0, b"NOTMINE!")
    with pytest.raises(SvarDamagedError, match="not a state variable table"):
        Table.attach("arm")


def test_another_version_is_refused_with_both_numbers(table):
    patch(table.path, 8, struct.pack("<I", 99))
    with pytest.raises(
        SvarLayoutError, match=r"expected table version 5 .*, got table version 99"
    ):
        Table.attach("arm")


def test_another_c_library_is_refused(table):
    patch(table.path, 12, struct.pack("<I", 7))
    with pytest.raises(SvarLayoutError, match="this machine's C library"):
        Table.attach("arm")


@pytest.mark.parametrize("size", [0, 8, 135])
def test_shorter_than_a_header_is_refused(table, size):
    os.truncate(table.path, size)
    with pytest.raises(SvarDamagedError, match="not a state variable table"):
        Table.attach("arm")


def test_cut_short_is_refused(table):
    os.truncate(table.path, table.path.stat().st_size - 4096)
    with pytest.raises(SvarDamagedError, match="truncated"):
        Table.attach("arm")


def test_too_long_is_refused(table):
    os.truncate(table.path, table.path.stat().st_size + 4096)
    with pytest.raises(SvarDamagedError, match="overwritten"):
        Table.attach("arm")


def test_every_byte_of_the_static_part_is_covered():
    with Table.create("arm2", PLAIN[:2]) as table:
        raw = table.path.read_bytes()
        end = struct.unpack_from("<Q", raw, 80)[0]
        assert raw[end - 200 : end].find(b"NDOF") > 0, "the records end the static part"
        for at in [*range(16, 136, 7), *range(136, end, 13)]:
            patch(table.path, at, bytes([raw[at] ^ 0x55]))
            with pytest.raises(SvarDamagedError):
                Table.attach("arm2")
            patch(table.path, at, raw[at : at + 1])
        Table.attach("arm2").close()


def test_changed_permissions_are_refused(table):
    table.path.chmod(0o644)
    with pytest.raises(SvarAccessError, match=r"mode 0600, got -rw-r--r-- of"):
        Table.attach("arm")


def test_a_symbolic_link_is_refused(table, tmp_path):
    link = tmp_path / f"pbonet.{os.geteuid()}.link.svar"
    link.symlink_to(table.path)
    with pytest.raises(SvarAccessError, match="got a symbolic link"):
        Table.attach("link")


def test_a_folder_is_refused(tmp_path):
    (tmp_path / f"pbonet.{os.geteuid()}.dir.svar").mkdir()
    with pytest.raises(SvarAccessError, match="cannot be opened"):
        Table.attach("dir")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_another_users_file_is_refused(table):
    os.chown(table.path, 12345, -1)
    with pytest.raises(SvarAccessError, match="file is not this user's own"):
        Table.attach("arm")
    table.close()
    with pytest.raises(SvarAccessError, match="file is not this user's own"):
        Table.create("arm", PLAIN)


def test_full_error_is_an_os_error():
    assert issubclass(SvarFullError, OSError)


@pytest.mark.parametrize("value", [1.5, 2**40, "many", None])
def test_an_integer_is_set_exactly_or_not_at_all(value):
    with Table.create("exact", [Variable(name="I", type="int")]) as made:
        made.write("I", [7])
        with pytest.raises(SvarLayoutError, match="the value of I does not fit"):
            made.write("I", [value])
        assert made.read("I").tolist() == [7]
