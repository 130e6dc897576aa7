"""The runtime folder: where the processes of one machine find each other.

``$PBONET_RUN_DIR``, else ``$XDG_RUNTIME_DIR/pbonet``, else ``/tmp/pbonet-<uid>``. It
belongs to the user, and no other user may enter it. It contains one folder per domain,
and in that, per RTPU: ``NAME.sock`` (the agent's zenoh endpoint), ``NAME.ctl`` (the
RTPU process's own socket), ``NAME.post`` (the agent's socket for tasks that use
resources of other machines), ``NAME.agent`` and ``NAME.rtpu`` (locked while these
processes live), ``NAME.state`` (what to clean up if the RTPU process is killed) and
``NAME.log`` (the RTPU process's standard error), ``NAME.hubN`` (the socket on which an
agent that is a client of a router accepts agents of the machine). ``.routerN`` are the
sockets of the agents that are routers for the others of the machine. ``devices`` has a
file for each I/O device that is open.

Nothing here imports zenoh, because the RTPU process uses it too.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import stat
import struct
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pbonet import shm
from pbonet.errors import DuplicateNameError, NodeError

if TYPE_CHECKING:
    from collections.abc import Generator

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,30}")
LONGEST_SOCKET = 107
"""Maximum length of a Unix socket's path on Linux, in bytes."""
TURN_TIME = 20.0
"""Seconds for which an agent that starts waits for those that start before it."""
SWEEP_TIME = 0.5
"""The same for one that ends, and removes what others may have left."""
_LOOK = 0.01
_HOLDER = re.compile(r"process (\d+)")
_RANK = re.compile(r"rank (\d+)")
_PLACE = re.compile(r"place (\d+)")
_ROUTER = re.compile(r"\.router(\d+)(\.lock)?")
_FLOCK = struct.Struct("hhqqi4x")


def claims() -> Path:
    """Return the folder of the claims on I/O devices; made if necessary."""
    path = folder() / "devices"
    path.mkdir(mode=0o700, exist_ok=True)
    return path


def check_name(what: str, name: str) -> str:
    """Return `name` if it is valid in a key and in a file name.

    Raises:
        NodeError: It is not valid.
    """
    if not NAME.fullmatch(name):
        raise NodeError(
            f"this is not a valid name for {what}",
            expected="1 to 31 letters, digits, '_', '-' and '.', no '-' or '.' first",
            got=repr(name[:40]),
            remedy="choose another name",
        )
    return name


def folder() -> Path:
    """Return the runtime folder; made if necessary.

    Raises:
        NodeError: It cannot be made, or belongs to another user.
    """
    path = _choose()
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = path.stat()
    except OSError as error:
        raise NodeError(
            "the runtime folder cannot be used",
            where=str(path),
            got=error.strerror or str(error),
            remedy="set PBONET_RUN_DIR to a folder of your own",
        ) from None
    if found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077:
        raise NodeError(
            "the runtime folder is not the user's own",
            where=str(path),
            expected=f"owner {os.getuid()} and mode 0700",
            got=f"owner {found.st_uid} and mode {stat.S_IMODE(found.st_mode):04o}",
            remedy="set PBONET_RUN_DIR to a folder of your own",
        )
    return path


def state_folder() -> Path:
    """Return the folder for what outlives a restart of the machine; not made here.

    ``$PBONET_STATE_DIR``, else ``$XDG_STATE_HOME/pbonet``, else
    ``~/.local/state/pbonet``; for a user without a home it is the runtime folder.
    """
    if chosen := os.environ.get("PBONET_STATE_DIR"):
        return Path(chosen)
    if home := os.environ.get("XDG_STATE_HOME"):
        return Path(home) / "pbonet"
    try:
        return Path.home() / ".local" / "state" / "pbonet"
    except RuntimeError:
        return _choose()


def _choose() -> Path:
    if chosen := os.environ.get("PBONET_RUN_DIR"):
        return Path(chosen)
    session = Path(os.environ.get("XDG_RUNTIME_DIR") or "/nowhere")
    if session.is_dir() and session.stat().st_uid == os.getuid():
        return session / "pbonet"
    return Path(f"/tmp/pbonet-{os.getuid()}")  # noqa: S108 - owner and mode are checked


class Places:
    """The files of one RTPU in the runtime folder."""

    def __init__(self, domain: str, name: str) -> None:
        self.domain = check_name("a domain", domain)
        self.name = check_name("an RTPU", name)
        self.folder = folder() / domain
        self.folder.mkdir(mode=0o700, exist_ok=True)
        self.sock = self.folder / f"{name}.sock"
        self.ctl = self.folder / f"{name}.ctl"
        self.post = self.folder / f"{name}.post"
        self.lock = self.folder / f"{name}.agent"
        self.ctl_lock = self.folder / f"{name}.rtpu"
        self.state = self.folder / f"{name}.state"
        self.log = self.folder / f"{name}.log"
        for path in (self.sock, self.ctl, self.post):
            _check_length(path)

    @property
    def endpoint(self) -> str:
        """The zenoh endpoint of the agent's socket."""
        return f"unixsock-stream/{self.sock}"

    def hub(self, rank: int) -> Path:
        """Return the agent's socket for agents of the machine of greater rank."""
        path = self.folder / f"{self.name}.hub{rank}"
        _check_length(path)
        return path

    def router(self, place: int) -> Path:
        """Return the socket of the machine's router at a place, from 1 on."""
        path = self.folder / f".router{place}"
        _check_length(path)
        return path

    def router_endpoint(self, place: int | None) -> str:
        """Return where others of the machine link with the agent, which is a router.

        At a place it is found by those that were there before it.
        """
        return f"unixsock-stream/{self.router(place)}" if place else self.endpoint

    @property
    def agents_files(self) -> tuple[Path, ...]:
        """The agent's sockets, and the lock files that zenoh makes for them."""
        hub = re.compile(re.escape(self.name) + r"\.hub\d+(\.lock)?")
        hubs = [path for path in self._files() if hub.fullmatch(path.name)]
        return self.sock, self.sock.with_suffix(".sock.lock"), self.post, *hubs

    def neighbours(self) -> list[str]:
        """Return the RTPUs of the domain whose agent or process lives here, sorted."""
        return sorted({
            path.stem
            for path in self._files()
            if path.suffix in {".agent", ".rtpu"} and is_held(path)
        })

    def _files(self) -> list[Path]:
        """Return the files of all RTPUs of the domain; none if the folder is gone."""
        try:
            return [Path(one) for one in os.scandir(self.folder)]
        except FileNotFoundError:
            return []

    def remove(self, *paths: Path) -> None:
        """Remove some of the files; missing ones are ignored."""
        for path in paths:
            path.unlink(missing_ok=True)


def _check_length(path: Path) -> None:
    if len(os.fsencode(path)) > LONGEST_SOCKET:
        raise NodeError(
            "the path of a socket is too long for the system",
            where=str(path),
            expected=f"at most {LONGEST_SOCKET} bytes",
            got=f"{len(os.fsencode(path))} bytes",
            remedy="set PBONET_RUN_DIR to a folder with a shorter path",
        )


class NameLock:
    """Holds an RTPU's name on this machine while the process lives.

    Uses an open-file-description lock, because its holder can be queried without taking
    it: a process that only checks never blocks an agent that starts.

    Args:
        path: The file.
        text: Description of the holder, for the error of a second process.
        patience: Seconds to try.

    Raises:
        DuplicateNameError: Another process holds it.
    """

    def __init__(self, path: Path, text: str = "", *, patience: float = 0.0) -> None:
        self.path = path
        deadline = time.monotonic() + patience
        while True:
            try:
                self._fd = self._take()
                break
            except DuplicateNameError:
                if time.monotonic() >= deadline:
                    raise
            time.sleep(_LOOK)
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, text.encode(), 0)

    def _take(self) -> int:
        while True:
            fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.fcntl(fd, fcntl.F_OFD_SETLK, _whole(fcntl.F_WRLCK))
            except (BlockingIOError, PermissionError):
                holder = os.pread(fd, 200, 0).decode(errors="replace").strip()
                os.close(fd)
                raise DuplicateNameError(
                    "the name is taken on this machine",
                    where=str(self.path),
                    got=holder,
                    remedy="choose another name, or stop the one that runs",
                ) from None
            if _same_file(fd, self.path):
                return fd
            os.close(fd)  # its last holder removed it between our open and our lock

    def release(self) -> None:
        """Release the name and remove the file. Idempotent."""
        if self._fd >= 0:
            self.path.unlink(missing_ok=True)
            os.close(self._fd)
            self._fd = -1


@contextlib.contextmanager
def turn(domain: str, *, patience: float = TURN_TIME) -> Generator[None]:
    """Wait until no other agent of `domain` is taking its place on this machine.

    Args:
        domain: The domain.
        patience: Seconds to wait.

    Raises:
        NodeError: Another agent has its turn for longer.
    """
    path = folder() / check_name("a domain", domain)
    deadline = time.monotonic() + patience
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        while not _has_turn(fd):
            if time.monotonic() >= deadline:
                raise NodeError(
                    "another agent of this machine starts or ends, and does not get on",
                    where=str(path),
                    expected=f"that done within {patience:g} s",
                    remedy="is it stopped? `ps -C pbonet -o pid,stat,args` shows T "
                    "then; continue it with `kill -CONT PID`, or end it",
                )
            time.sleep(_LOOK)
        yield
    finally:
        os.close(fd)


def _has_turn(fd: int) -> bool:
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def sweep_routers(domain: str) -> None:
    """Remove the sockets of routers of this machine that have ended.

    An end does not wait for an agent that starts and is stopped; then they remain until
    the next agent ends, or takes their place.
    """
    with contextlib.suppress(NodeError, OSError), turn(domain, patience=SWEEP_TIME):
        held = {its.place for its in positions(domain).values()}
        for path in list((folder() / domain).iterdir()):
            found = _ROUTER.fullmatch(path.name)
            if found is not None and int(found[1]) not in held:
                path.unlink(missing_ok=True)


def is_held(path: Path) -> bool:
    """Return whether the lock on `path` is held, without taking it."""
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        answer = fcntl.fcntl(fd, fcntl.F_OFD_GETLK, _whole(fcntl.F_WRLCK))
    finally:
        os.close(fd)
    kind = int(_FLOCK.unpack(answer)[0])
    return kind != fcntl.F_UNLCK


def _same_file(fd: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(fd), path.stat())
    except FileNotFoundError:
        return False


def _whole(kind: int) -> bytes:
    return _FLOCK.pack(kind, os.SEEK_SET, 0, 0, 0)


def live_agents(domain: str) -> list[str]:
    """Return the names of the agents of `domain` that live on this machine, sorted."""
    return sorted(agent_processes(domain))


def agent_processes(domain: str) -> dict[str, int]:
    """Return the agents of `domain` that live on this machine, and their processes.

    The process is 0 for an agent that does not report it.
    """
    here = folder() / check_name("a domain", domain)
    held = (path for path in here.glob("*.agent") if is_held(path))
    return {path.stem: _number(_HOLDER, path) for path in held}


class Position(NamedTuple):
    """An agent's part among those of its machine; see `client_of_router`."""

    rank: int = 0
    """Of a client of a router; 0: it is a router itself."""
    place: int | None = None
    """Without routers of its own: at which place it is a router for the others of the
    machine; 0: at none. None: it has routers."""

    def __str__(self) -> str:
        rank = f", rank {self.rank}" if self.rank else ""
        return rank if self.place is None else f"{rank}, place {self.place}"


def positions(domain: str) -> dict[str, Position]:
    """Return what each agent of `domain` that lives on this machine is there."""
    here = folder() / check_name("a domain", domain)
    held = (path for path in here.glob("*.agent") if is_held(path))
    return {path.stem: _position(path) for path in held}


def is_stopped(pid: int) -> bool:
    """Return whether a process is stopped, by SIGSTOP, a terminal or a debugger."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] in {"T", "t"}


def _position(path: Path) -> Position:
    place = _number(_PLACE, path, -1)
    return Position(_number(_RANK, path), None if place < 0 else place)


def _number(what: re.Pattern[str], path: Path, default: int = 0) -> int:
    """Return a number that a lock's holder has written, or the default."""
    try:
        found = what.search(path.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return default
    return int(found[1]) if found else default


def machine() -> str:
    """Return an identity that is equal for processes that see the same shared memory.

    It consists of the kernel's boot id and the shared memory's mount, so that two
    containers on one host differ unless they share it, and so do two hosts of the same
    name.
    """
    boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    found = shm.folder().stat()
    return f"{boot}/{found.st_dev}.{found.st_ino}"
