# Part of _rt.pyx: what a process sets up for itself; documented in `_rt.pyi`.

def probe():
    return rights.probe(rt_try_fifo())


def orphan_guard(int signal, int parent=0) -> int:
    cdef int fd = rt_guard_orphan(signal, parent)
    if fd < 0:
        raise RealTimeError("the parent process cannot be watched",
                            got=os.strerror(-fd))
    return fd


def orphaned() -> bool:
    return bool(rt_is_orphan())


def leave_to_next(int signal) -> None:
    cdef int error = rt_leave_to_next(signal)
    if error:
        raise RealTimeError("the signal cannot be left to the next program",
                            got=os.strerror(error))


def see_interrupt(int signal) -> None:
    cdef int error = rt_see_interrupt(signal)
    if error:
        raise RealTimeError("the signal is not seen amid a cycle in C",
                            got=os.strerror(error))


def lock_memory() -> None:
    cdef int error = rt_lock_memory()
    if error:
        raise RealTimeError("memory cannot be locked", got=os.strerror(error),
                            remedy="set 'memlock unlimited' in /etc/security/limits.d")


def restrict(pids) -> None:
    cdef int32_t[16] listed
    cdef size_t count = len(pids)
    for i, pid in enumerate(pids):
        listed[i] = pid
    cdef int error = rt_restrict(listed, count)
    if error:
        raise RealTimeError("calls of modules cannot be restricted",
                            got=os.strerror(error),
                            remedy="use a kernel with seccomp filters")


def drop_rights() -> None:
    cdef int error = rt_drop_rights()
    if error:
        raise RealTimeError("the task keeps its rights", got=os.strerror(error))


def prefault_stack(size_t size=1 << 19) -> None:
    rt_prefault_stack(size if size < 1 << 22 else 1 << 22)


def populate_pages(copied=(), size_t spare=1 << 20, size_t whole=1 << 24) -> int:
    """Ask the kernel for private writable pages (madvise): absent ones, and `copied`."""
    cdef size_t begin, end
    total = 0
    for begin, end in copied:
        rt_populate(begin, end - begin)
    if rt_spare_heap(spare):
        raise MemoryError
    with open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
        lines = maps.readlines()
    for line in lines:
        place, rights = line.split()[:2]
        low, high = (int(text, 16) for text in place.split("-"))
        if rights.startswith("rw") and rights.endswith("p") and "[v" not in line:
            if high - low <= whole:
                total += rt_populate_absent(low, high - low)
    return total


def set_timer_slack(unsigned long ns=1) -> None:
    rt_timer_slack(ns)


def pin(int core) -> None:
    cdef int error = rt_pin(0, core)
    if error:
        raise RealTimeError(f"the thread cannot be pinned to core {core}",
                            got=os.strerror(error),
                            expected=f"one of {sorted(os.sched_getaffinity(0))}")


def monotonic_ns() -> int:
    return rt_now()


def thread_cpu_ns() -> int:
    return rt_thread_cpu()
