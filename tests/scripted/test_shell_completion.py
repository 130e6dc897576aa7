"""Completion in real shells: zsh on a terminal, and fish, as they were installed."""

from __future__ import annotations

import os
import pty
import re
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

PUMA = Path(__file__).parents[2] / "examples" / "puma"
CASES = [
    ("pbonet log re", "recover"),
    ("pbonet stat", "status"),
    ("pbonet --vers", "--version"),
    ("pbonet run puma.j", "puma.job"),
    ("pbonet status puma.sbs jt", "jttrace"),
    ("pbonet status puma.sbs --fields state,mis", "state,miss"),
    ("pbonet spawn puma.sbs jttrace arm0 --take", "--take-over"),
    ("pbonet agent --backend=f", "--backend=fifo"),
    ("pbonet agent --backend f", "fifo"),
]
"""Command lines, and the word that the last one can only become."""
PATIENCE = 60.0


@pytest.fixture
def env(tmp_path: Path) -> dict[str, str]:
    """The environment of a user with a home folder and `pbonet` on the path."""
    program = tmp_path / "bin" / "pbonet"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m pbonet.cli "$@"\n')
    program.chmod(0o755)
    home = tmp_path / "a home"
    home.mkdir()
    return {
        "PATH": f"{program.parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(PUMA.parents[1]),
        "HOME": str(home),
        "TERM": "dumb",
    }


def install(shell: str, env: dict[str, str]) -> None:
    """Have new shells complete; skip the test where there is no such shell."""
    if shutil.which(shell) is None:
        if os.environ.get("CI"):
            pytest.fail(f"{shell} is not installed")
        pytest.skip(f"{shell} is not installed (apt-get install {shell})")
    subprocess.run(["pbonet", "completion", shell, "--install"], env=env, check=True)


class Zsh:
    """A zsh on a terminal, in the folder of the example."""

    def __init__(self, env: dict[str, str]) -> None:
        self.terminal, side = pty.openpty()
        self.process = subprocess.Popen(
            ["zsh", "-i"],
            stdin=side,
            stdout=side,
            stderr=side,
            env=env,
            cwd=PUMA,
            start_new_session=True,
        )
        os.close(side)
        self.until(re.compile("READY>"))

    def until(self, wanted: re.Pattern[str]) -> re.Match[str]:
        """Return what is wanted as soon as it is on the terminal."""
        text, end = "", time.monotonic() + PATIENCE
        while (found := wanted.search(text)) is None:
            assert time.monotonic() < end, text
            if select.select([self.terminal], [], [], 0.1)[0]:
                text += os.read(self.terminal, 1 << 16).decode(errors="replace")
        return found

    def completed(self, line: str) -> str:
        """Return what becomes of a line with Tab."""
        keys = f"{line}\t\x01print -r -- BEGIN \x05 END\n"  # ^A, ^E: start and end
        os.write(self.terminal, keys.encode())
        return self.until(re.compile(r"\nBEGIN (.*?) END\r"))[1]

    def end(self) -> None:
        """End it."""
        self.process.kill()
        self.process.wait()
        os.close(self.terminal)


@pytest.fixture
def zsh(env: dict[str, str]) -> Iterator[Zsh]:
    install("zsh", env)
    with (Path(env["HOME"]) / ".zshrc").open("a") as start:
        start.write("PS1='READY> '\n")
    shell = Zsh(env)
    yield shell
    shell.end()


def test_zsh_completes(zsh: Zsh) -> None:
    """The first case is the one for which zsh loads the script."""
    for line, word in CASES:
        expected = [*line.split()[:-1], word]
        assert zsh.completed(line).split() == expected


def test_zsh_completes_where_the_script_is_evaluated(env: dict[str, str]) -> None:
    install("zsh", env)
    start = "PS1='READY> '\neval \"$(pbonet completion zsh)\"\n"
    (Path(env["HOME"]) / ".zshrc").write_text(start)
    shell = Zsh(env)
    try:
        assert shell.completed("pbonet log re").split() == ["pbonet", "log", "recover"]
    finally:
        shell.end()


def test_fish_completes(env: dict[str, str]) -> None:
    install("fish", env)
    for line, word in CASES:
        done = subprocess.run(
            ["fish", "-c", f"complete -C '{line}'"],
            env=env,
            cwd=PUMA,
            capture_output=True,
            text=True,
            check=True,
        )
        offered = [one.partition("\t")[0] for one in done.stdout.splitlines()]
        assert (offered, done.stderr) == ([word], ""), line
