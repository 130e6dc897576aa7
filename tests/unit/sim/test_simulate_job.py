"""A job in virtual time: schedules, pictures, and modules that meet their delays."""

from __future__ import annotations

import json
from xml.etree import ElementTree

import pytest
from test_sim_rules import SINK, SOURCE, Shop

from pbonet.analysis.legality import Times
from pbonet.errors import SeveralError, VerificationError
from pbonet.master.subsystem.subsystem import Subsystem
from pbonet.master.tools import schedule_job

Y, Z = "OUTVAR Y", "OUTVAR Z"


@pytest.fixture
def shop(tmp_path):
    """A source and a sink at 100 Hz, each on an RTPU of its own."""
    found = Shop(tmp_path)
    found.module("source", SOURCE, Y, "FREQ 100", "MAXC 0.004")
    found.module("sink", SINK, "INVAR Y", Z, "FREQ 100", "MAXC 0.001")
    found.job("source a", "sink b")
    return found


def run(shop, seconds=0.1, **more):
    path = shop.folder / "test.job"
    return schedule_job.simulate(path, seconds, [shop.folder / "lib"], **more)


def overload(shop):
    """Three tasks on one RTPU that ask for 125 % of it; the slowest gives way."""
    shop.rmod("slow", "sink", "INVAR Y", Z, "FREQ 40", "MAXC 0.0125")
    shop.rmod("source", "source", Y, "FREQ 100", "MAXC 0.0075")
    shop.job("source a", "slow a")


def test_given_times_make_the_schedule(shop):
    outcome, told = run(shop, 1.0)
    assert told == []
    assert outcome.missing == set()
    source = outcome.rtpus["a"].tasks["source"]
    assert (source.releases, source.cycles, source.cpu_ns) == (101, 100, 400_000_000)
    assert set(source.responses_ns) == {4_000_000}


def test_an_overload_is_shown_and_not_refused(shop):
    overload(shop)
    outcome, told = run(shop, 1.0)
    assert outcome.missing == {"slow"}
    assert "on RTPU a slow may miss deadlines" in told[0]
    (shop.folder / "shop.sbs").write_text(
        (shop.folder / "shop.sbs")
        .read_text()
        .replace("RTPU a", "RTPU a\nSCHEDULER EDF")
    )
    outcome, told = run(shop, 1.0)
    assert "on RTPU a any of source and slow may miss deadlines" in told[0]
    assert outcome.missing


def test_what_is_illegal_otherwise_is_refused(shop):
    shop.rmod("second", "source", Y, "FREQ 50", "MAXC 0.001")
    shop.job("source a", "second b")
    with pytest.raises(VerificationError, match="Y"):
        run(shop)
    shop.job("source a", "nobody b", "nothing b")
    with pytest.raises(SeveralError):
        run(shop)


def test_unknown_times_are_refused_or_assumed(shop):
    shop.rmod("sink", "sink", "INVAR Y", Z, "FREQ 100")
    with pytest.raises(VerificationError, match="the execution time of sink is not"):
        run(shop)
    outcome, _ = run(shop, assume=0.5)
    assert outcome.rtpus["b"].utilization == pytest.approx(0.5)


def test_the_same_seed_gives_the_same_schedule(shop):
    shop.rmod("source", "source", Y, "FREQ 100", "MINC 0.001", "MAXC 0.009")
    results = [
        run(shop, 1.0, times=Times.RANDOM, seed=seed, code=code)[0].as_data()
        for code in (False, True)
        for seed in (1, 1, 2)
    ]
    assert results[0] == results[1] != results[2]
    assert results[3] == results[4] == results[0]  # the code costs no virtual time


# -- with the modules' code -----------------------------------------------------------


def values(shop, seconds, name):
    """Return what the table holds after `seconds`, when the modules have run."""
    path = shop.folder / "test.job"
    found = []

    class Watched(Subsystem):
        def stop(self):
            found.append(self.display(name)[0].values[0])
            return super().stop()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(schedule_job, "Subsystem", Watched)
        outcome, told = schedule_job.simulate(
            path, seconds, [shop.folder / "lib"], code=True
        )
    return found[0], outcome, told


def test_outputs_appear_when_the_cycle_ends(shop):
    """The source takes 4 ms, so its second count is there at 14 ms, not at 10 ms."""
    assert values(shop, 0.0139, "Y")[0] == 1.0
    assert values(shop, 0.0140, "Y")[0] == 2.0


def test_a_reader_on_another_rtpu_sees_what_was_published_by_then(shop):
    """Released together, the sink reads before the source's cycle has ended."""
    assert values(shop, 0.095, "Z")[0] == 9.0
    shop.rmod("source", "source", Y, "FREQ 100", "MAXC 0.0125", "SOFTNESS 0.5")
    after, outcome, _ = values(shop, 0.1, "Z")
    assert outcome.missing == {"source"}
    assert after < 9.0  # every other count is missing


def test_on_one_rtpu_the_producer_goes_first(shop):
    shop.job("source a", "sink a")
    assert values(shop, 0.095, "Z")[0] == 10.0


def test_a_module_that_fails_ends_its_own_cycles(shop):
    shop.module(
        "source",
        """
        class Source(PortBasedObject):
            "Fail."
            y: A[float, OutVar("Y", "1", "none", "count")]

            def cycle(self, dt):
                self.y += 1.0
                if self.y >= 3.0:
                    raise ValueError("three")
        """,
    )
    last, outcome, told = values(shop, 0.2, "Z")
    assert last == 2.0
    accounts = {**outcome.rtpus["a"].tasks, **outcome.rtpus["b"].tasks}
    assert accounts["source"].releases == 3
    assert accounts["sink"].cycles == 20
    assert any("three" in text for text in told)


def test_a_cycle_is_told_its_release(shop):
    shop.module(
        "sink",
        """
        class Sink(PortBasedObject):
            "Show the time."
            x: A[float, InVar("Y", "1", "none", "count")]
            z: A[float, OutVar("Z", "1", "none", "seconds")]

            def cycle(self, dt):
                self.z = self.task.now * 1e-9 % 1.0 + 10.0 * dt
        """,
    )
    shop.job("source a", "sink a")  # it begins 4 ms behind its release
    assert values(shop, 0.055, "Z")[0] == pytest.approx(0.05 + 0.1)


def test_a_server_s_code_runs_for_each_event(shop):
    shop.module(
        "srv",
        SINK.replace(
            "    def cycle", "    def sync(self):\n        pass\n\n    def cycle"
        ),
        *("INVAR Y", Z, "TASKTYPE deferrable", "FREQ 50", "CAPACITY 0.002"),
    )
    shop.job("source a", "srv b")
    outcome, _ = run(shop)
    assert outcome.rtpus["b"].tasks["srv"].cycles == 5
    last, outcome, _ = values(shop, 0.0999, "Z")
    server = outcome.rtpus["b"].tasks["srv"]
    assert (server.cycles, server.releases) == (5, 5)
    assert last == 8.0  # the event at 80 ms found what was published at 74 ms


def test_a_server_that_fails_serves_no_more(shop):
    shop.module(
        "srv",
        """
        class Srv(PortBasedObject):
            "Fail at the third event."
            z: A[float, OutVar("Z", "1", "none", "count")]

            def sync(self):
                raise AssertionError("not called in virtual time")

            def cycle(self, dt):
                self.z += 1.0
                if self.z >= 3.0:
                    raise ValueError("three events")
        """,
        *(Z, "TASKTYPE sporadic", "FREQ 50", "CAPACITY 0.002"),
    )
    shop.job("source a", "srv b")
    last, outcome, told = values(shop, 0.2, "Z")
    assert last == 2.0
    assert outcome.rtpus["b"].tasks["srv"].cycles == 2
    assert any("three events" in text for text in told)


BACKGROUND = """
class Srv(PortBasedObject):
    "Count pieces of work, and add up the steps between them."
    z: A[float, OutVar("Z", "1", "none", "pieces, and a hundredth of a second each")]

    def sync(self):
        raise AssertionError("not called in virtual time")

    def cycle(self, dt):
        self.z += 1.0 + dt
"""


def test_background_work_runs_in_what_the_others_leave(shop):
    """The source on the same core takes 4 of every 10 ms, a piece 3 of the rest."""
    shop.module("srv", BACKGROUND, *(Z, "TASKTYPE background", "MAXC 0.003"))
    shop.job("source a", "srv a")
    last, outcome, told = values(shop, 0.1, "Z")
    done = outcome.rtpus["a"].tasks
    assert told == []
    assert outcome.missing == set()
    used = done["source"].cpu_ns + done["srv"].cpu_ns
    assert used == 100_000_000
    assert done["srv"].cycles == done["srv"].cpu_ns // 3_000_000
    assert int(last) == done["srv"].cycles


def test_background_work_of_unknown_length_is_on_and_has_nothing_to_do(shop):
    shop.module("srv", BACKGROUND, *(Z, "TASKTYPE background"))
    shop.job("source a", "srv b")
    last, outcome, told = values(shop, 0.1, "Z")
    assert last == 0.0
    assert "srv" not in outcome.rtpus["b"].tasks
    assert told == [
        "background task srv has nothing to do here: MAXC of its cycles is not known; "
        "declare it, and it uses the time that the others leave"
    ]


# -- the verb -------------------------------------------------------------------------


def test_the_verb_shows_chart_and_table(shop, call):
    overload(shop)
    words = ("simulate", shop.folder / "test.job", "--library", shop.folder / "lib")
    status, out, err = call(*words, "--seconds", 1, "--ascii")
    assert status == 0
    assert "RTPU a: 100.0% used in 1 s; missed deadlines: slow" in out
    assert "x deadline missed" in out
    assert "releases  cycles  missed" in out
    assert err.startswith("WARNING> a: on RTPU a slow may miss deadlines")
    status, out, _ = call(*words, "--seconds", 1, "--json")
    data = json.loads(out)
    assert data["missing"] == ["slow"]
    assert data["rtpus"]["a"]["tasks"]["source"]["responses"]["p99_ns"] == 7_500_000
    assert call(*words, "--seconds", 0)[0] == 1
    assert call(*words, "--times", "never")[0] == 2


def test_the_verb_draws_a_picture_for_each_rtpu(shop, call, tmp_path):
    words = ("simulate", shop.folder / "test.job", "--library", shop.folder / "lib")
    assert call(*words, "--seconds", 1, "--svg", tmp_path / "s.svg")[0] == 0
    for name in ("s-a.svg", "s-b.svg"):
        root = ElementTree.parse(tmp_path / name).getroot()  # noqa: S314 - our own
        assert root.tag.endswith("svg")
    shop.job("source a", "sink a")
    shop.rtpus = ["a"]
    shop.job("source a", "sink a")
    call(*words, "--seconds", 1, "--svg", tmp_path / "one.svg")
    assert (tmp_path / "one.svg").exists()
    status, _, err = call(*words, "--svg", tmp_path / "no" / "one.svg")
    assert status == 1
    assert "the plot cannot be written" in err
