"""What a task must do, written by hand from Stewart 1994, 3.5, 3.6, 4.5.3 and 6.3.

An oracle for the life of a task. It imports nothing of pbonet, knows no tables, and
says for one signal at a time which methods must run, in which order, what each must
find in its ports, what must stand in the global table behind it, in which state the
task must be, and whether the signal must be refused. It can be compared with anything
that runs the probe module ``oracle_probe`` (beside this file): the executor in one
thread, or a real task process.

The probe has four ports: in-const ``C_IN``, out-const ``C_OUT``, in-var ``X`` and
out-var ``Y``. Each of its methods first notes in its diary what it finds in all four,
then sets ``C_OUT`` (`init`, `reinit`) or ``Y`` (`on`, `cycle`, `off`) to the number of
the note, and only then does what its script says: nothing, raise, call ``fail()``, or
give an answer. So every value says which method of which cycle made it, a copy that is
missing shows as an old value, and one too many as a new one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

NOT_CREATED, OFF, ON, ERROR = "NOT-CREATED", "OFF", "ON", "ERROR"
RAISE, FAIL = "raise", "fail"
"""What the script may say beside the answers ``OFF``, ``CONTINUE`` and ``ERROR``."""

SIGNALS = ("spawn", "on", "cycle", "sync", "off", "kill", "clear", "reinit", "set")
ABORT = "abort"
"""Beside the signals: a cycle that a handler of timing failures ends."""
MEANWHILE = 1_000_000
"""What others add to ``x`` while that cycle runs."""
METHODS = ("init", "on", "cycle", "sync", "off", "kill", "clear", "reinit", "set")
"""Methods whose behaviour the script may choose, `error` apart."""


@dataclass(frozen=True)
class Note:
    """What a method found when it was called."""

    method: str
    c_in: int
    c_out: int
    x: int
    y: int


@dataclass
class Ports:
    """One set of values: the global table, or a task's own copies."""

    c_in: int = 0
    c_out: int = 0
    x: int = 0
    y: int = 0


@dataclass
class Expected:
    """What one signal must lead to."""

    refused: bool = False
    """Not valid in this state: ignored, and an error to whoever sent it."""
    failed: bool = False
    """A method failed and was not put right: an error to whoever sent the signal."""
    notes: list[Note] = field(default_factory=list)


class _BrokenError(Exception):
    """A method failed."""


class Oracle:
    """The life of one task.

    Attributes:
        state: Where the task must be now.
        table: What must stand in the global table; others write ``c_in`` and ``x``.
    """

    def __init__(self) -> None:
        self.state = NOT_CREATED
        self.table = Ports()
        self._local = Ports()
        self._script: dict[str, str] = {}
        self._count = 0
        self._outdated = False
        self._now = Expected()

    def send(self, signal: str, script: dict[str, str]) -> Expected:
        """Carry out one signal (or one cycle, or one wait) and say what it must do.

        Args:
            signal: One of `SIGNALS`.
            script: What methods do; what is not named simply works. ``error`` has the
                answer of the error method, or ``raise``.
        """
        self._script = script
        self._now = Expected()
        wanted = {
            NOT_CREATED: {"spawn"},
            OFF: {"on", "kill", "reinit", "set"},
            ON: {"cycle", "sync", "abort", "off", "kill", "reinit", "set"},
            ERROR: {"clear", "kill", "reinit", "set"},
        }[self.state]
        if signal not in wanted:
            self._now.refused = True
        else:
            getattr(self, f"_{signal}")()
        return self._now

    # -- the signals ------------------------------------------------------------------

    def _spawn(self) -> None:
        # 3.5: before init in-consts are read, after it out-consts are written; then the
        # task is OFF. An error prevents creation and calls kill.
        self._local = Ports()
        self._count = 0
        self._outdated = False
        self._local.c_in = self.table.c_in
        try:
            self._call("init")
        except _BrokenError:
            self._now.failed = True
            self._kill_quietly()
            return
        self.table.c_out = self._local.c_out
        self.state = OFF

    def _on(self) -> None:
        # 3.5: in-vars and out-vars are read before; 3.6: out-vars are written after.
        # 3.5: all deal with the same constants always, so one whose reinit failed does
        # not come on before it has taken them in.
        if self._outdated:
            self._reinit()
            if self._outdated:
                return
        self._local.x = self.table.x
        self._local.y = self.table.y
        try:
            answer = self._call("on")
        except _BrokenError as broken:
            if self._ask(broken) != "CONTINUE":
                return
            answer = ""
        if answer == "OFF":
            return  # a task that stays OFF writes nothing
        self.table.y = self._local.y
        self.state = ON

    def _cycle(self) -> None:
        # 3.5: in-vars before, out-vars after; a cycle that raised writes nothing.
        self._local.x = self.table.x
        try:
            self._call("cycle")
        except _BrokenError as broken:
            self._ask(broken)
            return
        self.table.y = self._local.y

    def _abort(self) -> None:
        # 6.3: the task is prepared to start again in the next period. The cycle has
        # begun, and changed its output, which is lost. What `on` then finds is what
        # stands in the table now; the task goes on owning what it writes, and the
        # table changes with the next whole cycle.
        self._local.x = self.table.x
        self._note("cycle")
        self._local.y = self._count
        self.table.x += MEANWHILE
        self._local.x = self.table.x
        self._local.y = self.table.y
        try:
            answer = self._call("on")
        except _BrokenError as broken:
            self._ask(broken)
            return
        if answer == "OFF":
            self.state = OFF

    def _sync(self) -> None:
        try:
            self._call("sync")
        except _BrokenError as broken:
            self._ask(broken)

    def _off(self) -> None:
        if self._turn_off():
            self.state = OFF

    def _turn_off(self) -> bool:
        # 3.6: out-vars are written one more time behind off.
        try:
            self._call("off")
        except _BrokenError as broken:
            if self._ask(broken) != "CONTINUE":
                return False
        self.table.y = self._local.y
        return True

    def _kill(self) -> None:
        # 3.6: off and then kill from ON; kill alone from OFF and from ERROR. The kill
        # signal leads to NOT-CREATED: no answer of error saves a task from it, and
        # kill must free what init took (3.5) however off went.
        if self.state == ON:
            self._turn_off()
        self._kill_quietly()

    def _kill_quietly(self) -> None:
        try:
            self._call("kill")
        except _BrokenError:
            self._now.failed = True
        self.state = NOT_CREATED

    def _clear(self) -> None:
        # 3.6: OFF, or ERROR when the cause is still there; CONTINUE is impossible.
        try:
            answer = self._call("clear")
        except _BrokenError:
            self._now.failed = True
            return
        if answer == "CONTINUE":
            self._now.failed = True
        elif answer != "ERROR":
            self.state = OFF

    def _reinit(self) -> None:
        # 3.5: only what rests on the input constants is done again.
        self._local.c_in = self.table.c_in
        self._outdated = True
        try:
            self._call("reinit")
        except _BrokenError as broken:
            if self.state == ERROR:  # suspended: nobody is asked again
                self._now.failed = True
                return
            if self._ask(broken) != "CONTINUE":
                return
        self._outdated = False
        self.table.c_out = self._local.c_out

    def _set(self) -> None:
        try:
            self._call("set")
        except _BrokenError:
            self._now.failed = True

    # -- methods ----------------------------------------------------------------------

    def _call(self, method: str) -> str:
        """Run a method: its note, its new values, what its script says."""
        self._note(method)
        if method in {"init", "reinit"}:
            self._local.c_out = self._count
        if method in {"on", "cycle", "off"}:
            self._local.y = self._count
        told = self._script.get(method, "")
        if told == RAISE:
            raise _BrokenError
        if told == FAIL:
            self._fail(method)
            return ""
        if told == "CONTINUE" and method == "on":
            raise _BrokenError  # an answer that `on` cannot give
        if told == "ERROR" and method == "on":
            raise _BrokenError
        return told

    def _fail(self, method: str) -> None:
        """Call fail(): it comes back when the error method says CONTINUE."""
        asked = {"on", "cycle", "sync", "off"}
        if self.state in {OFF, ON}:
            asked.add("reinit")
        if method not in asked:
            raise _BrokenError
        self._note("error")
        answer = self._script.get("error", "ERROR")
        if answer != "CONTINUE":
            raise _UnwoundError(answer)

    def _ask(self, broken: _BrokenError) -> str:
        """Run the error method behind a failure, unless fail() did, and obey."""
        if isinstance(broken, _UnwoundError):
            answer = broken.answer
        else:
            self._note("error")
            answer = self._script.get("error", "ERROR")
        if answer == RAISE:
            answer = "ERROR"
        if answer != "CONTINUE":
            self._now.failed = True
            self.state = answer
        return answer

    def _note(self, method: str) -> None:
        self._count += 1
        have = self._local
        self._now.notes.append(Note(method, have.c_in, have.c_out, have.x, have.y))


class _UnwoundError(_BrokenError):
    """fail() did not come back; the error method has answered already."""

    def __init__(self, answer: str) -> None:
        super().__init__(answer)
        self.answer = answer
