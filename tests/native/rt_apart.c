/* A real dispatcher and tasks that release themselves as threads of one process, for the
 * thread sanitizer.
 *
 * usage: rt_apart CYCLES MAXC_NS; exits 0 when each task has run that many cycles and each
 * release was run once or counted as missed, while another slot is armed now and then and
 * others kick, ask and read; 77 when there are no real-time rights. The tasks may run on
 * other cores than the dispatcher, so a turn comes between any two of their steps.
 */
#include "slot.h"
#include "loop.h"
#include "view.h"
#include "rt_rig.h"

enum { TASKS = 3, OTHER = TASKS, PERIOD = 1000000 };
static const int64_t periods[] = {PERIOD, 1370000, 2110000, PERIOD};
static struct rt_table *table;
static int64_t wanted, lost[TASKS];
static _Atomic int64_t taken;
static _Atomic int left = TASKS;

/* Whether the task ran a release of a lease. */
static void count_taken(const struct rt_task *task)
{
    taken += task->seq != atomic_load(&task->slot->grant.seq);
}

static void cycle(struct rt_task *task, int64_t number)
{
    struct rt_cost cost = {.start_ns = rt_now(), .cpu_ns = 1000};
    int64_t until = number % 50 ? 0 : cost.start_ns + 5 * PERIOD / 2;
    while (rt_now() < until)
        ;
    cost.called_ns = cost.returned_ns = cost.end_ns = rt_now();
    rt_account(task, &cost);
    rt_end(task);
}

static void *task_main(void *arg)
{
    int i = (int)((const int64_t *)arg - periods);
    struct rt_task task = {.table = table, .slot = &table->slots[i]};
    int64_t last = 0, cycles = 0;
    rt_meet_dispatcher(&task);
    rt_arm(&task);
    for (int served = 0; cycles < wanted; served = 1) {
        int why = rt_wait(&task, served);
        if (why == RT_WAIT_COMMAND) {
            rt_leave(&task, RT_COMMAND);
            rt_arm(&task);
            served = 0;
            continue;
        }
        require(why == RT_RELEASED, "released");
        require(rt_begin(&task), "begun");
        require(task.rel_ns > last, "a release is run once");
        lost[i] += last ? (task.rel_ns - last) / periods[i] - 1
                        : (int64_t)atomic_load(&task.slot->grant.missed);
        last = task.rel_ns;
        count_taken(&task);
        cycle(&task, ++cycles);
    }
    rt_leave(&task, RT_OFF);
    atomic_fetch_sub(&left, 1);
    return NULL;
}

static void *busybody(void *arg)
{
    struct rt_task other = {.table = table, .slot = &table->slots[OTHER]};
    struct rt_view *view = malloc(sizeof *view);
    (void)arg;
    for (unsigned round = 1; atomic_load(&left); round++) {
        if (round % 3 == 0)
            rt_kick(table);
        if (round % 40 == 0)
            rt_request(&table->slots[round % TASKS], RT_ASK_COMMAND);
        if (round % 64 == 0)
            rt_arm(&other);
        if (round % 64 == 8)
            rt_leave(&other, RT_OFF);
        rt_snapshot(&table->slots[round % TASKS], view);
        usleep(300 + round % 7 * 400);
    }
    rt_leave(&other, RT_OFF);
    free(view);
    return NULL;
}

int main(int argc, char **argv)
{
    pthread_t threads[TASKS + 1];
    if (argc != 3)
        return 2;
    if (rt_try_fifo())
        return 77;
    wanted = atoll(argv[1]);
    table = aligned_alloc(64, (sizeof *table + 63) / 64 * 64);
    memset(table, 0, sizeof *table);
    require(!rt_init(table, sched_getcpu()), "init");
    int member = rt_join(table);
    struct rt_loop loop = {.table = table, .backend = RT_FIFO};
    for (int i = 0; i <= OTHER; i++) {
        struct rt_settings s = {.pid = -1, .crit = 5, .priority = -1, .kind = -1,
                                .drop = 3, .handler = -1, .tells = -1, .minc_ns = -1,
                                .maxc_ns = atoll(argv[2]), .hang_ns = -1,
                                .period_ns = periods[i], .deadline_ns = 0};
        require(rt_alloc(table, member, "rtpu", "task") == i, "alloc");
        rt_configure(table, i, &s);
    }
    require(!rt_start(&loop), "start");
    while (!rt_leading(&loop) || !atomic_load(&table->look_life))
        usleep(1000);
    for (int i = 0; i < TASKS; i++)
        pthread_create(&threads[i], NULL, task_main, (void *)(uintptr_t)&periods[i]);
    pthread_create(&threads[OTHER], NULL, busybody, NULL);
    for (int i = 0; i <= OTHER; i++)
        pthread_join(threads[i], NULL);
    rt_stop(&loop);
    for (int i = 0; i < TASKS; i++) {
        int64_t missed = (int64_t)atomic_load(&table->slots[i].grant.missed);
        require(missed == lost[i] || missed == lost[i] + 1,
                "each release was run or counted as missed");
    }
    require(taken > wanted / 20, "they took releases of leases");
    free(table);
    return 0;
}
