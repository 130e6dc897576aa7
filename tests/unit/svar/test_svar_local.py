"""Local tables: transfers, ownership, ages, the illegal-configuration flag."""

import os
import subprocess
import sys

import numpy as np
import pytest

from pbonet.config.model import Variable
from pbonet.errors import (
    SvarError,
    SvarFullError,
    SvarOwnerError,
    UnknownVariableError,
)
from pbonet.svar import Flags, Table

ME = os.getpid()
DOUBLES = [Variable(name=f"V{i}", type="double", nelem=3) for i in range(4)]


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))


@pytest.fixture
def table():
    with Table.create("arm", DOUBLES) as made:
        yield made


def fill(local, **values):
    for name, value in values.items():
        local.array(name)[:] = value


def test_a_commit_is_read_as_it_was_sent(table):
    writer = table.local("w", ME, outvar=["V1", "V3"])
    reader = table.local("r", ME, invar=["V0", "V1", "V3"])
    fill(writer, V1=1.5, V3=[1, 2, 3])
    assert writer.claim(now_ns=5, cycle=0) == 0
    fill(writer, V1=2.5)
    assert writer.commit(now_ns=6, cycle=7) == 0
    assert reader.copy_in() == 0
    assert reader.array("V1").tolist() == [2.5] * 3
    assert reader.array("V3").tolist() == [1, 2, 3]
    assert reader.array("V0").tolist() == [0, 0, 0]
    info = table.info("V3")
    assert (info.owner, info.writer, info.time_ns, info.cycle, info.seq) == (
        "w",
        "w",
        6,
        7,
        2,
    )


def test_arrays_stay_where_they_are_for_life(table):
    local = table.local("r", ME, invar=["V0"], outvar=["V1"])
    before = [local.array(name).ctypes.data for name in local.names()]
    local.claim()
    for _ in range(10):
        local.copy_in()
        local.commit()
    assert [local.array(name).ctypes.data for name in local.names()] == before
    assert all(address % 8 == 0 for address in before)
    table.close()
    local.array("V1")[:] = 3
    assert local.commit() == 0


def test_commit_counts_cycles_and_takes_the_time_when_not_told(table):
    writer = table.local("w", ME, outvar=["V0"])
    writer.claim()
    writer.commit()
    writer.commit()
    info = table.info("V0")
    assert info.cycle == 2
    assert 0 <= info.age_ns < 10**10


def test_on_reads_outputs_of_the_predecessor(table):
    first = table.local("first", ME, outvar=["V0"])
    fill(first, V0=8)
    first.claim()
    first.release()
    second = table.local("second", ME, invar=["V1"], outvar=["V0"])
    assert second.copy_in_on() == 0
    assert second.array("V0").tolist() == [8, 8, 8]


def test_copy_in_leaves_outputs_alone(table):
    task = table.local("t", ME, invar=["V1"], outvar=["V0"])
    fill(task, V0=5)
    task.copy_in()
    assert task.array("V0").tolist() == [5, 5, 5]


def test_a_variable_may_be_input_and_output_of_one_task(table):
    task = table.local("t", ME, invar=["V0", "V1"], outvar=["V0"])
    fill(task, V0=5)
    task.claim()
    fill(task, V0=6)
    task.copy_in()
    assert task.array("V0").tolist() == [5, 5, 5]


# -- ownership ------------------------------------------------------------------------


def test_a_claim_is_one_event_for_all_its_variables(table):
    before = table.generation
    writer = table.local("w", ME, outvar=["V0", "V1", "V2"])
    assert table.generation == before, "a register alone changes nothing for readers"
    writer.claim()
    assert table.generation == before + 1
    assert {table.info(n).owner for n in ("V0", "V1", "V2")} == {"w"}
    assert table.info("V3").owner is None


def test_a_second_live_owner_is_refused_and_nothing_changes(table):
    first = table.local("first", ME, outvar=["V0", "V1"])
    second = table.local("second", ME, outvar=["V1", "V2"])
    fill(first, V1=1)
    fill(second, V1=2, V2=2)
    first.claim()
    text = (
        r"arm: second cannot write V1: another task does \(expected one task that "
        r"writes a variable, got owner first\); turn first off first, or give second "
        r"an alias for V1"
    )
    with pytest.raises(SvarOwnerError, match=text):
        second.check_claim()
    generation = table.generation
    with pytest.raises(SvarOwnerError, match=text):
        second.claim()
    assert table.generation == generation
    assert table.read("V1").tolist() == [1] * 3
    assert table.read("V2").tolist() == [0] * 3
    assert not second.claimed
    assert second.commit() == Flags.COMMIT_NOT_OWNER


def test_values_stand_after_off_until_taken_over(table):
    first = table.local("first", ME, outvar=["V0", "V1"])
    fill(first, V0=1, V1=1)
    first.claim()
    first.commit(cycle=9)
    first.release()
    assert not first.claimed
    assert first.commit() == Flags.COMMIT_NOT_OWNER
    info = table.info("V0")
    assert (info.owner, info.writer, info.cycle) == (None, "first", 9)
    first.close()
    assert table.read("V0").tolist() == [1] * 3
    second = table.local("second", ME, outvar=["V0"])
    fill(second, V0=2)
    second.check_claim()
    second.claim()
    assert table.read("V0").tolist() == [2] * 3
    assert table.read("V1").tolist() == [1] * 3
    assert table.info("V1").writer == "first"


def test_a_task_may_go_on_and_off_for_ever(table):
    first = table.local("first", ME, outvar=["V0", "V1"])
    second = table.local("second", ME, outvar=["V1"])
    reader = table.local("r", ME, invar=["V0", "V1"])
    for n in range(200):
        fill(first, V0=n, V1=n)
        assert first.claim() == 0
        first.release()
        fill(second, V1=-n)
        assert second.claim() == 0
        second.release()
        assert reader.copy_in() == 0
        assert reader.array("V0")[0] == n
        assert reader.array("V1")[0] == -n
    assert len(table.registers()) == 3  # the one that was left is used next


def test_commit_before_claim_is_refused(table):
    task = table.local("t", ME, outvar=["V0"])
    fill(task, V0=1)
    assert task.commit() == Flags.COMMIT_NOT_OWNER
    assert table.read("V0").tolist() == [0] * 3


def test_a_task_without_outputs_commits_nothing(table):
    task = table.local("t", ME, invar=["V0"])
    generation = table.generation
    assert task.claim() == 0
    assert task.commit() == 0
    task.release()
    assert table.generation == generation
    assert task.owner == 0


def test_a_dead_tasks_claims_are_reaped_and_taken_over(table):
    script = (
        "import os\nfrom pbonet.svar import Table\n"
        "t = Table.attach('arm')\n"
        "w = t.local('gone', os.getpid(), outvar=['V0', 'V1'], outconst=['V2'])\n"
        "w.array('V0')[:] = 4\nw.claim()\nw.copy_out_consts()\nprint(w.owner)\n"
    )
    for by_name in (True, False):
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, check=True
        )
        assert table.info("V0").owner == "gone"
        assert table.reap("gone" if by_name else int(done.stdout)) == ["V0", "V1", "V2"]
        assert table.info("V0").owner is None
        assert table.info("V0").writer == "gone"
    subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    heir = table.local("heir", ME, outvar=["V0"])
    heir.claim()
    assert table.info("V0").owner == "heir"
    assert table.info("V1").owner == "gone", "only what was claimed is taken over"
    table.write("V1", [3, 3, 3])
    assert table.read("V1").tolist() == [3, 3, 3]


def test_a_live_task_is_not_reaped(table):
    task = table.local("t", ME, outvar=["V0"])
    task.claim()
    with pytest.raises(
        SvarOwnerError, match="the claims of t remain, because its process runs"
    ):
        table.reap(task.owner)
    assert table.info("V0").owner == "t"
    assert table.reap("nobody") == []


def test_who_does_not_run_gets_no_register(table):
    child = subprocess.Popen([sys.executable, "-c", "pass"])
    child.wait()
    with pytest.raises(SvarOwnerError, match="there is no process"):
        table.local("t", child.pid, outvar=["V0"])


def test_registers_run_out_with_an_error_and_are_used_again():
    variables = [Variable(name="X", type="double", nelem=40_000)]
    with Table.create("small", variables, spare=2) as table:
        held = [table.local(f"t{i}", ME, outvar=["X"]) for i in range(2)]
        with pytest.raises(SvarFullError, match="no register is free for t2"):
            table.local("t2", ME, outvar=["X"])
        held[0].claim()
        held[1].close()
        again = table.local("t2", ME, outvar=["X"])
        fill(again, X=3)
        held[0].release()
        again.claim()
        assert (table.read("X") == 3).all()
        held[0].close()
        table.local("t3", ME, outvar=["X"])
        assert (table.read("X") == 3).all()


def test_an_out_const_is_no_out_var(table):
    with pytest.raises(SvarOwnerError, match="V0 is an out-const and an out-var"):
        table.local("t", ME, outvar=["V0"], outconst=["V0"])


# -- constants ------------------------------------------------------------------------


def test_constants_go_their_own_way(table):
    maker = table.local("maker", ME, outconst=["V0"], outvar=["V1"])
    user = table.local("user", ME, inconst=["V0"], invar=["V1"])
    fill(maker, V0=6)
    assert maker.copy_out_consts() == 0
    assert not maker.claimed
    user.copy_in()
    assert user.array("V0").tolist() == [0] * 3
    assert user.copy_in_consts() == 0
    assert user.array("V0").tolist() == [6] * 3
    maker.claim()
    maker.release()
    assert table.info("V0").owner == "maker", "off gives up the out-vars only"
    maker.close()
    assert table.info("V0").owner is None


def test_the_same_constant_from_two_tasks_is_no_conflict(table):
    one = table.local("one", ME, outconst=["V0", "V1"])
    two = table.local("two", ME, outconst=["V0"])
    fill(one, V0=6)
    fill(two, V0=6)
    one.copy_out_consts()
    assert two.copy_out_consts() == 0
    assert table.info("V0").owner == "one"
    fill(two, V0=7)
    with pytest.raises(SvarOwnerError, match="two gives the constant V0 another value"):
        two.copy_out_consts()
    assert table.read("V0").tolist() == [6] * 3
    one.close()
    assert two.copy_out_consts() == 0
    assert table.read("V0").tolist() == [7] * 3


def test_who_replaces_a_task_gives_its_constants_whatever_the_values(table):
    one, two = (table.local(name, ME, outconst=["V0", "V1"]) for name in ("one", "two"))
    fill(one, V0=6, V1=1)
    one.copy_out_consts()
    fill(two, V0=7, V1=1)
    with two.replacing(["one"]):
        assert two.copy_out_consts() == 0
    assert [table.info(name).owner for name in ("V0", "V1")] == ["two", "two"]
    assert table.read("V0").tolist() == [7] * 3
    with pytest.raises(SvarOwnerError, match="one gives the constant V0 another value"):
        one.copy_out_consts()
    one.close()
    assert table.info("V0").owner == "two"
    three = table.local("three", ME, outconst=["V0"])
    fill(three, V0=8)
    with pytest.raises(RuntimeError), three.replacing(["two"]):
        raise RuntimeError
    with pytest.raises(SvarOwnerError, match="another value"):
        three.copy_out_consts()


# -- ages, provenance, single transfers -----------------------------------------------


def test_stale_inputs_are_flagged_and_still_brought():
    variables = [
        Variable(name="OLD", type="double", maxage=1.0),
        Variable(name="ANY", type="double"),
    ]
    with Table.create("age", variables) as table:
        reader = table.local("r", ME, invar=["OLD", "ANY"])
        careless = table.local("c", ME, invar=["ANY"])
        assert not reader.stale("OLD"), "nothing was copied yet"
        assert reader.copy_in() == Flags.COPY_STALE, "never written"
        assert reader.stale("OLD")
        assert reader.blamed[:2] == ("OLD", 0)
        assert careless.copy_in() == 0
        writer = table.local("w", ME, outvar=["OLD"])
        fill(writer, OLD=1)
        writer.claim()
        assert reader.stale("OLD"), "as the last copy brought it"
        assert reader.copy_in() == 0
        assert not reader.stale("OLD")
        fill(writer, OLD=2)
        writer.commit(now_ns=1)
        assert reader.copy_in() == Flags.COPY_STALE
        assert reader.array("OLD").tolist() == [2]
        assert reader.stale("OLD")
        assert not reader.stale("ANY"), "without MAXAGE nothing is stale"
        with pytest.raises(UnknownVariableError, match="did you mean OLD"):
            reader.stale("OLDE")
        assert table.info("OLD").stale
        writer.release()
        table.write("OLD", [3])
        assert reader.copy_in() == 0
        assert reader.counters.stale == 2


def test_every_commit_has_a_register_and_a_number(table):
    writer = table.local("w", ME, outvar=["V0"])
    reader = table.local("r", ME, invar=["V0"])
    assert (writer.out_uid, writer.out_number) == (0, 0)
    writer.claim()
    for number in range(1, 9):
        reader.copy_in()
        assert reader.consumed == [(writer.out_uid, writer.out_number)]
        assert writer.out_number == number
        writer.commit()
    fill(writer, V0=np.nan)
    writer.commit()
    assert writer.out_number == 9, "what was refused has no number"


def test_consumed_names_register_and_sequence_of_every_group(table):
    one = table.local("one", ME, outvar=["V0", "V1"])
    two = table.local("two", ME, outvar=["V2"])
    reader = table.local("r", ME, invar=["V0", "V1", "V2", "V3"])
    one.claim()
    two.claim()
    two.commit()
    reader.copy_in()
    tasks = {register.uid: register.task for register in table.registers()}
    assert {tasks.get(uid, "keeper"): seq for uid, seq in reader.consumed} == {
        "one": 1,
        "two": 2,
        "keeper": 1,
    }


def test_single_transfers_touch_one_variable(table):
    writer = table.local("w", ME, outvar=["V0", "V1"])
    reader = table.local("r", ME, invar=["V0", "V1"])
    fill(writer, V0=1, V1=1)
    writer.claim()
    fill(writer, V0=2, V1=2)
    assert writer.write("V1") == 0
    assert table.read("V0").tolist() == [1] * 3
    assert table.read("V1").tolist() == [2] * 3
    assert reader.read("V1") == 0
    assert reader.array("V1").tolist() == [2] * 3
    assert reader.array("V0").tolist() == [0] * 3
    with pytest.raises(UnknownVariableError, match="w does not write variable V2"):
        writer.write("V2")
    with pytest.raises(UnknownVariableError, match="r has no variable V2"):
        reader.read("V2")
    writer.release()
    assert writer.write("V1") == Flags.COMMIT_NOT_OWNER


def test_single_write_is_judged(table):
    writer = table.local("w", ME, outvar=["V0", "V1"])
    writer.claim()
    fill(writer, V1=np.nan)
    assert writer.write("V1") == Flags.COMMIT_NONFINITE


def test_keep_policy_reads_the_same_values(table):
    writer = table.local("w", ME, outvar=["V0"])
    reader = table.local("r", ME, invar=["V0", "V1"], keep=True)
    fill(writer, V0=4)
    writer.claim()
    table.write("V1", [1, 2, 3])
    assert reader.copy_in() == 0
    assert reader.array("V0").tolist() == [4] * 3
    assert reader.array("V1").tolist() == [1, 2, 3]


def test_unknown_names_are_said(table):
    with pytest.raises(
        UnknownVariableError, match=r"no variable V0X; did you mean V0\?"
    ):
        table.local("t", ME, invar=["V0X"])
    with pytest.raises(UnknownVariableError, match="t has no variable V0"):
        table.local("t", ME, invar=["V1"]).array("V0")


def test_a_closed_table_writes_into_nobodys_register(table):
    gone = table.local("gone", ME, outvar=["V0"], outconst=["V2"])
    gone.claim()
    gone.close()
    heir = table.local("heir", ME, outvar=["V0"])
    heir.claim()
    other = table.local("other", ME, outvar=["V1"])
    fill(other, V1=3)
    other.claim()
    fill(gone, V0=99)
    said = "arm/gone: the local table was closed"
    for write in (
        gone.claim,
        gone.check_claim,
        gone.copy_out_consts,
        lambda: gone.write("V0"),
    ):
        with pytest.raises(SvarError, match=said):
            write()
    assert gone.commit() == Flags.COMMIT_NOT_OWNER
    assert table.read("V1").tolist() == [3, 3, 3]
    assert table.info("V1").owner == "other"


def test_being_turned_on_again_needs_a_fresh_register_when_a_variable_moved(table):
    task = table.local("task", ME, outvar=["V0", "V1"])
    fill(task, V0=1, V1=1)
    task.claim()
    first = table.info("V0").register
    task.release()
    task.claim()
    assert table.info("V0").register == first
    task.release()
    table.write("V1", [5, 5, 5])
    fill(task, V0=2, V1=2)
    task.claim()
    assert table.info("V0").register != first
    assert table.read("V0").tolist() == table.read("V1").tolist() == [2, 2, 2]
    task.close()
    assert [one.held for one in table.registers()] == [False, False]
