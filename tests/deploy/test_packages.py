"""The sdist and the wheel: their content, and that they work where nothing else is."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

import pbonet
from pbonet import deploy
from pbonet.versions import LAYERS

ROOT = Path(__file__).resolve().parents[2]
BUILD = "from setuptools import build_meta as b; import sys; b.build_{}(sys.argv[1])"
PAGE = ROOT / "pbonet" / "master" / "web" / "dist"
CARRIED = {".py", ".pyi", ".pyx", ".pxd", ".pxi", ".h", ".rmod", ".trace", ".typed"}
CARRIED |= {".service", ".sysusers", ".tmpfiles", ".conf"}


def tracked() -> list[str]:
    git = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    return [name for name in git.stdout.splitlines() if (ROOT / name).is_file()]


def page() -> list[str]:
    """The files of the built page; none where there is no npm."""
    return [str(one.relative_to(ROOT)) for one in PAGE.glob("*")]


def build(what: str, source: Path, to: Path) -> Path:
    to.mkdir(exist_ok=True)
    command = [sys.executable, "-c", BUILD.format(what), str(to)]
    done = subprocess.run(
        command, cwd=source, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    (made,) = to.iterdir()
    return made


def unpacked(sdist: Path, folder: Path) -> Path:
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (source,) = folder.iterdir()
    return source


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    """An sdist of the files that git knows."""
    source = tmp_path_factory.mktemp("source")
    for name in [*tracked(), *page()]:
        if name.startswith(("pbonet/", "scripts/")) or "/" not in name:
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    return build("sdist", source, tmp_path_factory.mktemp("sdist") / "dist")


@pytest.fixture(scope="module")
def wheel(sdist, tmp_path_factory):
    """A wheel that `pbonet deploy --build` has built, from the sdist alone."""
    source = unpacked(sdist, tmp_path_factory.mktemp("unpacked"))
    folder = tmp_path_factory.mktemp("wheel") / "wheels"
    system = f"{sysconfig.get_platform()}-{sys.implementation.cache_tag}"
    left = source / "build" / f"lib.{system}" / "pbonet"  # by an earlier build
    left.mkdir(parents=True)
    (left / "removed.py").write_text("")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pbonet, "__file__", str(source / "pbonet" / "__init__.py"))
        patch.setenv("PIP_NO_BUILD_ISOLATION", "0")  # what pip reads as true
        made = deploy.built(folder)
    assert [*folder.iterdir()] == [made]
    return made


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A virtual environment with the wheel; what pbonet needs is our own."""
    folder = tmp_path_factory.mktemp("clean") / "env"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
    subprocess.run([*pip, "--no-index", "--no-deps", str(wheel)], check=True)
    (site,) = folder.glob("lib/python*/site-packages")
    ours = {sysconfig.get_path(name) for name in ("purelib", "platlib")}
    ours |= {path for path in sys.path if path.endswith("site-packages")}
    (site / "needs.pth").write_text("\n".join(sorted(ours)) + "\n")
    return folder


def test_what_deploy_builds_is_a_release_for_this_machine(wheel):
    (release,) = deploy.releases_of([wheel])
    assert release.version == pbonet.__version__
    assert release.machine == platform.machine()
    assert release.python == ".".join(map(str, sys.version_info[:2]))
    assert release.layers == LAYERS
    with zipfile.ZipFile(wheel) as archive:
        assert "pbonet/removed.py" not in archive.namelist()


def test_a_wheel_carries_stubs_data_and_native_parts(wheel):
    with zipfile.ZipFile(wheel) as archive:
        there = set(archive.namelist())
    wanted = {
        name
        for name in tracked()
        if name.startswith("pbonet/") and Path(name).suffix in CARRIED
    }
    assert (wanted | set(page())) - there == set()
    native = {
        Path(name).stem
        for name in tracked()
        if name.startswith("pbonet/") and name.endswith(".pyx")
    }
    built = {Path(name).name.partition(".")[0] for name in there if ".so" in name}
    assert built == native | {"_cython"}  # which all of them share


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--version"], "pbonet"),
        (["check", "puma.job"], "legal"),
        (["run", "puma.job", "--sim", "--seconds", "0.05"], "puma_pidg"),
    ],
)
def test_what_is_installed_works_by_itself(installed, tmp_path, words, said):
    example = tmp_path / "puma"
    shutil.copytree(ROOT / "examples" / "puma", example)
    env = {**os.environ, "PBONET_RUNS": str(tmp_path / "runs")}
    env.pop("PYTHONPATH", None)
    done = subprocess.run(
        [installed / "bin" / "pbonet", *words],
        cwd=example,
        env=env,
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert said in done.stdout


def test_a_module_in_c_is_built_with_what_is_installed(installed, tmp_path):
    example = tmp_path / "c_pid"
    ours = shutil.ignore_patterns("*.so")
    shutil.copytree(ROOT / "examples" / "c_pid", example, ignore=ours)
    make = ["make", "--silent", f"PYTHON={installed / 'bin' / 'python'}"]
    subprocess.run(make, cwd=example, check=True)
    check = [installed / "bin" / "pbonet", "check", "c_pid.job"]
    done = subprocess.run(
        check, cwd=example, check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "legal" in done.stdout


def test_without_a_compiler_one_sentence_says_what_to_install(sdist, tmp_path):
    source = unpacked(sdist, tmp_path)
    for what in ("wheel", "editable"):
        done = subprocess.run(
            [sys.executable, "-c", BUILD.format(what), str(tmp_path)],
            cwd=source,
            env={**os.environ, "CC": "/nonexistent/cc"},
            check=False,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 1
        assert done.stderr.splitlines()[-1] == (
            "pbonet: the C compiler /nonexistent/cc was not found; name another one "
            "with CC, or apt-get install gcc libc6-dev"
        )
        assert "copying" not in done.stdout
        assert "Traceback" not in done.stderr
