"""Threads that Python did not start, such as zenoh's."""

def stay_known() -> None:
    """Keep Python's state of the calling thread, which Python did not start.

    Otherwise it is created at each call and discarded afterwards, which takes longer
    than many calls. At most 64 threads of a process are kept; for others this does
    nothing.
    """
