"""One machine over ssh: commands as root, and files that are put there.

Host keys are checked against the operator's known hosts, and none is accepted unseen.
"""

from __future__ import annotations

import contextlib
import shlex
from typing import TYPE_CHECKING, Final, Self

from msgspec import Struct

from pbonet.errors import ConfigFileError, NodeError, UnreachableError

try:
    import asyncssh
except ImportError:
    raise NodeError(
        "reaching machines over ssh needs the package asyncssh",
        remedy="pip install 'pbonet[deploy]'",
    ) from None

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import TracebackType

    from .hosts_file import HostsFile, Machine
    from .steps import Put, Run

CONNECT: Final = 15.0
"""Seconds after which a machine that does not answer is given up."""
COMMAND: Final = 900.0
"""Seconds after which a command is given up; pip may fetch packages meanwhile."""
_SHOWN: Final = 3
"""Lines of a failed command that an error has."""


class Done(Struct, frozen=True):
    """A command that has ended."""

    status: int
    out: str
    err: str

    @property
    def said(self) -> str:
        """The last lines that it printed."""
        lines = (self.err or self.out).strip().splitlines()
        return " / ".join(line.strip() for line in lines[-_SHOWN:])


class Shell:
    """A connection to a machine.

    Args:
        machine: The machine.
        file: Where known hosts and the operator's key are, if not where ssh has them.
    """

    def __init__(self, machine: Machine, file: HostsFile) -> None:
        self.machine = machine
        self.file = file
        self._connection: asyncssh.SSHClientConnection | None = None
        self._root: tuple[str, ...] = ()

    async def __aenter__(self) -> Self:
        self._connection = await self._connect()
        try:
            await self._become_root()
        except BaseException:
            await self._close()
            raise
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self._close()

    async def run(self, *words: str, data: bytes = b"", check: bool = True) -> Done:
        """Run a command as root.

        Args:
            words: The command; no shell interprets them.
            data: Its standard input.
            check: Whether a status other than 0 is an error.

        Raises:
            NodeError: It failed, or took too long.
            UnreachableError: The connection was lost.
        """
        done = await self._run(*self._root, *words, data=data)
        if check and done.status:
            raise self._failed(done, words)
        return done

    async def do(self, command: Run) -> None:
        """Run a command of a step as root.

        Raises:
            NodeError: It failed, and must not; or it took too long.
            UnreachableError: The connection was lost.
        """
        done = await self.run(*command.words, data=command.data, check=False)
        if done.status and command.must:
            raise self._failed(done, command.words, command.what, command.remedy)

    async def put(self, file: Put) -> None:
        """Write a file, in one step for its readers; its folder is made if needed.

        Raises:
            NodeError: It cannot be written.
        """
        script = (
            'mkdir -p "$(dirname "$1")"; new="$1.$$.new"; umask 077; cat > "$new" '
            '&& [ "$(wc -c < "$new")" -eq "$4" ] '  # else the connection was lost
            '&& chown -- "$3" "$new" && chmod "$2" "$new" && mv -f "$new" "$1" '
            '|| { rm -f "$new"; exit 1; }'
        )
        about = (f"{file.mode:04o}", f"{file.owner}:{file.group}", str(len(file.data)))
        words = ("sh", "-ec", script, "sh", file.path, *about)
        done = await self.run(*words, data=file.data, check=False)
        if done.status:
            raise self._failed(done, words, f"{file.path} cannot be written")

    async def _run(self, *words: str, data: bytes = b"") -> Done:
        assert self._connection is not None, "the connection was not opened"  # noqa: S101
        try:
            process = await self._connection.create_process(
                f"umask 022; {shlex.join(words)}", encoding=None
            )
            with contextlib.suppress(BrokenPipeError):  # it ended without reading all
                process.stdin.write(data)
                process.stdin.write_eof()
            done = await process.wait(timeout=COMMAND)
        except asyncssh.TimeoutError:
            raise NodeError(
                f"a command did not end within {COMMAND:g} s: {shlex.join(words)}",
                where=self.machine.name,
                remedy="see what it waits for on the machine; deploy can be repeated",
            ) from None
        except (OSError, asyncssh.Error) as error:
            raise self._lost(str(error)) from None
        if done.exit_status is None:
            raise self._lost(f"the connection was lost during {shlex.join(words[:6])}")
        return Done(
            status=done.exit_status,
            out=_text(done.stdout),
            err=_text(done.stderr),
        )

    async def _connect(self) -> asyncssh.SSHClientConnection:
        host = self.machine.host
        given: dict[str, object] = self._files()
        if host.port is not None:
            given["port"] = host.port
        if host.user is not None:
            given["username"] = host.user
        try:
            return await asyncssh.connect(
                self.machine.address,
                connect_timeout=CONNECT,
                keepalive_interval=CONNECT,
                **given,
            )
        except asyncssh.HostKeyNotVerifiable as error:
            raise self._unknown_host(error.reason) from None
        except asyncssh.PermissionDenied as error:
            raise self._refused(error.reason) from None
        except (OSError, asyncssh.Error, ValueError) as error:
            raise self._lost(str(error) or "no answer") from None

    def _files(self) -> dict[str, object]:
        """Return the operator's own files as asyncssh takes them.

        Raises:
            ConfigFileError: One cannot be read, or has a passphrase.
        """
        file = self.file
        found: dict[str, object] = {}
        path, key = None, "known_hosts"
        try:
            if (path := file.known_hosts) is not None:
                found[key] = asyncssh.read_known_hosts(str(path))
            key = "identity"
            if (path := file.identity) is not None:
                found["client_keys"] = asyncssh.load_keypairs([str(path)])
        except (OSError, ValueError) as error:
            raise ConfigFileError(
                f"{key} of {file.path.name} cannot be used",
                where=str(path),
                got=getattr(error, "strerror", "") or str(error),
                remedy="name a file of ssh, or leave it out; for a key with a "
                "passphrase leave it out after 'ssh-add FILE'",
            ) from None
        return found

    async def _become_root(self) -> None:
        done = await self._run("id", "-u")
        if done.out.strip() == "0":
            return
        self._root = ("sudo", "-n", "--")
        done = await self._run(*self._root, "true")
        if done.status:
            name = (await self._run("id", "-un")).out.strip()
            raise NodeError(
                f"the user {name} may not become root there without a password",
                where=self.machine.name,
                got=done.said,
                remedy=f"visudo -f /etc/sudoers.d/{name} with the line "
                f"'{name} ALL=(ALL) NOPASSWD: ALL', or user = \"root\"",
            )

    async def _close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            await self._connection.wait_closed()

    @property
    def _login(self) -> str:
        host = self.machine.host
        port = f"-p {host.port} " if host.port else ""
        return f"{port}{f'{host.user}@' if host.user else ''}{self.machine.address}"

    def _failed(
        self, done: Done, words: Sequence[str], what: str = "", remedy: str = ""
    ) -> NodeError:
        """Return the error of a command that failed."""
        command = f"a command failed with status {done.status}: {shlex.join(words)}"
        return NodeError(
            what or command,
            where=self.machine.name,
            got=done.said or f"status {done.status}",
            remedy=remedy or _remedy(done.said),
        )

    def _lost(self, why: str) -> UnreachableError:
        return UnreachableError(
            "the machine cannot be reached over ssh",
            where=self.machine.name,
            got=why,
            remedy=f"see whether 'ssh {self._login}' works: address and port in "
            f"{self.file.path.name}, its sshd, the network",
        )

    def _unknown_host(self, why: str) -> NodeError:
        return NodeError(
            "the machine's host key is not known, or has changed",
            where=self.machine.name,
            got=why,
            remedy=f"log in once by 'ssh {self._login}' and compare the fingerprint "
            "with what 'ssh-keygen -lf /etc/ssh/ssh_host_ed25519_key.pub' prints there",
        )

    def _refused(self, why: str) -> NodeError:
        return NodeError(
            "the machine refuses the login",
            where=self.machine.name,
            got=why,
            remedy=f"ssh-copy-id {self._login}, or name a user and an identity that it "
            f"takes in {self.file.path.name}",
        )


def _text(data: object) -> str:
    return data.decode("utf-8", "replace") if isinstance(data, bytes) else ""


def _remedy(said: str) -> str:
    """Return what to do after a command that failed with these lines."""
    if "No space left" in said:
        return "make room on the machine (df -h /opt /etc /tmp), and repeat"
    if "invalid user" in said or "invalid group" in said:
        return (
            "make this user and group on the machine (pbonet deploy makes pbonet), and "
            "repeat"
        )
    if "No matching distribution" in said:
        return (
            "without a way to a package index, give the wheels of all dependencies "
            "with --wheelhouse (pip download --dest FOLDER WHEEL)"
        )
    return "mend this on the machine, and repeat; what is done stays"
