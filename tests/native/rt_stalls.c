/* The age of the last stall of a core, for a leader that is late and for one that begins. */
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>

#include "dispatch.h"
#include "view.h"

static struct rt_table *table;
static atomic_int begun, seen;

/* What a reader sees of a leader that has not taken its first turn. */
static inline void begin(struct rt_table *t)
{
    rt_recover(t);
    atomic_store(&begun, 1);
    atomic_store(&seen, !rt_stall_age(t));
}

#define rt_recover begin
#include "loop.h"

static void require(int good, const char *what)
{
    if (!good) {
        fprintf(stderr, "not so: %s\n", what);
        exit(1);
    }
}

static void ages(void)
{
    require(rt_stall_age(table) == -1, "there was none");
    atomic_store(&table->stall_end_ns, rt_now() + 1000000000);
    require(rt_stall_age(table) == 1, "it has ended, by whichever clock");
    atomic_store(&table->stall_end_ns, rt_now() - 5);
    require(rt_stall_age(table) >= 5, "it ended a while ago");
    atomic_store(&table->sure_ns, rt_now() - 2 * RT_STALL_NS);
    require(rt_stall_age(table) >= 5, "without a leader none is late");
    atomic_store(&table->leader_tid, 1);
    require(rt_stall_age(table) == 0, "the leader is late");
    atomic_store(&table->sure_ns, rt_now());
    require(rt_stall_age(table) >= 5, "its event was a moment ago");
    atomic_store(&table->leader_tid, 0);
    atomic_store(&table->stall_end_ns, 0);
}

int main(void)
{
    table = aligned_alloc(64, (sizeof *table + 63) / 64 * 64);
    memset(table, 0, sizeof *table);
    require(!rt_init(table, sched_getcpu()), "init");
    require(rt_join(table) == 0, "join");
    ages();
    struct rt_loop loop = {.table = table, .backend = RT_PARK};
    atomic_store(&table->sure_ns, 1);   /* of a leader that ended long ago */
    require(!rt_start(&loop), "start");
    while (!atomic_load(&begun))
        sched_yield();
    rt_stop(&loop);
    require(!atomic_load(&seen), "a leader that begins is not late");
    require(atomic_load(&table->stalls) == 0, "and nothing is counted");
    free(table);
    return 0;
}
