"""Prints what a machine has, as JSON; run there by its own Python, as root.

It is sent over ssh and needs nothing but Python 3.6. Its arguments are lists as JSON:
files whose content is wanted, files of which only a digest is, and units of systemd.
"""

import grp
import hashlib
import json
import os
import pathlib
import platform
import pwd
import shutil
import subprocess
import sys

OPT = "/opt/pbonet"
RELEASES = "/opt/pbonet-releases"
COMPLETE = "complete"


def file(path, secret):
    """Return a file's digest, rights, and, unless it is secret, its text."""
    try:
        about = os.stat(path)
        with pathlib.Path(path).open("rb") as stream:
            data = stream.read()
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
    }


def user():
    """Return the groups of the user pbonet; None if there is no such user."""
    try:
        found = pwd.getpwnam("pbonet")
    except KeyError:
        return None
    groups = [one.gr_name for one in grp.getgrall() if "pbonet" in one.gr_mem]
    return sorted({*groups, grp.getgrgid(found.pw_gid).gr_name})


def kernel(name):
    """Return the numbers in a list of cores such as 0,2-3."""
    try:
        with pathlib.Path("/sys/devices/system/cpu/" + name).open() as stream:
            parts = stream.read().strip().split(",")
    except OSError:
        return []
    found = []
    for part in filter(None, parts):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return found


def link(path):
    """Return the name of what a link leads to; empty if it is none."""
    return (
        os.path.basename(os.readlink(path)) if pathlib.Path(path).is_symlink() else ""
    )


def releases():
    """Return the names of the releases that are installed completely."""
    if not pathlib.Path(RELEASES).is_dir():
        return []
    names = os.listdir(RELEASES)
    return sorted(
        n
        for n in names
        if pathlib.Path(os.path.join(RELEASES, n, COMPLETE)).exists()
        and not pathlib.Path(os.path.join(RELEASES, n)).is_symlink()
    )


def unit(name):
    """Return the state of a unit: active, failed, ..., and whether it is enabled."""
    told = []
    for verb in ("is-active", "is-enabled"):
        done = subprocess.Popen(["systemctl", verb, name], stdout=subprocess.PIPE)
        told.append(done.communicate()[0].decode().strip())
    return {"state": told[0], "enabled": told[1] == "enabled"}


def others():
    """Return the RTPUs whose units are enabled."""
    folder = "/etc/systemd/system/multi-user.target.wants"
    names = os.listdir(folder) if pathlib.Path(folder).is_dir() else []
    begin, end = "pbonet-agent@", ".service"
    return sorted(
        n[len(begin) : -len(end)]
        for n in names
        if n.startswith(begin) and n.endswith(end)
    )


def main():
    """Print the facts."""
    read, secret, units = map(json.loads, sys.argv[1:4])
    units = sorted({*units, *("pbonet-agent@%s.service" % one for one in others())})
    systemd = pathlib.Path("/run/systemd/system").is_dir()
    existing = "/opt" if pathlib.Path("/opt").is_dir() else "/"
    facts = {
        "hostname": platform.node(),
        "machine": platform.machine(),
        "python": list(sys.version_info[:2]),
        "venv": venv(),
        "systemctl": shutil.which("systemctl") is not None,
        "systemd": systemd,
        "groups": user(),
        "files": {path: file(path, False) for path in read},
        "secrets": {path: file(path, True) for path in secret},
        "run_folder": pathlib.Path("/run/pbonet").is_dir(),
        "folder": pathlib.Path(OPT).is_dir() and not pathlib.Path(OPT).is_symlink(),
        "current": link(OPT),
        "previous": link(os.path.join(RELEASES, "previous")),
        "releases": releases(),
        "free": shutil.disk_usage(existing).free,
        "units": {name: unit(name) for name in units} if systemd else {},
        "enabled": others(),
        "online": kernel("online"),
        "isolated": kernel("isolated"),
    }
    print(json.dumps(facts))


def venv():
    """Return whether environments can be made; Debian has that in another package."""
    try:
        import ensurepip
        import venv
    except ImportError:
        return False
    return bool(ensurepip and venv)


if __name__ == "__main__":
    main()
