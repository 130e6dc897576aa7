"""Files of another machine by fsspec, as numpy and MCAP readers use them."""

import pytest
from far_rig import LEASE_MS, UNSEEN, VERB, Cell, RefusedError, Site
from nodekit import Master, rmod

pytestmark = pytest.mark.timeout(300)
TASK = """
import fsspec
from typing import Annotated as A
from pbonet import OutVar, PortBasedObject, Vector


class Looker(PortBasedObject):
    y: A[Vector, OutVar("Y", "2", "none", "what a file of another machine says")]

    def init(self):
        with fsspec.open("pbonet://vision0/numbers.txt", "r") as file:
            self.numbers = [float(word) for word in file.read().split()]

    def cycle(self, dt):
        self.y[:] = self.numbers
"""


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """Two machines; vision0 declares a folder of files."""
    library = tmp_path_factory.mktemp("library")
    (library / "looker.py").write_text(TASK)
    made = Cell(LEASE_MS)
    made.a.files = tmp_path_factory.mktemp("files")
    try:
        made.start(library)
        yield made
    finally:
        made.close()


@pytest.fixture
def hand(cell):
    """A program on the other machine."""
    made = cell.hand(cell.b)
    made.do("import fsspec, io, numpy as np")
    made.do("fs = fsspec.filesystem('pbonet')")
    yield made
    made.kill()
    cell.b.programs.remove(made)


def test_as_a_local_file(cell, hand):
    hand.do("data = np.random.default_rng(1).bytes(3_000_000)")
    hand.do("f = fsspec.open('pbonet://vision0/a/big', 'wb')  # makes the folder")
    hand.do("with f as file: file.write(data)")
    assert (cell.a.files / "a" / "big").stat().st_size == 3_000_000
    assert hand.do("fsspec.open('pbonet://vision0/a/big').open().read() == data") == (
        "True"
    )
    hand.do("file = fs.open('vision0/a/big')")
    hand.do("file.seek(-5, 2)")
    assert hand.do("file.read() == data[-5:]") == "True"
    assert hand.do("fs.ls('vision0', detail=False)") == ["vision0/a"]
    assert hand.do("fs.ls('', detail=False)") == ["arm0", "vision0"]
    assert hand.do("fs.find('pbonet://vision0')") == ["vision0/a/big"]
    assert hand.do("fs.size('vision0/a/big')") == "3000000"
    with pytest.raises(RefusedError) as caught:
        hand.do("fs.open('vision0/none')")
    assert caught.value.kind == "XmMissingError"
    with pytest.raises(RefusedError, match="read or written as a whole"):
        hand.do("fs.open('vision0/a/big', 'ab')")
    with pytest.raises(RefusedError, match="this agent declares no files"):
        hand.do("fs.ls('arm0')")
    hand.do("fs.rm('vision0/a', recursive=True)")
    assert list(cell.a.files.iterdir()) == []


def test_numpy_and_mcap(cell, hand):
    hand.do("with fs.open('vision0/x.npy', 'wb') as file: np.save(file, np.eye(300))")
    assert hand.do("float(np.load(fs.open('vision0/x.npy')).sum())") == "300.0"
    hand.do(
        "from mcap.writer import Writer\n"
        "from mcap.reader import make_reader\n"
        "with fs.open('vision0/run.mcap', 'wb') as file:\n"
        "    writer = Writer(file); writer.start()\n"
        "    schema = writer.register_schema(name='s', encoding='', data=b'')\n"
        "    channel = writer.register_channel('q', '', schema)\n"
        "    for n in range(100): writer.add_message(channel, n, b'x' * 100, n)\n"
        "    writer.finish()\n"
    )
    assert (cell.a.files / "run.mcap").read_bytes()[:5] == b"\x89MCAP"
    hand.do("messages = make_reader(fs.open('vision0/run.mcap')).iter_messages()")
    assert hand.do("[m.log_time for _, _, m in messages]") == list(range(100))
    for name in ("x.npy", "run.mcap"):
        hand.do(f"fs.rm_file('vision0/{name}')")


def test_a_cut_cable_amid_a_file(cell, hand):
    hand.do("with fs.open('vision0/kept', 'wb') as file: file.write(b'old')")
    hand.do("file = fs.open('vision0/kept', 'wb'); file.write(bytes(1 << 20))")
    hand.do("reading = fs.open('vision0/kept')")
    cell.cable.cut()
    try:
        for code in ("file.write(bytes(1 << 20)); file.close()", "reading.read()"):
            with pytest.raises(RefusedError) as caught:
                hand.do(f"exec({code!r})")
            assert caught.value.kind in UNSEEN
    finally:
        cell.cable.heal()
    hand.wait("fs.exists('vision0/kept')", "True")
    hand.wait("file.close()", "None")
    hand.wait("fs.ls('vision0', detail=False) == ['vision0/kept']", "True")
    assert (cell.a.files / "kept").read_text() == "old", "what stood there stands"
    hand.wait("fs.cat_file('vision0/kept')", "b'old'")
    (cell.a.files / "kept").unlink()


def test_verbs_copy_list_and_remove(cell, hand, tmp_path):
    hand.do(VERB)
    folder = tmp_path / "maps"
    folder.mkdir()
    (folder / "floor").write_bytes(bytes(range(256)) * 5000)
    (folder / "roof").write_text("roof")

    def verb(*words):
        return hand.do(f"verb(*{[str(word) for word in words]!r})")

    assert verb("file", "put", folder / "floor", "vision0/a/b/floor")[0] == 0
    status, data = verb("file", "put", folder / "roof", "vision0/a/b/")
    assert (status, data["file"]) == (0, "vision0/a/b/roof")
    assert verb("file", "put", folder, "vision0/all")[0] == 1
    assert verb("file", "put", folder, "vision0/all", "-r")[0] == 0
    assert (cell.a.files / "all" / "roof").read_text() == "roof"
    found = verb("file", "ls", "vision0/a/b")[1]["entries"]
    assert [(one["name"], one["size"]) for one in found] == [
        ("vision0/a/b/floor", 1_280_000),
        ("vision0/a/b/roof", 4),
    ]
    assert "vision0" in [one["name"] for one in verb("file", "ls")[1]["entries"]]
    (tmp_path / "here").mkdir()
    assert verb("file", "get", "vision0/a/b/floor", tmp_path / "here")[0] == 0
    assert (tmp_path / "here" / "floor").read_bytes() == bytes(range(256)) * 5000
    assert verb("file", "get", "vision0/all", tmp_path / "copy", "-r")[0] == 0
    assert (tmp_path / "copy" / "roof").read_text() == "roof"
    starred = folder.rename(tmp_path / "al*")
    assert verb("file", "put", starred, "vision0/al*", "-r")[0] == 0
    assert verb("file", "get", "vision0/al*", tmp_path / "one", "-r")[0] == 0
    assert sorted(one.name for one in (tmp_path / "one").iterdir()) == ["floor", "roof"]
    assert verb("file", "rm", "vision0/al*", "-r")[0] == 0
    folder = starred.rename(folder)
    status, data = verb("file", "get", "vision0/none", tmp_path / "none")
    assert (status, data["error"]["code"]) == (1, "XM_MISSING")
    assert verb("file", "get", "vision0/a", tmp_path / "x")[0] == 1
    assert not [*tmp_path.glob(".*")]
    assert verb("file", "rm", "vision0/a")[0] == 1, "it is not empty"
    assert verb("file", "rm", "vision0/*", "-r")[0] == 1, "a name is no pattern"
    assert verb("file", "put", folder / "roof", "vision0/a*")[0] == 0
    assert verb("file", "rm", "vision0/a*", "-r")[0] == 0
    assert verb("file", "put", folder / "roof", "vision0/")[0] == 0
    assert verb("file", "rm", "vision0/roof")[0] == 0
    for name in ("a", "all"):
        assert verb("file", "rm", f"vision0/{name}", "--recursive")[0] == 0
    assert not [*cell.a.files.iterdir()]


def test_a_killed_writer_leaves_nothing(cell, hand):
    other = cell.hand(cell.b)
    other.do("import fsspec")
    other.do("file = fsspec.open('pbonet://vision0/half', 'wb').open()")
    other.do("file.write(bytes(1 << 20))")
    assert [path.name[:6] for path in cell.a.files.iterdir()] == [".half."]
    other.kill()
    cell.b.programs.remove(other)
    hand.wait("len(fs.ls('vision0'))", "0")


def test_a_module_opens_one_like_a_local_file(cell):
    (cell.a.files / "numbers.txt").write_text("3 4")
    site = Site(cell.b)
    master = Master(site, "arm0", "arm")
    try:
        master.open_table()
        master.spawn("looker", "looker", text=rmod("looker"))
        master.on("looker")
        master.wait_cycles("looker", 2)
        assert master.value("Y0").values == [3.0, 4.0]
    finally:
        master.stop()
        site.session.close()
        (cell.a.files / "numbers.txt").unlink()
