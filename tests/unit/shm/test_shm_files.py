"""Shared memory files of all kinds stand in one folder, and are each user's own."""

import contextlib
import os
import re
import secrets
from pathlib import Path

import pytest

from pbonet import shm, tbuf, xm
from pbonet.config.model import Variable
from pbonet.errors import XmAccessError, XmExistsError, XmFullError
from pbonet.node.ring._ring import Ring
from pbonet.node.rt._rt import CoreTable
from pbonet.svar import Table
from pbonet.xm.ipc.names import living_on
from pbonet.xm.net import run_folder

ROOT = Path(__file__).resolve().parents[3]
FILES = shm.Files("thing", XmExistsError, XmAccessError, XmFullError)


def make_all(name, cleanup):
    """Make a file of every kind; return their paths."""
    core = CoreTable(100_000 + secrets.randbelow(100_000))
    cleanup.callback(core.close)
    table = Table.create(name, [Variable(name="A", type="float")])
    cleanup.callback(table.destroy)
    ring = Ring.create(name)
    cleanup.callback(ring.destroy)
    for make in (
        lambda place: xm.segment(place, 8),
        lambda place: xm.semaphore(place, initial=1),
        xm.queue,
    ):
        cleanup.callback(make(f"here:{name}").destroy)
    link = tbuf.Writer(f"here:{name}", float)
    cleanup.callback(link.destroy)
    kinds = ("shm", "sem", "queue")
    files = [shm.path_of(f"default:here:{name}.{kind}") for kind in kinds]
    return [*files, *map(Path, (core.path, table.path, ring.path, link.path))]


@pytest.mark.parametrize("given", ["", None, "here"])
def test_files_of_all_kinds_stand_in_one_folder(given, monkeypatch, tmp_path):
    wanted = tmp_path if given == "here" else Path("/dev/shm")  # noqa: S108 - its place
    monkeypatch.chdir(tmp_path)  # where a file with no folder would be
    if given is None:
        monkeypatch.delenv("PBONET_SHM_DIR")
    else:
        monkeypatch.setenv("PBONET_SHM_DIR", given and str(tmp_path))
    with contextlib.ExitStack() as cleanup:
        cleanup.enter_context(living_on("here", domain="default"))
        files = make_all(f"one-folder-{secrets.token_hex(4)}", cleanup)
        assert {file.absolute().parent for file in files} == {wanted}
        assert all(file.exists() for file in files)
        status = wanted.stat()
        assert run_folder.machine().endswith(f"/{status.st_dev}.{status.st_ino}")
    assert not any(file.exists() for file in files)


def test_one_file_reads_where_the_folder_is():
    read = re.compile(r"environ.*PBONET_SHM_DIR|getenv.*PBONET_SHM_DIR")
    sources = [*(ROOT / "pbonet").rglob("*.py"), *(ROOT / "pbonet").rglob("*.p?[xid]")]
    found = [path.name for path in sources if read.search(path.read_text())]
    assert found == ["paths.py"]


def test_a_file_is_made_published_opened_and_removed_when_unused(shared_memory):
    path = shm.path_of("thing")
    assert path == shared_memory / f"pbonet.{os.geteuid()}.thing"
    fd, fresh = FILES.make(path, 5000)
    assert not path.exists()
    FILES.publish(fresh, path)
    assert not fresh.exists()
    assert not FILES.remove_unused(path)
    other, size = FILES.open(path)
    assert size == 5000
    os.close(fd)
    assert not FILES.remove_unused(path)
    os.close(other)
    assert FILES.remove_unused(path)
    with pytest.raises(FileNotFoundError):
        FILES.open(path)


def test_a_file_in_use_is_not_replaced_and_an_unused_one_is():
    path = shm.path_of("thing")
    first, fresh = FILES.make(path, 8)
    FILES.publish(fresh, path)
    second, fresh = FILES.make(path, 16)
    with pytest.raises(XmExistsError, match="a thing of this name already exists"):
        FILES.publish(fresh, path)
    assert not fresh.exists()
    os.close(first)
    os.close(second)
    third, fresh = FILES.make(path, 16)
    FILES.publish(fresh, path)
    assert path.stat().st_size == 16
    shm.remove_same(path, third)
    os.close(third)


def test_only_the_same_file_is_removed():
    path = shm.path_of("thing")
    fd, fresh = FILES.make(path, 8)
    fresh.unlink()
    path.touch()
    shm.remove_same(path, fd)
    assert path.exists()
    os.close(fd)
    path.unlink()


@pytest.mark.parametrize("mask", [0o000, 0o077, 0o277])
def test_its_mode_is_the_same_under_every_umask(mask):
    path = shm.path_of("thing")
    before = os.umask(mask)
    try:
        fd, fresh = FILES.make(path, 8)
    finally:
        os.umask(before)
    FILES.publish(fresh, path)
    os.close(FILES.open(path)[0])
    os.close(fd)
    assert FILES.remove_unused(path)


def test_what_is_not_this_users_own_is_refused():
    path = shm.path_of("thing")
    path.touch(0o644)
    path.chmod(0o644)
    said = r"the thing's file is not .* own .*mode 0600, got -rw-r--r-- of user"
    with pytest.raises(XmAccessError, match=said):
        FILES.open(path)
    with pytest.raises(XmAccessError, match=said):
        FILES.remove_unused(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(XmAccessError, match=r"cannot be opened.*Is a directory"):
        FILES.open(path)
    path.rmdir()


def test_no_room_is_said_with_the_size():
    path = shm.path_of("thing")
    size = 1 << 60
    with pytest.raises(XmFullError, match="no room for the thing in shared") as caught:
        FILES.make(path, size)
    assert caught.value.expected == f"{size} free bytes"
    assert not list(shm.folder().glob("*.new"))


def test_a_folder_that_is_not_there_is_said(monkeypatch, tmp_path):
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path / "none"))
    with pytest.raises(XmAccessError, match=r"cannot be opened.*No such file"):
        FILES.make(shm.path_of("thing"), 8)
