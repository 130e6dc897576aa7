"""The fsspec file system over a filer in this process; see test_xm_files for agents."""

import contextlib
import io
import os

import fsspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from pbonet.errors import (
    UnreachableError,
    XmAccessError,
    XmError,
    XmExistsError,
    XmMissingError,
    XmNameError,
)
from pbonet.node.agent.file_server import FileServer
from pbonet.xm.ipc import remote_channel
from pbonet.xm.net import file_messages as f


class Desk:
    """A carrier that has the agents in its own process."""

    name = "desk"

    def __init__(self, root):
        self.fileserver = FileServer(str(root), "arm1")
        self.filers = {"arm1": self.fileserver}
        self.asked = []
        self.cut_after = 1 << 60

    def call(self, rtpu, request, result, *, timeout):
        assert timeout == 5.0
        if len(self.asked) >= self.cut_after:
            raise UnreachableError("cut", remedy="heal")
        self.asked.append(request)
        request.client = self.name
        got = self.filers[rtpu].operations[type(request)](request)
        assert isinstance(got, result)
        return got

    def rtpus(self):
        return ["arm1"]


@pytest.fixture
def root(tmp_path):
    made = tmp_path / "root"
    made.mkdir()
    return made


@pytest.fixture
def desk(root, monkeypatch):
    made = Desk(root)
    monkeypatch.setattr(remote_channel, "_carrier", made)
    return made


@pytest.fixture
def fs(desk):
    assert desk.asked == []
    fsspec.get_filesystem_class("pbonet").clear_instance_cache()
    return fsspec.filesystem("pbonet")


def test_written_and_read_in_parts(fs, desk, root):
    data = np.random.default_rng(1).bytes(1_300_000)
    with fsspec.open("pbonet://arm1/big", "wb") as file:
        file.write(data[:900_000])
        assert not (root / "big").exists()
        file.write(data[900_000:])
    assert (root / "big").read_bytes() == data
    assert max(len(r.data) for r in desk.asked if isinstance(r, f.FileWrite)) <= f.CHUNK
    with fsspec.open("pbonet://arm1/big") as file:
        assert file.read() == data
        file.seek(-7, io.SEEK_END)
        assert file.read() == data[-7:]
    fs.pipe_file("arm1/none", b"")
    assert (root / "none").read_bytes() == b""


def test_text_numpy_and_mcap(fs):
    with fsspec.open("pbonet://arm1/a.txt", "w") as file:
        file.write("öne\ntwo\n")
    with fsspec.open("pbonet://arm1/a.txt", "r") as file:
        assert list(file) == ["öne\n", "two\n"]
    with fs.open("arm1/x.npy", "wb") as file:
        np.save(file, np.eye(300))
    assert np.load(fs.open("arm1/x.npy")).sum() == 300
    with fs.open("arm1/run.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(name="s", encoding="", data=b"")
        channel = writer.register_channel("q", "", schema)
        for n in range(100):
            writer.add_message(channel, n, b"x" * 100, n)
        writer.finish()
    found = make_reader(fs.open("arm1/run.mcap")).iter_messages()
    assert [message.log_time for _, _, message in found] == list(range(100))


def test_folders(fs, root, monkeypatch):
    monkeypatch.setattr(f, "PAGE", 2)
    fs.mkdir("arm1/logs/old")
    for name in "abc":
        fs.pipe_file(f"arm1/logs/{name}", b"12")
    assert fs.ls("pbonet://arm1/logs", detail=False) == [
        *("arm1/logs/a", "arm1/logs/b", "arm1/logs/c", "arm1/logs/old"),
    ]
    assert fs.find("pbonet://arm1") == [f"arm1/logs/{name}" for name in "abc"]
    assert fs.glob("pbonet://arm1/*/b") == ["arm1/logs/b"]
    assert fs.du("arm1") == 6
    assert fs.ls("", detail=False) == ["arm1"]
    assert fs.isdir("arm1")
    assert fs.isfile("arm1/logs/a")
    assert not fs.exists("arm1/logs/d")
    assert fs.modified("arm1/logs/a").year > 2000
    with pytest.raises(XmExistsError):
        fs.makedirs("arm1/logs")
    fs.makedirs("arm1/logs", exist_ok=True)
    fs.rm("arm1/logs", recursive=True)
    assert list(root.iterdir()) == []


def test_a_cut_amid_a_file_leaves_the_old_one(fs, desk, root):
    (root / "kept").write_text("old")
    file = fs.open("arm1/kept", "wb")
    file.write(bytes(f.CHUNK))
    desk.cut_after = len(desk.asked)
    with pytest.raises(UnreachableError):
        file.write(bytes(f.CHUNK))
    desk.cut_after = 1 << 60
    file.close()
    desk.fileserver.lost("desk")
    assert [path.name for path in root.iterdir()] == ["kept"]
    assert (root / "kept").read_text() == "old"


def test_a_transaction_is_all_or_nothing_of_each_file(fs, root):
    with fs.transaction:
        with fs.open("arm1/one", "wb") as file:
            file.write(b"1")
        assert not (root / "one").exists()
    assert (root / "one").read_bytes() == b"1"
    fs.start_transaction()
    with fs.open("arm1/two", "wb") as file:
        file.write(b"2")
    fs.transaction.complete(commit=False)
    assert [path.name for path in root.iterdir()] == ["one"]


def test_modes(fs, root):
    with fs.open("arm1/new", "xb") as file:
        file.write(b"1")
    with pytest.raises(XmExistsError, match="there is already a file at this path"):
        fs.open("arm1/new", "xb")
    file = fs.open("arm1/newer", "xb")
    file.write(b"2")
    (root / "newer").write_bytes(b"1")
    with pytest.raises(XmExistsError):
        file.close()
    assert (root / "newer").read_bytes() == b"1"
    with pytest.raises(XmAccessError, match="is read or written as a whole"):
        fs.open("arm1/new", "ab")
    (root / "sub").mkdir()
    with pytest.raises(XmAccessError, match="this is not a regular file"):
        fs.open("arm1/sub")
    with pytest.raises(XmMissingError) as error:
        fs.open("arm1/none")
    assert isinstance(error.value, FileNotFoundError)
    with pytest.raises(XmNameError, match="the path names no RTPU"):
        fs.open("pbonet:///none")


@pytest.fixture
def tree(root):
    """A folder with a file and a folder of two."""
    (root / "logs" / "old").mkdir(parents=True)
    for name in ("run", "old/a", "old/b"):
        (root / "logs" / name).write_text(name)
    return root / "logs"


@pytest.fixture
def other(desk, tmp_path):
    """The folder of a second machine, arm2."""
    made = tmp_path / "other"
    made.mkdir()
    desk.filers["arm2"] = FileServer(str(made), "arm2")
    return made


def files(folder):
    """Return what stands below a folder: files, and folders that hold nothing."""
    found = (path for path in folder.rglob("*"))
    kept = (
        p for p in found if not p.is_dir() or p.is_symlink() or not any(p.iterdir())
    )
    return sorted(str(path.relative_to(folder)) for path in kept)


def test_moved_on_one_machine(fs, desk, root, tree):
    """Under another name, into a folder, over a file; nothing of it travels."""
    fs.mv("pbonet://arm1/logs/run", "pbonet://arm1/logs/ran")
    fs.mv("arm1/logs/ran", "arm1/logs/old")
    assert files(root) == ["logs/old/a", "logs/old/b", "logs/old/ran"]
    fs.rename("arm1/logs/old/a", "arm1/logs/old/b")
    assert (tree / "old" / "b").read_text() == "old/a"
    fs.mv("arm1/logs/old", "arm1/kept/older")  # a folder, into one that is new
    assert files(root) == ["kept/older/b", "kept/older/ran", "logs"]
    fs.mv("arm1/kept/older/*", "arm1/logs/")
    assert files(root) == ["kept/older", "logs/b", "logs/ran"]
    fs.mv(["arm1/logs/b", "arm1/logs/ran"], ["arm1/c", "arm1/d"])
    fs.mv("arm1/d", "arm1/d")
    assert files(root) == ["c", "d", "kept/older", "logs"]
    (root / "lost").symlink_to(root / "nowhere")
    fs.mv("arm1/lost", "arm1/fresh/lost")
    assert files(root) == ["c", "d", "fresh/lost", "kept/older", "logs"]
    assert not [r for r in desk.asked if isinstance(r, f.FileRead | f.FileWrite)]


OUT = "out of the agent's folder"


@pytest.mark.parametrize(
    ("paths", "words"),
    [
        ("arm1/none arm1/new", "there is no such file"),
        ("arm1/none arm1/fresh/new", "arm1:none: there is no such file"),
        ("arm1/none/at arm1/fresh/new", "arm1:none/at: there is no such file"),
        ("arm1/logs arm1/logs/fresh/logs", "this move is not possible"),
        ("arm1 arm1/new", "this move is not possible"),
        ("arm1/logs arm1/logs/old/logs", "this move is not possible"),
        ("arm1/logs/run arm1/logs/../run", "this is not a valid path"),
        ("arm1/logs/run arm1/out/run", f"the path leads {OUT}"),
        ("arm1/out/secret arm1/got", f"the path leads {OUT}"),
    ],
)
@pytest.mark.usefixtures("tree")
def test_what_cannot_be_moved(fs, root, tmp_path, paths, words):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "secret").write_text("secret")
    (root / "out").symlink_to(tmp_path / "elsewhere")
    before = files(tmp_path)
    with pytest.raises(XmError, match=words):
        fs.mv(*paths.split())
    assert files(tmp_path) == before


@pytest.mark.usefixtures("tree")
def test_copied(fs, root, other):
    """A file, a folder with all it holds, by a pattern; also to another machine."""
    fs.cp_file("arm1/logs/run", "arm1/new/run")
    fs.copy("arm1/logs/old/*", "arm2/")
    fs.copy("arm1/logs", "arm2/all", recursive=True)
    assert files(other) == ["a", "all/old/a", "all/old/b", "all/run", "b"]
    assert (other / "all" / "old" / "a").read_text() == "old/a"
    assert files(root) == ["logs/old/a", "logs/old/b", "logs/run", "new/run"]


def test_a_copy_whose_source_is_cut_replaces_nothing(
    fs, desk, root, other, monkeypatch
):
    """Though its target is within reach; the same of any block that is left early."""
    (root / "new").write_bytes(bytes(3 * f.CHUNK))
    (other / "new").write_text("old")
    read = desk.fileserver._read

    def once(request):
        if request.offset:
            raise UnreachableError("cut", remedy="heal")
        return read(request)

    monkeypatch.setattr(desk.fileserver, "_read", once)
    with pytest.raises(UnreachableError):
        fs.cp_file("arm1/new", "arm2/new")
    with contextlib.suppress(KeyError), fs.open("arm2/new", "wb") as file:
        file.write(bytes(10))
        raise KeyError
    assert [path.name for path in other.iterdir()] == ["new"]
    assert (other / "new").read_text() == "old"


@pytest.mark.usefixtures("tree")
def test_moved_to_another_machine(fs, desk, root, other):
    """What was moved is gone at its old place, and only when its copy is whole."""
    fs.mv("arm1/logs/run", "arm2/run")
    fs.mv("arm1/logs", "arm2")
    assert files(root) == []
    assert files(other) == ["logs/old/a", "logs/old/b", "run"]
    (root / "logs").mkdir()
    (root / "logs" / "new").write_bytes(bytes(3 * f.CHUNK))
    with pytest.raises(XmExistsError, match="there is a folder at the new path"):
        fs.mv("arm1/logs", "arm2/")
    desk.cut_after = len(desk.asked) + 12
    with pytest.raises(UnreachableError):
        fs.mv("arm1/logs/new", "arm2/new")
    desk.filers["arm2"].lost("desk")
    assert files(root) == ["logs/new"]
    assert files(other) == ["logs/old/a", "logs/old/b", "run"]


@pytest.mark.usefixtures("tree")
def test_links_are_removed_not_what_they_lead_to(fs, root):
    (root / "runs").mkdir()
    (root / "runs" / "latest").symlink_to("../logs")
    (root / "runs" / "round").symlink_to(".")
    (root / "runs" / "lost").symlink_to("none")
    kinds = {one["name"]: one["islink"] for one in fs.ls("arm1/runs")}
    assert kinds == dict.fromkeys(
        ("arm1/runs/latest", "arm1/runs/lost", "arm1/runs/round"), True
    )
    assert fs.isdir("arm1/runs/latest")
    fs.rm("arm1/runs", recursive=True)
    assert files(root) == ["logs/old/a", "logs/old/b", "logs/run"]


def test_a_name_is_no_pattern_where_it_says_so(fs, root):
    for name in ("a*", "ab"):
        (root / name).write_text("x")
    fs.rm_exactly("arm1/a*")
    assert files(root) == ["ab"]
    with pytest.raises(XmMissingError):
        fs.rm_exactly("arm1/*", recursive=True)


def test_made_and_touched(fs, root, tree):
    fs.touch("arm1/new/empty")
    assert (root / "new" / "empty").read_bytes() == b""
    os.utime(tree / "run", (1.0, 1.0))
    fs.touch("arm1/logs/run", truncate=False)
    assert (tree / "run").read_text() == "run"
    assert (tree / "run").stat().st_mtime > 1e9
    fs.touch("arm1/logs/run")
    assert (tree / "run").read_bytes() == b""
    with pytest.raises(XmExistsError):
        fs.makedirs("arm1/logs/run", exist_ok=True)
    with pytest.raises(XmError, match="Directory not empty"):
        fs.rm("arm1/logs")


@pytest.mark.usefixtures("tree")
def test_a_cut_link_is_not_taken_for_a_missing_file(fs, desk):
    assert fs.exists("arm1/logs/run")
    assert not fs.exists("arm1/logs/none")
    desk.cut_after = 0
    for look in (fs.exists, fs.isfile, fs.isdir):
        with pytest.raises(UnreachableError):
            look("arm1/logs/run")


@pytest.mark.usefixtures("tree")
def test_walked(fs):
    assert list(fs.walk("arm1")) == [
        ("arm1", ["logs"], []),
        ("arm1/logs", ["old"], ["run"]),
        ("arm1/logs/old", [], ["a", "b"]),
    ]
    assert fs.info("pbonet://arm1/logs/old/a")["size"] == 5
    assert fs.glob("arm1/**/[ab]") == ["arm1/logs/old/a", "arm1/logs/old/b"]
    assert fs.cat("arm1/logs/old/*") == {
        "arm1/logs/old/a": b"old/a",
        "arm1/logs/old/b": b"old/b",
    }
