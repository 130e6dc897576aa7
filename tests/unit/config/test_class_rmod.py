"""A module whose class says it all needs no .rmod file, from the job to the replay."""

import json
from typing import Annotated as A

import pytest

from pbonet import InVar, PortBasedObject
from pbonet.cli import main
from pbonet.config import Library, parse_rmod
from pbonet.errors import ConfigError, DeclarationError
from pbonet.log import Log

HEAD = """
from typing import Annotated as A

from pbonet import InVar, OutVar, Params, PortBasedObject, Vector, param
"""
SPRING = (
    HEAD
    + '''

class Gains(Params):
    kp: A[float, param("N*m/rad", "stiffness", ge=0)] = 2.0


class Spring(PortBasedObject[Gains], module_class="controller", freq=500):
    """Pull q to zero."""

    q: A[Vector, InVar("Q_MEZ", "2", "rad", "position")]
    tau: A[Vector, OutVar("T_REF", "2", "N*m", "torque")]

    def cycle(self, dt):
        self.tau[:] = -self.params.kp * self.q
'''
)
MASS = (
    HEAD
    + '''

class Mass(PortBasedObject):
    """Move by a torque."""

    tau: A[Vector, InVar("T_REF", "2", "N*m", "torque")]
    q: A[Vector, OutVar("Q_MEZ", "2", "rad", "position", new=True)]

    def on(self):
        self._v = 0.0 * self.q
        self.q[:] = 1.0

    def cycle(self, dt):
        self._v += self.tau * dt
        self.q += self._v * dt
'''
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "spring.py").write_text(SPRING)
    (tmp_path / "mass.py").write_text(MASS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PBONET_RUNS", str(tmp_path / "runs"))
    return tmp_path


def call(*words):
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    return ended.value.code


def test_the_class_is_the_rmod(folder):
    rmod = Library([folder]).record("spring")
    assert (rmod.name, rmod.module, rmod.desc) == (
        "spring",
        "spring",
        "Pull q to zero.",
    )
    assert (rmod.invar, rmod.outvar, rmod.freq) == (("Q_MEZ",), ("T_REF",), 500.0)
    assert (rmod.tasktype, rmod.critical, rmod.local) == ("periodic", False, {})
    assert rmod.file == str(folder / "spring.py")
    assert rmod.places == {}, "the text has no lines in a file"


def test_a_file_goes_before_the_class(folder):
    text, _ = Library([folder]).source("spring")
    (folder / "spring.rmod").write_text(text.replace("500", "250"))
    rmod = Library([folder]).record("spring")
    assert rmod.freq == 250.0
    assert rmod.file == str(folder / "spring.rmod")


def test_what_else_the_class_says(folder):
    code = SPRING.replace("controller", "robot interface").replace(
        '"torque")', '"t", safe=0.0)'
    )
    (folder / "spring.py").write_text(code + "\n    def sync(self):\n        pass\n")
    rmod = Library([folder]).record("spring")
    assert rmod.critical
    assert rmod.tasktype == "synchronous"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (" = 2.0", "", r"spring\.py: spring has no \.rmod file, .* got none for KP"),
        (
            ", freq=500",
            "",
            r"no frequency .* or write FREQ after TASK spring in the job",
        ),
    ],
)
def test_a_class_that_does_not_say_all_is_refused(folder, old, new, message):
    (folder / "spring.py").write_text(SPRING.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        Library([folder]).record("spring")


def test_the_job_may_say_the_frequency(folder):
    assert Library([folder]).record("mass", 40.0).freq == 40.0
    assert Library([folder]).record("spring", 40.0).freq == 500.0, "it is the job's"


@pytest.mark.parametrize("freq", [0, -1.0, float("nan"), 1e9, "fast"])
def test_a_wrong_frequency_is_refused_with_the_class(freq):
    with pytest.raises(DeclarationError, match="freq is no frequency"):

        class Wrong(PortBasedObject, freq=freq):
            def cycle(self, dt):
                pass


@pytest.mark.parametrize("name", ["FREQ", "freq"])
def test_a_frequency_in_the_body_is_refused_with_the_line_to_write(folder, name):
    code = SPRING.replace(", freq=500", "").replace(
        "    def cycle", f"    {name} = 500\n\n    def cycle"
    )
    assert f"{name} = 500" in code
    (folder / "spring.py").write_text(code)
    with pytest.raises(
        DeclarationError,
        match=rf"Spring\.{name} \(line 17\): .* got {name} = 500\); "
        r"write `class Spring\(..., freq=500\)`",
    ):
        Library([folder]).record("spring")


@pytest.mark.parametrize("line", ["", ', module_class="controller"'])
def test_a_class_of_modules_in_the_body_is_refused_with_the_line_to_write(folder, line):
    code = SPRING.replace(', module_class="controller"', line).replace(
        "    def cycle", '    module_class = "sensor"\n\n    def cycle'
    )
    assert line in code
    (folder / "spring.py").write_text(code)
    with pytest.raises(
        DeclarationError,
        match=r"Spring\.module_class \(line 17\): .*got module_class = 'sensor'\); "
        r"write `class Spring\(..., module_class='sensor'\)`",
    ):
        Library([folder]).record("spring")


def test_freq_may_be_the_name_of_a_port_or_a_method():
    class Tone(PortBasedObject):
        freq: A[float, InVar("F", "1", "Hz", "of the tone")]

        def cycle(self, dt):
            pass

    class Own(PortBasedObject):
        def freq(self):
            """Return nothing."""

        def cycle(self, dt):
            pass

    assert Tone.__freq__ is Own.__freq__ is None


def test_a_part_of_a_combination_needs_no_file(folder):
    (folder / "both.rmod").write_text(
        "COMBINE mass spring\nDESC both\nINCONST none\nOUTCONST none\nINVAR none\n"
        "OUTVAR Q_MEZ T_REF\nTASKTYPE periodic\nFREQ 100\nEOF\n"
    )
    (folder / "mass.py").write_text(MASS.replace("Object)", "Object, freq=100)"))
    (folder / "spring.py").write_text(SPRING.replace("500", "100"))
    rmod = Library([folder]).read_rmod(folder / "both.rmod")
    assert [part.name for part in rmod.parts] == ["mass", "spring"]
    assert [part.freq for part in rmod.parts] == [100.0, 100.0]


def test_it_is_checked_run_recorded_and_replayed(folder, capsys):
    assert call("new", "job", "swing", "spring", "mass") == 0
    job = (folder / "swing.job").read_text()
    assert "TASK      spring\nTASK      mass FREQ 100.0\n" in job
    (folder / "swing.job").write_text(job.replace("spring", "spring FREQ 250"))
    assert call("check", "swing.job") == 0
    assert call("check", "swing.job", "--no-code") == 1
    assert "spring has no .rmod file, and its module is not" in capsys.readouterr().out
    assert call("run", "swing.job", "--sim", "--seconds", "0.2", "--record", "all") == 0
    (run,) = (folder / "runs").iterdir()
    about = Log(run).task_about("spring")
    assert about.rmod_name == "spring.rmod"
    recorded = parse_rmod(about.rmod, about.rmod_name)
    assert (recorded.freq, recorded.invar) == (500.0, ("Q_MEZ",))
    (folder / "mass.py").write_text(MASS.replace("Mass(", "Mess("))
    capsys.readouterr()
    assert call("replay", run, "spring", "--verify", "--json") == 0
    assert json.loads(capsys.readouterr().out)
    assert not list(folder.glob("*.rmod"))


def test_no_code_runs_to_advise_what_writes_a_missing_variable(folder, capsys):
    """A module whose import ends the process would end the master, too."""
    assert call("new", "job", "swing", "spring", "mass") == 0
    deadly = "import os\n\nos._exit(5)\n\n\nclass A(PortBasedObject):\n    pass\n"
    (folder / "deadly.py").write_text(deadly)
    job = (folder / "swing.job").read_text()
    (folder / "swing.job").write_text(job.replace("TASK      mass FREQ 100.0\n", ""))
    assert call("check", "swing.job") == 1
    assert "equation 2" in capsys.readouterr().out


def test_a_missing_task_is_told_what_it_could_be(folder, capsys):
    assert call("new", "job", "swing", "spring", "mass") == 0
    job = (folder / "swing.job").read_text()
    (folder / "swing.job").write_text(job.replace("TASK      mass", "TASK      mess"))
    assert call("check", "swing.job") == 1
    out = capsys.readouterr().out
    assert "there is no RMOD mess" in out
    assert "did you mean mass?" in out
