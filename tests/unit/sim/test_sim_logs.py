"""The log of a simulated run says what that of a run in real time says."""

from __future__ import annotations

from pathlib import Path

import pytest
from adding_module import SVAR

from pbonet.errors import LogError
from pbonet.log import Log, Step, text
from pbonet.log.groups import size
from pbonet.master.configuration.environment import Place
from pbonet.master.console.run_job import run
from pbonet.master.sim import sim_log
from pbonet.testing import rerun, verify

FRAGILE = '''
from typing import Annotated as A

from pbonet import InVar, OutVar, Params, PortBasedObject, Vector, param


class When(Params):
    """When it fails."""

    at: A[int, param("1", "cycle in which it fails", ge=0)] = 0


class Fragile(PortBasedObject[When]):
    """It warns in its tenth cycle, and fails in another one."""

    z: A[Vector, InVar("Z", "2", "none", "heard")]
    y: A[Vector, OutVar("Y", "2", "none", "told")]

    def on(self) -> None:
        self.count = 0

    def cycle(self, dt: float) -> None:
        self.count += 1
        if self.count == 10:
            self.task.warn("ten")
        if self.count == self.params.at:
            raise ValueError("it breaks")
        self.y[:] = self.z + 1.0
'''
FRAGILE_RMOD = (
    "MODULE fragile\nDESC d\nSVARALIAS Z={z}\nSVARALIAS Y={y}\nINCONST none\n"
    "OUTCONST none\nINVAR Z\nOUTVAR Y\nTASKTYPE periodic\nFREQ 100\n"
    "LOCAL\nat {at}\nEOF\n"
)


def job(folder, *, a=0, b=0) -> Path:
    """Write a job of two tasks that fail in these cycles; 0: never."""
    (folder / "fragile.py").write_text(FRAGILE)
    (folder / "x.job").write_text("JOB x\nDESC\nSBS x.sbs\nTASK a\nTASK b\nEOF\n")
    (folder / "a.rmod").write_text(FRAGILE_RMOD.format(z="X", y="Y", at=a))
    (folder / "b.rmod").write_text(FRAGILE_RMOD.format(z="Y", y="X", at=b))
    (folder / "x.sbs").write_text("SUBSYSTEM x\nSVARFILE x.svar\nRTPU r\nEOF\n")
    (folder / "x.svar").write_text(SVAR)
    return folder / "x.job"


def simulated(folder, seconds, record=None, **fails):
    return run(
        job(folder, **fails),
        Place(libraries=(str(folder),)),
        seconds=seconds,
        sim=True,
        runs=folder / "runs",
        quiet=True,
        record=record,
    )


def test_its_events_and_states_are_in_the_log(tmp_path) -> None:
    outcome = simulated(tmp_path, 1.0, a=50)
    log = Log(outcome.log)
    told = [(one["task"], one["code"], one["text"]) for one in log.events()]
    spawned = [one[:2] for one in told[:2]]
    assert spawned == [("a", "SPAWNED"), ("b", "SPAWNED")]
    assert [one for one in told if one[1] == "WARNING"] == [
        ("a", "WARNING", "ten"),
        ("b", "WARNING", "ten"),
    ]
    (failed,) = [one for one in log.events() if one["code"] == "METHOD"]
    assert (failed["task"], failed["state"], failed["severity"]) == ("a", "ERROR", 40)
    assert "fragile.py:" in failed["place"]
    assert "it breaks" in failed["text"]
    assert [one[2] for one in told if one[1] == "ILLEGAL"] == ["a is in ERROR (r/a)"]
    assert told[-1][1:] == ("STOPPED", "2 tasks ended")
    data = text.info(log)
    states = {name: one["timeline"] for name, one in data["tasks"].items()}
    assert [state for state, _ in states["a"]] == ["OFF", "ON", "ERROR", "NOT-CREATED"]
    assert [state for state, _ in states["b"]] == ["OFF", "ON", "OFF", "NOT-CREATED"]
    assert data["tasks"]["a"]["states"]["ON"] == pytest.approx(0.49, abs=0.011)
    counts = {
        name: (one["cycles"], one["missed"]) for name, one in data["tasks"].items()
    }
    assert counts == {"a": (49, 0), "b": (100, 0)}
    assert data["tasks"]["a"]["gaps"] == 0
    assert data["tasks"]["a"]["rtpu"] == "r"
    assert data["tasks"]["a"]["freq"] == 100.0
    assert log.missed() == {"a": 0, "b": 0}, "somebody has counted"


def test_each_task_can_be_verified_by_itself(tmp_path) -> None:
    log = Log(simulated(tmp_path, 0.5).log)
    verdicts = verify(log)
    assert [(one.good, one.cycles) for one in verdicts] == [(True, 50), (True, 50)]
    code = tmp_path / "fragile.py"
    code.write_text(code.read_text().replace("+ 1.0", "+ 2.0"))
    (verdict, _) = verify(log)
    assert verdict.divergence.cycle == 1
    assert verdict.changed, "the file is told, as its log has it"


def test_all_has_the_inputs_of_every_cycle(tmp_path) -> None:
    stored = {}
    for mode in ("outputs", "all"):
        (tmp_path / mode).mkdir()
        log = Log(simulated(tmp_path / mode, 0.2, record=mode).log)
        (life,) = log.lives("b")
        rows = [life.schema.rest(one)[1] for one in life.commits[1:]]
        assert {len(one) for one in rows} <= {0, size(life.about.invar)}
        stored[mode] = sum(map(bool, rows))
        kinds = [Step(int(one)) for one in life.schema.arrays(life.commits)["kind"]]
        assert kinds == [Step.CLAIM, *[Step.CYCLE] * 20, Step.COMMIT]
        assert all(verdict.good for verdict in verify(log))
    assert stored == {"outputs": 1, "all": 20}


def test_last_is_written_behind_an_error_only(tmp_path) -> None:
    (tmp_path / "good").mkdir()
    good = simulated(tmp_path / "good", 1.0, record="last 0.3")
    assert (good.log, good.recording) == ("", None)
    assert not (tmp_path / "good" / "runs").exists()
    outcome = simulated(tmp_path, 5.0, record="last 0.3", a=100, b=400)
    names = sorted(path.name for path in Path(outcome.log).iterdir())
    assert names == ["run-2.mcap", "run.mcap"], "each error makes a file"
    log = Log(outcome.log)
    b = log.arrays("b")["cycle"].tolist()
    first, second = [n for n in b if n <= 250], [n for n in b if n > 250]
    # 0.3 s before it and one second behind it, as in real time.
    assert first == list(range(first[0], first[-1] + 1))
    assert (first[0], first[-1]) == pytest.approx((70, 200), abs=10)
    assert (second[0], second[-1]) == pytest.approx((370, 399), abs=10)
    assert log.tasks == ["a", "b"]
    assert [one["task"] for one in log.events() if one["code"] == "METHOD"] == [
        "a",
        "b",
    ]
    assert "fragile.py" in " ".join(log.attached)
    assert rerun(log).good, "what there is comes out the same"


def test_last_keeps_no_more_than_it_must(tmp_path, monkeypatch) -> None:
    begin, logs = sim_log.begin, []

    def begun(*args, **options):
        logs.append(begin(*args, **options))
        return logs[-1]

    monkeypatch.setattr(sim_log, "begin", begun)
    found = simulated(tmp_path, 9.0, record="last 0.5")
    (rtpu,) = logs[0]._rtpus.values()
    times = [at for at, *_ in rtpu._files._kept]
    assert times[-1] - times[0] <= 0.5
    kept = sum(len(records) for *_, records in rtpu._files._kept)
    assert 0 < kept < 2 * 60 * 300, "of two tasks, 60 cycles at most"
    assert (found.recording, found.log) == (None, "")


def test_that_it_cannot_be_written_is_a_fault_of_the_run(tmp_path) -> None:
    (tmp_path / "runs").touch()
    outcome = simulated(tmp_path, 0.2)
    assert outcome.status == 1
    assert outcome.log == ""
    assert "cannot grow" in outcome.faults[0]


def test_a_simulation_that_is_no_way_to_record_is_refused_first(tmp_path) -> None:
    with pytest.raises(LogError, match="this is not a recording mode"):
        simulated(tmp_path, 0.1, record="last")
    assert not (tmp_path / "runs").exists()


def test_a_log_that_was_cut_is_simulated_again_as_far_as_it_goes(tmp_path) -> None:
    whole = Path(simulated(tmp_path, 3.0).log, "run.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 9 // 10])
    found = rerun(cut)
    assert found.good
    assert 0 < found.tasks[0].cycles <= 300
