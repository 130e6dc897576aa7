"""Message queues; part of _ipc.pyx."""


cdef class Queue(Shared):
    cdef xm_queue *q
    cdef readonly int last_priority

    @staticmethod
    def create(name, *, policy=Policy.FIFO, messages=64, blocks=None, block=64):
        n = messages if blocks is None else blocks
        for what, value, least in ("messages", messages, 1), ("blocks", n, 1), ("block", block, 8):
            if not least <= value <= MOST:
                raise ValueError(f"{what} {value} is not within {least} to {MOST}")
        if active():
            return _heard(Queue.create, name, policy=policy, messages=messages, blocks=n,
                          block=block)
        found, here = names.find(name)
        if not here:
            from pbonet.xm.ipc import remote_resources
            return remote_resources.RemoteQueue.create_there(
                found, Policy(policy), messages, n, block
            )
        cdef xm_queue plan
        memset(&plan, 0, sizeof(plan))
        plan.policy = Policy(policy)
        cdef uint64_t size = xm_lay_out(&plan, messages, n, block)
        path = found.path("queue")
        fd, fresh = files.FILES.make(path, size)
        cdef Queue self = Queue.__new__(Queue)
        self.name = str(found)
        try:
            self.map(str(path), fd, size)
            self.q = <xm_queue *>self.at
            self.judge(xm_queue_make(self.q, &plan))
            self.enter()
        except BaseException:
            fresh.unlink()
            raise
        files.FILES.publish(fresh, path)
        return self

    @staticmethod
    def attach(name):
        if active():
            return _heard(Queue.attach, name)
        found, here = names.find(name)
        if not here:
            from pbonet.xm.ipc import remote_resources
            return remote_resources.RemoteQueue.attach_there(found)
        fd, size = files.open_file(found, "queue")
        cdef Queue self = Queue.__new__(Queue)
        self.name = str(found)
        self.map(str(found.path("queue")), fd, max(1, size))
        self.judge(XM_DAMAGED if size == 0
                   else xm_queue_verify(<xm_queue *>self.at, self.bytes))
        self.q = <xm_queue *>self.at
        self.enter()
        return self

    cdef int enter(self) except -1:
        return self.joined(xm_queue_enter(self.q))

    cdef int leave(self) except -1:
        cdef int code = xm_queue_exit(self.q, self.me)
        return self.fail(code) if code else 0

    cdef void look_around(self) noexcept nogil:
        xm_queue_patrol(self.q, self.me)

    def __len__(self) -> int:
        self.open()
        return self.q.queued

    @property
    def policy(self):
        self.open()
        return Policy(self.q.policy)

    @property
    def messages(self) -> int:
        self.open()
        return self.q.heads

    @property
    def blocks(self) -> int:
        self.open()
        return self.q.blocks

    @property
    def block(self) -> int:
        self.open()
        return self.q.block

    @property
    def free(self):
        self.open()
        return self.q.n_heads, self.q.n_blocks

    @property
    def sent(self) -> int:
        self.open()
        return self.q.seq

    @property
    def dropped(self) -> int:
        self.open()
        return self.q.dropped

    def send(self, data, priority=0, *, full=Full.REFUSE, until_ns=0,
             wait_priority=None, still=None, answer=True) -> bool:
        self.open()
        cdef Py_buffer view
        cdef int code, mode = full
        PyObject_GetBuffer(data, &view, PyBUF_SIMPLE)
        try:
            if view.len > LONGEST:
                code = XM_TOO_LONG
            else:
                code = self.put(&view, priority, mode, _limit(until_ns), wait_priority,
                                still)
            if code == XM_NO_ROOM and mode == XM_REFUSE:
                raise XmQueueFullError("the queue is full", where=self.name,
                                       expected=f"room for {view.len} bytes",
                                       got=f"{len(self)} messages in it",
                                       remedy="receive more often, make it larger, or choose "
                                       "what to drop (full=)")
            if code == XM_TOO_LONG:
                raise XmTooLongError("the message is longer than the queue", where=self.name,
                                     expected=f"at most {self.q.blocks * self.q.block} bytes",
                                     got=f"{view.len} bytes",
                                     remedy="create the queue with more or larger blocks")
            if code and code != XM_NO_ROOM:
                self.fail(code)
            return code == 0
        finally:
            PyBuffer_Release(&view)

    cdef int put(self, Py_buffer *view, int32_t priority, int mode, int64_t until,
                 object wait_priority, object still) except? -100:
        """Send, and wait for room until the time-out; then apply `mode`."""
        cdef int how = XM_WAIT if until != 1 else mode
        cdef int slot, code = self.post(-1, view, priority, how)
        if code != XM_NO_ROOM or until == 1:
            return code
        slot = self.stand(XM_SENDER, _priority(wait_priority), view.len)
        self.waits += 1
        try:
            while code == XM_NO_ROOM and self.sleep(slot, until, still):
                code = self.post(slot, view, priority, XM_WAIT)
                if code == XM_NO_ROOM:
                    xm_queue_again(self.q, slot)
            if code == 0:
                return 0
        except BaseException:
            xm_queue_leave(self.q, slot)
            raise
        finally:
            self.waits -= 1
        xm_queue_leave(self.q, slot)
        return self.post(-1, view, priority, mode) if code == XM_NO_ROOM else code

    cdef int post(self, int slot, Py_buffer *view, int32_t priority, int mode) noexcept:
        cdef int code
        if view.len <= XM_SHORT:
            return xm_send(self.q, self.me, slot, <uint8_t *>view.buf, view.len, priority, mode)
        self.waits += 1         # no other thread may unmap it meanwhile
        with nogil:
            code = xm_send(self.q, self.me, slot, <uint8_t *>view.buf, view.len, priority, mode)
        self.waits -= 1
        return code

    cdef int stand(self, uint32_t role, int32_t priority, uint32_t size) except -1:
        cdef int slot = xm_queue_wait(self.q, self.me, role, priority, size)
        return self.fail(slot) if slot < 0 else slot

    def receive(self, until_ns=None, *, priority=None):
        cdef int32_t of_letter
        return self.read(until_ns, priority, LONGEST, None, &of_letter)

    def letter(self, until_ns=None, *, priority=None, most=LONGEST, still=None):
        cdef int32_t of_letter
        found = self.read(until_ns, priority, most, still, &of_letter)
        return None if found is None else (found, of_letter)

    cdef object read(self, object until_ns, object priority, uint32_t most, object still,
                     int32_t *of_letter):
        """Return the first message, or None; and its priority."""
        self.open()
        cdef uint8_t small[XM_SHORT]
        cdef xm_letter letter
        if not self.take(small, min(XM_SHORT, most), most, _limit(until_ns), priority, still,
                         &letter):
            return None
        self.last_priority = of_letter[0] = letter.priority
        if letter.head == XM_END:
            return PyBytes_FromStringAndSize(<char *>small, letter.size)
        return self.fetch(&letter)

    def wait(self, until_ns=None, *, priority=None, still=None) -> bool:
        self.open()
        cdef int slot = self.stand(XM_RECEIVER, _priority(priority), 0)
        self.waits += 1
        try:
            return bool(self.sleep(slot, _limit(until_ns), still))
        finally:
            self.waits -= 1
            xm_queue_leave(self.q, slot)

    def try_receive(self):
        return self.receive(0)

    def receive_into(self, buffer, until_ns=None, *, priority=None):
        self.open()
        cdef Py_buffer view
        cdef xm_letter letter
        cdef int code
        PyObject_GetBuffer(buffer, &view, PyBUF_SIMPLE | PyBUF_WRITABLE)
        try:
            if not self.take(<uint8_t *>view.buf, min(view.len, XM_SHORT),
                             min(view.len, LONGEST), _limit(until_ns), priority, None,
                             &letter):
                return None
            self.last_priority = letter.priority
            if letter.head != XM_END:
                self.waits += 1
                with nogil:
                    code = xm_copy_out(self.q, letter.head, <uint8_t *>view.buf)
                    code = xm_received(self.q, letter.head) or code
                self.waits -= 1
                if code:
                    self.fail(code)
            return letter.size
        finally:
            PyBuffer_Release(&view)

    cdef bytes fetch(self, xm_letter *letter):
        """Return a long message that is in progress."""
        cdef bytes copy
        cdef char *to
        cdef int code
        try:
            copy = PyBytes_FromStringAndSize(NULL, letter.size)
        except MemoryError:
            xm_received(self.q, letter.head)
            raise
        to = PyBytes_AS_STRING(copy)
        self.waits += 1
        with nogil:
            code = xm_copy_out(self.q, letter.head, <uint8_t *>to)
            code = xm_received(self.q, letter.head) or code
        self.waits -= 1
        if code:
            self.fail(code)
        return copy

    cdef bint take(self, uint8_t *to, uint32_t room, uint32_t most, int64_t until,
                   object priority, object still, xm_letter *letter) except -1:
        """Receive one message; False if there was none until the time-out."""
        cdef int code = xm_receive(self.q, self.me, -1, to, room, most, letter)
        if code == XM_EMPTY:
            if until == 1:
                return False
            code = self.take_called(to, room, most, until, _priority(priority), still,
                                    letter)
        if code == XM_TOO_LONG:
            raise XmTooLongError("the message is longer than the buffer; it stays",
                                 where=self.name, expected=f"at most {most} bytes",
                                 got=f"{letter.size} bytes",
                                 remedy="receive into a longer buffer")
        if code and code != XM_EMPTY:
            self.fail(code)
        return code == 0

    cdef int take_called(self, uint8_t *to, uint32_t room, uint32_t most, int64_t until,
                         int32_t priority, object still, xm_letter *letter) except? -100:
        """Receive by waiting in line; a result of xm_receive."""
        cdef int slot = self.stand(XM_RECEIVER, priority, 0), code = XM_EMPTY
        self.waits += 1
        try:
            while code == XM_EMPTY and self.sleep(slot, until, still):
                code = xm_receive(self.q, self.me, slot, to, room, most, letter)
                if code == XM_EMPTY:
                    xm_queue_again(self.q, slot)
        except BaseException:
            xm_queue_leave(self.q, slot)
            raise
        finally:
            self.waits -= 1
        if code and code != XM_TOO_LONG:
            xm_queue_leave(self.q, slot)
        return code

    def __repr__(self):
        return f"<Queue {self.name}>"
