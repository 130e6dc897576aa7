"""Memory that a log takes while it is written."""

import subprocess
import sys
import textwrap
import tracemalloc

from mcap.reader import make_reader

from pbonet.log import LogWriter, RunAbout

CHUNKS = 500


def fill(writer: LogWriter, chunks: int) -> None:
    """Write chunks with a message of each channel."""
    event = {"rtpu": "c", "subsystem": "s", "task": "", "code": "X", "text": "x"}
    for n in range(chunks):
        writer.add_event({**event, "severity": 20, "time": n})
        writer.add_clocks(n, {"machine": "m"})
        writer.add_status(n, {"tasks": {}})
        writer.flush()


def test_a_chunk_takes_little_memory_until_the_file_ends(tmp_path) -> None:
    about = RunAbout(run="r", job="j", subsystem="s", domain="d", rtpu="c")
    writer = LogWriter(tmp_path / "a.mcap", about)
    fill(writer, 10)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        fill(writer, CHUNKS)
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert writer.chunks == CHUNKS + 10
    assert (after - before) / CHUNKS < 250, "bytes; the library's own index took 570"
    writer.close()
    with writer.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert len(summary.chunk_indexes) == CHUNKS + 10
    assert all(len(one.message_index_offsets) == 3 for one in summary.chunk_indexes)


def test_a_recorder_writes_without_numpy(tmp_path) -> None:
    """It would be a third of a recorder's memory, and most of its start."""
    code = textwrap.dedent("""
        import sys
        from pathlib import Path
        from pbonet.config.model import Variable
        from pbonet.log import LogWriter, RunAbout, TaskAbout
        from pbonet.log.schema import HEAD_BYTES, RECORD
        from pbonet.node.recorder import recorder_process
        same = {"domain": "d", "rtpu": "c", "subsystem": "s"}
        writer = LogWriter(Path(sys.argv[1]), RunAbout(run="r", job="j", **same))
        task = {"task": "t", "module": "m", "pid": 1, "freq": 1.0, "rmod": ""}
        out = [Variable(name="Y", type="double", nelem=6)]
        number = writer.add_task(TaskAbout(rmod_name="", outvar=out, **same, **task))
        size = RECORD.size + HEAD_BYTES + 48
        writer.add(number, RECORD.pack(size, 0, 48, 0, 0, 0) + bytes(HEAD_BYTES + 48))
        writer.close()
        print("numpy" in sys.modules)
    """)
    ran = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.mcap")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ran.stdout, ran.stderr) == ("False\n", "")
