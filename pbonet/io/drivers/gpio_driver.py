"""Digital lines of a chip: class PIO, drivers ``gpio`` and ``gpio_edges``.

The address is the chip's device file, such as ``/dev/gpiochip0``; physical port k is
its line k. ``gpio`` reads and writes lines, ``gpio_edges`` returns their edges with the
kernel's stamps.

Its tests have chips that a test makes up, and gpio-sim in User-Mode Linux. It was not
run with hardware here.
"""

from __future__ import annotations

from abc import abstractmethod
from contextlib import suppress
from datetime import timedelta
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated as A, Any, ClassVar, Literal, NamedTuple

from msgspec import Meta

from pbonet.errors import DeviceError
from pbonet.io import from_extra

from .device import Device, Kind, Settings
from .device_classes import FrameDevice, PortDevice
from .modes import Mode
from .stream_waits import read_pieces

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from .port_claims import Claim

_REFUSALS = OSError, ValueError, NotImplementedError
"""Errors of gpiod for what a chip does not do."""
Lines = tuple[A[int, Meta(ge=0)], ...]


class LineSettings(Settings, frozen=True, forbid_unknown_fields=True):
    """``[device.NAME.settings]`` of lines; numbers of lines are those of the chip."""

    active_low: Lines = ()
    """Lines whose value 1 is a low voltage."""
    bias: Literal["as is", "off", "up", "down"] = "as is"
    """The pull of the lines where nothing drives them."""


class GpioSettings(LineSettings, frozen=True, forbid_unknown_fields=True):
    """Settings of lines that are read and written."""

    drive: Literal["push-pull", "open-drain", "open-source"] = "push-pull"


class EdgeSettings(LineSettings, frozen=True, forbid_unknown_fields=True):
    """Settings of lines whose edges are read."""

    edges: Literal["both", "rising", "falling"] = "both"
    debounce_us: A[int, Meta(ge=0)] = 0
    """How long a line keeps a value before that is an edge, in microseconds."""
    buffer: A[int, Meta(ge=1, le=1024)] = 64
    """Edges that the kernel keeps; it drops the oldest."""


class _Lines(Device):
    """Lines of one chip, requested together."""

    kind: ClassVar[Kind] = "PIO"
    packages: ClassVar[tuple[str, ...]] = ("gpiod", "gpiod.line")

    def open(self, claim: Claim | None) -> None:
        """Open the device, and note how many lines it has; see `Device.open`."""
        super().open(claim)
        self._ports: int = self.ask(lambda: self._count - self.entry.first, default=0)

    def connect(self) -> None:
        """Request the lines; see `Device.connect`."""
        with from_extra("gpio", f"the device {self.name}"):
            self._gpiod: Any = import_module("gpiod")
            self._words: Any = import_module("gpiod.line")
        o, first = self.opening, self.entry.first
        self._lines = range(first + o.start, first + o.end + 1)
        self._request: Any = None
        try:
            with self._gpiod.Chip(self.entry.address) as chip:
                self._count: int = chip.get_info().num_lines
                self.check_ports(self._count - first)
                if o.mode is not Mode.NONE:
                    self._take_lines(chip)
        except DeviceError:
            raise
        except _REFUSALS as error:
            self.disconnect()
            raise DeviceError(
                "the lines cannot be had",
                where=self._where(),
                expected="a chip of /dev, with lines that nothing else uses",
                got=getattr(error, "strerror", None) or str(error),
                remedy="`gpiodetect` lists the chips, `gpioinfo` their lines and users",
            ) from None

    def _take_lines(self, chip: Any) -> None:  # noqa: ANN401 - of gpiod
        """Request the lines, each with its settings."""
        self._request_lines(
            chip, {line: self._config(line) for line in self._lines}, **self.more()
        )

    def _request_lines(self, chip: Any, config: dict[int, Any], **more: Any) -> None:  # noqa: ANN401
        self._request = chip.request_lines(
            config=config, consumer=f"pbonet {self.name}", **more
        )

    def disconnect(self) -> None:
        """Give the lines back to the kernel."""
        if self._request is not None:
            with suppress(*_REFUSALS):
                self._request.release()

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known of the chip; it has a port for each line."""
        if command == "PORTNUM":
            return self.entry.ports or self._ports
        return super().status(command, port)

    def port_bits(self, port: int) -> int:
        """Return how many bits a line has."""
        del port
        return 1

    def more(self) -> dict[str, Any]:
        """Return what this driver asks for beside the lines' settings."""
        return {}

    @abstractmethod
    def line_settings(self, line: int) -> dict[str, Any]:
        """Return what this driver asks of a line."""

    def _config(self, line: int) -> Any:  # noqa: ANN401 - settings of gpiod
        k, words = self.settings, self._words
        bias: dict[str, Any] = {
            "as is": words.Bias.AS_IS,
            "off": words.Bias.DISABLED,
            "up": words.Bias.PULL_UP,
            "down": words.Bias.PULL_DOWN,
        }
        return self._gpiod.LineSettings(
            bias=bias[k.bias],
            active_low=line in k.active_low,
            **self.line_settings(line),
        )

    def _where(self) -> str:
        return f"{self.name} ({self.entry.address})"


class GpioLines(_Lines, PortDevice):
    """Lines that are inputs, or outputs where they are opened for writing.

    An output has its safe value from the moment on in which it becomes one; without
    safe values it keeps the value that its line has. Opened for both, it is an output
    whose line is read back.
    """

    settings_type: ClassVar[type[Settings]] = GpioSettings
    _first: Mapping[int, int] = MappingProxyType({})
    """The first value of each output."""

    def connect(self) -> None:
        """Request the lines; see `Device.connect`."""
        if self.safe is not None:
            self.check_safe()
        super().connect()

    def _take_lines(self, chip: Any) -> None:  # noqa: ANN401 - of gpiod
        """Request the lines; outputs begin with their safe values, or as they are."""
        if Mode.WRITE not in self.opening.mode:
            super()._take_lines(chip)
        elif self.safe is not None:
            self._first = dict(zip(self._lines, self.raw_of(self.safe), strict=True))
            super()._take_lines(chip)
        else:
            low = self.settings.active_low
            as_it_is = {
                line: self._gpiod.LineSettings(active_low=line in low)
                for line in self._lines
            }
            self._request_lines(chip, as_it_is)
            self._first = dict(zip(self._lines, self.read_ports(), strict=True))
            config = {line: self._config(line) for line in self._lines}
            self._request.reconfigure_lines(config)

    def line_settings(self, line: int) -> dict[str, Any]:
        """Return direction, drive and first value of a line."""
        k, words = self.settings, self._words
        if Mode.WRITE not in self.opening.mode:
            return {"direction": words.Direction.INPUT}
        return {
            "direction": words.Direction.OUTPUT,
            "drive": words.Drive[k.drive.upper().replace("-", "_")],
            "output_value": words.Value(self._first[line]),
        }

    def read_ports(self) -> list[int]:
        """Return the values of the opened lines, all of one moment."""
        found = self._request.get_values(list(self._lines))
        active = self._words.Value.ACTIVE
        return [int(one == active) for one in found]

    def write_ports(self, values: Sequence[int]) -> None:
        """Set the opened lines, all at once."""
        value = self._words.Value
        self._request.set_values({
            line: value.ACTIVE if one else value.INACTIVE
            for line, one in zip(self._lines, values, strict=True)
        })


class Edge(NamedTuple):
    """A change of a line."""

    port: int
    """Of the logical device."""
    rising: bool
    """Whether it is 1 now."""
    stamp_ns: int = 0
    """Nanoseconds since 1970, by the kernel."""


class GpioEdges(_Lines, FrameDevice[Edge]):
    """Edges of input lines; what is not read in time, the kernel drops."""

    kind: ClassVar[Kind] = "PIO"
    can = Mode.READ
    one_port = False
    settings_type: ClassVar[type[Settings]] = EdgeSettings

    def connect(self) -> None:
        """Request the lines; see `Device.connect`."""
        super().connect()
        self._held: list[tuple[int, bool, int]] = []
        self._number = self._dropped = 0

    def line_settings(self, line: int) -> dict[str, Any]:
        """Return direction and edges of a line."""
        del line
        k, words = self.settings, self._words
        return {
            "direction": words.Direction.INPUT,
            "edge_detection": words.Edge[k.edges.upper()],
            "debounce_period": timedelta(microseconds=k.debounce_us),
            "event_clock": words.Clock.REALTIME,
        }

    def more(self) -> dict[str, Any]:
        """Return how many edges the kernel keeps."""
        return {"event_buffer_size": self.settings.buffer}

    def read(self, count: int) -> list[Edge]:
        """Return edges that were seen; see `FrameDevice.read`."""
        self.require(Mode.READ)
        return [Edge(*one) for one in self.ask(self._read, count, default=[])]

    def _read(self, count: int) -> list[tuple[int, bool, int]]:
        request, wait = self._request, self.opening.wait
        return read_pieces(request.fd, self._taken, count, wait, self._held)

    def _taken(self, limit: int) -> list[tuple[int, bool, int]]:
        """Return edges that were seen, at most so many; empty if there is none."""
        request, first = self._request, self.entry.first
        if not request.wait_edge_events(0):
            return []
        found: list[tuple[int, bool, int]] = []
        rising = self._gpiod.EdgeEvent.Type.RISING_EDGE
        for one in request.read_edge_events(limit):
            self._dropped += one.global_seqno - self._number - 1
            self._number = one.global_seqno
            up = one.event_type == rising
            found.append((one.line_offset - first, up, one.timestamp_ns))
        return found

    def status(self, command: str, port: int = 0) -> Any:  # noqa: ANN401
        """Return what is known: ``DROPPED`` counts edges that were not read in time."""
        if command == "DROPPED":
            return self.ask(lambda: self._dropped, default=0)
        return super().status(command, port)
