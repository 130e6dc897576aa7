"""A tool is changed in virtual time as it is on agents."""

import threading

import pytest
import tool_constants

from benchmarks import steering
from pbonet.config import Library
from pbonet.errors import MethodError
from pbonet.master import Subsystem


@pytest.fixture
def held(tmp_path):
    """The grip is held: 20 N at 0.5 m."""
    library, folder = tmp_path / "library", tmp_path / "tools"
    library.mkdir()
    tool_constants.write(folder, library)
    with Subsystem(
        folder / "tools.sbs",
        libraries=[library],
        virtual=True,
        warned=lambda _text: None,
    ) as subsystem:
        subsystem.start("grip")
        yield subsystem


def torque(held):
    held.clock.wait(0.02, threading.Event())
    return held.display(["F"])[0].values


def test_tools_are_changed_and_changed_back(held):
    assert torque(held) == [10.0]
    assert held.switch("drill", dry_run=True).replaces == {"drill": ["grip"]}
    assert torque(held) == [10.0]
    held.switch("drill")
    assert torque(held) == [30.0]
    assert "grip" not in held.model
    held.swap("drill", "grip")
    assert torque(held) == [10.0]
    held.swap("grip", "drill")
    assert torque(held) == [30.0]
    with pytest.raises(MethodError, match="another value"):
        held.control("grip", "reinit")
    held.control("grip", "kill")
    with pytest.raises(MethodError, match="drill"):
        held.spawn("grip")  # in nobody's place


def test_a_tool_that_somebody_cannot_take_is_put_back(held):
    with pytest.raises(MethodError, match="too heavy"):
        held.switch("anvil")
    assert torque(held) == [10.0]
    assert [held.display([name])[0].values for name in ("MASS", "LENGTH")] == [
        [2.0],
        [0.5],
    ]
    assert held.model.names == ["grip", "weigh", "hold"]


def test_who_could_not_take_a_constant_in_does_so_before_it_comes_on(held):
    held.set("grip", "mass", 200.0)
    for again in ("reinit grip", "on weigh"):
        signal, task = again.split()
        with pytest.raises(MethodError, match="too heavy"):
            held.control(task, signal)
        assert held.status("weigh").state == "ERROR"
        held.clear("weigh")
    assert torque(held) == [10.0]
    held.set("weigh", "heaviest", 300.0)
    told = []
    held.warned = told.append
    held.on("weigh")
    assert torque(held) == [1000.0], "and who uses what it gives has the new value"
    assert "on of weigh: re-initialized hold" in told


def test_a_spawn_reads_the_library_once(tmp_path, monkeypatch):
    """Its remedies name RMODs; the folders are not searched before and after it."""
    read, seen = Library.records, []
    monkeypatch.setattr(Library, "records", lambda one: seen.append(one) or read(one))
    (tmp_path / "wave.sbs").write_text(steering.SBS.replace("steering", "wave"))
    (tmp_path / "wave.svar").write_text(steering.SVAR)
    warned = []
    with Subsystem(tmp_path / "wave.sbs", virtual=True, warned=warned.append) as wave:
        wave.spawn("sine", hz=100.0)
        assert len(seen) == 1
        assert "no task produces the constant NDOF" in warned[0]
        wave.control("sine", "kill")
        wave.spawn("sine", hz=100.0)
        assert len(seen) == 2
        wave.graph()
    assert len(seen) == 3, "a notebook shows it when a file was added"
