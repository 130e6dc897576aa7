"""Finds the records in an uncompressed chunk of an MCAP file."""

def walk(data: bytes, /) -> bytes | None:
    """Return type, channel, place and size of each record, as int64 in rows of four.

    Args:
        data: The uncompressed chunk.

    Returns:
        None if a record does not fit: the records do not end with the chunk, or a
        message is too short for its head. The place is the offset of the record's
        content; the channel is that of a message.
    """
