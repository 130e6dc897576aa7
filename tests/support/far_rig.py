"""Programs on two machines that do what a test says, one line at a time."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from unittest import mock

from long_limits import LIMIT
from tbuf_rig import Machine, Pair
from watching import wait_for

from pbonet.xm.net import session


class Site:
    """A machine's own way into the domain, for a master there."""

    def __init__(self, machine: Machine) -> None:
        self.domain = machine.domain
        where = [f"tcp/127.0.0.1:{machine.port}"]
        with mock.patch.object(session, "SILENT_MS", machine.lease_ms):
            self.session = session.client(machine.domain, connect=where, timeout=60.0)


PATIENT = ("ANSWER_TIME", "PROOF_TIME")
"""Limits of a program's requests that are made long."""
UNSEEN = {"UnreachableError", "NoAnswerError"}
"""What is said while an agent is out of reach."""
LEASE_MS = 5000
"""A link that is cut is given up after that; one that stands outlives a stall."""
PROGRAM = """
import importlib.util, json, sys, time
from pbonet import xm

settings = json.loads(sys.argv[1])

class Patience:
    # The network is not loaded for it: limits are set when somebody else loads that.
    limits = {
        "pbonet.xm.net.session": {"SILENT_MS": settings["lease"]},
        "pbonet.xm.net.rpc": {name: settings["limit"] for name in settings["patient"]},
    }
    def find_spec(self, name, path, target=None):
        limits = self.limits.pop(name, None)
        if limits is None:
            return None
        spec = importlib.util.find_spec(name)
        load = spec.loader.exec_module
        def loaded(module):
            load(module)
            vars(module).update(limits)
        spec.loader.exec_module = loaded
        return spec

sys.meta_path.insert(0, Patience())
if settings["home"]:
    xm.live_on(settings["home"], domain=settings["domain"])
space = {"xm": xm, "now": time.monotonic_ns, "s": 1_000_000_000}
print("ready", flush=True)
for line in sys.stdin:
    code = json.loads(line)
    try:
        try:
            found = eval(code, space)
        except SyntaxError:
            found = exec(code, space)
        answer = {"got": found if isinstance(found, (list, dict)) else repr(found)}
    except Exception as error:
        answer = {"error": type(error).__name__, "text": str(error)}
    print(json.dumps(answer), flush=True)
"""


VERB = """
import contextlib, io, json
from pbonet.cli import main


def verb(*words):
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        try:
            main([*words, "--json"])
        except SystemExit as end:
            return [end.code or 0, json.loads(out.getvalue())]
"""
"""Has a program run verbs of the command line: status and data."""


class RefusedError(Exception):
    """What a program's line raised."""

    def __init__(self, answer: dict) -> None:
        super().__init__(answer["text"])
        self.kind = answer["error"]


class Hand:
    """A program on a machine.

    Args:
        machine: Where it runs.
        home: The RTPU that it is at home on; the machine's, or "" for none.
        env: More of its environment.
    """

    def __init__(self, machine: Machine, home: str | None = None, **env: str) -> None:
        where = machine.name if home is None else home
        limits = {"lease": machine.lease_ms, "limit": LIMIT, "patient": PATIENT}
        text = json.dumps({"home": where, "domain": machine.domain, **limits})
        self.process = subprocess.Popen(
            [*machine.prefix, sys.executable, "-c", PROGRAM, text],
            env=machine.env | {"PBONET_DOMAIN": machine.domain} | env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        machine.programs.append(self)
        assert self.process.stdout.readline() == "ready\n"

    def begin(self, code: str) -> None:
        """Have it do something; `end` returns what came of it."""
        self.process.stdin.write(json.dumps(code) + "\n")
        self.process.stdin.flush()

    def end(self):
        answer = json.loads(self.process.stdout.readline())
        if "error" in answer:
            raise RefusedError(answer)
        return answer["got"]

    def do(self, code: str):
        """Have it do something, and return that as text (or list, or map)."""
        self.begin(code)
        return self.end()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(60)
        for pipe in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()

    def wait(self, code: str, wanted: str, limit: float = 60.0) -> None:
        """Wait until something is so; links may be coming back meanwhile."""

        def so():
            try:
                return self.do(code) == wanted
            except RefusedError as error:
                if error.kind not in UNSEEN:
                    raise
            return False

        wait_for(so, f"{code} to be {wanted}", limit)


class Cell(Pair):
    """Two machines, vision0 and arm0 that dials it, and programs on them."""

    def __init__(self, lease_ms: int = session.LEASE_MS) -> None:
        super().__init__()
        self.a.lease_ms = self.b.lease_ms = lease_ms

    def hand(self, machine: Machine, **more: str) -> Hand:
        return Hand(machine, **more)


def traffic(hand: Hand) -> bool:
    """Tell whether a program has loaded the network."""
    return hand.do("'zenoh' in __import__('sys').modules") == "True"
