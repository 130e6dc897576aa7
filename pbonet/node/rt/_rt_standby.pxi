# Part of _rt.pyx: detection of tasks' deaths; documented in `_rt.pyi`.

cdef class Vigil:
    cdef rt_vigil *vigil
    cdef CoreTable table        # keeps the memory
    cdef dict arenas            # keeps the tables of the watched tasks alive
    cdef int pid

    def __init__(self, Dispatcher beside not None):
        beside.table.open()
        self.vigil = <rt_vigil *>calloc(1, sizeof(rt_vigil))
        if self.vigil is NULL:
            raise MemoryError
        self.table = beside.table
        self.arenas = {}
        self.pid = os.getpid()
        cdef int error = rt_start_vigil(self.vigil, &beside.loop)
        if error:
            raise RealTimeError("the thread that watches tasks cannot be started",
                                where=f"core {self.table.core}", got=os.strerror(error))
        self.table.busy += 1

    def watch(self, int i, Arena arena, bytes raiser, bytes died, bytes fell) -> None:
        self.table.slot(i)
        self.forget(i)
        cdef rt_watched *w = &self.vigil.watched[i]
        w.table = NULL
        if arena is not None:
            w.table = <const pb_table *>arena.core
        w.died[0] = w.fell[0] = w.raiser[0] = w.machine[0] = 0
        strncat(w.died, died, RT_CAUSE - 1)
        strncat(w.fell, fell, RT_CAUSE - 1)
        strncat(w.raiser, raiser, RT_RAISER - 1)
        if arena is not None:
            strncat(w.machine, <const char *>arena.machine, RT_RAISER - 1)
        self.arenas[i] = arena
        rt_watch_life(self.vigil, i)

    def forget(self, int i) -> None:
        if not 0 <= i < RT_SLOTS:
            raise ValueError(f"there is no slot {i}")
        rt_unwatch(self.vigil, i)
        self.arenas.pop(i, None)

    @property
    def counts(self) -> tuple:
        return rt_deaths(self.vigil), rt_falls(self.vigil)

    def stop(self) -> None:
        if self.vigil.running and self.pid == os.getpid():
            with nogil:
                rt_end_vigil(self.vigil)
            self.table.busy -= 1

    def __dealloc__(self):
        if self.vigil is not NULL and self.vigil.running and self.pid == os.getpid():
            with nogil:
                rt_end_vigil(self.vigil)
        free(self.vigil)
