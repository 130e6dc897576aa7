"""Hosts that are reached over ssh: each with a root, a systemd and an sshd of its own.

The root is an overlay on this machine's, and what is written there is in memory.
systemd is the first process of a process name space, with a control group of its own;
it starts sshd on an unprivileged port, and whatever a test enables. Nothing outside of
the folder and the control group is changed.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import zipfile
from importlib import metadata
from pathlib import Path

from long_limits import LIMIT
from nodekit import MISBEHAVING
from watching import wait_for

import pbonet

PORT = 2222
TOOLS = (
    *("unshare", "nsenter", "/usr/sbin/sshd", "/lib/systemd/systemd", "ssh-keygen"),
    "sudo",
)
OPERATOR = "anna"
"""A user who may become root there by sudo, without a password."""
PYTHON = "/usr/local/pbonet-test/python"
PACKAGES = "/usr/local/pbonet-test/packages"
MODULES = "/usr/local/pbonet-test/modules"
SSHD = """Port {port}
HostKey {key}
AuthorizedKeysFile {authorized}
StrictModes no
UsePAM no
PermitRootLogin prohibit-password
PasswordAuthentication no
SetEnv PIP_NO_COMPILE=1
"""
"""pip need not compile what comes compiled in the wheel (`make_wheel`)."""
UNIT = """[Unit]
After=basic.target
[Service]
RuntimeDirectory=sshd
ExecStart=/usr/sbin/sshd -D -e -f {config}
[Install]
WantedBy=multi-user.target
"""
RIGHTS = """[Service]
CapabilityBoundingSet=CAP_SYS_NICE CAP_IPC_LOCK
AmbientCapabilities=CAP_SYS_NICE CAP_IPC_LOCK
"""
"""What the limits of the agent's unit cannot give in a container whose root may not
raise them; whatever else the unit closes is closed."""
BOOT = """
mount --make-rprivate /
mount -t tmpfs -o mode=755 layers {0}/layers
cd {0}/layers
mkdir upper work root
mount -t overlay none -o lowerdir=/,upperdir=upper,workdir=work root
cd root
rm -rf etc/init.d etc/rc?.d etc/systemd/system lib/systemd/system/*.target.wants
rm -f etc/machine-id
units=lib/systemd/system
mkdir -p etc/systemd/system/multi-user.target.wants $units/sysinit.target.wants
ln -s ../systemd-journald.service $units/sysinit.target.wants
: > etc/machine-id
cp {0}/sshd.service etc/systemd/system
ln -s ../sshd.service etc/systemd/system/multi-user.target.wants
if ! prlimit --rtprio=95 true 2> /dev/null; then
  mkdir etc/systemd/system/pbonet-agent@.service.d
  cp {0}/rights.conf etc/systemd/system/pbonet-agent@.service.d
fi
for bind in {binds}; do
  mkdir -p ".${{bind#*:}}"
  mount --bind "${{bind%%:*}}" ".${{bind#*:}}"
done
{library}
mount -t proc proc proc
mount -t sysfs -o ro sys sys
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs -o mode=755 dev dev
for name in null zero full random urandom tty; do
  touch dev/$name
  mount --bind /dev/$name dev/$name
done
mkdir dev/shm dev/pts
mount -t tmpfs -o mode=1777 shm dev/shm
mount -t devpts -o newinstance,ptmxmode=0666 devpts dev/pts
ln -s pts/ptmx dev/ptmx
mount -t tmpfs -o mode=755 run run
mount -t tmpfs -o mode=1777 tmp tmp
hostname {1}
echo {1} > etc/hostname
chroot . useradd --create-home --shell /bin/sh --password '*' {2}
echo '{2} ALL=(ALL) NOPASSWD: ALL' > etc/sudoers.d/{2}
exec chroot . /usr/bin/env -i container=test PATH=/usr/sbin:/usr/bin:/sbin:/bin \
  /lib/systemd/systemd --log-target=journal --show-status=no
"""
WHEEL = "Wheel-Version: 1.0\nRoot-Is-Purelib: false\nTag: {}\n"
OWN = """
echo $$ > {0}/cgroup.procs
exec unshare --cgroup --mount --pid --fork --kill-child --uts --ipc sh -ec "$1"
"""


def groups():
    """Return where control groups of version 2 are; None if nowhere."""
    for line in Path("/proc/self/mounts").read_text().splitlines():
        _, where, kind, *_ = line.split()
        if kind == "cgroup2" and os.access(where, os.W_OK):
            return Path(where)
    return None


def missing():
    """Return why there can be no such hosts; empty if there can."""
    lacks = [name for name in TOOLS if not shutil.which(name)]
    if lacks:
        return f"hosts over ssh need {' '.join(lacks)} (openssh-server, systemd, sudo)"
    return "" if groups() else "no control groups of version 2"


def library():
    """Return commands that put a shared libpython where every user finds it."""
    get = sysconfig.get_config_var
    if not get("Py_ENABLE_SHARED") or sys.base_prefix == "/usr":
        return ""
    found = Path(get("LIBDIR"), get("INSTSONAME"))
    return f"cp {found} usr/lib/{os.uname().machine}-linux-gnu\nchroot . ldconfig"


class SshHost:
    """One machine.

    Args:
        host: Its network.
        folder: A new folder for its root.
        authorized: The file of public keys that may log in.
    """

    def __init__(self, host, folder, authorized):
        self.host, self.folder = host, folder
        self.group = groups() / folder.name
        (folder / "layers").mkdir(parents=True)
        key, config = folder / "host_key", folder / "sshd_config"
        make = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)]
        subprocess.run(make, check=True)
        # What is in the folder is bound to a place of its own, as /tmp is the host's.
        inside = Path("/usr/local/pbonet-test/ssh")
        shutil.copy(authorized, folder / "authorized")
        config.write_text(
            SSHD.format(
                port=PORT, key=inside / key.name, authorized=inside / "authorized"
            )
        )
        (folder / "rights.conf").write_text(RIGHTS)
        (folder / "sshd.service").write_text(UNIT.format(config=inside / config.name))
        binds = [
            f"{sys.base_prefix}:{PYTHON}",
            f"{sysconfig.get_path('purelib')}:{PACKAGES}",
            f"{MISBEHAVING}:{MODULES}",
            f"{folder}:{inside}",
        ]
        boot = BOOT.format(
            folder, host.hostname, OPERATOR, binds=" ".join(binds), library=library()
        )
        self.group.mkdir()
        own = ("sh", "-ec", OWN.format(self.group), "sh", boot)
        with (folder / "boot").open("w") as told:
            self.process = subprocess.Popen(
                ["nsenter", f"--net=/run/netns/{host.space}", *own],
                stdout=told,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )

    @property
    def known(self):
        """The line of `known_hosts` for an address."""
        words = (self.folder / "host_key.pub").read_text().split()[:2]
        return f"[{{}}]:{PORT} {' '.join(words)}\n"

    def wait(self, operator, address):
        """Wait until an operator on a host gets an answer of its sshd."""
        scan = operator.command("ssh-keyscan", "-p", str(PORT), address)

        def answers():
            assert self.process.poll() is None, (self.folder / "boot").read_text()
            return subprocess.run(scan, capture_output=True, check=False).stdout

        wait_for(answers, f"sshd of {self.host.name}")

    def inside(self, *words, check=True):
        """Run a command in the host's name spaces, as root; return what it printed."""
        pid = self.first()
        enter = ["nsenter", "-t", str(pid), "-m", "-p", "-u", "-i", "-n", "-C"]
        root = f"--root=/proc/{pid}/root"
        done = subprocess.run(
            [*enter, root, "--wd=/", *words],
            capture_output=True,
            text=True,
            check=False,
        )
        assert not check or done.returncode == 0, done
        return done.stdout

    def first(self):
        """Return the process number of its systemd, as seen from outside."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return int(children.read_text().split()[0])

    def close(self):
        """End all its processes, and remove its control groups and its root."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGKILL)
        self.process.wait(LIMIT)
        wait_for(lambda: not self._populated(), "the end of the host's processes")
        inner = [path for path in self.group.rglob("*") if path.is_dir()]
        for path in [*sorted(inner, key=lambda p: -len(p.parts)), self.group]:
            path.rmdir()

    def _populated(self):
        return "populated 1" in (self.group / "cgroup.events").read_text()


# -- wheels ---


def make_wheel(folder, version, layers="", **added):
    """Return a wheel of this checkout as it is built here, as another release.

    Args:
        folder: Where it is put.
        version: Its version.
        layers: Text that is added to `pbonet/versions.py`.
        added: Text that is added to other files, by name with __ for /.
    """
    source = Path(pbonet.__file__).parent
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
    tag = f"{tag}-{tag}-linux_{os.uname().machine}"
    changed = {
        "pbonet/__init__.py": lambda text: text.replace(pbonet.__version__, version),
        "pbonet/versions.py": lambda text: text + layers,
    }
    for name, more in added.items():
        changed[f"pbonet/{name.replace('__', '/')}.py"] = lambda text, m=more: text + m
    files = {}
    for path in sorted(source.rglob("*")):
        name = str(path.relative_to(source.parent))
        if path.is_file() and path.suffix not in {".pyc", ".c", ".pyx", ".pxd", ".pxi"}:
            data = path.read_bytes()
            change = changed.get(name)
            files[name] = change(data.decode()).encode() if change else data
            if path.suffix == ".py" and not change:
                files |= compiled(path, source.parent)
    dist = metadata.distribution("pbonet")
    about = dist.read_text("METADATA")
    about = about.replace(f"\nVersion: {dist.version}", f"\nVersion: {version}")
    path = folder / f"pbonet-{version}-{tag}.whl"
    return pack(path, files, about, dist.entry_points)


def compiled(path, top):
    """Return what Python has compiled of a file, to be used whatever its time is."""
    cached = Path(importlib.util.cache_from_source(path))
    if not cached.exists():
        return {}
    head = importlib.util.MAGIC_NUMBER + (1).to_bytes(4, "little")
    head += importlib.util.source_hash(path.read_bytes())
    return {str(cached.relative_to(top)): head + cached.read_bytes()[16:]}


def pack(path, files, about, entry_points=()):
    """Write a wheel; return its path."""
    info = "-".join(path.name.split("-")[:2]) + ".dist-info"
    tag = "-".join(path.stem.split("-")[2:])
    lines = ["[console_scripts]"]
    lines += [
        f"{e.name} = {e.value}" for e in entry_points if e.group == "console_scripts"
    ]
    files = {
        **files,
        f"{info}/METADATA": about.encode(),
        f"{info}/WHEEL": WHEEL.format(tag).encode(),
        f"{info}/entry_points.txt": "\n".join([*lines, ""]).encode(),
    }
    record = "".join(f"{n},sha256={digest(d)},{len(d)}\n" for n, d in files.items())
    files[f"{info}/RECORD"] = f"{record}{info}/RECORD,,\n".encode()
    with zipfile.ZipFile(path, "w") as archive:
        for inner, data in files.items():
            archive.writestr(inner, data)
    return path


def digest(data):
    found = base64.urlsafe_b64encode(hashlib.sha256(data).digest())
    return found.rstrip(b"=").decode()


def make_wheelhouse(folder):
    """Make wheels of what pbonet needs: empty ones, that lead to our own packages."""
    folder.mkdir()
    needs = [text for text in metadata.requires("pbonet") if "extra ==" not in text]
    for number, text in enumerate(needs):
        name = text.split(";")[0].strip()
        for mark in "<>=!~ [":
            name = name.partition(mark)[0]
        version = metadata.version(name)
        about = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
        files = {} if number else {"needs.pth": f"{PACKAGES}\n".encode()}
        file = f"{name.replace('-', '_')}-{version}-py3-none-any.whl"
        pack(folder / file, files, about)
    return folder
