"""Help and completion: every verb in its group, and what the shell is offered."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pbonet.cli import completing, verbs

PUMA = Path(__file__).parents[3] / "examples" / "puma"


def test_help_of_the_program_has_every_verb_in_a_group(call):
    for words in ((), ("--help",), ("-h",)):
        status, out, _ = call(*words)
        assert status == 0
        for name in verbs.NAMES:
            assert f"\n  {name} " in out
        for title in verbs.GROUPS:
            assert f"\n{title}:\n" in out


def test_help_of_a_family_and_of_its_verb(call):
    for words in (("log",), ("log", "--help")):
        status, out, _ = call(*words)
        assert status == 0
        assert "  recover " in out
    status, out, _ = call("log", "cat", "--help")
    assert status == 0
    assert "usage: pbonet log cat FILE TASK [VARIABLES ...] [options]" in out
    assert "pbonet log cat runs/teleop jttrace -o jttrace.npz" in out


def test_help_of_a_verb_says_defaults_ranges_and_variables(call):
    out = call("view", "-h")[1]
    assert "--port N " in out
    assert "[default: 8765; 0 to 65535]" in " ".join(out.split())
    assert "or PBONET_DOMAIN]" in " ".join(out.split())


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("sta",), ["start", "status"]),
        (("log", "re"), ["recover"]),
        (("status", "a.sbs", "--dom"), ["--domain"]),
        (("agent", "--backend", "f"), ["fifo"]),
        (("run", "a.job", "--no"), ["--no-embed"]),
        (("completion", ""), ["bash", "zsh", "fish"]),
        (("status", str(PUMA / "puma.sbs"), "--domain", "x", "puma_"), ["puma_pidg"]),
        (("start", str(PUMA / "puma.sbs"), "pu"), ["puma"]),
        (("spawn", "a.sbs", "jttr"), ["jttrace"]),
        (("agent", "--backend", "=", "f"), ["fifo"]),  # as bash divides it
        (("--ver",), ["--version"]),
        (("log", "--h"), ["--help"]),
        (("log", "info", "x", "--h"), ["--help"]),
        (("spawn", str(PUMA / "puma.sbs"), "jttrace", "arm"), ["arm0", "arm1"]),
        (("write", str(PUMA / "puma.sbs"), "NDO"), ["NDOF"]),
        (("swap", str(PUMA / "puma.sbs"), "qrdiff,jt"), ["qrdiff,jttrace"]),
        (("display", "--domain", "x", str(PUMA / "puma.sbs"), "NDO"), ["NDOF"]),
        (("events", str(PUMA / "puma.sbs"), "--task", "jt"), ["jttrace"]),
        (("replay", "x", "--set", "pid", "KP", "--ver"), []),
        (("replay", "x", "--set", "pid", "KP", "2", "--ver"), ["--verify"]),
        (("check", ""), []),
        (("nonsense", ""), []),
    ],
)
def test_the_shell_is_offered_what_may_come_next(words, offered):
    assert list(completing.lines("bash", words)) == offered


def test_a_shell_gets_the_meaning_of_a_word_in_its_own_form():
    words = ("status", "a.sbs", "--tak")
    assert list(completing.lines("zsh", words)) == []
    words = ("on", "a.sbs", "--tak")
    about = "Take the subsystem over from a master that still runs."
    assert list(completing.lines("zsh", words)) == [f"--take-over:{about}"]
    assert list(completing.lines("fish", words)) == [f"--take-over\t{about}"]


def test_completion_is_installed_once(call, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    (tmp_path / ".bashrc").write_text("alias ll='ls -l'")
    for _ in range(2):
        assert call("completion", "bash", "--install")[0] == 0
    lines = (tmp_path / ".bashrc").read_text().splitlines()
    assert lines[0] == "alias ll='ls -l'"
    assert len(lines) == 2
    places = {"zsh": ".zfunc/_pbonet", "fish": ".config/fish/completions/pbonet.fish"}
    for shell, file in places.items():
        assert call("completion", shell, "--install")[0] == 0
        assert (tmp_path / file).read_text() == completing.SCRIPTS[shell]


def test_bash_completes_a_verb(tmp_path):
    program = tmp_path / "pbonet"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m pbonet.cli "$@"\n')
    program.chmod(0o755)
    asked = (
        f"PATH={tmp_path}:$PATH; {completing.SCRIPTS['bash']}"
        "COMP_WORDS=(pbonet log re); COMP_CWORD=2; _pbonet; echo ${COMPREPLY[@]}"
    )
    done = subprocess.run(
        ["bash", "-c", asked], capture_output=True, text=True, check=True
    )
    assert done.stdout == "recover\n"
