"""Several modules as one task: variables, parameters, signals, what cannot be."""

from __future__ import annotations

import pytest
from combined_modules import ONE, TWO, Folder, calls

from pbonet import Signal
from pbonet.config.library import Library
from pbonet.errors import ConfigError, DeclarationError, MethodError, ParameterError
from pbonet.testing import Bench


@pytest.fixture
def folder(tmp_path):
    made = Folder(tmp_path)
    made.module("one", ONE, "self.y[:] = self.params.gain * self.x")
    made.module("two", TWO, "self.z[:] = self.params.gain * self.y")
    return made


# -- parameters, signals, sizes -----------------------------------------------------


def test_a_parameter_is_its_part_s_and_goes_by_its_name(folder):
    bench = folder.bench("TWO.GAIN 3")
    assert (bench.get("one.gain"), bench.get("two.GAIN")) == (1.0, 3.0)
    calls(bench)
    assert bench.set("two.gain", 4.0) == 4.0
    assert calls(bench) == ["two.set"]
    assert [part.params.gain for part in bench.module.parts] == [1.0, 4.0]
    with pytest.raises(MethodError, match=r"both\.set: ValueError: too much"):
        bench.set("two.gain", 200.0)
    assert bench.get("two.gain") == bench.module.parts[1].params.gain == 4.0
    with pytest.raises(ParameterError, match=r"no parameter gain .*one\.gain"):
        bench.set("gain", 1.0)
    with pytest.raises(ParameterError, match=r"both\.rmod:10:1: parameter one\.gain"):
        folder.bench("one.GAIN -1")


def test_the_part_s_own_file_gives_its_parameters(folder):
    folder.rmod("two", "MODULE two", "GAIN 8", INCONST="NDOF", INVAR="Y", OUTVAR="Z")
    assert folder.bench().get("two.gain") == 8.0
    assert folder.bench("two.GAIN 9").get("two.gain") == 9.0


def test_signals_of_one_number_stay_two(folder):
    more = '    DONE = UserSignal(0, "done")'
    folder.module("one", ONE, "self.task.signal(self.DONE | Signal.FINISH)", more)

    more = '    READY = UserSignal(0, "ready")'
    folder.module("two", TWO, "self.task.signal(self.READY)", more)
    loaded = folder.load(folder.both())
    assert [(one.name, one.number) for one in loaded.info.signals] == [
        ("DONE", 0),
        ("READY", 1),
    ]
    bench = folder.bench()
    bench.on()
    bench.step()
    bits = {one.name: one.bit for one in loaded.info.signals}
    assert [notice.bits for notice in bench.notices()] == [
        bits["DONE"] | Signal.FINISH,
        bits["READY"],
    ]


def test_constants_within_are_there_for_the_parts_behind(folder):
    folder.module(
        "one",
        """
    ndof: A[int, OutConst("NDOF", "1", "none", "size")]
    y: A[Vector, OutVar("Y", "ndof", "rad", "out")]
""",
        more="    def init(self): self.ndof = 2",
    )
    path = folder.both(INCONST="none", INVAR="none")
    bench = Bench.of(path, {"ndof": 2})
    assert bench.module.parts[1].n == 2
    with pytest.raises(MethodError, match=r"both\.one\.init: .*NDOF is not the size"):
        Bench.of(path, {"ndof": 3})


def test_an_inner_variable_whose_size_nobody_knows(folder):
    folder.module("one", ONE.replace('"ndof", "rad", "out"', '"m", "rad", "out"'))
    folder.module("two", TWO.replace('"Y", "n"', '"Y", "k"'))
    with pytest.raises(
        ValueError, match=r"size of port one\.y \(Y\) cannot be known.*`m="
    ):
        folder.bench()


def test_a_stale_input_is_told_to_the_part_that_asks(folder):
    folder.module("one", ONE, "self.task.old = self.task.stale('x')")
    folder.module("two", TWO, "self.task.inner = self.task.stale('y')")
    bench = folder.bench()
    bench.on()
    bench.stale.add("x")
    bench.step()
    assert bench.task.old
    assert not bench.task.inner


def test_a_combination_within_another(folder):
    folder.both("one.GAIN 2")
    folder.module("three", TWO.replace('"Y"', '"Z"').replace('"Z", "n", "rad", "out"',
                  '"W", "n", "rad", "out"'), "self.z[:] = -self.y")  # fmt: skip
    path = folder.rmod(
        "more", "COMBINE both three", "both.two.GAIN 5; three.FAILS off",
        INCONST="NDOF", INVAR="X", OUTVAR="W",
    )  # fmt: skip
    bench = Bench.of(path, {"ndof": 2, "x": 1.0})
    bench.on()
    bench.step()
    assert bench["W"].tolist() == [-10.0, -10.0]
    bench.set("both.one.fails", "cycle")
    with pytest.raises(MethodError, match=r"more\.both\.one\.cycle: RuntimeError"):
        bench.step()


def test_aliases_of_the_parts_and_of_the_whole(folder):
    folder.rmod(
        "one", "MODULE one", alias="X=A Y=B", INCONST="NDOF", INVAR="X", OUTVAR="Y"
    )
    folder.rmod(
        "two", "MODULE two", alias="Y=B Z=C", INCONST="NDOF", INVAR="Y", OUTVAR="Z"
    )
    path = folder.both(INVAR="A", OUTVAR="C", alias="C=T_REF")
    library = Library([folder.path])
    rmod = library.read_rmod(path)
    assert [port.name for port in library.load_rmod(rmod).info.ports] == [
        *("NDOF", "A", "C")
    ]
    assert rmod.svar_name("C") == "T_REF"
    bench = Bench.of(path, {"ndof": 1, "x": 4.0})
    bench.on()
    bench.step()
    assert bench["C"] == 4.0


# -- what cannot be combined ----------------------------------------------------------


def test_two_writers_of_one_variable(folder):
    folder.module("two", TWO.replace('"Z"', '"Y"').replace('InVar("Y"', 'InVar("X"'))
    with pytest.raises(DeclarationError) as caught:
        folder.bench()
    assert str(caught.value) == (
        f"{folder.path}/both.rmod:1:1: the parts one and two both write Y (expected "
        "one writer, got one and two); rename the port of one of them by SVARALIAS in "
        "its .rmod file; a join brings two variables together"
    )


def test_an_inner_variable_that_is_read_before_it_is_written(folder):
    path = folder.rmod("both", "COMBINE two one", INCONST="NDOF", INVAR="X", OUTVAR="Z")
    with pytest.raises(DeclarationError, match="part two reads Y before part one"):
        folder.load(path)
    text = path.read_text().replace("OUTVAR Z", "OUTVAR Y Z")
    path.write_text(text)
    bench = Bench.of(path, {"n": 1, "x": 5.0, "y": 2.0})
    bench.on()
    bench.step()
    assert bench["Z"] == 2.0  # of the table, as the last writer left it
    bench.step()
    assert bench["Z"] == 5.0


def test_a_constant_for_one_and_a_variable_for_the_other(folder):
    folder.module("two", TWO.replace('A[Vector, InVar("Y", "n", "rad"',
                                     'A[Vector, InConst("Y", "n", "rad"'))  # fmt: skip
    with pytest.raises(DeclarationError, match="Y is a in-const of part two and a out"):
        folder.bench()


def test_an_rmod_that_is_not_there_or_there_twice(folder):
    for names, said in (
        ("one tow", "the library has no RMOD tow.*did you mean two"),
        ("one one", "names 'one' twice"),
        ("one both", "names 'both' within itself"),
        ("one", "at least two"),
    ):
        path = folder.rmod("both", f"COMBINE {names}", INVAR="X")
        with pytest.raises(ConfigError, match=said):
            Library([folder.path]).read_rmod(path)
