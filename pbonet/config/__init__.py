"""The configuration files, read and written (Stewart 1994, sections 3.8, 4.5.1, 5.5).

For each kind there is ``read_x(path)``, ``parse_x(text, file)``, ``write_x(record)``;
the records in between are those of `pbonet.config.model`.
"""

from pbonet.lazy import attach, load_without

load_without("typing_extensions", "msgspec")  # as in `pbonet.node`

__getattr__, __dir__, __all__ = attach(__name__, __file__)
