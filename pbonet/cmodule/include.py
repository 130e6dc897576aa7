"""The folder with the headers of modules in C."""

from pathlib import Path


def get_include() -> str:
    """Return the folder with ``pbonet.h``, for ``cc -I``."""
    return str(Path(__file__).parent)
