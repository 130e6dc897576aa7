"""What `pbonet new module` writes, and that it passes what this project passes."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.config import parse_rmod, parse_svar
from pbonet.config.library import Library
from pbonet.config.types import TYPES
from pbonet.errors import ConfigError
from pbonet.master.tools.scaffold import class_name, in_own_tree, scaffold
from pbonet.master.tools.scaffold_port import NewPort, read_port
from pbonet.ports import Kind

ROOT = Path(__file__).parents[3]
BIN = Path(sys.executable).parent
SVAR = parse_svar(
    """
NAME   NDOF
TYPE   int
DESC   degrees of freedom
UNITS  none
NELEM  1
INIT   7

NAME   Q_REF
TYPE   double
DESC   reference joint position
UNITS  rad
NELEM  7

NAME   SG_MEZ
TYPE   int
DESC   measured strain gauge values
UNITS  none
NELEM  8

EOF
""",
    "arm.svar",
)
IC, OC, IV, OV = Kind


def ports(*words):
    """Return ports out of alternating kinds and texts."""
    return [
        read_port(text, kind) for kind, text in zip(*[iter(words)] * 2, strict=True)
    ]


MODULES = {
    "mysample": ports(
        *(OC, "NDOF:1:none:int", OC, "DH:NDOF,4:none"),
        *(IV, "Q_REF:ndof:rad", IV, "Q^_REF:ndof:rad/s", IV, "T_GRAV:ndof:N*m"),
        *(OV, "Q_MEZ:ndof:rad", OV, "Q^_MEZ:ndof:rad/s"),
    ),
    "odd_one": ports(
        *(IC, "FLAG:1:none:bool", IC, "TOOL:3:m:float", OC, "SEED:2:none:uint8"),
        *(IV, "TRAJ::none:struct[32]", IV, "TRAJS:4:none:struct[32]"),
        *(OC, "LAST::none:struct[8]", IV, "SET:1:none:int16", OV, "OK:1:none:bool"),
    ),
    "no_ports": [],
    "only_inputs": ports(IV, "A:n:none", IV, "B:n,3:none:int", IC, "GAIN:1:none"),
    "long_names": ports(
        *(OV, "VERY_LONG_NAME1:number_of_elements_of_this:kg*m/s^2"),
        *(OC, "class:1:none:int", OC, "MEAN:1:K", IV, "_.x'y:class:none"),
    ),
    "counts": ports(OV, "COUNT:1:none:int64", OV, "BITS:n:none:bool", IC, "N:1:s:int"),
}


HANDLERS = ("mysample", "no_ports", "long_names")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("new")
    (folder / "tests").mkdir()
    for name, its in MODULES.items():
        desc = {"odd_one": 'A "quoted" \\ thing, ' + "and long " * 20}.get(name, "")
        handler = name in HANDLERS
        made = scaffold(name, its, desc=desc, timing_failure=handler)
        for file, text in made.items():
            (folder / file).write_text(text)
    return folder


def run(folder, *command, **environ):
    """Return what a tool says; nothing but its exit status is judged."""
    done = subprocess.run(
        [BIN / command[0], *command[1:]],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={"PATH": "/usr/bin:/bin", "HOME": str(folder), **environ},
    )
    return "" if done.returncode == 0 else done.stdout + done.stderr


def test_it_passes_ruff(folder):
    config = ("--config", ROOT / "pyproject.toml", "--no-cache")
    assert not run(folder, "ruff", "check", *config, ".")
    assert not run(folder, "ruff", "format", "--check", *config, ".")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_it_passes_mypy_strict(folder):
    files = [*folder.glob("*.py"), *folder.glob("tests/*.py")]
    config = ("--config-file", ROOT / "pyproject.toml", "--strict")
    cache = ("--cache-dir", ROOT / ".mypy_cache")
    assert not run(folder, "mypy", *config, *cache, *files, MYPYPATH=str(ROOT))


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_it_passes_pyright_strict(folder):
    settings = {"include": ["."], "extraPaths": [str(ROOT)]}
    settings |= {"typeCheckingMode": "strict", "pythonVersion": "3.11"}
    config = folder / "pyrightconfig.json"
    config.write_text(json.dumps(settings))
    assert not run(folder, "pyright", "--pythonpath", sys.executable, "-p", config)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_its_tests_pass(folder):
    options = ("-q", "-p", "no:cacheprovider", "--rootdir", folder, "-W", "error")
    command = ("python", "-m", "pytest", *options, folder)
    assert not run(folder, *command, PYTHONPATH=str(ROOT), PYTHONDONTWRITEBYTECODE="1")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_its_tests_take_parameters_from_the_rmod_and_outlive_a_new_name(tmp_path):
    """Parameters are added with the law: what LOCAL gives them counts in the tests."""
    for file, text in scaffold(
        "hold", [NewPort(name="Y", kind=OV, shape="1", unit="m")]
    ).items():
        path = tmp_path / file
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    module, rmod = tmp_path / "hold.py", tmp_path / "hold.rmod"
    gains = (
        'class Gains(Params):\n    """G."""\n\n    kp: A[float, param("1", "gain")]\n'
    )
    text = module.read_text().replace("(PortBasedObject)", "(PortBasedObject[Gains])")
    text = text.replace("PortBasedObject\n", "Params, PortBasedObject, param\n", 1)
    module.write_text(text.replace("class Hold", f"{gains}\n\nclass Hold"))
    text = rmod.read_text().replace("EOF", "LOCAL\nKP 2.0\nEOF")
    (tmp_path / "keep.rmod").write_text(re.sub(r"(MODULE +)hold", r"\1keep", text))
    rmod.unlink()
    module.rename(tmp_path / "keep.py")
    (tmp_path / "tests" / "test_hold.py").rename(tmp_path / "tests" / "test_keep.py")
    sys_path = {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    options = ("-q", "-p", "no:cacheprovider", "--rootdir", tmp_path, "-W", "error")
    assert not run(tmp_path, "python", "-m", "pytest", *options, tmp_path, **sys_path)


@pytest.mark.parametrize("name", MODULES)
def test_class_and_rmod_agree(folder, name):
    info = Library([folder]).load(name).info
    rmod = parse_rmod((folder / f"{name}.rmod").read_text(), f"{name}.rmod")
    assert rmod.module == name
    listed = {IC: rmod.inconst, OC: rmod.outconst, IV: rmod.invar, OV: rmod.outvar}
    for kind, names in listed.items():
        assert names == info.named(kind)
    assert [port.name for port in info.ports if port.kind is IV] == [
        port.name for port in MODULES[name] if port.kind is IV
    ]


@pytest.mark.parametrize("name", MODULES)
def test_a_handler_of_timing_failures_is_written_when_asked_for(folder, name):
    methods = Library([folder]).load(name).info.methods
    assert ("timing_failure" in methods) == (name in HANDLERS)


def test_the_module_of_the_thesis(folder):
    text = (folder / "mysample.py").read_text()
    assert 'qd_mez: A[Vector, OutVar("Q^_MEZ", "ndof", "rad/s", ' in text
    assert 'dh: A[Matrix, OutConst("DH", "ndof,4", "none", ' in text
    assert "self.ndof = self.dh.shape[0]" in text
    assert "class Mysample(PortBasedObject):" in text


def test_what_is_left_out_comes_from_the_svar_file():
    port = read_port("Q_REF", IV, SVAR)
    assert (port.shape, port.unit, port.type) == ("7", "rad", "double")
    assert port.doc == "reference joint position"
    assert read_port("SG_MEZ:n", IV, SVAR).shape == "n"


def test_a_size_that_a_constant_has_is_written_as_that_constant():
    its = [read_port("NDOF", IC, SVAR), read_port("Q_REF", IV, SVAR)]
    text = scaffold("law", its, svar=SVAR)["law.py"]
    assert 'q_ref: A[Vector, InVar("Q_REF", "ndof", "rad", "reference joint pos' in text
    alone = scaffold("law", its[1:], svar=SVAR)["law.py"]
    assert 'InVar("Q_REF", "7", "rad", ' in alone


REFUSED = [
    (
        lambda: read_port("Q_MEZ", IV),
        "Q_MEZ: the unit of port Q_MEZ is not known (expected Q_MEZ:SHAPE:UNIT, such "
        "as Q_MEZ:6:rad); write it (none for a pure number), or name a .svar file",
    ),
    (
        lambda: read_port("Q_RF", IV, SVAR),
        "arm.svar: there is no variable Q_RF; did you mean Q_REF?",
    ),
    (
        lambda: read_port("Q:6:rad:double:more", IV),
        "Q:6:rad:double:more: a port has at most four parts (expected "
        "NAME:SHAPE:UNIT:TYPE, got 5 parts); remove the surplus parts",
    ),
    (
        lambda: read_port("Q:6*2:rad", IV),
        "Q:6*2:rad: the shape has a part that is neither a size nor a name: '6*2' "
        '(expected "1", "6", "ndof" or "ndof,4"); correct it, or leave it empty to '
        "take it from a .svar file",
    ),
    (
        lambda: read_port("Q:6:rad:doubel", IV),
        f"Q:6:rad:doubel: there is no type doubel (expected {' or '.join(TYPES)}); did "
        "you mean double?",
    ),
    (
        lambda: scaffold("Law", []),
        "Law: the name cannot be a module's (expected lower-case letters, digits and "
        "underscores, a letter first); choose another name",
    ),
    (
        lambda: scaffold("law", ports(IV, "Q:6:rad", OV, "Q:6:rad")),
        "Q: port Q is named twice; leave one out; an output holds what was written "
        "last, so it need not be read as well",
    ),
    (
        lambda: read_port("A-B:6:rad", IV),
        "A-B:6:rad: the port's name is not allowed in an .rmod file (expected a letter "
        "or _, then letters, digits and any of _ ^ ' ., at most 15 in all, got "
        '"A-B"); choose another name',
    ),
    (
        lambda: scaffold("signal", []),
        "signal: a file signal.py would hide the package of that name from Python; "
        "choose another name for the module",
    ),
    (
        lambda: scaffold("pbonet", []),
        "pbonet: a file pbonet.py would hide the package of that name from Python; "
        "choose another name for the module",
    ),
    (
        lambda: scaffold("law", ports(IV, "Q:6:rad", OV, "q:6:rad")),
        "q: ports Q and q are one attribute, q; leave one out, and write it by hand "
        "under another attribute",
    ),
]


@pytest.mark.parametrize(("act", "sentence"), REFUSED)
def test_what_cannot_be_written_is_refused(act, sentence):
    with pytest.raises(ConfigError) as caught:
        act()
    assert str(caught.value) == sentence


@pytest.mark.parametrize("name", ["1st", "_x", "if", "a-b", "../x", "", "é"])
def test_names_that_no_module_can_have(name):
    with pytest.raises(ConfigError, match="the name cannot be a module's"):
        scaffold(name, [])


ATTRS = {
    "Q_MEZ": "q_mez",
    "Q^_MEZ": "qd_mez",
    "Z^": "zd",
    "ON": "on_",
    "class": "class_",
    "A.B'": "a_b_",
    "__": "port",
    "_1A": "port_1a",
    "FREQ": "freq_",
}


@pytest.mark.parametrize(("name", "attr"), ATTRS.items())
def test_attributes_are_made_from_names(name, attr):
    assert NewPort(name=name, kind=IV, shape="1", unit="m").attr == attr


def test_class_names():
    assert class_name("joint_pid2") == "JointPid2"


def test_where_imports_are_sorted_as_pbonets_own(tmp_path):
    assert in_own_tree(ROOT / "pbonet" / "modules")
    assert not in_own_tree(tmp_path)
    (tmp_path / "pyproject.toml").write_text("")
    assert not in_own_tree(tmp_path / "robot")
    text = scaffold("odd_one", MODULES["odd_one"], own_tree=True)["odd_one.py"]
    assert "from numpy.typing import NDArray\n\nfrom pbonet" in text
