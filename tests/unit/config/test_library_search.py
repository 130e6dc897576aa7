"""The library is searched by class, port, unit and text; packages add to it."""

import itertools
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.cli import main
from pbonet.config import Library, Search, described, search
from pbonet.errors import ConfigError, ModuleLoadError

PAGE = (Path(__file__).parents[3] / "docs" / "library.md").read_text(encoding="utf-8")
HALVE = '''
from typing import Annotated as A
from pbonet import InVar, OutVar, PortBasedObject

class Halve(PortBasedObject, module_class="controller"):
    """Write half of a pressure."""

    p: A[float, InVar("P_MEZ", "1", "Pa", "measured pressure")]
    u: A[float, OutVar("P_CMD", "1", "Pa", "half of it")]

    def cycle(self, dt):
        self.u = self.p / 2
'''
HALVE_RMOD = """MODULE halve
DESC for the boiler
SVARALIAS P_CMD=P_BOILER
INCONST none
OUTCONST none
INVAR P_MEZ
OUTVAR P_CMD
TASKTYPE periodic
FREQ 10
EOF
"""


@pytest.fixture(scope="module")
def everything():
    library = Library()
    infos, faults = described(library)
    assert faults == []
    return infos, library.records()


def names(everything, *text, **wanted):
    return [one.name for one in search(*everything, Search(text=text, **wanted))]


def test_a_module_is_found_by_each_of_what_it_has(everything):
    assert "puma_inv_kin" in names(everything, class_="kin", unit="rad", out="Q_REF")
    assert "joint_pid" not in names(everything, class_="kinematics")
    found = names(everything, in_="Q_REF")
    assert {"joint_pid", "puma_pidg", "diff"} <= set(found), "diff by an RMOD's alias"
    assert "jtball" not in found, "it writes it"
    assert "jtball" in names(everything, out="Q_REF")
    assert "diff" in names(everything, out="Q^_R*")
    assert "gain" not in names(everything, out="Q^_R*")
    assert "forward_kin" in names(everything, "singular", "jacobian")
    assert "diff" not in names(everything, "singular", "jacobian")
    assert names(everything, "qmdiff") == ["diff"], "by the name of an RMOD"


def test_a_generic_port_takes_every_variable_and_comes_last(everything):
    found = search(*everything, Search(in_="T_REF", unit="N*m"))
    named = [one.name for one in found if not one.generic]
    generic = [one.name for one in found if one.generic]
    assert "mujoco_arm" in named
    assert {"biquad", "median", "gain"} <= set(generic)
    assert [one.name for one in found] == [*named, *generic]
    assert "constant" in names(everything, out="NO_SUCH")
    assert "constant" not in names(everything, in_="NO_SUCH"), "it reads nothing"
    assert "gain" not in names(everything, in_="Q_R*"), "a pattern is no variable"
    assert "gain" in names(everything, in_="Q_MEZ", out="Y", class_="signal")
    with pytest.raises(ModuleLoadError):
        names(everything, in_="NO_SUCH", out="Q_REF", unit="Hz", class_="kin")


def test_a_multiplexer_is_found_by_its_usual_name(everything):
    assert names(everything, "mux") == ["select_by"]


def test_an_rmod_is_found_by_its_file_s_name(everything):
    assert names(everything, "jttrace.rmod") == ["jtball"]


def test_units_are_those_of_the_port_that_is_asked_for(everything):
    assert "forward_kin" in names(everything, in_="Q_MEZ", unit="rad")
    assert "forward_kin" in names(everything, unit="mixed")
    with pytest.raises(ModuleLoadError):
        names(everything, in_="Q_ME*", unit="mixed")


def test_the_name_of_a_module_means_it_alone(everything):
    (gain,) = search(*everything, Search(text=("gain",)))
    assert gain.rmods == ("gain",)
    assert len(names(everything, "gai")) > 1


def test_modules_are_listed_by_class(everything):
    order = [one.info.module_class for one in search(*everything, Search())]
    assert order[0] == "controller"
    assert len(set(order)) == 1 + sum(a != b for a, b in itertools.pairwise(order))


def test_nothing_and_no_class_are_refused(everything):
    with pytest.raises(ModuleLoadError, match=r"got output NO_SUCH.* ask for less"):
        names(everything, out="NO_SUCH*")
    with pytest.raises(ModuleLoadError, match=r"did you mean joint_pid\?"):
        names(everything, "joint_pdi")
    with pytest.raises(ConfigError, match="several classes of modules begin with s"):
        names(everything, class_="s")
    with pytest.raises(ConfigError, match="there is no class of modules cotroller"):
        names(everything, class_="cotroller")


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("controllers", "controller"),
        ("Trajectories", "trajectory"),
        ("trajectorie", "trajectory"),
        ("robot_interfaces", "robot interface"),
        ("subsystem-interface", "subsystem interface"),
        ("SENSORS", "sensor"),
    ],
)
def test_a_class_may_be_written_as_its_page_or_folder(everything, text, kind):
    found = search(*everything, Search(class_=text))
    assert {one.info.module_class for one in found} == {kind}


@pytest.mark.parametrize(
    ("text", "near"),
    [
        ("digital controllers", "controller"),
        ("trajectory generator", "trajectory"),
        ("contoler", "controller"),
        ("sensing", "sensor"),
    ],
)
def test_another_word_for_a_class_is_refused_with_the_right_one(everything, text, near):
    with pytest.raises(ConfigError, match=f"did you mean {near}\\?"):
        names(everything, class_=text)


def test_an_rmod_of_the_library_is_shown_by_its_name(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["library", "jttrace.rmod", "--json"])
    assert ended.value.code == 0
    (found,) = json.loads(capsys.readouterr().out)["modules"]
    assert (found["name"], found["rmods"]) == ("jtball", ["jttrace"])
    with pytest.raises(SystemExit) as ended:
        main(["library", "jtrace.rmod"])
    assert ended.value.code == 1
    assert "did you mean jttrace?" in capsys.readouterr().err


def test_generic_modules_are_told_from_the_others(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["library", "--in", "T_REF"])
    out = capsys.readouterr().out
    assert re.search(r"ports of the unit any take every variable.*: .*\bgain\b", out)


def test_a_program_in_a_folder_is_not_run(tmp_path):
    (tmp_path / "program.py").write_text("import pbonet\n1/0\n")
    (tmp_path / "halve.py").write_text(HALVE)
    (tmp_path / "broken.py").write_text(HALVE + "1/0\n")
    infos, faults = described(Library([tmp_path]))
    found = {info.name for info in infos}
    assert "halve" in found
    assert "program" not in found
    assert len(faults) == 1
    assert "broken.py" in faults[0]


def test_changed_rmods_are_read_again(tmp_path):
    library = Library([tmp_path])
    assert "boiler" not in library.records()
    path = tmp_path / "boiler.rmod"
    path.write_text(HALVE_RMOD)
    assert library.records()["boiler"].svar_name("P_CMD") == "P_BOILER"
    path.write_text("MODULE\n")
    assert "boiler" not in library.records(), "it is reported when it is used"


def run(*words, folder, path=""):
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={"PYTHONPATH": path, "PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


LARGE = [
    "control",
    "daqp",
    "matplotlib",
    "mujoco",
    "osqp",
    "pinocchio",
    "placo",
    "proxsuite",
    "ruckig",
    "scipy",
]


def test_describing_the_library_loads_no_large_package(tmp_path):
    """Modules import these in `init`: they are found where these are not installed."""
    code = (
        "import json, sys; from pbonet.config import Library, described\n"
        "print(json.dumps([described(Library())[1], list(sys.modules)]))"
    )
    faults, modules = json.loads(run("-c", code, folder=tmp_path))
    assert faults == []
    assert not set(LARGE) & set(modules)


def test_modules_of_an_installed_package_are_found(tmp_path):
    """The page's pyproject.toml, with one module and one RMOD, installed by pip."""
    project, site = tmp_path / "project", tmp_path / "site"
    own = project / "acme_modules" / "controllers"
    own.mkdir(parents=True)
    (shown,) = re.findall(
        r"<!-- file: pyproject.toml -->\n```toml\n(.*?)```", PAGE, re.DOTALL
    )
    (project / "pyproject.toml").write_text(shown)
    (own.parent / "__init__.py").write_text("")
    (own / "__init__.py").write_text("")
    (own / "halve.py").write_text(HALVE)
    (own / "boiler.rmod").write_text(HALVE_RMOD)
    install = ["-m", "pip", "install", "--no-index", "--no-build-isolation"]
    install += ["--no-deps", "--quiet", "--no-compile", "--target", str(site)]
    run(*install, str(project), folder=tmp_path)
    words = ["-m", "pbonet.cli", "library", "--out", "P_BOILER", "--unit", "Pa"]
    out = run(*words, "--json", folder=tmp_path, path=str(site))
    found, *others = json.loads(out)["modules"]
    assert (found["name"], found["rmods"]) == ("halve", ["boiler"])
    assert not found["generic"]
    assert all(one["generic"] for one in others)
    assert found["module_class"] == "controller"
    assert Path(found["file"]).is_relative_to(site)


def test_the_commands_of_the_page_find_modules(monkeypatch, tmp_path, capsys):
    (shown,) = re.findall(r"<!-- commands -->\n```\n(.*?)```", PAGE, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    for line in shown.splitlines():
        with pytest.raises(SystemExit) as ended:
            main(shlex.split(line)[1:])
        assert ended.value.code == 0
    out = capsys.readouterr().out
    assert out.count("damped_ls") >= 2
    assert "parameters" in out
