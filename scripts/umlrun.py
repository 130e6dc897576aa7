"""Run a Python file as root on a kernel of its own: User-Mode Linux.

    python scripts/umlrun.py [-m MODULE[:"NAME=VALUE ..."]] ... FILE [ARGUMENT ...]
    python scripts/umlrun.py --kernel KERNEL FILE [ARGUMENT ...]

The kernel is a process of this machine (Debian: `apt-get install user-mode-linux`; one
with simulated devices is built by umlkernel.py); it needs no rights. Its root file
system is this machine's own, so the file finds what this Python has installed. /dev,
/proc, /sys, /run and /dev/shm are the guest's. The modules named by -m are loaded
before. Output and exit status are those of the file.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final, NamedTuple

KERNEL: Final = "linux.uml"
MODULES: Final = (Path("/usr/lib/uml/modules"), Path("/lib/modules"))
"""Folders that may have the kernel's modules, by release."""
MOUNTS: Final = (
    *(("proc", "/proc"), ("sysfs", "/sys"), ("devtmpfs", "/dev"), ("tmpfs", "/run")),
    *(("tmpfs", "/dev/shm"), ("devpts", "/dev/pts")),  # noqa: S108 - the guest's own
)
SYSTEM: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
POWER_OFF: Final = 0x4321FEDC
"""Command of reboot(2), see <linux/reboot.h>."""
FINIT_MODULE: Final = {"x86_64": 313, "aarch64": 273, "i686": 350}
LOST: Final = 125
"""Exit status where the guest gives none."""


class Guest(NamedTuple):
    """What runs a file."""

    kernel: str
    """The program."""
    modules: list[str]
    """Modules that are loaded before, as `-m` has them."""
    seconds: float
    """How long it may take."""


def run(file: str, arguments: list[str], how: Guest) -> int:
    """Run a file in a guest; return its exit status."""
    kernel = shutil.which(how.kernel)
    if kernel is None:
        told = f"umlrun: there is no {how.kernel}; Debian's package is user-mode-linux"
        print(told, file=sys.stderr)
        return LOST
    with tempfile.TemporaryDirectory(prefix="umlrun-") as folder:
        work = Path(folder)
        job = {
            "command": [sys.executable, str(Path(file).resolve()), *arguments],
            "modules": how.modules,
            "cwd": str(Path.cwd()),
        }
        (work / "job").write_text(json.dumps(job))
        guest = shlex.join([sys.executable, __file__, "--guest", folder])
        init = work / "init"
        init.write_text(f"#!/bin/sh\nexport PATH={SYSTEM} HOME=/root\nexec {guest}\n")
        init.chmod(0o700)
        options = (
            *("mem=512M", "quiet", f"init={init}", "con=null", "con0=null,fd:2"),
            *("root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw", "ssl=null"),
            "random.trust_cpu=on",  # the host's numbers; Python waits for some
        )
        told = guarded([kernel, *options], folder, how.seconds)
        return report(work, told)


def guarded(command: list[str], folder: str, seconds: float) -> str:
    """Run the kernel, for so long at most; return what it said."""
    kernel = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env={**os.environ, "TMPDIR": folder},
        start_new_session=True,
    )
    try:
        return kernel.communicate(timeout=seconds)[0]
    except subprocess.TimeoutExpired:
        return f"it has not ended within {seconds:g} s"
    finally:
        if kernel.poll() is None:  # its processes are those of the guest
            os.killpg(kernel.pid, 9)
            kernel.communicate()


def report(work: Path, told: str) -> int:
    """Print what the file printed; return its exit status."""
    for name, to in (("stdout", sys.stdout), ("stderr", sys.stderr)):
        if (work / name).exists():
            to.write((work / name).read_text(errors="replace"))
    if (work / "status").exists():
        return int((work / "status").read_text())
    print(f"umlrun: the guest did not finish\n{told[-2000:]}", file=sys.stderr)
    return LOST


def guest(work: Path) -> None:
    """Be the guest's first process: prepare the system, run the file, switch off."""
    try:
        for kind, where in MOUNTS:
            Path(where).mkdir(exist_ok=True)
            if not Path(where).is_mount():  # the kernel may have mounted /dev
                do("mount", "-t", kind, kind, where)
        do("ip", "link", "set", "lo", "up")
        job = json.loads((work / "job").read_text())
        with (work / "stdout").open("w") as out, (work / "stderr").open("w") as err:
            try:
                load(job["modules"])
            except (OSError, LookupError) as error:
                print(f"umlrun: {error}", file=err, flush=True)
            done = subprocess.run(
                job["command"], check=False, cwd=job["cwd"], stdout=out, stderr=err
            )
        (work / "status").write_text(str(done.returncode))
    finally:
        os.sync()
        ctypes.CDLL(None).reboot(POWER_OFF)


def do(*command: str) -> None:
    """Run a command of the system, which must succeed."""
    subprocess.run(command, check=True)


def load(modules: list[str]) -> None:
    """Load modules; a kernel that has everything built in needs none.

    Raises:
        LookupError: The kernel has none of a name.
        OSError: One is refused.
    """
    if modules:
        loader = Loader()
        for module in modules:
            name, _, values = module.partition(":")
            loader.load(name, values)


class Loader:
    """Loads modules of the running kernel, with those that they need."""

    def __init__(self) -> None:
        release = os.uname().release
        self._folder = next(
            one / release for one in MODULES if (one / release / "modules.dep").exists()
        )
        self._needs: dict[str, tuple[Path, list[str]]] = {}
        for line in (self._folder / "modules.dep").read_text().splitlines():
            path, _, needs = line.partition(":")
            names = [module_name(one) for one in needs.split()]
            self._needs[module_name(path)] = self._folder / path, names
        self._loaded: set[str] = set()
        self._libc = ctypes.CDLL(None, use_errno=True)

    def load(self, name: str, values: str = "") -> None:
        """Load a module once.

        Args:
            name: Its name.
            values: Its parameters, as ``NAME=VALUE NAME=VALUE``.

        Raises:
            LookupError: The kernel has none of that name.
            OSError: It is refused.
        """
        name = module_name(name)
        if name in self._loaded:
            return
        self._loaded.add(name)
        if name not in self._needs:
            raise LookupError(f"{self._folder} has no module {name}")
        path, needs = self._needs[name]
        for one in reversed(needs):
            self.load(one)
        with path.open("rb") as file:
            call = FINIT_MODULE[os.uname().machine]
            if self._libc.syscall(call, file.fileno(), values.encode(), 0):
                number = ctypes.get_errno()
                raise OSError(number, os.strerror(number), str(path))


def module_name(path: str) -> str:
    """Return the name of a module's file, as the kernel writes it."""
    return Path(path).name.partition(".")[0].replace("-", "_")


def main() -> int:
    """Run the file that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-m", dest="modules", action="append", default=[])
    parser.add_argument("--kernel", default=KERNEL)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--guest", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("file", nargs="?")
    parser.add_argument("arguments", nargs=argparse.REMAINDER)
    a = parser.parse_args()
    if a.guest:
        guest(a.guest)
    if not a.file:
        parser.error("a file is needed")
    return run(a.file, a.arguments, Guest(a.kernel, a.modules, a.seconds))


if __name__ == "__main__":
    raise SystemExit(main())
