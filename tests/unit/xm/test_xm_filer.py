"""Files for other machines: confined to a folder, whatever is asked."""

import os

import pytest

from pbonet.errors import (
    NodeError,
    XmAccessError,
    XmError,
    XmExistsError,
    XmFullError,
    XmLapsedError,
    XmMissingError,
    XmNameError,
)
from pbonet.node.agent import file_server as server
from pbonet.xm.net import file_messages as f, roles


@pytest.fixture
def root(tmp_path):
    made = tmp_path / "root"
    (made / "logs").mkdir(parents=True)
    (made / "logs" / "run.txt").write_text("0123456789")
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "file").write_text("secret")
    return made


@pytest.fixture
def ask(root):
    """Ask a filer something, as its office does."""
    fileserver = server.FileServer(str(root), "arm1")

    def do(request, client="c1"):
        request.client = client
        return fileserver.operations[type(request)](request)

    do.fileserver = fileserver
    return do


def write(ask, path, data, *, part="a1", client="c1", **how):
    ask(f.FileWrite(path=path, part=part, offset=0, data=data), client)
    ask(f.FileFinish(path=path, part=part, size=len(data), keep=True, **how), client)


def test_looking(ask):
    assert ask(f.FileRead(path="logs/run.txt", offset=2, size=3)) == b"234"
    assert ask(f.FileRead(path="/logs//run.txt", offset=10, size=3)) == b""
    found = ask(f.FileStat(path="logs/run.txt"))
    assert (found.name, found.type, found.size) == ("run.txt", "file", 10)
    assert [one.name for one in ask(f.FileList(path="")).entries] == ["logs"]
    assert ask(f.FileStat(path="")).type == "directory"


def test_long_folders_come_in_pages(ask, root, monkeypatch):
    monkeypatch.setattr(f, "PAGE", 2)
    for name in "abc":
        (root / name).touch()
    first = ask(f.FileList(path=""))
    assert ([e.name for e in first.entries], first.more, first.last) == (
        ["a", "b"],
        True,
        "b",
    )
    second = ask(f.FileList(path="", after="b"))
    assert ([e.name for e in second.entries], second.more) == (["c", "logs"], False)


HOSTILE = [
    "../secret",
    "logs/../../secret",
    "..",
    "logs\0",
    "x" * 5000,
    "a/" * 100 + "b",
    "\ud800",
]


@pytest.mark.parametrize("path", HOSTILE)
@pytest.mark.parametrize(
    "make",
    [
        lambda path: f.FileStat(path=path),
        lambda path: f.FileList(path=path),
        lambda path: f.FileRead(path=path, offset=0, size=10),
        lambda path: f.FileWrite(path=path, part="a", offset=0, data=b""),
        lambda path: f.FileChange(path=path, what="remove"),
        lambda path: f.FileChange(path=path, what="mkdir"),
        lambda path: f.FileChange(path=path, what="touch"),
        lambda path: f.FileMove(path=path, to="got"),
        lambda path: f.FileMove(path="logs/run.txt", to=path),
    ],
)
def test_paths_that_mean_harm(ask, root, path, make):
    with pytest.raises((XmError, ValueError)):
        ask(make(path))
    assert (root.parent / "secret").read_text() == "secret"


def test_an_absolute_path_begins_in_the_folder(ask):
    with pytest.raises(XmMissingError):
        ask(f.FileRead(path="/etc/passwd", offset=0, size=10))


def test_links_are_followed_within_the_folder_only(ask, root):
    (root / "out").symlink_to(root.parent / "outside")
    (root / "out.txt").symlink_to("../secret")
    (root / "in.txt").symlink_to("logs/run.txt")
    assert ask(f.FileRead(path="in.txt", offset=0, size=3)) == b"012"
    for path in ("out/file", "out.txt", "out"):
        with pytest.raises(XmAccessError) as error:
            ask(f.FileRead(path=path, offset=0, size=3))
        assert str(error.value) == (
            f"arm1:{path}: the path leads out of the agent's folder; copy the file "
            "into the folder"
        )
    with pytest.raises(XmAccessError):
        write(ask, "out/new", b"x")
    with pytest.raises(XmAccessError):
        ask(f.FileChange(path="out/file", what="remove"))
    with pytest.raises(XmAccessError):
        ask(f.FileChange(path="out.txt", what="touch"))
    for path, to in (("out/file", "got"), ("logs/run.txt", "out/run.txt")):
        with pytest.raises(XmAccessError):
            ask(f.FileMove(path=path, to=to))
    kinds = {one.name: one.type for one in ask(f.FileList(path="")).entries}
    assert kinds == {
        "in.txt": "file",
        "logs": "directory",
        "out": "other",
        "out.txt": "other",
    }
    ask(f.FileChange(path="out.txt", what="remove"))
    assert (root.parent / "secret").exists(), "the link went, not what it leads to"


def test_a_link_put_in_the_way_meanwhile_is_refused(ask, root, monkeypatch):
    real = os.path.realpath

    def swapped(path):
        found = real(path)
        (root / "logs").rename(root / "old")
        (root / "logs").symlink_to(root.parent / "outside")
        return found

    (root.parent / "outside" / "run.txt").write_text("secret")
    monkeypatch.setattr(server.os.path, "realpath", swapped)
    with pytest.raises(XmError):
        ask(f.FileRead(path="logs/run.txt", offset=0, size=6))


def test_only_regular_files_are_read(ask, root):
    os.mkfifo(root / "pipe")
    for path in ("pipe", "logs"):
        with pytest.raises(XmAccessError, match="this is not a regular file"):
            ask(f.FileRead(path=path, offset=0, size=3))


def test_a_file_appears_whole(ask, root):
    ask(f.FileWrite(path="logs/new", part="a1", offset=0, data=b"half"))
    assert not (root / "logs" / "new").exists()
    ask(f.FileWrite(path="logs/new", part="a1", offset=0, data=b"half"))  # repeated
    ask(f.FileWrite(path="logs/new", part="a1", offset=4, data=b" and half"))
    ask(f.FileFinish(path="logs/new", part="a1", size=13, keep=True))
    assert (root / "logs" / "new").read_text() == "half and half"
    assert sorted(p.name for p in (root / "logs").iterdir()) == ["new", "run.txt"]


@pytest.mark.parametrize(
    "name", ["läufe/ß", "🦾" * 63, "n" * 255], ids=["letters", "wide", "long"]
)
def test_names_are_those_of_the_file_system(ask, root, name):
    """Of any letters, and as long as it takes."""
    (root / "läufe").mkdir()
    write(ask, name, b"1")
    write(ask, name, b"2")
    assert ask(f.FileRead(path=name, offset=0, size=9)) == b"2"
    assert (root / name).read_bytes() == b"2"


def test_what_is_not_finished_leaves_the_old_file(ask, root):
    ask(f.FileWrite(path="logs/run.txt", part="a1", offset=0, data=b"x"))
    ask.fileserver.lost("another")
    ask.fileserver.lost("c1")
    for late in (
        f.FileWrite(path="logs/run.txt", part="a1", offset=1, data=b"y"),
        f.FileFinish(path="logs/run.txt", part="a1", size=1, keep=True),
    ):
        with pytest.raises(XmLapsedError, match="an existing file is unchanged"):
            ask(late)
    ask(f.FileWrite(path="logs/run.txt", part="a2", offset=0, data=b"x"))
    with pytest.raises(XmLapsedError):
        ask(f.FileFinish(path="logs/run.txt", part="a2", size=7, keep=True))
    assert (root / "logs" / "run.txt").read_text() == "0123456789"
    assert [p.name for p in (root / "logs").iterdir()] == ["run.txt"]


def test_a_fresh_file_replaces_nothing(ask, root):
    write(ask, "new", b"1", fresh=True)
    with pytest.raises(XmExistsError):
        write(ask, "new", b"2", fresh=True)
    assert sorted(path.name for path in root.iterdir()) == ["logs", "new"]


def test_one_client_does_not_write_into_anothers_file(ask):
    ask(f.FileWrite(path="new", part="a1", offset=0, data=b"x"))
    with pytest.raises(XmLapsedError):
        ask(f.FileFinish(path="new", part="a1", size=1, keep=True), "c2")
    with pytest.raises(XmExistsError):
        ask(f.FileWrite(path="new", part="a1", offset=0, data=b"y"), "c2")
    ask.fileserver.lost("c1")


def test_a_replaced_file_is_noticed(ask, root):
    inode = ask(f.FileStat(path="logs/run.txt")).inode
    (root / "logs" / "other").write_text("other")
    (root / "logs" / "other").rename(root / "logs" / "run.txt")
    with pytest.raises(XmLapsedError, match="replaced while it was read"):
        ask(f.FileRead(path="logs/run.txt", offset=0, size=1, inode=inode))


def test_bounds(ask, monkeypatch):
    monkeypatch.setattr(server, "PARTS", 1)
    ask(f.FileWrite(path="a", part="a1", offset=0, data=b"x"))
    with pytest.raises(XmFullError, match="too many files are being written"):
        ask(f.FileWrite(path="b", part="b1", offset=0, data=b"x"))
    with pytest.raises(XmNameError, match="not a valid name of a part"):
        ask(f.FileWrite(path="b", part="../x", offset=0, data=b"x"))
    with pytest.raises(XmNameError, match="this change is not possible"):
        ask(f.FileChange(path="", what="rmdir"))
    ask.fileserver.lost("c1")


def test_folders(ask, root):
    ask(f.FileChange(path="logs/old", what="mkdir"))
    with pytest.raises(XmExistsError):
        ask(f.FileChange(path="logs/old", what="mkdir"))
    ask(f.FileChange(path="logs/old", what="rmdir"))
    with pytest.raises(XmError, match="Directory not empty"):
        ask(f.FileChange(path="logs", what="rmdir"))
    assert (root / "logs").is_dir()


def test_an_agent_that_declares_none_says_how():
    fileserver = server.FileServer(None, "arm1")
    with pytest.raises(XmAccessError) as error:
        fileserver.operations[f.FileStat](f.FileStat(path="x"))
    assert str(error.value) == (
        "arm1: this agent declares no files (expected files = FOLDER in its "
        "agent.toml, or --files FOLDER); start it with one of these; every master can "
        "then write to it"
    )


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(
        NodeError, match="folder of files for other machines does not exist"
    ):
        server.FileServer(str(tmp_path / "none"), "arm1")


@pytest.mark.parametrize(
    ("request_", "leaf"),
    [
        (f.FileStat(path="a"), "status"),
        (f.FileList(path="a"), "status"),
        (f.FileRead(path="a", offset=0, size=1), "status"),
        (f.FileWrite(path="a", part="a", offset=0, data=b""), "mail"),
        (f.FileFinish(path="a", part="a", size=0, keep=True), "mail"),
        (f.FileChange(path="a", what="remove"), "mail"),
        (f.FileMove(path="a", to="b"), "mail"),
    ],
)
def test_observers_read_and_masters_write(request_, leaf):
    assert roles.leaf(request_) == leaf
