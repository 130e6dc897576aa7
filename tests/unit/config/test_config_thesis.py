"""The files that the thesis prints (sections 3.8 and 5.5.2), figure by figure."""

from math import pi
from pathlib import Path

import pytest

from pbonet.config import read_rmod, read_svar
from pbonet.config.model import LocalLine, TaskType
from pbonet.errors import ConfigError

CASES = Path(__file__).parent / "cases"


def test_the_sample_as_printed_is_refused_for_its_typing_error() -> None:
    file = CASES / "invalid-thesis-sample.svar"
    line = file.read_text().splitlines().index("AME   SG_MEZ") + 1
    with pytest.raises(ConfigError) as caught:
        read_svar(file)
    assert caught.value.where == f"{file}:{line}:1"
    assert caught.value.what == "unknown keyword 'AME'"
    assert caught.value.remedy == "did you mean NAME?"


def test_the_sample_without_its_typing_error() -> None:
    table = read_svar(CASES / "valid-thesis-sample.svar")
    assert table.defines == {
        "DOF": "7",
        "PI": "3.141592653589793",
        "TWOPI": "6.283185307179586",
    }
    position, velocity, gauge, trajectory = table.variables
    assert (position.name, position.type, position.nelem) == ("Q_REF", "double", 7)
    assert position.units == "radians"
    assert position.init == (-pi, 0, 2 * pi, 0, 0, -pi, 0)
    assert position.min == (-pi, -pi, -2 * pi, -pi, -2 * pi, -pi, -2 * pi)
    assert position.max == (pi, 0, 2 * pi, 0, 2 * pi, 0, 2 * pi)
    assert (velocity.name, velocity.units) == ("Q^_REF", "radians/seconds")
    assert (gauge.dtype, gauge.nelem, gauge.init) == ("<i4", 8, None)
    assert gauge.min == (-1000,) * 8
    assert (trajectory.type, trajectory.dtype) == ("struct[32]", "V32")
    assert (trajectory.nelem, trajectory.init) == (4, None)


@pytest.mark.parametrize(
    ("name", "variable", "freq"), [("qmdiff", "Q_MEZ", 100), ("qrdiff", "Q_REF", 40)]
)
def test_the_two_differentiators(name: str, variable: str, freq: float) -> None:
    rmod = read_rmod(CASES / f"valid-{name}.rmod")
    assert rmod.module == "diff"
    assert rmod.aliases == {"Z": variable, "Z^": f"Q^{variable[1:]}"}
    assert (rmod.inconst, rmod.outconst) == (("NDOF",), ())
    assert (rmod.invar, rmod.outvar) == (("Z",), ("Z^",))
    assert (rmod.tasktype, rmod.freq) == (TaskType.PERIODIC, freq)
    assert rmod.svar_name("Z") == variable
    assert rmod.svar_name("NDOF") == "NDOF"


def test_forward_kinematics_is_synchronous_and_says_its_period() -> None:
    rmod = read_rmod(CASES / "valid-fwdkin.rmod")
    assert rmod.aliases == {"JPOS": "Q_MEZ", "XPOS": "X_MEZ"}
    assert rmod.inconst == ("NDOF", "DH")
    assert (rmod.tasktype, rmod.freq) == (TaskType.SYNCHRONOUS, 200.0)


def test_inverse_dynamics_has_local_values() -> None:
    rmod = read_rmod(CASES / "valid-invdyn.rmod")
    assert rmod.inconst == ("LINKS", "COGLINKS", "MASS")
    assert len(rmod.invar) == 6
    assert rmod.outvar == ("REFTORQ", "MODTORQ")
    assert set(rmod.local) == {"FC", "FCLIMIT"}
    gains = rmod.local["FC"]
    assert isinstance(gains, LocalLine)
    assert [float(word) for word in gains.words] == [
        0, 400, 0, 500, 600, 700, 500, 500, 500,
    ]  # fmt: skip
    assert gains.place is not None
    assert (gains.place.line, gains.place.column) == (11, 1)
