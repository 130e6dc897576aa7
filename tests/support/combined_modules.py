"""Modules that note what is called, and a folder to combine them in."""

from __future__ import annotations

import re

from pbonet.config.library import Library
from pbonet.testing import Bench

PROBE = """
from typing import Annotated as A, Literal
from pbonet import (
    Answer, Handling, InConst, InVar, OutConst, OutVar, Params, PortBasedObject,
    Recovery, Signal, UserSignal, Vector, param,
)

class Told(Params):
    gain: A[float, param("none", "factor", gt=0)] = 1.0
    fails: A[str, param("none", "the method that fails")] = "nothing"
    how: A[Literal["raise", "fail"], param("none", "how")] = "raise"
    answer: A[str, param("none", "what error answers")] = "ERROR"

class Name(PortBasedObject[Told]):
PORTS
    def note(self, method):
        calls = vars(self.task).setdefault("calls", [])
        calls.append(f"NAME.{method}")
        if self.params.fails == method:
            if self.params.how == "raise":
                raise RuntimeError(f"NAME fails in {method}")
            self.task.fail(f"NAME fails in {method}")
            calls.append(f"NAME.{method} goes on")

    def init(self): self.note("init")
    def on(self):
        self.note("on")
        return Answer.OFF if self.params.answer == "later" else None
    def cycle(self, dt):
        self.note("cycle")
        CYCLE
    def off(self): self.note("off")
    def kill(self): self.note("kill")
    def reinit(self): self.note("reinit")
    def error(self, error):
        self.note("error")
        return Answer(self.params.answer)
    def clear(self):
        self.note("clear")
        return Answer.OFF
    def set(self, name, value):
        self.note("set")
        if name == "gain" and value > 100:
            raise ValueError("too much")
MORE
"""
ONE = """
    ndof: A[int, InConst("NDOF", "1", "none", "size")]
    x: A[Vector, InVar("X", "ndof", "rad", "in")]
    y: A[Vector, OutVar("Y", "ndof", "rad", "out")]
"""
TWO = """
    n: A[int, InConst("NDOF", "1", "none", "size")]
    y: A[Vector, InVar("Y", "n", "rad", "in")]
    z: A[Vector, OutVar("Z", "n", "rad", "out")]
"""


class Folder:
    """A library with modules and RMODs made for one test."""

    def __init__(self, path):
        self.path = path

    def module(self, name, ports, cycle="pass", more=""):
        text = PROBE.replace("PORTS", ports.strip("\n")).replace("CYCLE", cycle)
        text = text.replace("NAME", name).replace("MORE", more)
        (self.path / f"{name}.py").write_text(text.replace("Name(", f"{name.title()}("))
        kinds = {
            kind: " ".join(re.findall(rf'{kind}\("([^"]+)"', ports)) or "none"
            for kind in ("InConst", "OutConst", "InVar", "OutVar")
        }
        self.rmod(name, f"MODULE {name}", **{k.upper(): v for k, v in kinds.items()})

    def rmod(self, name, first, local="", alias="", **lists):
        lines = [first, "DESC", *(f"SVARALIAS {one}" for one in alias.split())]
        lines += [
            f"{keyword} {lists.get(keyword, 'none')}"
            for keyword in ("INCONST", "OUTCONST", "INVAR", "OUTVAR")
        ]
        lines += [lists.get("TASKTYPE", "TASKTYPE periodic"), "FREQ 100"]
        if local:
            lines += ["LOCAL", *local.split("; ")]
        path = self.path / f"{name}.rmod"
        path.write_text("\n".join([*lines, "EOF", ""]))
        return path

    def both(self, local="", **lists):
        given = {"INCONST": "NDOF", "INVAR": "X", "OUTVAR": "Z", **lists}
        return self.rmod("both", "COMBINE one two", local, **given)

    def bench(self, *words):
        return Bench.of(self.both(*words), {"ndof": 3}, library=[self.path])

    def load(self, path):
        library = Library([self.path])
        return library.load_rmod(library.read_rmod(path))


def calls(bench):
    found, bench.task.calls = getattr(bench.task, "calls", []), []
    return found
