"""Prints what a machine has, as JSON; run there by its own Python, as root.

It is sent over ssh, so it imports nothing of pbonet, and runs with Python 3.7. Its
arguments are lists as JSON: files whose content is wanted, files of which only a digest
is, and units of systemd.
"""

from __future__ import annotations

import grp
import hashlib
import importlib.util
import json
import platform
import pwd
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

OPT = Path("/opt/pbonet")
RELEASES = Path("/opt/pbonet-releases")
COMPLETE = "complete"
WANTS = Path("/etc/systemd/system/multi-user.target.wants")
BEGIN, END = "pbonet-agent@", ".service"
ASKED = (
    *("ActiveState", "UnitFileState"),
    *("StateChangeTimestampMonotonic", "NeedDaemonReload"),
)


def file(name: str, *, secret: bool) -> dict[str, Any] | None:
    """Return a file's digest, rights, and, unless it is secret, its text."""
    path = Path(name)
    try:
        about, data = path.stat(), path.read_bytes()
    except OSError:
        return None
    try:
        owner = pwd.getpwuid(about.st_uid).pw_name
    except KeyError:
        owner = str(about.st_uid)
    return {
        "digest": hashlib.sha256(data).hexdigest(),
        "mode": about.st_mode & 0o7777,
        "owner": owner,
        "text": "" if secret else data.decode("utf-8", "replace"),
        "written": about.st_mtime,
    }


def user() -> list[str] | None:
    """Return the groups of the user pbonet; None if there is no such user."""
    try:
        found = pwd.getpwnam("pbonet")
    except KeyError:
        return None
    groups = [one.gr_name for one in grp.getgrall() if "pbonet" in one.gr_mem]
    return sorted({*groups, grp.getgrgid(found.pw_gid).gr_name})


def cores(name: str) -> list[int]:
    """Return the numbers in one of the kernel's lists of cores, such as 0,2-3."""
    try:
        text = Path("/sys/devices/system/cpu", name).read_text(encoding="utf-8")
    except OSError:
        return []
    found: list[int] = []
    for part in filter(None, text.strip().split(",")):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return found


def link(path: Path) -> str:
    """Return the name of what a link leads to; empty if it is none."""
    return path.resolve().name if path.is_symlink() else ""


def releases() -> list[str]:
    """Return the names of the releases that are installed completely."""
    there = RELEASES.iterdir() if RELEASES.is_dir() else ()
    return sorted(
        one.name for one in there if not one.is_symlink() and (one / COMPLETE).exists()
    )


def unit(name: str) -> dict[str, Any]:
    """Return the state of a unit, since when, and whether systemd read its files."""
    done = subprocess.run(
        ["systemctl", "show", "--property", ",".join(ASKED), name],  # noqa: S607
        stdout=subprocess.PIPE,
        check=False,
    )
    lines = done.stdout.decode().splitlines()
    pairs = [line.partition("=") for line in lines]
    told = {name: value for name, _, value in pairs}
    since = int(told.get(ASKED[2]) or 0) / 1e6
    return {
        "state": told.get(ASKED[0], ""),
        "enabled": told.get(ASKED[1]) == "enabled",
        "since": time.time() - time.monotonic() + since,
        "unread": told.get(ASKED[3]) == "yes",
    }


def enabled() -> list[str]:
    """Return the RTPUs whose agents start with the machine."""
    names = [one.name for one in WANTS.iterdir()] if WANTS.is_dir() else []
    return sorted(
        name[len(BEGIN) : -len(END)]
        for name in names
        if name.startswith(BEGIN) and name.endswith(END)
    )


def venv() -> bool:
    """Return whether environments can be made; Debian has that in another package."""
    return all(importlib.util.find_spec(name) for name in ("venv", "ensurepip"))


def main() -> None:
    """Print the facts."""
    read, secret, asked = map(json.loads, sys.argv[1:4])
    rtpus = enabled()
    units = sorted({*asked, *(f"{BEGIN}{rtpu}{END}" for rtpu in rtpus)})
    systemd = Path("/run/systemd/system").is_dir()
    place = OPT.parent if OPT.parent.is_dir() else Path("/")
    facts = {
        "hostname": platform.node(),
        "machine": platform.machine(),
        "python": list(sys.version_info[:2]),
        "venv": venv(),
        "systemctl": shutil.which("systemctl") is not None,
        "systemd": systemd,
        "groups": user(),
        "files": {path: file(path, secret=False) for path in read},
        "secrets": {path: file(path, secret=True) for path in secret},
        "run_folder": Path("/run/pbonet").is_dir(),
        "folder": OPT.is_dir() and not OPT.is_symlink(),
        "current": link(OPT),
        "previous": link(RELEASES / "previous"),
        "releases": releases(),
        "free": shutil.disk_usage(str(place)).free,
        "units": {name: unit(name) for name in units} if systemd else {},
        "enabled": rtpus,
        "online": cores("online"),
        "isolated": cores("isolated"),
    }
    sys.stdout.write(json.dumps(facts) + "\n")


if __name__ == "__main__":
    main()
