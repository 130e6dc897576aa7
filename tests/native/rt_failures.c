/* A failure reaches its cycle whenever its signal comes: before, within, or amid both.
 *
 * usage: rt_failures; exits 0 when each was delivered once, and none to another cycle.
 */
#include "slot.h"
#include "dispatch.h"
#include "loop.h"
#include "failure.h"
#include "../../pbonet/cmodule/instance.h"
#include "guard.h"
#include "ring.h"
#include "view.h"
#include "rt_rig.h"

static volatile sig_atomic_t interrupts;

static int interrupt(int signal)
{
    (void)signal;
    interrupts++;
    return 0;
}

/* As the dispatcher tells of a failure: the word first, then the signal. */
static void tell(struct rt_task *task, uint32_t grant, int kind)
{
    atomic_fetch_or(&task->slot->grant.failed, grant << 3 | UINT32_C(1) << kind);
    raise(RT_FAIL_SIGNAL);
}

/* Methods in C; `state` is the task. Each returns PBO_OK if `must_end` is as it says. */

static int sees(void *state, pbo_task *task)
{
    (void)state;
    return task->must_end == PBO_MAXEXEC ? PBO_OK : PBO_ERROR;
}

static int is_late(void *state, pbo_task *task)
{
    (void)state;
    return task->must_end == PBO_DEADLINE ? PBO_OK : PBO_ERROR;
}

static int fails(void *state, pbo_task *task)
{
    int early = task->must_end != 0;
    tell(state, 7, RT_MAXEXEC);
    return early ? PBO_ERROR : sees(state, task);
}

int main(void)
{
    static struct rt_table table;
    struct rt_task task = {.table = &table, .slot = &table.slots[0], .seq = 7};
    struct pbo_running running = {0};
    static pbo_instance parts[2];       /* of a combination */
    for (int i = 0; i < 2; i++)
        pbo_begin(&parts[i], NULL, &task, &running);
    require(rt_guard_failures(&task, 500000000, interrupt, &running) == 0, "the guard");

    require(!rt_enter(RT_IN_CYCLE), "nothing came, and something is to be delivered");
    require(!pbo_run(fails, &parts[0]), "a method in C sees the failure of its cycle");
    require(interrupts == 1, "a failure amid the cycle interrupts it");
    require(rt_has_failed(&task), "and it is not handled yet");
    require(rt_take_failures(&task) == 1u << RT_MAXEXEC, "it is that kind");
    require(!rt_has_failed(&task), "now it is");
    require(!pbo_run(sees, &parts[1]), "later parts of the cycle see it from their start");
    rt_exit();
    require(!rt_enter(RT_IN_CYCLE), "nothing came in the next cycle");
    require(pbo_run(sees, &parts[1]), "which need not end");
    rt_exit();

    tell(&task, 7, RT_DEADLINE);        /* while inputs are copied */
    require(interrupts == 1, "nothing is delivered outside the cycle");
    require(rt_enter(RT_IN_CYCLE), "what came before the cycle is delivered in it");
    require(!pbo_run(is_late, &parts[0]), "and seen in it");
    require(rt_take_failures(&task) == 1u << RT_DEADLINE, "it is that kind");
    require(rt_take_failures(&task) == 0, "it is delivered once");
    rt_exit();

    tell(&task, 7, RT_DEADLINE);        /* behind the cycle: nobody is there */
    task.seq = 8;
    require(rt_enter(RT_IN_CYCLE), "something is there to be looked at");
    require(pbo_run(is_late, &parts[0]), "another cycle is not to end for it");
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

    struct rt_event event = {.kind = RT_FAIL, .arg = RT_MAXEXEC, .a = 1};
    struct rt_state *state = &table.slots[0].state;
    _Atomic uint64_t *merged = &table.slots[0].grant.merged;
    state->kind = RT_PERIODIC;
    state->seq = 1;
    rt_tell(&table, 0, &event);
    require(rt_get(merged) == 0, "the first of its kind is to be handled");
    event.arg = RT_DEADLINE;
    rt_tell(&table, 0, &event);
    require(rt_get(merged) == 0, "one of another kind has a call of its own");
    rt_tell(&table, 0, &event);
    require(rt_get(merged) == 1, "one of the same kind shares its call: it is counted");
    state->seq = 2;
    rt_tell(&table, 0, &event);
    require(rt_get(merged) == 3, "two of an earlier grant have no call any more");
    require(!rt_enter(RT_OUTSIDE), "a process that is no task is told nothing");
    return 0;
}
