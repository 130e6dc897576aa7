"""The fsspec file system over a filer in this process; see test_xm_files for agents."""

import io

import fsspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from pbonet.errors import (
    UnreachableError,
    XmAccessError,
    XmExistsError,
    XmMissingError,
    XmNameError,
)
from pbonet.node.filer import Filer
from pbonet.xm import carriers
from pbonet.xm import filing as f


class Desk:
    """A carrier that has the one agent in its own process."""

    name = "desk"

    def __init__(self, root):
        self.filer = Filer(str(root), "arm1")
        self.asked = []
        self.cut_after = 1 << 60

    def call(self, rtpu, request, result, *, timeout):
        assert (rtpu, timeout) == ("arm1", 5.0)
        if len(self.asked) >= self.cut_after:
            raise UnreachableError("cut", remedy="heal")
        self.asked.append(request)
        request.client = self.name
        got = self.filer.operations[type(request)](request)
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
    monkeypatch.setattr(carriers, "_carrier", made)
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
    desk.filer.lost("desk")
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
    file = fs.open("arm1/new", "xb")
    file.write(b"2")
    with pytest.raises(XmExistsError):
        file.close()
    assert (root / "new").read_bytes() == b"1"
    with pytest.raises(XmAccessError, match="is read or written, whole"):
        fs.open("arm1/new", "ab")
    (root / "sub").mkdir()
    with pytest.raises(XmAccessError, match="this is no regular file"):
        fs.open("arm1/sub")
    with pytest.raises(XmMissingError) as error:
        fs.open("arm1/none")
    assert isinstance(error.value, FileNotFoundError)
    with pytest.raises(XmNameError, match="the path names no RTPU"):
        fs.open("pbonet:///none")
