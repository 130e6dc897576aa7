"""The native half, for other packages; modules use `Reader` and `Writer`."""

from ._tbuf import CARER, READER, WRITER, Buffer, In, Out, parts

__all__ = ["CARER", "READER", "WRITER", "Buffer", "In", "Out", "parts"]
