from pbonet.config import DRIVERS as DRIVERS, Entry as Entry

from . import database as database, port_claims as port_claims
from .can_driver import BusSettings as BusSettings, CanBus as CanBus
from .device import Device as Device, Kind as Kind, Settings as Settings
from .device_classes import (
    Frame as Frame,
    FrameDevice as FrameDevice,
    MemoryDevice as MemoryDevice,
    PortDevice as PortDevice,
    StreamDevice as StreamDevice,
)
from .device_list import listed as listed
from .device_opening import driver as driver, open_device as open_device
from .gpio_driver import Edge as Edge
from .guard import GUARD as GUARD
from .iio_buffer_driver import Sample as Sample
from .j1939_driver import Group as Group
from .modes import Mode as Mode, Opening as Opening, Wait as Wait
from .request_device import Line as Line, RequestDevice as RequestDevice
