"""Threads that Python did not start, such as zenoh's."""

def stay_known() -> None:
    """Have Python keep what it knows of this thread, which it did not start.

    Otherwise it is made anew at each call and discarded afterwards, which takes longer
    than many calls. At most 64 threads of a process get this; for others it does
    nothing.
    """
