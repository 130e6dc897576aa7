# cython: language_level=3, boundscheck=False, wraparound=False
"""Threads that Python did not start, such as zenoh's; `_threads.pyi` says what is here."""

cdef extern from *:
    """
    /* Python knows a thread that it did not start for as long as a call lasts: at each call
     * it maps and unmaps memory for it. One that comes again and again is to stay known.
     * What is kept of a thread is never freed, so there is an end to it. */
    enum { XM_KNOWN = 64 };
    static _Thread_local int xm_known;
    static _Atomic int xm_knowns;
    static inline void xm_stay_known(void) {
        if (xm_known) return;
        xm_known = 1;
        if (xm_knowns++ < XM_KNOWN) PyGILState_Ensure();
    }
    """
    void xm_stay_known() noexcept


def stay_known() -> None:
    xm_stay_known()
