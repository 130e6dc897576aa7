"""The runtime folder: names, locks, and who may use it."""

import os

import pytest

from pbonet.errors import DuplicateNameError, NodeError, UnreachableError
from pbonet.node.rtpu import cleanup
from pbonet.node.wire import process_setup
from pbonet.xm.net import run_folder, session


@pytest.fixture
def run_dir(tmp_path, monkeypatch):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    return tmp_path / "run"


def test_the_folder_is_the_user_s_own(run_dir):
    assert run_folder.folder() == run_dir
    assert run_dir.stat().st_mode & 0o777 == 0o700


def test_where_it_is_without_being_told(monkeypatch, tmp_path):
    monkeypatch.delenv("PBONET_RUN_DIR", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert run_folder.folder() == tmp_path / "pbonet"
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/proc/1")  # not ours, or not there
    if os.getuid() != 0:
        assert run_folder.folder().name == f"pbonet-{os.getuid()}"


@pytest.mark.parametrize("name", ["a", "arm0", "A.b-c_d", "0", "x" * 31])
def test_good_names(name):
    assert run_folder.check_name("an RTPU", name) == name


@pytest.mark.parametrize("name", ["", ".", "-a", "a/b", "a*", "ä", "a b", "x" * 32])
def test_bad_names(name):
    with pytest.raises(NodeError, match="not a valid name for an RTPU"):
        run_folder.check_name("an RTPU", name)


def test_lock_is_seen_taken_and_given_back(run_dir):
    path = run_folder.folder() / "a.agent"
    assert not run_folder.is_held(path)
    lock = run_folder.NameLock(path, "process 7")
    assert run_folder.is_held(path)
    with pytest.raises(DuplicateNameError) as caught:
        run_folder.NameLock(path)
    assert caught.value.got == "process 7"
    assert run_folder.is_held(path)  # the attempt took nothing away
    lock.release()
    lock.release()
    assert not path.exists()
    run_folder.NameLock(path).release()
    assert run_dir.is_dir()


def test_lock_of_a_file_that_was_removed_is_none(run_dir):
    path = run_folder.folder() / "a.agent"
    first = run_folder.NameLock(path)
    path.unlink()
    second = run_folder.NameLock(path)  # another file of that name
    assert run_folder.is_held(path)
    second.release()
    first.release()
    assert run_dir.is_dir()


def test_live_agents(run_dir):
    places = [run_folder.Places("d", name) for name in ("b", "a", "a.x")]
    held = [run_folder.NameLock(place.lock) for place in places]
    rtpu = run_folder.NameLock(places[0].ctl_lock)
    (places[0].folder / "dead.agent").write_text("")
    assert run_folder.live_agents("d") == ["a", "a.x", "b"]
    assert run_folder.live_agents("e") == []
    for lock in [*held, rtpu]:
        lock.release()
    assert run_dir.is_dir()


def test_no_two_places_share_a_file(run_dir):
    files = []
    for name in ("a", "a.sock", "a.ctl", "a.agent", "a.rtpu", "a.state"):
        place = run_folder.Places("d", name)
        files += [place.lock, place.ctl_lock, place.state, place.log, place.ctl]
        files += place.agents_files
    assert len(files) == len(set(files))
    assert run_dir.is_dir()


def test_machine_changes_with_its_shared_memory(monkeypatch, tmp_path):
    before = run_folder.machine()
    assert before == run_folder.machine()
    monkeypatch.setenv("PBONET_SHM_DIR", str(tmp_path))
    assert run_folder.machine() != before


# -- endpoints ---


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "udp/localhost:1",
        "unixsock-stream//tmp/x",
        "tcp/127.3.2.1:0?so_sndbuf=65000",
    ],
)
def test_endpoints_on_this_machine(endpoint):
    assert session.check_endpoint(endpoint, insecure=False) == endpoint


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:1", "tcp/[::]:1", "tcp/10.0.0.1:1", "ws/a.example:1"]
)
def test_endpoints_beyond_it(endpoint):
    with pytest.raises(NodeError, match="beyond this machine"):
        session.check_endpoint(endpoint, insecure=False)
    assert session.check_endpoint(endpoint, insecure=True) == endpoint


@pytest.mark.parametrize("endpoint", ["", "tcp", "tcp/", "ftp/1.2.3.4:5", "1.2.3.4:5"])
def test_endpoints_that_are_none(endpoint):
    with pytest.raises(NodeError, match="this is not an endpoint"):
        session.check_endpoint(endpoint)


def test_no_agent_here(run_dir):
    with pytest.raises(UnreachableError) as caught:
        session.client("d")
    assert str(caught.value) == (
        f"{run_dir}/d: no agent of domain d runs on this machine; start one with "
        "`pbonet agent --name NAME`, or name an agent elsewhere with "
        "--connect tcp/HOST:PORT"
    )


# -- processes ---


def test_a_process_is_known_by_more_than_its_number():
    mine = process_setup.start_time(os.getpid())
    assert process_setup.is_alive(os.getpid(), mine)
    assert not process_setup.is_alive(os.getpid(), mine - 1)
    assert not process_setup.is_alive(os.getpid(), 0)
    assert process_setup.start_time(2**22 + 1) == 0


def test_environment_reaches_this_package(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", "/somewhere")
    env = process_setup.environment()
    assert env["OPENBLAS_NUM_THREADS"] == "1"
    assert "/somewhere" in env["PYTHONPATH"].split(":")


def test_housekeeping_leaves_the_core_alone(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2})
    assert process_setup.housekeeping_cores(1) == {0, 2}
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {1})
    assert process_setup.housekeeping_cores(1) == {1}


def test_state_file_is_whole_or_not_at_all(run_dir):
    places = run_folder.Places("d", "a")
    state = cleanup.Leftovers(pid=1, started=2, core=3, tables=["d.s"])
    cleanup.write(places.state, state)
    assert cleanup.read(places.state) == state
    places.state.write_bytes(b"{")
    assert cleanup.read(places.state) is None
    assert cleanup.read(run_dir / "nothing") is None
    with pytest.raises(NodeError, match="cannot be written to"):
        cleanup.write(run_dir / "no" / "a.state", state)


def test_nothing_is_cleaned_while_the_process_lives(run_dir):
    places = run_folder.Places("d", "a")
    state = cleanup.Leftovers(
        pid=os.getpid(), started=process_setup.start_time(os.getpid()), core=0
    )
    cleanup.write(places.state, state)
    assert cleanup.clean(places) == []
    assert places.state.exists()
    assert run_dir.is_dir()


@pytest.mark.usefixtures("run_dir")
def test_an_agent_that_is_stopped_as_it_starts_holds_up_no_end(monkeypatch):
    """One that ends leaves the sockets; one that starts tells why it cannot."""
    places = run_folder.Places("d", "a")
    places.router(1).touch()
    monkeypatch.setattr(run_folder, "SWEEP_TIME", 0.0)
    with run_folder.turn("d"):
        run_folder.sweep_routers("d")
        assert places.router(1).exists()
        with (
            pytest.raises(NodeError, match="starts or ends, and does not get on"),
            run_folder.turn("d", patience=0.0),
        ):
            pass
    run_folder.sweep_routers("d")
    assert not places.router(1).exists()


@pytest.mark.usefixtures("run_dir")
def test_a_sweep_spares_the_sockets_of_routers_that_live():
    places = run_folder.Places("d", "a")
    lock = run_folder.NameLock(places.lock, f"agent a{run_folder.Position(0, 2)}")
    locks = [places.folder / f".router{place}.lock" for place in (1, 2)]
    for path in (places.router(1), places.router(2), *locks):
        path.touch()
    run_folder.sweep_routers("d")
    left = {path.name for path in places.folder.glob(".router*")}
    assert left == {".router2", ".router2.lock"}
    lock.release()
    run_folder.sweep_routers("d")
    assert not list(places.folder.glob(".router*"))
