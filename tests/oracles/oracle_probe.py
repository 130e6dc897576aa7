"""The module that `oracle_lifecycle` knows: it notes what it finds and does as told."""

import json
import os
import time
from pathlib import Path
from typing import Annotated as A

from pbonet import (
    Answer,
    InConst,
    InVar,
    OutConst,
    OutVar,
    Params,
    PortBasedObject,
    Recovery,
    TimingFailure,
    param,
)


class Told(Params):
    """Where the probe finds its script and leaves its notes."""

    folder: A[str, param("none", "folder with script.json, gets diary.jsonl")]
    gain: A[float, param("none", "something that can be set")] = 1.0


class OracleProbe(PortBasedObject[Told]):
    """Note the ports in every method, number the outputs, then obey the script."""

    c_in: A[int, InConst("C_IN", "1", "none", "a constant of somebody else")]
    c_out: A[int, OutConst("C_OUT", "1", "none", "number of a note")]
    x: A[int, InVar("X", "1", "none", "a variable of somebody else")]
    y: A[int, OutVar("Y", "1", "none", "number of a note")]

    def init(self) -> None:
        self.number = 0
        self.obey("init")

    def on(self) -> Answer | None:
        told = self.obey("on")
        return Answer(told) if told else None

    def cycle(self, dt: float) -> None:  # noqa: ARG002
        self.given_up = False
        if self.obey("cycle") == "abort":
            self.overrun()

    def overrun(self) -> None:
        """Say so, wait until the script changes, then take time until it is aborted."""
        (Path(self.params.folder) / "overruns").touch()
        while self.script().get("cycle") == "abort":
            time.sleep(0.001)
        self.given_up = True
        while True:
            pass

    def timing_failure(self, kind: TimingFailure) -> Recovery:  # noqa: ARG002
        return Recovery.ABORT if self.given_up else Recovery.CONTINUE

    def sync(self) -> None:
        self.obey("sync")

    def off(self) -> None:
        self.obey("off")

    def kill(self) -> None:
        self.obey("kill")

    def clear(self) -> Answer:
        return Answer(self.obey("clear") or "OFF")

    def reinit(self) -> None:
        self.obey("reinit")

    def set(self, name: str, value: object) -> None:  # noqa: ARG002
        self.obey("set")

    def error(self, error: Exception) -> Answer:  # noqa: ARG002
        return Answer(self.obey("error") or "ERROR")

    def obey(self, method: str) -> str:
        """Note, number, and do what the script says about `method`."""
        self.number += 1
        self.note([method, self.c_in, self.c_out, self.x, self.y])
        if method in {"init", "reinit"}:
            self.c_out = self.number
        if method in {"on", "cycle", "off"}:
            self.y = self.number
        told = self.script().get(method, "")
        if told == "raise":
            raise RuntimeError(f"{method} as told")
        if told == "fail":
            self.task.fail(f"{method} as told", 7)
            return ""
        return told

    def script(self) -> dict[str, str]:
        """Return what methods have to do now."""
        text = (Path(self.params.folder) / "script.json").read_text()
        script: dict[str, str] = json.loads(text)
        return script

    def note(self, entry: list[object]) -> None:
        """Append to the diary, whole lines only."""
        line = json.dumps(entry).encode() + b"\n"
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        fd = os.open(Path(self.params.folder) / "diary.jsonl", flags, 0o600)
        try:
            os.write(fd, line)
        finally:
            os.close(fd)
