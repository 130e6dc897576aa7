"""An I/O device of a machine, and the drivers that there are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

if TYPE_CHECKING:
    from collections.abc import Mapping

DRIVERS: Final[Mapping[str, str]] = {
    "serial": "serial_driver:SerialDevice",
    "tcp": "socket_driver:TcpDevice",
    "udp": "socket_driver:UdpDevice",
    "file": "mapped_file_driver:FileDevice",
    "can": "can_driver:CanDevice",
    "i2c": "i2c_driver:I2cDevice",
    "iio_adc": "iio_driver:IioAdc",
    "iio_dac": "iio_driver:IioDac",
    "modbus": "modbus_driver:ModbusDevice",
    "dynamixel": "dynamixel_driver:DynamixelDevice",
    "iio_buffer": "iio_buffer_driver:IioBuffer",
    "joystick": "joystick_driver:JoystickDevice",
    "spi": "spi_driver:SpiDevice",
    "canopen": "canopen.sdo_driver:CanopenDevice",
    "canopen_pdo": "canopen.pdo_driver:PdoDevice",
    "j1939": "j1939_driver:J1939Device",
    "camera": "camera_driver:CameraDevice",
    "ethercat": "ethercat_driver:EthercatDevice",
    "gpio": "gpio_driver:GpioLines",
    "gpio_edges": "gpio_driver:GpioEdges",
}
"""Drivers by name: the file in pbonet.io.drivers and the class of each."""


class Entry(Struct, frozen=True, kw_only=True):
    """A device: ``[device.NAME]`` of an ``agent.toml``."""

    driver: str
    """Its name in `DRIVERS`, or ``package.module:Class``."""
    address: str
    """Where the device is: a device file, HOST:PORT, a folder of sysfs."""
    first: int = 0
    """The physical port that is port 0 of this logical device."""
    ports: int = 0
    """How many ports it has; 0: as many as the driver finds."""
    settings: dict[str, Any] = {}
    """The driver's own settings."""
