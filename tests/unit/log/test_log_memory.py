"""Memory that a log takes while it is written."""

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
