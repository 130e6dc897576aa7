/* A real dispatcher and tasks as threads of one process, for the thread sanitizer.
 *
 * usage: rt_threads CYCLES; exits 0 when every task has run that many cycles, each for a
 * release of its own, while others configure, ask, read, free and allocate.
 */
#include "slot.h"
#include "loop.h"
#include "guard.h"
#include "ring.h"
#include "view.h"
#include "rt_rig.h"

enum { TASKS = 4 };
static struct rt_table *table;
static struct ring *rings[TASKS];
static int64_t wanted;
static _Atomic int left = TASKS;
static int member;

static void *task_main(void *arg)
{
    int i = (int)(intptr_t)arg;
    struct rt_task task = {.table = table, .slot = &table->slots[i]};
    int64_t last = 0, cycles = 0, commands = 0;
    while (cycles < wanted) {
        rt_arm(&task);
        for (int served = 0;; served = 1) {
            int why = rt_wait(&task, served);
            if (why == RT_WAIT_COMMAND) {
                commands++;
                rt_leave(&task, commands % 5 ? RT_COMMAND : RT_OFF);
                break;
            }
            require(why == RT_RELEASED, "released");
            rt_begin(&task);
            require(task.rel_ns > last, "a release is run once");
            last = task.rel_ns;
            struct rt_cost cost = {.start_ns = rt_now()};
            cost.called_ns = cost.returned_ns = cost.end_ns = rt_now();
            cost.cpu_ns = 1000;
            rt_account(&task, &cost);
            struct ring_record record = {.cycle = (uint64_t)cycles, .bytes = 8};
            ring_put(rings[i], &record, NULL, &cycles, NULL);
            rt_end(&task);
            if (++cycles >= wanted)
                break;
        }
    }
    rt_leave(&task, RT_OFF);
    atomic_fetch_sub(&left, 1);
    return NULL;
}

static void *busybody(void *arg)
{
    struct rt_view *view = malloc(sizeof *view);
    struct rt_event *copy = malloc(RT_TRACE * sizeof *copy);
    uint64_t since = 0, first, end, next[TASKS] = {0};
    unsigned char data[4096];
    (void)arg;
    for (unsigned round = 0; atomic_load(&left); round++) {
        int i = (int)(round % TASKS);
        struct rt_settings s = {.pid = -1, .crit = (int32_t)(round % 9), .priority = -1,
                                .kind = -1, .period_ns = -1, .deadline_ns = -1};
        rt_configure(table, i, &s);
        rt_kick(table);
        rt_snapshot(&table->slots[i], view);
        require(view->cycles <= (uint64_t)wanted, "counted right");
        rt_copy_trace(table, since, copy, &first, &end);
        require(first == since, "no record was lost");
        since = end;
        if (round % 50 == 0)
            rt_request(&table->slots[i], RT_ASK_COMMAND);
        int spare = rt_alloc(table, member, "spare", "spare");
        rt_free(table, spare);
        while (ring_ready(rings[i]) >= sizeof(struct ring_record)) {
            struct ring_record record;
            ring_look(rings[i], data, sizeof record + 8);
            memcpy(&record, data, sizeof record);
            require(record.cycle == next[i]++, "records in order");
            require(!memcmp(data + sizeof record, &record.cycle, 8), "records whole");
            ring_done(rings[i], record.size);
        }
        usleep(500);
    }
    free(view);
    free(copy);
    return NULL;
}

int main(int argc, char **argv)
{
    pthread_t threads[TASKS + 1];
    if (argc != 2)
        return 2;
    wanted = atoll(argv[1]);
    table = aligned_alloc(64, (sizeof *table + 63) / 64 * 64);
    memset(table, 0, sizeof *table);
    require(!rt_init(table, sched_getcpu()), "init");
    member = rt_join(table);
    require(member == 0, "join");
    struct rt_loop loop = {.table = table, .backend = RT_PARK};
    for (int i = 0; i < TASKS; i++) {
        struct rt_settings s = {.pid = -1, .crit = 5, .priority = i, .kind = -1,
                                .period_ns = 1000000 + 300000 * i, .deadline_ns = 0};
        require(rt_alloc(table, member, "rtpu", "task") == i, "alloc");
        rt_configure(table, i, &s);
        rings[i] = calloc(1, sizeof(struct ring));
        rings[i]->file = calloc(1, sizeof(struct ring_file) + 65536 + 64);
        ring_init(rings[i], 65536, 0);
    }
    require(!rt_start(&loop), "start");
    for (intptr_t i = 0; i < TASKS; i++)
        pthread_create(&threads[i], NULL, task_main, (void *)i);
    pthread_create(&threads[TASKS], NULL, busybody, NULL);
    for (int i = 0; i <= TASKS; i++)
        pthread_join(threads[i], NULL);
    rt_stop(&loop);
    for (int i = 0; i < TASKS; i++) {
        free(rings[i]->file);
        free(rings[i]);
    }
    free(table);
    return 0;
}
