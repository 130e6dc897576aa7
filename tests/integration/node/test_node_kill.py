"""Each kind of process killed: what goes on, what ends, what is left behind."""

import os
import signal
import time

import pytest
from nodekit import CORE, Master, alive, wait_gone, wait_hung
from reference import Reference
from watching import wait_for

from pbonet.analysis.schedule.events import Event
from pbonet.errors import NodeError, SvarMissingError
from pbonet.node.ring._ring import Ring
from pbonet.node.rt import _rt
from pbonet.node.rtpu import cleanup
from pbonet.xm.net import codec, messages as m, run_folder

ABOVE_TASKS = 90
"""A level above those of all cycles, and below the dispatcher's."""


def entries(path):
    """Return what the diary of `counts` says, with times in seconds."""
    lines = [line.split(maxsplit=2) for line in path.read_text().splitlines()]
    return [(int(now) * 1e-9, text) for now, _, text in lines]


def check_last_words(books, killed, reference):
    """Check that each task ran `off` and then `kill`, in time if the machine let it."""
    stalled = reference.longest() > 0.3
    for book in books:
        times = {text: at - killed for at, text in entries(book)}
        if not stalled:
            assert times["off False"] < times["kill"] < 1.0


def said(path, text):
    return path.exists() and text in [entry for _, entry in entries(path)]


@pytest.fixture
def split(nodes):
    """An agent in a process of its own, claimed, with its table open."""
    nodes.agent_process("arm0", stop_time=30.0)
    return nodes.master("arm0", "arm")


def start_pair(master, tmp_path, first=0, **more):
    """Turn two tasks on; return their diaries and the process ids of all tasks."""
    books = [tmp_path / "first", tmp_path / "second"]
    for i, book in enumerate(books, first):
        master.spawn(f"t{i}", "counts", out=f"Y{i}", local={"DIARY": book}, **more)
        master.on(f"t{i}")
    return books, [one.tid for one in master.status().values()]


def hang_above(master, names):
    """Have a task hang at a level above those of others; return its process id."""
    tid = master.spawn("bad", "hangs_in_c", out="Y5", freq=150.0).tid
    master.ask(m.Rank(tasks={"bad": (50, 0)} | dict.fromkeys(names, (1, 0))))
    master.on("bad")
    wait_hung(master, "bad")
    return tid


class TestAgent:
    """Control goes on without the agent, for the declared grace."""

    def test_a_restarted_agent_takes_over_without_a_lost_cycle(
        self, split, nodes, tmp_path
    ):
        _, pids = start_pair(split, tmp_path, freq=40.0)
        rtpu = nodes.state("arm0").pid
        before = split.wait_cycles("t0", 10)
        ring = Ring.attach(before.ring)
        with Reference(CORE, beside=before.tid) as reference:
            before = split.status("t0")
            nodes.processes["arm0"].kill()
            nodes.processes["arm0"].wait()
            nodes.forget_session()
            nodes.agent_process("arm0")
            assert nodes.state("arm0").pid == rtpu
            master = Master(nodes, "arm0", "arm")
            assert master.epoch > split.epoch
            assert master.claimed.tasks == ["t0", "t1"]
            after = master.wait_cycles("t0", 10)
            assert after.miss - before.miss <= reference.lost(40.0)
        assert [one.tid for one in master.status().values()] == pids
        assert after.on_ns == before.on_ns
        done = [record.cycle for record in ring.drain() if not record.kind]
        ring.close()
        assert done == list(range(done[0], done[-1] + 1))
        assert done[-1] >= after.cycle > before.cycle
        codes = [event.code for event in master.events()]
        assert "AGENT_GONE" in codes
        assert "AGENT_BACK" in codes
        assert master.events("SPAWNED", "t0")  # events of before are there still
        assert master.off("t0").state == "OFF"

    def test_answers_survive_the_agent(self, split, nodes):
        request = m.Control(
            id="once",
            client="me",
            subsystem="arm",
            epoch=split.epoch,
            task="t0",
            signal="on",
        )
        payload = codec.Codec().pack(request)
        split.spawn("t0", "counts")

        def ask():
            key = f"pbonet/{nodes.domain}/rtpu/arm0/sbs"
            reply = next(iter(nodes.session.get(key, payload=payload, timeout=30.0)))
            return codec.Codec().answer(reply.ok.payload.to_bytes())

        first = ask()
        assert first.ok
        nodes.processes["arm0"].kill()
        nodes.processes["arm0"].wait()
        nodes.forget_session()
        nodes.agent_process("arm0")
        assert ask() == first  # it was not sent again, which would be refused

    def test_without_an_agent_everything_goes_off_in_order(
        self, nodes, tmp_path, shared_memory
    ):
        nodes.agent_process("arm0", grace=0.5)
        master = nodes.master("arm0", "arm")
        books, pids = start_pair(master, tmp_path)
        rtpu = nodes.state("arm0").pid
        killed = time.monotonic()
        nodes.processes["arm0"].kill()
        wait_gone([rtpu, *pids])
        first, second = ({t: n for n, t in entries(book)} for book in books)
        assert second["off False"] < first["off False"]  # the last one on goes first
        assert first["kill"] > first["off False"]
        assert second["off False"] - killed > 0.45
        assert list(shared_memory.iterdir()) == []
        places = run_folder.Places(nodes.domain, "arm0")
        assert not places.state.exists()
        assert not places.ctl.exists()

    @pytest.mark.parametrize("which", [signal.SIGTERM, signal.SIGINT])
    def test_signal_ends_everything_in_order(self, split, nodes, tmp_path, which):
        books, pids = start_pair(split, tmp_path)
        process = nodes.processes["arm0"]
        process.send_signal(which)
        assert process.wait(60) == 0
        assert all(said(book, "off False") and said(book, "kill") for book in books)
        assert not any(map(alive, pids))
        assert list(nodes.folder.glob("*/*")) == []

    def test_names_are_free_again_at_once(self, nodes):
        for _ in range(2):
            nodes.agent_process("arm0", grace=0.3)
            nodes.processes["arm0"].kill()
            nodes.processes["arm0"].wait()
            nodes.forget_session()

    def test_another_one_waits_for_an_rtpu_process_that_ends(self, nodes, tmp_path):
        begun, go_on = tmp_path / "begun", tmp_path / "go on"
        nodes.agent_process("arm0", grace=0.1)
        arm = nodes.master("arm0", "arm")
        arm.spawn("a", "waits_in_off", local={"BEGUN": begun, "GO_ON": go_on})
        arm.on("a")
        old = nodes.state("arm0").pid
        nodes.processes["arm0"].kill()
        nodes.processes["arm0"].wait()
        nodes.forget_session()
        wait_for(begun.exists, "the RTPU process ends: the task is turned off")
        nodes.agent_process("arm0")
        assert nodes.state("arm0").pid != old


class TestRtpuProcess:
    """Every task turns itself off within a second; the agent restarts."""

    def test_killed(self, arm, nodes, tmp_path, shared_memory):
        books, pids = start_pair(arm, tmp_path)
        old = nodes.state("arm0").pid
        forks = nodes.fork_server("arm0")
        with Reference(CORE, _rt.COMMAND_LEVEL) as reference:
            os.kill(old, signal.SIGKILL)
            killed = time.monotonic()
            wait_gone([old, forks, *pids])
            check_last_words(books, killed, reference)
        nodes.wait_restarted("arm0", old)
        event = arm.wait_event("RTPU_DIED")
        assert "SIGKILL" in event.text
        arm.wait_event("RESTARTED", "t1")
        assert {one.state for one in arm.status().values()} == {"OFF"}
        assert nodes.client().call("arm0", m.Hello(), m.AgentInfo).claims == {
            "arm": arm.epoch
        }
        rings = {path.stem.split(".")[-1] for path in shared_memory.glob("*.ring")}
        assert rings == {"t0", "t1"}, "nothing is left of the former ones"
        assert arm.on("t0").state == "ON"

    def test_killed_with_a_task_that_hangs(self, arm, nodes, tmp_path):
        """One that never comes back keeps the others from nothing, and is ended."""
        books, pids = start_pair(arm, tmp_path)
        hung = hang_above(arm, ["t0", "t1"])
        old = nodes.state("arm0").pid
        with Reference(CORE, ABOVE_TASKS) as reference:
            begun = time.monotonic()
            os.kill(old, signal.SIGKILL)
            killed = time.monotonic()
            wait_gone([hung, *pids])
            check_last_words(books, killed, reference)
        assert time.monotonic() > begun + 0.9  # the last resort came for the one
        nodes.wait_restarted("arm0", old)

    def test_killed_together_with_its_agent(
        self, split, nodes, tmp_path, shared_memory
    ):
        books, pids = start_pair(split, tmp_path)
        rtpu = nodes.state("arm0").pid
        nodes.processes["arm0"].kill()
        os.kill(rtpu, signal.SIGKILL)
        nodes.processes["arm0"].wait()
        wait_gone([rtpu, *pids])
        assert all(said(book, "kill") for book in books)
        assert list(shared_memory.glob("*.svar"))  # nobody was there to clean
        nodes.forget_session()
        tables = {path.stat().st_ino for path in shared_memory.glob("*.svar")}
        nodes.agent_process("arm0")
        assert not tables & {p.stat().st_ino for p in shared_memory.glob("*.svar")}
        master = nodes.master("arm0", "arm")
        assert master.claimed.tasks == ["t0", "t1"]
        assert {one.state for one in master.status().values()} == {"OFF"}
        assert any("table" in event.text for event in master.events("CLEANED"))

    def test_everything_killed_leaves_nothing_behind_the_next(
        self, split, nodes, tmp_path, shared_memory
    ):
        _, pids = start_pair(split, tmp_path)
        victims = [
            nodes.processes["arm0"].pid,
            nodes.state("arm0").pid,
            nodes.fork_server("arm0"),
            *pids,
        ]
        for pid in victims:
            os.kill(pid, signal.SIGSTOP)  # no one outlives another's end
        for pid in reversed(victims):
            os.kill(pid, signal.SIGKILL)
        nodes.processes["arm0"].wait()
        wait_gone(victims)
        left = {path.stat().st_ino for path in shared_memory.glob("*.*ing")}
        assert left
        nodes.forget_session()
        process = nodes.agent_process("arm0", stop_time=30.0)
        assert not left & {p.stat().st_ino for p in shared_memory.glob("*.*ing")}
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        assert list(shared_memory.iterdir()) == []

    @pytest.mark.parametrize("which", [signal.SIGTERM, signal.SIGINT])
    def test_signal_ends_it_in_order_and_the_agent_with_it(
        self, split, nodes, tmp_path, which
    ):
        books, pids = start_pair(split, tmp_path)
        os.kill(nodes.state("arm0").pid, which)
        assert nodes.processes["arm0"].wait(60) == 1
        assert all(said(book, "off False") and said(book, "kill") for book in books)
        assert not any(map(alive, pids))

    def test_requests_meanwhile_are_answered(self, arm, nodes):
        old = nodes.state("arm0").pid
        os.kill(old, signal.SIGKILL)
        deadline = time.monotonic() + 60.0
        outcomes = []
        while time.monotonic() < deadline:
            try:
                arm.client.call("arm0", m.Status(), m.RtpuStatus)
            except NodeError as error:
                outcomes.append(type(error).__name__)
            else:
                state = nodes.state("arm0")
                if state is not None and state.pid != old:
                    break
        assert time.monotonic() < deadline
        assert set(outcomes) <= {"NodeError"}


class TestTwoRtpus:
    """Of two RTPUs on one machine one is killed; the other's tasks miss nothing."""

    @pytest.fixture
    def pair(self, nodes):
        """The keeper arm0, and arm1 on the same core, both with a task that is ON."""
        for name in ("arm0", "arm1"):
            nodes.agent(name)
        nodes.wait_agent("arm1")
        keeper = nodes.master("arm0", "arm")
        other = nodes.master("arm1", "arm", table=False)
        other.open_table(keep=False)
        for i, master in enumerate((keeper, other)):
            master.spawn(f"t{i}", "counts", out=f"Y{i}", freq=40.0)
            master.on(f"t{i}")
            master.wait_cycles(f"t{i}", 3)
        return keeper, other

    @pytest.mark.parametrize("victim", ["arm0", "arm1"])
    def test_killed(self, pair, nodes, shared_memory, victim):
        keeper, other = pair
        dead, alive_one = (keeper, other) if victim == "arm0" else (other, keeper)
        task = "t1" if victim == "arm0" else "t0"
        before = alive_one.status(task)
        old = nodes.state(victim).pid
        with Reference(CORE, beside=before.tid) as reference:
            before = alive_one.status(task)
            os.kill(old, signal.SIGKILL)
            nodes.wait_restarted(victim, old)
            after = alive_one.wait_cycles(task, 5)
            assert after.on_ns == before.on_ns
            assert after.miss - before.miss <= reference.lost(40.0)
        assert len(list(shared_memory.glob("*.svar"))) == 1  # it is still in use
        back = f"t{1 - int(task[1])}"
        dead.wait_event("RESTARTED", back)
        assert dead.value(f"Y{task[1]}").writer == task
        assert dead.status(back).state == "OFF"
        assert dead.on(back).state == "ON"  # under the claim of before
        for master in (dead, alive_one):
            master.stop()

    def test_all_of_one_killed_at_once(self, nodes, shared_memory):
        """Nobody is left to say that its task is dead; the other RTPU finds out."""
        nodes.agent("arm0")
        keeper = nodes.master("arm0", "arm")
        nodes.agent_process("arm1")
        other = nodes.master("arm1", "arm", table=False)
        other.open_table(keep=False)
        for i, master in enumerate((keeper, other)):
            master.spawn(f"t{i}", "counts", out=f"Y{i}", freq=40.0)
            master.on(f"t{i}")
        victims = [
            *(nodes.processes["arm1"].pid, nodes.state("arm1").pid),
            *(nodes.fork_server("arm1"), other.status("t1").tid),
        ]
        for pid in victims:
            os.kill(pid, signal.SIGSTOP)
        for pid in reversed(victims):
            os.kill(pid, signal.SIGKILL)
        nodes.processes["arm1"].wait()
        core = _rt.CoreTable(CORE, member=False)
        name = f"{nodes.domain}/arm1", "arm/t1"
        wait_for(lambda: core.find(*name) is None, "the dead task's slot is free")
        core.close()
        keeper.wait_cycles("t0", 5)
        keeper.stop()
        nodes.agent_process("arm1")
        assert len(list(shared_memory.glob("*.svar"))) == 1

    def test_a_takeover_gives_orphans_no_level_back(self, pair, nodes, tmp_path):
        """One that hangs would keep the others from turning themselves off."""
        leader, other = pair
        books, pids = start_pair(leader, tmp_path, first=2)
        pids.append(hang_above(leader, ["t0", "t2", "t3"]))
        other.ask(m.Rank(tasks={"t1": (50, 0)}))
        old = nodes.state("arm0").pid
        core = _rt.CoreTable(CORE, member=False)
        slot = core.find(f"{nodes.domain}/arm0", "arm/bad")
        so_far, _, _ = core.trace()
        with Reference(CORE, ABOVE_TASKS) as reference:
            os.kill(old, signal.SIGKILL)
            killed = time.monotonic()
            wait_gone(pids)
            check_last_words(books, killed, reference)
        kinds = [one.kind for one in core.trace(so_far)[2] if one.slot == slot]
        assert Event.LEVEL not in kinds[kinds.index(Event.DEAD) :]
        core.close()
        nodes.wait_restarted("arm0", old)
        other.wait_cycles("t1", 5)
        other.stop()


class TestForkServer:
    """Its end is the end of its tasks, and of nothing else."""

    def test_killed_with_a_task_that_hangs(self, arm, nodes, tmp_path):
        """The dispatcher lives, and gives those who end themselves no level either."""
        books, pids = start_pair(arm, tmp_path)
        pids.append(hang_above(arm, ["t0", "t1"]))
        with Reference(CORE, ABOVE_TASKS) as reference:
            os.kill(nodes.fork_server("arm0"), signal.SIGKILL)
            killed = time.monotonic()
            wait_gone(pids)
            check_last_words(books, killed, reference)

    @pytest.mark.parametrize("which", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
    def test_ended(self, arm, nodes, tmp_path, which):
        books, pids = start_pair(arm, tmp_path)
        rtpu = nodes.state("arm0").pid
        with Reference(CORE, _rt.COMMAND_LEVEL) as reference:
            os.kill(nodes.fork_server("arm0"), which)
            killed = time.monotonic()
            wait_gone(pids)
            check_last_words(books, killed, reference)
        event = arm.wait_event("FORK_SERVER_DIED")
        assert which.name in event.text
        wait_for(
            lambda: {s.state for s in arm.status().values()} == {"NOT-CREATED"},
            "both are known to be dead",
        )
        told = [event.text for event in arm.events("TASK_DIED")]
        assert told == ["the task ended by itself: its fork server has ended"] * 2
        assert nodes.state("arm0").pid == rtpu
        arm.spawn("t2", "counts", out="Y0")
        assert arm.on("t2").state == "ON"


class TestFiles:
    """What stands in shared memory and in the runtime folder may vanish or linger."""

    def test_table_file_removed_while_running(self, arm, shared_memory):
        arm.spawn("a", "counts")
        arm.on("a")
        (path,) = shared_memory.glob("*.svar")
        path.unlink()
        arm.wait_event("TABLE_REMOVED")
        arm.wait_cycles("a", 5)
        assert arm.value("Y0").values[0] > 0
        error = arm.refused(SvarMissingError, arm.spawn, "b", "counts", out="Y1")
        assert "removed while it was in use" in error.what
        arm.stop()
        arm.ask(m.CloseTable())
        arm.open_table()
        assert arm.spawn("b", "counts", out="Y1").state == "OFF"

    def test_stale_files_stand_in_nobody_s_way(self, nodes):
        places = run_folder.Places(nodes.domain, "arm0")
        for path in (places.sock, places.ctl, places.lock, places.log):
            path.write_text("left by a crash")
        state = cleanup.Leftovers(
            pid=2**22 - 1,
            started=1,
            core=0,
            tables=["x.y"],
            tasks=[cleanup.TaskLeft(2**22 - 1, 1)],
            rings=["no.such.ring"],
        )
        cleanup.write(places.state, state)
        assert nodes.agent("arm0").info().name == "arm0"

    def test_damaged_state_file(self, nodes):
        places = run_folder.Places(nodes.domain, "arm0")
        places.state.write_bytes(b"\0\xff{")
        assert nodes.agent("arm0").info().name == "arm0"

    def test_runtime_folder_of_others_is_refused(self, nodes, monkeypatch):
        open_to_all = nodes.folder / "open"
        open_to_all.mkdir()
        open_to_all.chmod(0o755)
        monkeypatch.setenv("PBONET_RUN_DIR", str(open_to_all))
        with pytest.raises(NodeError, match="not the user's own"):
            run_folder.folder()
        monkeypatch.setenv("PBONET_RUN_DIR", "/proc/none")
        with pytest.raises(NodeError, match="cannot be used"):
            run_folder.folder()
        long = nodes.folder / ("x" * 90)
        monkeypatch.setenv("PBONET_RUN_DIR", str(long))
        with pytest.raises(NodeError, match="path of a socket is too long"):
            run_folder.Places("d", "arm0")
        monkeypatch.setenv("PBONET_RUN_DIR", str(nodes.folder))
