"""Threads that Python did not start, such as zenoh's."""

def stay_known() -> None:
    """Let Python keep its state of this thread, which it did not start.

    Otherwise it is made again at each call and discarded afterwards, which takes longer
    than many calls. At most 64 threads of a process get this; for others it does
    nothing.
    """
