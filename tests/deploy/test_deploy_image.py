"""The image's own steps and the host's set-up, really run, in a chroot.

There is no container engine here: `tests/support/dockerfile.py` runs each step of the
Dockerfile over this machine's root, and nothing of it stays. That the base image has
what the steps expect is all that it cannot show.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BASE = 110_000_000
"""Bytes of debian:bookworm-slim (75 MB) and its packages for python3 (35 MB)."""
MOST = 250_000_000
"""Bytes that an image may have."""
OVERLAY = "mount -t overlay none -o lowerdir=/,upperdir={0}/u,workdir={0}/w {0}/r"

AS_USER = """
id -u
touch /opt/pbonet/mine 2>/dev/null && echo "its own program can be written over"
pbonet agent --name arm0 > /tmp/said &
until grep -q ready /tmp/said; do sleep 0.1; done
pbonet doctor
pbonet run --seconds 1 /opt/pbonet/examples/two_hosts/vision.job
du -sb /opt/pbonet | sed 's/^/bytes of its own: /'
kill $!
wait $!
find /dev/shm -mindepth 1 -printf 'left behind: %p\\n'
"""

AS_ROOT = """
/opt/pbonet/bin/python -m ensurepip # which the image does without
mkdir -p /etc/pbonet
echo '# mine' > /etc/pbonet/arm0.toml
cd /mnt/deploy
./host-setup.sh --apply arm0=0 arm1
cat /etc/pbonet/arm0.toml
cat /etc/systemd/system/pbonet-agent@arm0.service.d/cores.conf
systemd-analyze verify --man=no pbonet-agent@arm0.service
stat -c '%a %U' /run/pbonet
su -s /bin/sh pbonet -c '/opt/pbonet/bin/pbonet --version'
./host-setup.sh --remove
ls /etc/pbonet
test ! -e /opt/pbonet
find /etc/systemd/system -name 'pbonet-agent@*' -printf 'left behind: %p\n'
"""


def mountable(folder):
    """Say why no overlay of the root can be mounted here, or nothing."""
    if os.geteuid():
        return "only root may mount and change its root"
    for name in "uwr":
        (folder / name).mkdir(parents=True)
    tried = subprocess.run(
        ["unshare", "--mount", "sh", "-ec", OVERLAY.format(folder)],
        capture_output=True,
        text=True,
        check=False,
    )
    return tried.stderr.strip()


def reachable():
    """Whether Debian's packages can be had."""
    return not subprocess.run(
        ["apt-get", "update", "-q"], capture_output=True, check=False
    ).returncode


def context(folder):
    """Put what git knows of the checkout there, as a build's context."""
    names = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    ).stdout
    folder.mkdir()
    packed = subprocess.run(
        ["tar", "c", "--null", "--ignore-failed-read", "-T", "-"],
        cwd=ROOT,
        input=names,
        capture_output=True,
        check=True,
    ).stdout
    subprocess.run(["tar", "x", "-C", str(folder)], input=packed, check=True)
    return folder


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_image_and_host_as_their_files_say(tmp_path):
    if why := mountable(tmp_path / "probe"):
        pytest.skip(f"no overlay on the root can be mounted: {why}")
    if not os.environ.get("CI") and not reachable():
        pytest.skip("Debian's packages cannot be reached")
    tree = context(tmp_path / "context")
    done = subprocess.run(
        [
            *("unshare", "--mount", "--pid", "--fork", "--kill-child", sys.executable),
            ROOT / "tests" / "support" / "dockerfile.py",
            *(tree / "deploy" / "Dockerfile", tree, tmp_path / "stages"),
            *(AS_USER, AS_ROOT),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    print(done.stdout)
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    own = next(line for line in lines if line.startswith("bytes of its own: "))
    assert int(own.split()[4]) + BASE <= MOST, own
    assert "900" in lines
    assert "its own program can be written over" not in lines
    assert any(line.startswith("PASS arm0: core") for line in lines)
    assert any(line.startswith("job look ended after") for line in lines)
    assert not [line for line in lines if line.startswith("left behind")]
    assert "# mine" in lines
    assert any(re.fullmatch(r"CPUAffinity=[1-9][\d ]* 0", line) for line in lines)
    assert "700 pbonet" in lines
    assert lines[-2:] == ["arm0.toml", "arm1.toml"]
