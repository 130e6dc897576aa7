"""The command line interface of Stewart 1994, section 4.4.1: a prompt that stays.

Whatever a command does, the prompt comes back; and whatever it is doing, one key stops
the subsystem. So a command runs in a thread of its own while the terminal is read.
"""

from __future__ import annotations

import threading
import traceback
from typing import TYPE_CHECKING, Final

from prompt_toolkit import PromptSession
from prompt_toolkit.application import create_app_session
from prompt_toolkit.completion import Completer, Completion
from prompt_toolkit.history import FileHistory, History, InMemoryHistory
from prompt_toolkit.input import create_input
from prompt_toolkit.input.typeahead import store_typeahead
from prompt_toolkit.key_binding import KeyBindings
from prompt_toolkit.keys import Keys
from prompt_toolkit.output import create_output
from prompt_toolkit.patch_stdout import patch_stdout

from pbonet.errors import PbonetError, StateError
from pbonet.master.subsystem import Window
from pbonet.xm.net import messages as m, run_folder

from . import render
from .command_session import CommandSession
from .completion import complete
from .network_interface import Port
from .watch_values import Listener

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from prompt_toolkit.completion import CompleteEvent
    from prompt_toolkit.document import Document
    from prompt_toolkit.input import Input
    from prompt_toolkit.key_binding import KeyPressEvent
    from prompt_toolkit.key_binding.key_processor import KeyPress
    from prompt_toolkit.output import Output

    from pbonet.master.subsystem import Subsystem

STOP_KEYS: Final = (Keys.F12, Keys.ControlE)
"""Either one stops the subsystem, whatever the prompt is doing."""

_STOP: Final = "\x00stop"
_LOOK: Final = 0.02
_POLL: Final = 1.0


class Prompt:
    """The interactive prompt.

    Args:
        subsystem: It is open, and not in virtual time.
        debug: Show the stack of an error.
        source: Where keys come from; the terminal by default.
        screen: Where the prompt goes; the terminal by default.
        history: Where lines are kept; by default a file in the user's state folder.
        say: Prints a line above the prompt, from whatever thread.

    Raises:
        StateError: The subsystem is in virtual time, which would stand still here.
    """

    def __init__(
        self,
        subsystem: Subsystem,
        *,
        debug: bool = False,
        source: Input | None = None,
        screen: Output | None = None,
        history: History | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        if subsystem.simulation is not None:
            raise StateError(
                "a prompt needs a subsystem in real time",
                where=subsystem.name,
                expected="Subsystem(...) without virtual=True",
                remedy="in virtual time use its methods: time passes in wait",
            )
        self._say = say or render.print_line
        self._subsystem = subsystem
        self._debug = debug
        self._input = source or create_input()
        self._screen = screen or create_output()
        self._back = threading.Event()
        self._commands = CommandSession(subsystem, hand_over=self._hand_over)
        self._bar = _Toolbar(subsystem)
        self._listener = Listener(subsystem, heard=self._print_event)
        self._input_line: PromptSession[str] = PromptSession(
            completer=_Completer(self._commands),
            complete_while_typing=False,
            history=history if history is not None else _history(),
            key_bindings=_bindings(),
            bottom_toolbar=self._bar.text,
            refresh_interval=_POLL / 2,
            input=self._input,
            output=self._screen,
        )

    def run(self) -> None:
        """Read and carry out commands until `quit` or the end of the input."""
        self._listener.open()
        self._bar.open()
        try:
            with (
                create_app_session(input=self._input, output=self._screen),
                patch_stdout(raw=True),
            ):
                while not self._commands.ended:
                    self._turn()
        finally:
            self._bar.close()
            self._listener.close()

    def _turn(self) -> None:
        try:
            line = self._input_line.prompt(self._commands.prompt)
        except KeyboardInterrupt:
            return  # the line is thrown away
        except EOFError:
            line = "quit"
        self._watch_keys(lambda: self.execute("stop" if line == _STOP else line))

    def execute(self, line: str) -> None:
        """Carry out one line and print its result or error."""
        try:
            reply = self._commands.execute(line)
        except PbonetError as error:
            self._say(render.error(error, debug=self._debug))
        except Exception as error:  # noqa: BLE001 - the prompt outlives any command
            self._say(
                f"ERROR> it failed inside pbonet: {type(error).__name__}: {error}"
            )
            if self._debug:
                self._say(traceback.format_exc().rstrip())
        else:
            if reply is None:
                return
            for warning in reply.warnings:
                self._say(render.warning(warning))
            if text := render.text(reply.command, reply.data):
                self._say(text)

    # -- while a command runs ---------------------------------------------------------

    def _watch_keys(self, command: Callable[[], None]) -> None:
        """Run a command in a thread and watch the stop key meanwhile."""
        self._back.clear()
        worker = threading.Thread(target=command, name="command", daemon=True)
        worker.start()
        worker.join(_LOOK)
        if not worker.is_alive():
            return
        with self._input.raw_mode():
            while worker.is_alive():
                self._read_keys()
                worker.join(_LOOK)

    def _read_keys(self) -> None:
        ahead: list[KeyPress] = []
        for press in self._input.read_keys():
            if press.key in STOP_KEYS:
                threading.Thread(target=self.execute, args=("stop",)).start()
            elif press.key == Keys.ControlC:
                self._back.set()
                self._say("the command continues; F12 stops the subsystem")
            else:
                ahead.append(press)
        store_typeahead(self._input, ahead)

    def _hand_over(self, portname: str) -> None:
        """Let a program on the network take control until it ends, or until Ctrl-C."""
        with Port(self._subsystem, portname, told=self._say) as port:
            self._say(f"port {portname} waits for a client; Ctrl-C takes control back")
            port.serve(self._back)

    def _print_event(self, event: m.Event) -> None:
        """Print an event above the prompt; called in zenoh's thread."""
        self._say(render.event(event))


def _bindings() -> KeyBindings:
    bindings = KeyBindings()

    def stop(event: KeyPressEvent) -> None:
        event.app.exit(result=_STOP)

    for key in STOP_KEYS:
        bindings.add(key)(stop)
    return bindings


class _Completer(Completer):
    """Offers what `pbonet.master.console.completion` finds."""

    def __init__(self, commands: CommandSession) -> None:
        self._commands = commands

    def get_completions(
        self,
        document: Document,
        complete_event: CompleteEvent,  # noqa: ARG002 - prompt_toolkit gives it
    ) -> Iterable[Completion]:
        text = document.text_before_cursor
        last = text.split()[-1] if text and not text[-1].isspace() else ""
        for word in complete(self._commands, text):
            yield Completion(word, start_position=-len(last))


class _Toolbar:
    """The line below the prompt; a thread updates it, so the prompt never waits."""

    def __init__(self, subsystem: Subsystem) -> None:
        self._subsystem = subsystem
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._poll, name="bar", daemon=True)
        self._about = ""
        self._window = Window()

    def open(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._end.set()
        self._thread.join()

    def text(self) -> str:
        return f" F12 or Ctrl-E: STOP   {self._about}"

    def _poll(self) -> None:
        while True:
            try:
                results, errors = self._subsystem.clients.each(
                    lambda _: m.Status(), m.RtpuStatus
                )
            except PbonetError as error:
                self._about = error.what
                return
            for status in results.values():
                for task in status.tasks:
                    self._window.rates(task)
            self._about = summary(list(results.values()), errors, self._window)
            if self._end.wait(_POLL):
                return


def summary(
    rtpus: list[m.RtpuStatus], errors: list[PbonetError], window: Window
) -> str:
    """Return one line on the state of a subsystem; loads are those of the window."""
    states = [task.state for rtpu in rtpus for task in rtpu.tasks]
    counts = [f"{states.count(s)} {s}" for s in ("ON", "OFF", "ERROR") if s in states]
    causes = [cause for rtpu in rtpus for cause in rtpu.illegal]
    parts = [", ".join(counts) or "no tasks"]
    parts += [
        f"{rtpu.rtpu} {rtpu.backend} {window.load(rtpu.tasks):.0%}" for rtpu in rtpus
    ]
    parts += [f"{error.where}: {error.what}" for error in errors]
    parts += [f"ILLEGAL {cause}" for cause in sorted(set(causes))[:1]]
    return "   ".join(parts)


def _history() -> History:
    """Return the user's history file, or none where there is no home."""
    path = run_folder.state_folder() / "history"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch(mode=0o600)
    except OSError:
        return InMemoryHistory()
    return FileHistory(str(path))
