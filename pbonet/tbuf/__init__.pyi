from . import layout as layout, places as places
from .link_ends import Reader as Reader, Writer as Writer
from .link_status import seen as seen
from .native import (
    CARER as CARER,
    READER as READER,
    WRITER as WRITER,
    Buffer as Buffer,
    In as In,
    Out as Out,
    parts as parts,
)
from .places import sweep as sweep
