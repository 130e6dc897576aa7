"""Makes one task of a simulation: its module bound, nothing of it run yet."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from pbonet.node.task import ages, check_ports
from pbonet.outside import using
from pbonet.pbo import BoundedOutbox, TaskContext, bind, decode_params

from .sim_journal import SimExecutor, SimTime
from .sim_table import MemoryCopies
from .sim_task import SimTask

if TYPE_CHECKING:
    from collections.abc import Callable

    from pbonet.config import Library, Rmod
    from pbonet.master.configuration import Member
    from pbonet.pbo import ModuleInfo

    from .sim_log import SimLog
    from .sim_recording import Recording
    from .sim_table import MemoryTable


def make(
    member: Member,
    library: Library,
    table: MemoryTable,
    clock: Callable[[], int],
    *,
    slot: int,
    keep: Recording | None,
    log: SimLog | None,
) -> SimTask:
    """Return a task whose `init` has not run.

    Args:
        member: What it is.
        library: Where its module is.
        table: The table that it is bound to.
        clock: The virtual time, in nanoseconds.
        slot: Its place on its RTPU.
        keep: Where its cycles are kept in memory; None: nowhere.
        log: Where it is recorded; None: nowhere.

    Raises:
        PbonetError: The module does not load, or does not fit.
    """
    rmod = member.rmod
    loaded = library.load_rmod(rmod)
    check_ports(rmod, loaded.info)
    params = decode_params(loaded.cls, rmod.settings, where=rmod.file)
    copies = MemoryCopies(table, rmod, member.name)
    source, outbox = SimTime(clock), BoundedOutbox()
    journal = log.journal(member, library, table, copies, source) if log else None
    context = TaskContext(member.name, freq=member.freq, source=source, outbox=outbox)
    arrays = {
        port.attr: copies.array(rmod.svar_name(port.name)) for port in loaded.info.ports
    }
    with using(journal.tape if journal else None):
        instance = bind(loaded.cls, params, arrays, context)
    stale = _stale(rmod, loaded.info, table, context)
    if journal is not None:
        ask = journal.outside.ask
        context.is_stale = lambda port: ask(stale, port, default=False)
    else:
        context.is_stale = stale
    context.on_illegal = partial(table.said, f"{member.rtpu}/{member.name}")
    illegal = (lambda: bool(table.illegal)) if rmod.critical else None
    return SimTask(
        member=member,
        executor=SimExecutor(instance, copies, illegal=illegal, journal=journal),
        copies=copies,
        source=source,
        outbox=outbox,
        slot=slot,
        record=None
        if keep is None
        else keep.task(member.name, table.variables, copies.out_vars),
    )


def _stale(
    rmod: Rmod, info: ModuleInfo, table: MemoryTable, context: TaskContext
) -> Callable[[str], bool]:
    return ages(rmod, info, lambda name: table.stale(name, context.now))
