/* Who ends the last cycle that is looked at stops the timer, and nobody else.
 *
 * usage: rt_looks; exits 0 when the timer stood and stopped as it must.
 */
#include "looker.h"
#include "slot.h"
#include "rt_rig.h"

static struct rt_table table;
static struct rt_looker looker = {.table = &table};

static int set(void)
{
    struct itimerspec left;
    timerfd_gettime(looker.fd, &left);
    return left.it_value.tv_sec || left.it_value.tv_nsec;
}

/* Two tasks amid their cycles, and a timer for them. */
static void begin(void)
{
    for (int i = 0; i < 2; i++) {
        struct rt_state *s = &table.slots[i].state;
        *s = (struct rt_state){.armed = 1, .ready = 1, .granted = 1, .begun = 1, .seq = 7};
        atomic_store(&table.slots[i].post.done, 6);
    }
    rt_count_looked(&table);
    rt_set_look(&looker, rt_now() + INT64_C(60000000000));
}

static void finish(struct rt_task *task)
{
    atomic_store(&task->slot->post.done, 7);
    rt_spare(&table, task->slot, &task->look);
}

int main(void)
{
    struct rt_task one = {.table = &table, .slot = &table.slots[0]};
    struct rt_task two = {.table = &table, .slot = &table.slots[1]};
    atomic_store(&table.high, 3);
    atomic_store(&table.leader_pid, getpid());
    looker.fd = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC);
    atomic_store(&table.look_fd, looker.fd);
    atomic_store(&table.look_life, 1);

    begin();
    require((uint32_t)atomic_load(&table.look) == 2, "both are looked at");
    finish(&one);
    require(set(), "the other one still runs");
    finish(&one);
    require(set(), "nobody ends twice, but if, the other one is not counted out");
    begin();
    finish(&two);
    finish(&one);
    if (one.look.fd < 0)
        return 77;              /* the kernel gives no descriptor of another process */
    require(!set(), "the last one stops the timer");
    require(atomic_load(&table.look_ns) == 0 && atomic_load(&table.spared) == 1, "told");

    begin();
    finish(&one);
    begin();                    /* a turn: `one` runs again, and nobody has ended */
    atomic_store(&table.slots[0].grant.look, 1);
    finish(&one);
    require(set() && (uint32_t)atomic_load(&table.look) == 2, "an old number ends nothing");

    begin();
    close(looker.fd);           /* another leader, whose descriptor nobody gets */
    looker.fd = timerfd_create(CLOCK_MONOTONIC, TFD_CLOEXEC);
    atomic_store(&table.look_fd, -1);
    atomic_store(&table.look_life, 2);
    rt_set_look(&looker, rt_now() + INT64_C(60000000000));
    finish(&one);
    finish(&two);
    require(set() && atomic_load(&table.look_ns), "without it the timer runs out");
    return 0;
}
