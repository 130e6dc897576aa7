"""The verbs: made of the command table, documented, with data and proper status."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import sys
from pathlib import Path

import pytest

from pbonet import cli
from pbonet.cli import parser, verbs
from pbonet.cli.table import example
from pbonet.errors import StateError
from pbonet.log import Log, last_run
from pbonet.master.console.command_session import bind, split_name
from pbonet.master.console.commands import COMMANDS, Scope

OWN = {"stop", "check", "profile", "library"}
"""Verbs that take other words than the command of their name."""
PARTS = {"__init__", "__main__", "options", "table", "parser", "help", "program"}
PARTS |= {"verbs", "completing", "shared_arguments"}
"""Files of the command line that are no verbs."""
SUMMARY = 68
"""Characters of a line of help, so that it fits a terminal."""
PUMA = Path(__file__).parents[3] / "examples" / "puma"
ASKED = (
    *("agent", "run", "prompt", "spawn", "on", "off", "kill", "clear", "set", "get"),
    *("freq", "reconfig", "status", "display", "library", "check", "new"),
    *("stop", "doctor", "events"),
)


def every_verb():
    """Yield every verb, those of families too."""
    for name in verbs.NAMES:
        found = verbs.load(name)
        yield from [found] if isinstance(found, parser.Verb) else found.verbs.values()


ALL = {verb.name: verb for verb in every_verb()}


def options_of(verb):
    return {name for one in verb.options for name in one.names}


def test_every_verb_that_was_asked_for_is_there():
    assert set(ASKED) <= set(verbs.NAMES)


def test_every_file_of_a_verb_is_in_the_help():
    files = {path.stem for path in Path(cli.__file__).parent.rglob("*.py")}
    assert files - PARTS <= set(verbs.NAMES)


def test_every_command_of_the_table_is_a_verb_too():
    for command in COMMANDS:
        if command.scope is Scope.EVERYWHERE:
            assert command.name in verbs.NAMES, command.name
            if command.name not in OWN:
                arguments = {one.name for one in ALL[command.name].parameters}
                assert {arg.name for arg in command.args} <= arguments, command.name


@pytest.mark.parametrize("verb", ALL.values(), ids=ALL)
def test_every_verb_is_documented(verb):
    assert verb.help
    assert len(verb.summary) <= SUMMARY
    assert "--debug" in options_of(verb)
    if verb.name not in {"agent", "router"}:  # they run until they are ended
        assert "--json" in options_of(verb)
    for one in verb.parameters:
        assert one.help, one.name


@pytest.mark.parametrize("verb", ALL.values(), ids=ALL)
def test_every_verb_has_two_examples_that_it_takes(verb):
    assert len(verb.examples) >= 2
    for line, purpose in verb.examples:
        assert purpose.endswith(".")
        words = shlex.split(line.removeprefix('eval "$(').removesuffix(')"'))
        assert words[0] == "pbonet"
        found, rest = verbs.find(words[1:])
        assert found.name == verb.name
        parser.parse(found, rest)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_example_of_a_command_is_a_line_of_the_prompt(command):
    for line, _ in command.examples:
        found, words = split_name(shlex.split(line))
        assert found is command
        bind(command, words, lambda _: True)


def test_an_example_of_the_prompt_is_told_as_a_verb():
    swap = next(one for one in COMMANDS if one.name == "swap")
    line = "swap a b rtpu=arm1 dry_run=yes"
    assert example(swap, line) == "pbonet swap arm.sbs a b --rtpu arm1 --dry-run"


def test_verbs_that_change_can_take_over():
    for command in COMMANDS:
        if command.scope is Scope.EVERYWHERE and command.name != "stop":
            has = "--take-over" in options_of(ALL[command.name])
            assert has == command.changes, command.name


def test_verbs_hold_no_logic():
    """A verb's file defines one function, and imports pbonet's parts inside it.

    Two more may prepare what it prints or asks.
    """
    for path in Path(cli.__file__).parent.rglob("*.py"):
        if path.stem in PARTS:
            continue
        tree = ast.parse(path.read_text())
        functions = [n for n in tree.body if isinstance(n, ast.FunctionDef)]
        plain = [one for one in functions if one.name.startswith("_")]
        assert len(plain) <= 2, path.name
        assert not any(isinstance(n, ast.While | ast.Try) for n in ast.walk(tree))


@pytest.mark.parametrize(
    "words", [("check",), ("run", "--sim", "--seconds", "0.1")], ids=["check", "run"]
)
def test_rtpu_misspelt_in_a_job_is_said_of_the_job(call, tmp_path, words):
    for file in PUMA.glob("puma.*"):
        text = file.read_text().replace("grav_comp  arm1", "grav_comp  arm11")
        (tmp_path / file.name).write_text(text)
    job = tmp_path / "puma.job"
    line = job.read_text().splitlines().index("TASK  grav_comp  arm11") + 1
    verb, *options = words
    status, out, err = call(verb, str(job), *options)
    assert status == 1
    assert re.search(rf"{job}:{line}:1: .* arm11\b.*; did you mean arm1\?", out + err)


def test_a_module_that_is_missing_is_told_at_the_line_that_names_it(call, tmp_path):
    (tmp_path / "s.svar").write_text(
        "NAME X\nTYPE int\nDESC\nUNITS none\nNELEM 1\nEOF\n"
    )
    (tmp_path / "s.sbs").write_text("SUBSYSTEM s\nSVARFILE s.svar\nRTPU c0\nEOF\n")
    (tmp_path / "j.job").write_text("JOB j\nDESC d\nSBS s.sbs\nTASK d\nEOF\n")
    rmod = Path(cli.__file__).parents[1] / "modules" / "signals" / "diff.rmod"
    (tmp_path / "d.rmod").write_text(rmod.read_text().replace(" diff", " dif", 1))
    for words in (("check",), ("run", "--sim", "--record", "off")):
        status, out, err = call(*words, tmp_path / "j.job")
        assert status == 1
        assert f"{tmp_path / 'd.rmod'}:1:1: the library has no module dif" in out + err


def test_user_error_is_told_without_a_stack(call):
    status, out, err = call("library", "nosuch")
    assert (status, out) == (1, "")
    assert err.startswith("pbonet: the library has no such module")
    assert "ask for less" in err
    assert "Traceback" not in err


def test_an_rmod_is_found_as_its_module(call):
    assert call("library", "jttrace")[1].startswith("jtball: ")


def test_debug_adds_the_stack(call):
    status, _, err = call("library", "nosuch", "--debug")
    assert status == 1
    assert "Traceback" in err


def test_error_is_data_with_json(call):
    status, out, err = call("library", "nosuch", "--json")
    assert (status, err) == (1, "")
    assert json.loads(out)["error"]["code"] == "MODULE_LOAD"


def test_wrong_usage_is_status_two(call):
    assert call("spawn")[0] == 2
    assert call("nonsense")[0] == 2


@pytest.mark.parametrize(
    ("words", "option", "expected"),
    [
        (("run", "a.job", "--seconds", "5s"), "--seconds", "a number"),
        (("agent", "--core", "1.5"), "--core", "an integer"),
        (("new", "module", "a", "--freq", "-7"), "--freq", "at least 0.001"),
        (("events", "a.sbs", "many"), "LAST", "an integer"),
        (("freq", "a.sbs", "jttrace", "50kHz"), "HZ", "a number"),
        (("write", "a.sbs", "Q_REF", "1", "-2.5", "3m"), "VALUE", "a number"),
        (("simulate", "a.job", "--seconds", "inf"), "--seconds", "a finite number"),
        (("simulate", "a.job", "--show", "nan"), "--show", "a finite number"),
        (("simulate", "a.job", "--show", "-3"), "--show", "at least 0"),
    ],
)
def test_an_option_that_is_no_number_or_out_of_range_is_told_with_its_word(
    call, words, option, expected
):
    status, _, err = call(*words)
    told, usage, _ = err.splitlines()
    assert status == 2
    assert told == f"pbonet: {option} must be {expected} (got '{words[-1]}')"
    assert usage.startswith(f"usage: pbonet {words[0]} ")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("stats",), "there is no verb stats; did you mean status?"),
        (("log", "inf"), "pbonet log has no verb inf; did you mean info?"),
        (("stat",), "there is no verb stat; did you mean status?"),
        (("q",), "there is no verb q; see 'pbonet --help'"),
        (("new", "q"), "pbonet new has no verb q; it has module, svar, job, program"),
        (("on", "a.sbs", "--domian", "x"), "there is no option --domian; did you mean"),
        (("get",), "FILE is missing: The subsystem's .sbs file"),
        (("get", "a.sbs", "a", "b", "c"), "one word too many: c"),
        (("stop", "--timeout"), "--timeout needs a value: --timeout SECONDS"),
        (("run", "a.job", "--sim=yes"), "--sim takes no value (got 'yes')"),
        (("log", "merge", "a"), "--out is missing: The new file."),
    ],
)
def test_wrong_words_are_told(call, words, told):
    status, out, err = call(*words)
    assert (status, out) == (2, "")
    assert err.startswith(f"pbonet: {told}")


def test_options_come_anywhere_and_in_every_form(monkeypatch):
    monkeypatch.setenv("PBONET_CONNECT", "tcp/a:1 tcp/b:2")
    monkeypatch.setenv("PBONET_LIBRARY", "/x:/y")
    verb, rest = verbs.find(["set", "--json", "a.sbs", "t", "--domain=lab", "--", "-x"])
    given = parser.parse(verb, rest)
    assert (given["task"], given["param"], given["json_"]) == ("t", "-x", True)
    assert (given["domain"], given["connect"]) == ("lab", ["tcp/a:1", "tcp/b:2"])
    assert given["library"] == [Path("/x"), Path("/y")]
    verb, rest = verbs.find(["log", "merge", "a", "-oc.mcap", "b"])
    given = parser.parse(verb, rest)
    assert (given["files"], given["out"]) == ([Path("a"), Path("b")], Path("c.mcap"))
    verb, rest = verbs.find(["run", "a.job", "--no-embed", "--connect", "x"])
    given = parser.parse(verb, rest)
    assert (given["embed"], given["connect"]) == (False, ["x"])


def test_a_host_that_is_not_found_is_told_in_words_of_pbonet(call):
    """A name with an empty part is none anywhere, which no server needs to say."""
    words = ("status", PUMA / "puma.sbs", "--connect", "tcp/no..where:7447")
    status, _, err = call(*words, "--domain", "nobody-here")
    assert status == 1
    assert err.startswith(
        "pbonet: tcp/no..where:7447: no agent of domain nobody-here answers (got the "
        "host name no..where is unknown); is the name right?"
    )


def test_a_word_that_a_command_does_not_take_is_reported_with_the_verbs_usage(call):
    assert call("start", PUMA / "puma.sbs", "--wait", "5min") == (
        1,
        "",
        "pbonet: start: WAIT is not a number: 5min (expected pbonet start FILE [JOB] "
        "[options]); 'pbonet start --help' explains it\n",
    )


def test_interrupt_is_status_130(call, monkeypatch):
    def interrupt(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr("pbonet.master.configuration.check_files.check_file", interrupt)
    status, out, err = call("check", PUMA / "puma.job")
    assert (status, out, err) == (130, "", "")


def test_version(call):
    status, out, _ = call("--version")
    assert status == 0
    assert out.startswith("pbonet 0.")


def test_check_takes_every_kind_of_file(call, tmp_path):
    agent = tmp_path / "agent.toml"
    agent.write_text('name = "arm0"\n')
    rmod = Path(cli.__file__).parents[1] / "modules" / "signals" / "diff.rmod"
    files = [PUMA / "puma.svar", PUMA / "puma.sbs", PUMA / "puma.job", rmod, agent]
    status, out, _ = call("check", *files)
    assert status == 0
    assert out.count(": legal\n") == 5
    assert "job teleop of 4 tasks" in out


def test_check_tells_what_of_an_agent_is_not_here(call, tmp_path, monkeypatch):
    agent = tmp_path / "agent.toml"
    agent.write_text('name = "arm0"\nlibraries = ["nowhere", "."]\ncore = 4000\n')
    monkeypatch.chdir(tmp_path)
    status, out, _ = call("check", agent)
    assert status == 0, "it may be another machine's"
    cores = " ".join(map(str, sorted(os.sched_getaffinity(0))))
    assert out.splitlines()[:-1] == [
        f"WARNING> there is no folder {tmp_path / 'nowhere'}, named as a library",
        f"WARNING> core 4000 cannot be used here (expected one of {cores})",
    ]


def test_check_of_an_illegal_job_names_tasks_ports_and_remedy(call, tmp_path):
    for name in ("puma.svar", "puma.sbs"):
        (tmp_path / name).write_text((PUMA / name).read_text())
    text = (PUMA / "puma.job").read_text()
    text = text.replace("TASK  grav_comp  arm1\n", "").replace(" grav_comp\n", "\n")
    (tmp_path / "bad.job").write_text(text)
    status, out, _ = call("check", tmp_path / "bad.job")
    assert status == 1
    assert "puma_pidg" in out
    assert "T_GRAV" in out
    assert "grav_comp" in out
    status, out, _ = call("check", tmp_path / "bad.job", "--json")
    assert status == 1
    found = json.loads(out)[0]
    assert found["legal"] is False
    assert found["errors"][0]["code"] == "VERIFICATION"


def test_check_compares_an_rmod_with_its_module(call, tmp_path):
    source = Path(cli.__file__).parents[1] / "modules" / "signals" / "diff.rmod"
    rmod = tmp_path / "mine.rmod"
    text = source.read_text().replace("EOF", "\nLOCAL\nTAU       0.01\nEOF")
    for old, new, what in (
        ("INVAR     Z", "INVAR     Z W", "W"),
        ("TAU ", "TAO ", "did you mean tau?"),
        ("MODULE    diff", "MODULE    dif", "did you mean diff?"),
        ("MODULE    diff", "MODULE    dif", f"{rmod}:1:1: the library has no module"),
        ("FREQ", "FREK", "did you mean FREQ?"),
        ("\nLOCAL", "\nMAXC 1\nLOCAL", "MAXC of task mine is above its period"),
        ("periodic", "synchronous", f"{rmod}:7:1: module diff has no sync()"),
        ("\nLOCAL", "\nHANDLER 6\nLOCAL", "module diff has no timing_failure()"),
    ):
        assert old in text
        rmod.write_text(text.replace(old, new, 1))
        status, out, _ = call("check", rmod)
        assert status == 1, new
        assert what in out, out
        assert "fault" in out.splitlines()[-1]
    rmod.write_text(text.replace("TAU       0.01", "").replace("diff", "gain"))
    out = call("check", rmod)[1].splitlines()
    assert f"ERROR> {rmod}:10:1: module Gain needs parameter gain" in out[-2]


def test_library_shows_the_parts_of_a_combination(call):
    servo = Path(__file__).parents[3] / "examples" / "servoing" / "servo.rmod"
    status, out, _ = call("library", str(servo))
    assert status == 0
    assert "Q^_CMD  float64[ndof]    rad/s  commanded joint velocity" in out
    info = json.loads(call("library", str(servo), "--json")[1])["modules"][0]
    names = [part["name"] for part in info["parts"]]
    assert names == ["forward_kin", "damped_ls", "qrint"]


def test_library_shows_ports_and_parameters(call):
    status, out, _ = call("library", "diff")
    assert status == 0
    assert "parameters" in out
    info = json.loads(call("library", "diff", "--json")[1])["modules"][0]
    assert {port["name"] for port in info["ports"]} >= {"Z", "Z^"}


def test_new_module_is_written_once(call, tmp_path):
    words = ["new", "module", "squash", "--in", "Z:6:rad", "--out", "Y:6:rad"]
    words += ["--folder", tmp_path]
    status, out, _ = call(*words)
    assert status == 0
    assert (tmp_path / "squash.py").exists()
    assert len(out.splitlines()) == 3
    status, _, err = call(*words)
    assert status == 1
    assert "a file exists there already" in err
    assert call(*words, "--force")[0] == 0
    assert call("check", tmp_path / "squash.rmod", "--library", tmp_path)[0] == 0


def test_job_runs_in_virtual_time(call, tmp_path):
    words = ["run", PUMA / "puma.job", "--sim", "--seconds", "0.2", "--runs", tmp_path]
    status, out, _ = call(*words)
    assert status == 0
    assert "0.2 s of virtual time are over" in out
    assert len(Log(last_run(tmp_path)).arrays("puma_pidg")["cycle"]) == 100
    status, out, _ = call(*words, "--json")
    outcome = json.loads(out)
    assert outcome["tasks"][0]["cpu_avg"] is None, "not simulated"
    assert {task["task"]: task["cycles"] for task in outcome["tasks"]} == {
        "puma_pidg": 100,
        "grav_comp": 50,
        "qrdiff": 20,
        "jttrace": 10,
    }


def test_a_run_is_looked_at(call, tmp_path):
    words = ["run", PUMA / "puma.job", "--sim", "--seconds", "0.2", "--runs"]
    for folder in ("one", "two"):
        assert call(*words, tmp_path / folder)[0] == 0
    one, two = (last_run(tmp_path / folder) for folder in ("one", "two"))
    data = json.loads(call("log", "info", one, "--json")[1])
    assert data["tasks"]["qrdiff"]["cycles"] == 20
    assert "puma_pidg" in call("log", "info", one)[1]
    rows = call("log", "cat", one, "jttrace", "Q_REF")[1].splitlines()
    assert rows[0].startswith("time,cycle,Q_REF[0]")
    assert len(rows) == 11
    table = json.loads(call("log", "cat", one, "jttrace", "--json")[1])
    assert table["cycle"] == list(range(1, 11))
    assert call("log", "diff", one, two)[0] == 0, "a simulation gives the same twice"
    merged = tmp_path / "m.mcap"
    out = json.loads(call("log", "merge", one, "-o", merged, "--json")[1])
    count = sum(part.count for part in Log(one).parts)
    assert out == {"file": str(merged), "messages": count, "clocks": []}
    assert call("log", "recover", merged, "-o", merged)[0] == 1, "it stands"
    assert call("log", "plot", one, "Q_MEZ", "-o", tmp_path / "a.png")[0] == 0
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    told = json.loads(call("log", "events", one, "--json")[1])["events"]
    assert {event["code"] for event in told} == {"SPAWNED", "STATE", "STOPPED"}
    assert json.loads(call("log", "commands", one, "--json")[1]) == {"commands": []}
    status, out, _ = call("replay", one, "grav_comp", "--verify")
    assert status == 0
    assert out.startswith("grav_comp: 50 cycles identical")
    for words, why in (
        (("--play", "jttrace", "--verify"), "--play takes only"),
        (("--play", ","), "--play takes only"),
        (("--rate", "2"), "need --play"),
        (("--verify", "--loop"), "need --play"),
        (("--start", "1"), "need --play"),
        (("--subsystem", "arm"), "need --play"),
        (("--verify", "-o", tmp_path / "x.mcap"), "--out and --verify exclude"),
    ):
        status, _, err = call("replay", one, *words)
        assert (status, why in err) == (1, True), err
    status, out, _ = call("replay", one)
    assert status == 0, out
    assert out.startswith("4 tasks together: identical")


def test_what_is_recorded_is_said(call, tmp_path):
    words = ["run", PUMA / "puma.job", "--sim", "--seconds", "0.1", "--runs", tmp_path]
    status, _, err = call(*words, "--record", "alll")
    assert status == 1
    assert (
        "this is not a recording mode (expected off or outputs or all or last " in err
    )
    assert call(*words, "--record", "off")[0] == 0
    assert list(tmp_path.glob("*")) == []


def test_negative_numbers_are_values(monkeypatch, call):
    given = {}

    def run(_file, command, args, place):
        given.update(args)
        raise StateError("seen", where=command, got=str(place.domain))

    monkeypatch.setattr("pbonet.master.console.oneshot.run", run)
    status, _, err = call("write", "a.sbs", "T_REF", "-1.5", "2", "--domain", "lab")
    assert status == 1
    assert given == {"variable": "T_REF", "value": [-1.5, 2.0]}
    assert "got lab" in err


def test_doctor_finds_nothing_that_fails(call):
    status, out, _ = call("doctor", "--domain", "nobody-here")
    assert status == 0
    assert out.splitlines()[0].startswith("PASS pbonet ")
    found = json.loads(call("doctor", "--json", "--domain", "nobody-here")[1])
    assert {one["level"] for one in found} <= {"PASS", "WARN"}


def test_a_verb_whose_output_is_closed_does_its_work(monkeypatch):
    """As behind ``>&-``, where Python has no stream at all."""
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    for job, status in (("puma.job", 0), ("none.job", 1)):
        with pytest.raises(SystemExit) as caught:
            cli.main(["check", str(PUMA / job)])
        assert (caught.value.code or 0) == status
    for stream in (sys.stdout, sys.stderr):
        stream.close()


def test_a_view_for_other_machines_gets_a_remedy_that_fits_it(call) -> None:
    status, out, err = call("view", "x.sbs", "--host", "192.0.2.1", "--port", "9000")
    assert (status, out) == (1, "")
    assert "--host 192.0.2.1" in err
    assert "ssh -L 9000:127.0.0.1:9000" in err
    assert "control" not in err, "viewers only read"
    assert "tls" not in err, "viewers do not use it"
