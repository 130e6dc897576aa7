from .pdo_driver import PdoDevice as PdoDevice
from .sdo_driver import CanopenDevice as CanopenDevice
