"""A Dockerfile as steps, and its stages run in a chroot over this machine's own root.

No container engine is needed: each stage is an overlay on `/`, so a step may find more
than the base image has; what it installs, copies, makes and runs as whom is real. Run
as root in a mount and process name space of its own, which takes all mounts with it:

    unshare --mount --pid --fork \
      python tests/support/dockerfile.py DOCKERFILE CONTEXT FOLDER \
      'SHELL COMMANDS OF THE IMAGE' 'OF ROOT IN IT'

builds every stage, then runs the first commands in the last one as its user with its
variables, and the second as root with nothing but a path. The context is in /mnt.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

KNOWN = ("FROM", "ARG", "RUN", "COPY", "ENV", "USER", "WORKDIR", "EXPOSE")
KNOWN += ("ENTRYPOINT", "CMD")
PLAIN = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"}


class Step(NamedTuple):
    """One instruction."""

    word: str
    rest: str

    @property
    def listed(self) -> list[str]:
        """Return the list that an exec form is."""
        found = json.loads(self.rest)
        assert isinstance(found, list)
        return found


def parse(text: str) -> list[Step]:
    """Return the instructions of a Dockerfile."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ")
    steps = [Step(*line.split(None, 1)) for line in joined.splitlines() if line.strip()]
    unknown = {step.word for step in steps} - set(KNOWN)
    assert not unknown, f"not understood: {unknown}"
    return steps


class Stage:
    """One stage under way: a root folder, and what ENV, USER and WORKDIR have said.

    Args:
        folder: Where the overlay's layers are.
    """

    def __init__(self, folder: Path) -> None:
        self.root = folder / "root"
        for name in ("upper", "work", "root"):
            (folder / name).mkdir(parents=True)
        layers = f"lowerdir=/,upperdir={folder}/upper,workdir={folder}/work"
        mount("-t", "overlay", "overlay", "-o", layers, self.root)
        mount("-t", "proc", "proc", self.root / "proc")
        mount("--rbind", "/dev", self.root / "dev")
        mount("--rbind", "/sys", self.root / "sys")
        mount("-t", "tmpfs", "shm", self.root / "dev/shm")
        mount("-t", "tmpfs", "run", self.root / "run")
        self.env = {
            "PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
        }
        # Where packages come from is the machine's business, and what it keeps of what
        # was compiled before.
        kept = ("PIP_", "CCACHE_")
        self.machine = {k: v for k, v in os.environ.items() if k.startswith(kept)}
        if "CCACHE_DIR" in self.machine:
            self.env["PATH"] = f"/usr/lib/ccache:{self.env['PATH']}"
        self.user = "0"
        self.workdir = "/"
        self.entry: list[str] = []

    def do(self, step: Step, context: Path, others: dict[str, Stage]) -> None:
        """Carry out one instruction."""
        match step.word:
            case "RUN":
                self.run("/bin/sh", "-ec", step.rest)
            case "COPY":
                self.copy(shlex.split(step.rest), context, others)
            case "ENV" | "ARG":
                self.env |= dict(one.split("=", 1) for one in shlex.split(step.rest))
            case "USER":
                self.user = step.rest.strip()
            case "WORKDIR":
                self.workdir = step.rest.strip()
            case "ENTRYPOINT":
                self.entry = step.listed
            case _:
                pass

    def run(self, *command: str) -> None:
        """Run a command in the stage as its user, in its folder.

        Raises:
            CalledProcessError: It failed.
        """
        spec = f"--userspec={self.user}:{self.user}"
        groups = ["--groups="] if self.user != "0" else []
        env = [f"{k}={v}" for k, v in (self.machine | self.env).items()]
        inside = ["/usr/bin/env", "-i", "-C", self.workdir, *env, *command]
        chroot = ["chroot", spec, *groups, str(self.root), *inside]
        subprocess.run(chroot, check=True, stdin=subprocess.DEVNULL)

    def copy(self, words: list[str], context: Path, others: dict[str, Stage]) -> None:
        """Copy files of the context or of another stage, as COPY does."""
        if words[0].startswith("--from="):
            context = others[words.pop(0).removeprefix("--from=")].root
        *sources, target = words
        for name in sources:
            source = context / name.lstrip("/")
            to = self.root / target.lstrip("/")
            if source.is_dir():
                shutil.copytree(source, to, symlinks=True, dirs_exist_ok=True)
            else:
                to = to / source.name if target.endswith("/") else to
                to.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, to)


def mount(*words: object) -> None:
    """Mount, in this name space alone."""
    subprocess.run(["mount", *map(str, words)], check=True)


def build(dockerfile: Path, context: Path, folder: Path) -> Stage:
    """Run every step of every stage; return the last stage."""
    stages: dict[str, Stage] = {}
    last = ""
    for step in parse(dockerfile.read_text(encoding="utf-8")):
        if step.word == "FROM":
            last = step.rest.split()[-1]
            stages[last] = Stage(folder / str(len(stages)))
        else:
            stages[last].do(step, context, stages)
    return stages[last]


def main(words: list[str]) -> None:
    """Build, then run the commands that are given."""
    dockerfile, context, folder = map(Path, words[:3])
    mount("--make-rprivate", "/")
    stage = build(dockerfile, context, folder)
    mount("--bind", context, stage.root / "mnt")
    stage.run("/bin/sh", "-ec", words[3])
    stage.user, stage.workdir, stage.env = "0", "/", dict(PLAIN)
    stage.run("/bin/sh", "-ec", words[4])


if __name__ == "__main__":
    main(sys.argv[1:])
