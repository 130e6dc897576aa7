"""The number of open files: raised to what is allowed, refused if that is too small."""

import errno
import resource
import subprocess
import sys

import pytest

from pbonet.errors import PbonetError
from pbonet.node.wire import Answers
from pbonet.xm.net import codec, messages as m

LIMITED = """
import resource, sys
soft, hard = map(int, sys.argv[1:3])
resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
from pbonet.cli import main
from pbonet.errors import NodeError
from pbonet.xm.net import open_files
if sys.argv[3:]:
    main(sys.argv[3:])
try:
    open_files.ensure("arm0")
except NodeError as error:
    print(error)
else:
    print(resource.getrlimit(resource.RLIMIT_NOFILE))
"""
REFUSED = (
    "too few files may be open at the same time (expected at least 64, got a hard "
    "limit of 36); raise it: ulimit -Hn, LimitNOFILE= of the service, or nofile in "
    "/etc/security/limits.conf"
)


def limited(soft, hard, *words):
    """Run in a process that may open so many files."""
    command = [sys.executable, "-c", LIMITED, str(soft), str(hard), *words]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=60
    )


def test_the_soft_limit_is_raised_to_the_hard_one():
    assert limited(36, 256).stdout == "(256, 256)\n"
    assert limited(64, 64).stdout == "(64, 64)\n"
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= 64


def test_a_hard_limit_that_is_too_small_is_one_sentence():
    assert limited(36, 36).stdout == f"arm0: {REFUSED}\n"


def test_a_request_that_finds_no_descriptor_says_what_to_do():
    reported = []
    answers = Answers("arm0", reported.append)
    request = m.Status(id="1")
    error = OSError(errno.EMFILE, "Too many open files")
    failed = codec.Codec().answer(answers.bad(request, error)).error
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert str(PbonetError.from_wire(failed)) == (
        f"arm0: no more files can be opened (expected at most {soft} at the same time, "
        "got [Errno 24] Too many open files); use fewer tasks there, or raise the "
        "limit: ulimit -Hn, LimitNOFILE= of the service, or nofile in "
        "/etc/security/limits.conf"
    )
    assert reported == []


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("arm0", ("agent", "--name", "arm0")),
        ("run", ("run", "examples/puma/puma.job")),
    ],
)
def test_agents_and_runs_refuse_at_once(tmp_path, monkeypatch, where, words):
    monkeypatch.setenv("PBONET_RUN_DIR", str(tmp_path / "run"))
    done = limited(36, 36, *words)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"pbonet: {where}: {REFUSED}\n"
