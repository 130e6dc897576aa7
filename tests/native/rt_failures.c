/* A failure reaches its cycle whenever its signal comes: before, within, or amid both.
 *
 * usage: rt_failures; exits 0 when each was delivered once, and none to another cycle.
 */
#include "slot.h"
#include "dispatch.h"
#include "loop.h"
#include "failure.h"
#include "guard.h"
#include "ring.h"
#include "view.h"

static volatile sig_atomic_t interrupts;

static int interrupt(int signal)
{
    (void)signal;
    interrupts++;
    return 0;
}

static void require(int good, const char *what)
{
    if (!good) {
        fprintf(stderr, "broken: %s\n", what);
        exit(1);
    }
}

/* As the dispatcher tells of a failure: the word first, then the signal. */
static void tell(struct rt_task *task, uint32_t grant, int kind)
{
    atomic_fetch_or(&task->slot->grant.failed, grant << 3 | UINT32_C(1) << kind);
    raise(RT_FAIL_SIGNAL);
}

int main(void)
{
    static struct rt_table table;
    struct rt_task task = {.table = &table, .slot = &table.slots[0], .seq = 7};
    volatile uint32_t ends = 0, *volatile must_end = &ends;
    require(rt_guard_failures(&task, 500000000, interrupt, &must_end) == 0, "the guard");

    require(!rt_enter(RT_IN_CYCLE), "nothing came, and something is to be delivered");
    tell(&task, 7, RT_MAXEXEC);
    require(interrupts == 1, "a failure amid the cycle interrupts it");
    require(ends == 1u << RT_MAXEXEC, "a method in C sees the failure");
    must_end = NULL;
    require(rt_has_failed(&task), "and it is not handled yet");
    require(rt_take_failures(&task) == 1u << RT_MAXEXEC, "it is that kind");
    require(!rt_has_failed(&task), "now it is");
    rt_exit();

    tell(&task, 7, RT_DEADLINE);        /* while inputs are copied */
    require(interrupts == 1, "nothing is delivered outside the cycle");
    require(rt_enter(RT_IN_CYCLE), "what came before the cycle is delivered in it");
    require(rt_take_failures(&task) == 1u << RT_DEADLINE, "it is that kind");
    require(rt_take_failures(&task) == 0, "it is delivered once");
    rt_exit();

    tell(&task, 7, RT_DEADLINE);        /* behind the cycle: nobody is there */
    task.seq = 8;
    require(rt_enter(RT_IN_CYCLE), "something is there to be looked at");
    require(rt_take_failures(&task) == 0, "another cycle is not told");
    require(rt_get(&task.slot->stats.stale_failures) == 1, "but it is counted");
    require(!rt_enter(RT_IN_CYCLE), "and gone");

    rt_lock();
    tell(&task, 8, RT_MAXEXEC);
    require(interrupts == 1, "a critical section holds it off");
    require(rt_unlock(), "its end delivers it");
    require(rt_take_failures(&task) == 1u << RT_MAXEXEC, "it is that kind");
    rt_exit();

    task.kind = RT_SYNCHRONOUS;         /* a grant for all cycles; the device numbers them */
    rt_begin_event(&task);
    tell(&task, 1, RT_MAXEXEC);
    rt_end_event(&task);
    rt_begin_event(&task);
    require(rt_enter(RT_IN_CYCLE), "something is there to be looked at");
    require(rt_take_failures(&task) == 0, "the cycle of another event is not told");
    require(rt_get(&task.slot->stats.stale_failures) == 2, "but it is counted");
    atomic_store(&task.slot->grant.forced, 1);
    rt_lock();
    tell(&task, 3, RT_DEADLINE);
    require(interrupts == 1, "what overruled a section overrules none of the next cycle");
    require(rt_unlock(), "its end delivers it");
    require(rt_take_failures(&task) == 1u << RT_DEADLINE, "and it is this one's");
    rt_exit();
    rt_unguard_failures(&task);
    require(!rt_enter(RT_OUTSIDE), "a process that is no task is told nothing");
    return 0;
}
