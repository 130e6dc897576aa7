# cython: language_level=3, boundscheck=False, wraparound=False
"""Threads that Python did not start, such as zenoh's; documented in `_threads.pyi`."""

cdef extern from *:
    """
    /* Python keeps the state of a foreign thread only during a call: at each call it maps
     * and unmaps memory for it. For a thread that calls often, the state is kept. It is
     * never freed, so the number of threads is limited. */
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
