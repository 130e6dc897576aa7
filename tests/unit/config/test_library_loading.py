"""Modules and RMODs by name: what is found, what is refused, what is run."""

import errno
import importlib
import subprocess
import sys

import pytest

import pbonet.io
import pbonet.modules.signals.diff
from pbonet.config import library
from pbonet.config.library import Library
from pbonet.errors import ConfigFileError, DeclarationError, ModuleLoadError
from pbonet.pbo import OUTPUT_DEVICES

GOOD = '''
from typing import Annotated as A
from pbonet import OutVar, PortBasedObject

class Ramp(PortBasedObject):
    """Rise steadily."""

    y: A[float, OutVar("Y", "1", "none", "value")]

    def cycle(self, dt: float) -> None:
        self.y += dt
'''


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "ramp.py").write_text(GOOD)
    (tmp_path / "fast_ramp.rmod").write_text("MODULE ramp\n")
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("_pbonet_library_")]:
        del sys.modules[name]


def test_a_module_is_loaded_and_described(folder):
    loaded = Library([folder]).load("ramp")
    assert loaded.cls.__name__ == "Ramp"
    assert loaded.path == folder / "ramp.py"
    assert (loaded.info.name, loaded.info.doc) == ("ramp", "Rise steadily.")
    assert loaded.info.file == str(folder / "ramp.py")


def test_the_version_is_that_of_the_text_that_ran(folder):
    lib = Library([folder])
    first = lib.load("ramp")
    assert lib.load("ramp") is first
    (folder / "ramp.py").write_text(GOOD.replace("steadily", "slowly"))
    second = lib.load("ramp")
    assert second.info.version != first.info.version
    assert second.info.doc == "Rise slowly."
    assert second.cls is not first.cls


def test_a_folder_that_may_not_be_searched_is_not_passed_over(folder, monkeypatch):
    """Else the module of that name in a later folder would run in its place."""
    real = library.os.stat

    def guarded(path, **more):
        if str(path).startswith(str(folder)):
            raise PermissionError(errno.EACCES, "Permission denied")
        return real(path, **more)

    monkeypatch.setattr(library.os, "stat", guarded)
    for search in (Library([folder]).load, Library([folder]).find_rmod):
        with pytest.raises(ModuleLoadError, match="may not be searched") as caught:
            search("sine")
        assert str(folder) in caught.value.where
        assert caught.value.got == "Permission denied"


def test_rmods_of_the_current_folder_have_its_files_names(folder, monkeypatch):
    monkeypatch.chdir(folder)
    text = Library().find_rmod("sine").read_text()
    (folder / "slow_sine.rmod").write_text(text)
    assert Library(["."]).records()["slow_sine"].file == "slow_sine.rmod"


def test_everything_is_listed_without_running_it(folder):
    (folder / "broken.py").write_text("1/0")
    (folder / "_shared.py").write_text("1/0")
    (folder / "test_ramp.py").write_text("1/0")
    (folder / "not-a-name.py").write_text("1/0")
    lib = Library([folder])
    assert {"ramp", "broken", "diff"} <= set(lib.modules())
    assert not {"_shared", "test_ramp", "not-a-name"} & set(lib.modules())
    assert {"fast_ramp", "qmdiff", "qrdiff"} <= set(lib.rmods())
    assert list(lib.modules()) == sorted(lib.modules())


def test_folders_come_before_what_pbonet_brings(folder):
    (folder / "diff.py").write_text(GOOD)
    (folder / "qmdiff.rmod").write_text("MODULE diff\n")
    lib = Library([folder])
    assert lib.load("diff").path == folder / "diff.py"
    assert lib.find_rmod("qmdiff") == folder / "qmdiff.rmod"
    assert Library().load("diff").cls is pbonet.modules.signals.diff.Diff


def test_a_module_that_was_loaded_can_be_imported_by_its_full_name():
    """In a process of its own: here a test may have imported it before."""
    code = """
from pbonet.config.library import Library
loaded = Library().load("gain").cls
import pbonet.modules.signals.gain
print(loaded is pbonet.modules.signals.gain.Gain)
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"


def test_of_two_folders_the_first_one_counts(folder, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "ramp.py").write_text(GOOD)
    assert Library([other, folder]).load("ramp").path == other / "ramp.py"
    assert Library([folder, other]).load("ramp").path == folder / "ramp.py"


def test_every_module_of_the_library_loads():
    lib = Library()
    for name in lib.modules():
        info = lib.load(name).info
        assert info.name == name
        assert info.doc


def test_a_file_of_the_same_folder_can_be_imported(folder):
    (folder / "_values.py").write_text("STEP = 3\n")
    (folder / "stairs.py").write_text(
        GOOD.replace("Ramp", "Stairs").replace(
            "from pbonet", "from ._values import STEP\nfrom pbonet"
        )
    )
    assert Library([folder]).load("stairs").cls.__name__ == "Stairs"
    (folder / "stairs.py").write_text("import _values\n")
    with pytest.raises(ModuleLoadError) as caught:
        Library([folder]).load("stairs")
    assert str(caught.value) == (
        f"{folder}/stairs.py:1: the code of module stairs does not load (got "
        "ModuleNotFoundError: No module named '_values'); write `from . import "
        "_values`: the folder is a package"
    )


def fails(folder, text):
    (folder / "wrong.py").write_text(text)
    with pytest.raises(ModuleLoadError) as caught:
        Library([folder]).load("wrong")
    return str(caught.value)


def test_a_syntax_error_is_named_with_file_and_line(folder):
    assert fails(folder, "\n\ndef cycle(self)\n    pass\n") == (
        f"{folder}/wrong.py:3: the code of module wrong does not load "
        "(got expected ':': `def cycle(self)`); correct it there and try again"
    )


def test_an_exception_is_named_with_the_line_of_the_module(folder):
    text = "import json\n\n\ndef f():\n    json.loads('{')\n\n\nf()\n"
    assert fails(folder, text).startswith(
        f"{folder}/wrong.py:5: the code of module wrong does not load "
        "(got JSONDecodeError: "
    )


def test_sys_exit_while_loading_ends_nothing(folder):
    assert "got SystemExit: 2" in fails(folder, "raise SystemExit(2)\n")
    assert not [name for name in sys.modules if name.endswith(".wrong")]


def test_what_does_not_load_leaves_what_did(folder):
    lib = Library([folder])
    cls = lib.load("ramp").cls
    for wrong in ("1/0", "class Ramp:", GOOD.replace('"none"', '""')):
        (folder / "ramp.py").write_text(wrong)
        with pytest.raises((ModuleLoadError, DeclarationError)):
            lib.load("ramp")
        assert sys.modules[cls.__module__].Ramp is cls


def test_null_bytes_are_told(folder):
    (folder / "wrong.py").write_bytes(b"x = 1\0")
    with pytest.raises(ModuleLoadError, match=r"source code .* null bytes"):
        Library([folder]).load("wrong")


def test_a_wrong_class_body_is_a_declaration_error(folder):
    (folder / "wrong.py").write_text(GOOD.replace('"none", "value"', '"", "value"'))
    with pytest.raises(DeclarationError) as caught:
        Library([folder]).load("wrong")
    assert str(caught.value).startswith(
        f"{folder}/wrong.py: wrong.Ramp.y (line 8): the port has no unit"
    )


def test_a_file_that_was_corrected_is_shown_as_it_is_now(folder):
    wrong = GOOD.replace('"none", "value"', '"", "value"')
    for lines in ("", "\n\n\n"):
        (folder / "wrong.py").write_text(lines + wrong)
        with pytest.raises(DeclarationError) as caught:
            Library([folder]).load("wrong")
    assert "wrong.Ramp.y (line 11)" in str(caught.value)


def test_code_means_what_it_means_when_it_is_imported(folder):
    """No ``from __future__`` of the library's own reaches it."""
    (folder / "ramp.py").write_text(GOOD + "\n    speed: int = 3\n")
    cls = Library([folder]).load("ramp").cls
    assert cls.__annotations__["speed"] is int
    assert "NameError: name 'OutVra'" in fails(
        folder, GOOD.replace("OutVar(", "OutVra(")
    )


def test_a_file_without_a_module_class(folder):
    assert fails(folder, "from pbonet import PortBasedObject\n") == (
        f"{folder}/wrong.py: module wrong must define one class that derives from "
        "PortBasedObject (expected one, or one with the name of the file, got none); "
        "derive its class from pbonet.PortBasedObject"
    )


def test_a_class_that_is_only_imported_does_not_count(folder):
    assert "(expected one, or one with the name of the file, got none)" in fails(
        folder, "from .ramp import Ramp\n"
    )


def test_of_two_classes_the_one_that_is_named_like_the_file(folder):
    two = GOOD + GOOD.replace("Ramp", "Rampe").replace('"Y"', '"Z"')
    assert fails(folder, two).endswith(
        "got Ramp, Rampe); put each class into its own file"
    )
    (folder / "ramp.py").write_text(two)
    assert Library([folder]).load("ramp").cls.__name__ == "Ramp"


def test_a_module_that_is_not_there(folder):
    with pytest.raises(ModuleLoadError) as caught:
        Library([folder]).load("rmap")
    built_in = importlib.import_module("pbonet.modules").__path__[0]
    assert str(caught.value) == (
        f"the library has no module rmap (expected rmap.py or rmap.so in {folder} or "
        f"{built_in}); did you mean ramp?"
    )


def test_a_module_beside_the_files_that_want_it_is_found_before_others(folder):
    own = folder / "own"
    own.mkdir()
    (own / "ramp.py").write_text(GOOD)
    library = Library([folder])
    library.beside = (own, folder)
    assert library.folders == (own, folder)
    assert library.load("ramp").path == own / "ramp.py"
    assert library.for_agent("ramp", "arm0") == (
        f"ramp.py is in {own}; the agent arm0 needs it, too: "
        f"pbonet agent --name arm0 --library {own}"
    )
    assert not library.for_agent("rmap", "arm0")
    assert not library.for_agent("diff", "arm0"), "every pbonet brings it"


def test_a_package_that_is_missing_is_to_be_installed(folder):
    (folder / "ramp.py").write_text(f"import no_such_package.part\n{GOOD}")
    with pytest.raises(ModuleLoadError) as caught:
        Library([folder]).load("ramp")
    assert caught.value.remedy == (
        f"install no_such_package where pbonet is ({sys.prefix}), or correct the name"
    )


def test_a_folder_that_is_not_there_is_told_when_it_matters(folder):
    lib = Library([folder / "gone", folder])
    assert lib.load("ramp").info.name == "ramp"
    with pytest.raises(ModuleLoadError, match=r"there is no folder .*/gone$"):
        lib.load("zzzzzz")
    with pytest.raises(ModuleLoadError, match="its folder by --library"):
        Library([folder]).load("zzzzzz")


PATHS = ["../ramp", "/etc/passwd", "ramp.py", "a/b", "", ".", "_shared", "os\0", "if"]


@pytest.mark.parametrize("name", [*PATHS, "rämp", "ramp\n"])
def test_a_module_is_named_and_not_located(folder, name):
    with pytest.raises(ModuleLoadError, match="a module is given by name, not by path"):
        Library([folder]).load(name)


def test_an_rmod_is_found(folder):
    lib = Library([folder])
    assert lib.find_rmod("fast_ramp") == folder / "fast_ramp.rmod"
    assert lib.find_rmod("fast_ramp.rmod") == folder / "fast_ramp.rmod"


def test_an_rmod_that_is_not_there(folder):
    with pytest.raises(ConfigFileError, match=r"did you mean fast_ramp\?"):
        Library([folder]).find_rmod("fast_rmap")
    for name in ("../x", "/etc/passwd", "", "..", "a/b"):
        with pytest.raises(ConfigFileError, match="the library has no RMOD"):
            Library([folder]).find_rmod(name)


def test_the_present_folder_is_named_among_those_searched(folder, monkeypatch):
    monkeypatch.chdir(folder)
    with pytest.raises(ConfigFileError, match=r"expected zzz\.rmod in \. or /"):
        Library(["."]).find_rmod("zzz")


def test_an_unreadable_file_is_told(folder, monkeypatch):
    def refuse(_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(library.Path, "read_bytes", refuse)
    with pytest.raises(
        ModuleLoadError, match=r"cannot be read \(got Permission denied"
    ):
        Library([folder]).load("ramp")


class Point:
    """An entry point, as installed packages have them."""

    def __init__(self, name, value):
        self.name = name
        self.value = value


def test_installed_packages_add_modules(tmp_path, monkeypatch):
    package = tmp_path / "robot_parts"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "ramp.py").write_text(GOOD)
    monkeypatch.syspath_prepend(tmp_path)
    points = [Point("parts", "robot_parts")]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: points)
    loaded = Library().load("ramp")
    assert loaded.cls.__module__ == "robot_parts.ramp"
    assert importlib.import_module("robot_parts.ramp").Ramp is loaded.cls
    del sys.modules["robot_parts.ramp"], sys.modules["robot_parts"]


def test_installed_packages_are_looked_up_last_and_once(folder, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "importlib.metadata.entry_points", lambda **_: asked.append(1) or []
    )
    lib = Library([folder])
    lib.load("ramp")
    lib.load("diff")
    lib.find_rmod("fast_ramp")
    assert asked == []
    for _ in range(2):
        with pytest.raises(ModuleLoadError):
            lib.load("nowhere")
        lib.rmods()
    assert asked == [1]


def test_an_installed_package_that_does_not_import_is_told(monkeypatch):
    points = [Point("parts", "gone_package.modules")]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: points)
    with pytest.raises(ModuleLoadError) as caught:
        Library().modules()
    assert str(caught.value) == (
        "gone_package.modules: entry point parts names a package that does not import "
        "(got ModuleNotFoundError: No module named 'gone_package'); install it again, "
        "or remove it"
    )


ARM = """
from typing import Annotated as A
from pbonet import {port}Var, PortBasedObject
{top}

class Arm(PortBasedObject{said}):
    u: A[float, {port}Var("U", "1", "N*m", "torque")]

    def init(self) -> None:
        {inside}

    def cycle(self, dt: float) -> None:
        pass
"""
USES = {
    "at the top": ("from pbonet.io import SimulatedArm", "pass"),
    "renamed": ("from pbonet.io import SerialLine as Line", "pass"),
    "of the package": ("import pbonet.io", "self.line = pbonet.io.SerialLine('x')"),
    "inside": ("", "from pbonet.io.serial_line import SerialLine"),
}


@pytest.mark.parametrize("use", USES)
def test_a_module_that_reads_and_uses_an_output_device_moves_something(folder, use):
    top, inside = USES[use]

    def moves(top=top, inside=inside, port="In", said=""):
        text = ARM.format(top=top, inside=inside, port=port, said=said)
        (folder / "arm.py").write_text(text)
        return Library([folder]).load("arm").info.robot_interface

    assert moves()
    assert not moves(port="Out"), "it reads nothing that it could turn into motion"
    assert not moves(said=', module_class="teleoperation"')
    assert moves("", "pass", said=', module_class="robot interface"')
    assert not moves("from pbonet.io import Chain", "self.task.warn('SerialLine')")


def test_a_module_inherits_the_use_of_a_device(folder):
    text = ARM.format(top=USES["at the top"][0], inside="pass", port="In", said="")
    (folder / "_base.py").write_text(text)
    (folder / "arm.py").write_text(
        "from ._base import Arm as Base\n\nclass Arm(Base):\n    pass\n"
    )
    assert Library([folder]).load("arm").info.robot_interface


def test_a_combination_with_a_robot_interface_is_one(folder):
    text = ARM.format(top=USES["at the top"][0], inside="pass", port="In", said="")
    (folder / "arm.py").write_text(text)
    for name, first, invar, outvar in (
        ("arm", "MODULE arm", "U", "none"),
        ("ramp", "MODULE ramp", "none", "Y"),
        ("both", "COMBINE ramp arm", "none", "none"),
    ):
        alias = "SVARALIAS Y=U\n" * (name == "ramp")
        (folder / f"{name}.rmod").write_text(
            f"{first}\nDESC one\n{alias}INCONST none\nOUTCONST none\nINVAR {invar}\n"
            f"OUTVAR {outvar}\nTASKTYPE periodic\nFREQ 9\nEOF\n"
        )
    lib = Library([folder])
    info = lib.load_rmod(lib.read_rmod(folder / "both.rmod")).info
    assert (info.module_class, info.robot_interface) == ("", True)


def test_all_output_devices_are_known():
    """Those of pbonet.io to which bytes or commands can be given."""
    kinds = [getattr(pbonet.io, name) for name in pbonet.io.__all__]
    found = {
        kind.__name__
        for kind in kinds
        if isinstance(kind, type)
        and {"write_nowait", "command", "send"} & {*vars(kind)}
    }
    assert found == OUTPUT_DEVICES
