/* Random histories through the turn function, for the sanitizers to watch.
 *
 * usage: rt_turn SEED TURNS; exits 0 when every invariant held.
 */
#include "slot.h"
#include "call.h"
#include "dispatch.h"
#include "loop.h"
#include "failure.h"
#include "guard.h"
#include "ring.h"
#include "view.h"
#include "rt_rig.h"

static void play(struct rt_table *t, int i, int mode, int begun, int done)
{
    struct rt_part part = {.mode = mode, .begun = begun, .done = done, .locked = -1};
    rt_play(t, &t->slots[i], &part);
}

/* What a task does amid its cycle: uses CPU time, locks, answers, wishes, serves. */
static void live(struct rt_table *t, int i)
{
    struct rt_part part = {.mode = -1, .locked = (int)pick(3) - 1,
                           .event = pick(4) == 0, .now_ns = 1 + pick(1000000000),
                           .handled = pick(4) == 0, .cpu_ns = pick(3000000)};
    struct rt_task task = {.table = t, .slot = &t->slots[i]};
    rt_play(t, &t->slots[i], &part);
    if (pick(8) == 0)
        rt_wish(&task, (int)pick(65) - 1, pick(2) ? 0 : 1 + pick(2000000000));
}

static void disturb(struct rt_table *t, int i)
{
    struct rt_settings s = {.pid = -1, .crit = -1, .priority = -1, .kind = -1,
                            .period_ns = -1, .deadline_ns = -1, .minc_ns = -1,
                            .maxc_ns = -1, .hang_ns = -1, .drop = -1, .handler = -1, .tells = -1};
    struct rt_part part = {.mode = -1, .locked = -1};
    uint64_t after[RT_MASKS];
    struct rt_config *c = &t->slots[i].config;
    int lives = atomic_load(&t->slots[i].config.dead) != rt_life(t, i);
    if (!(rt_life(t, i) & 1)) {
        rt_alloc(t, -1, "rtpu", "task");
        return;
    }
    switch (pick(12)) {
    case 0:
        rt_free(t, i);
        break;
    case 1:
        rt_died(t, i);
        break;
    case 2:
        s.period_ns = 100000 + pick(5000000);
        s.crit = (int32_t)pick(64);
        s.priority = (int32_t)pick(65536);
        s.deadline_ns = pick(2) ? 0 : pick(3000000) + 1;
        s.maxc_ns = pick(2) ? 0 : pick(2000000);
        s.minc_ns = pick(2) ? 0 : pick(2000000);
        s.drop = (int32_t)pick(64);
        s.handler = pick(2) ? 0 : (int32_t)pick(64);
        s.tells = (int32_t)pick(2);
        if (rt_mode_of(&t->slots[i]) == RT_OFF && pick(4) == 0)
            s.kind = (int32_t)pick(5);
        rt_configure(t, i, &s);
        break;
    case 3:
        play(t, i, (int)pick(4), 0, 0);
        break;
    case 6:
        for (int k = 0; k < RT_MASKS; k++)
            after[k] = UINT64_C(1) << pick(64);
        rt_follow(t, i, (int)pick(2), after, 0);
        break;
    case 8:         /* a stale or early call engages nobody; who is dead is not there */
        memset(after, 0, sizeof after);
        rt_follow(t, i, RT_HANDOVER, after, rt_callers(7, 2));
        require(!rt_call(c, rt_life(t, i) + 2, 7, 0), "a call of another life");
        require(!rt_call(c, rt_life(t, i), 8, 0), "a call with another ticket");
        require(rt_call(c, rt_life(t, i), 7, 0) == lives, "the first call");
        require(!rt_call(c, rt_life(t, i), 7, 0), "the first call, repeated");
        require(!rt_all_have_called(c, 7), "one has not called");
        require(rt_one_has_called(c) == lives, "one has called");
        if (pick(2))
            require(rt_call(c, rt_life(t, i), 7, 1) == lives, "the last call");
        break;
    case 7:
        part.fell = 1;
        rt_play(t, &t->slots[i], &part);
        break;
    case 4:
    case 5:
        live(t, i);
        break;
    default:
        play(t, i, RT_ON, (int)pick(2), (int)pick(2));
    }
}

static void check(struct rt_table *t, int park)
{
    int running = 0, held = 0, last = RT_DISPATCHER_LEVEL;
    struct muf_item ready[RT_SLOTS];
    int n = 0;
    for (int i = 0; i < RT_SLOTS; i++) {
        struct rt_state *s = &t->slots[i].state;
        require(!s->granted || s->ready, "granted without a release");
        require(!s->parked || s->granted, "held without a grant");
        require(!s->ready || s->armed || s->engaged, "ready without being armed");
        require(!s->engaged || (s->word & 3) == RT_STANDS, "engaged and no standby");
        require(s->armed || (!s->check_ns && !s->next_ns), "watched though OFF");
        require(!rt_is_server(s) || s->left <= s->maxc, "no more than the capacity");
        require(s->n_pieces <= RT_PIECES, "pieces");
        if (!s->ready || ((s->word & 3) != RT_ON && !s->engaged))
            continue;
        ready[n++] = rt_item(s, i);
        running += s->granted && !s->parked;
        held += !s->granted || s->parked;
    }
    muf_sort(ready, n);
    for (int k = 0; k < n; k++) {
        int level = ready[k].level, in_background = ready[k].group == MUF_BACKGROUND;
        int low = in_background ? MUF_BACKGROUND_LOW : MUF_LOW;
        int high = in_background ? MUF_BACKGROUND_HIGH : MUF_HIGH;
        if (ready[k].group == MUF_HUNG) {
            require(!level, "what hangs has no level");
            continue;
        }
        require(level >= low && level <= high, "level range");
        require(level < last || (level == low && n > high - low + 1),
                "levels follow urgency");
        last = level;
    }
    require(!park || running <= 1, "one runs under park");
    require(park || held == 0, "all are told under fifo");
    require(atomic_load(&t->journal_valid) == 0, "the journal is closed");
}

/* A leader killed anywhere in rt_commit: the next one finds old or new, never a mix. */
static void kill_amid_commit(struct rt_table *t, int64_t now)
{
    int i = (int)pick(RT_SLOTS);
    struct rt_state old = t->slots[i].state, next = old;
    next.missed += 7;
    next.next_ns = now + 12345;
    size_t torn = pick(sizeof next);
    t->journal = next;
    t->journal_slot = (uint32_t)i;
    if (pick(2)) {
        atomic_store(&t->journal_valid, 1);
        memcpy(&t->slots[i].state, &next, torn);
        old = next;
    }
    rt_recover(t);
    require(!memcmp(&t->slots[i].state, &old, sizeof old), "recovered whole");
    t->slots[i].state.next_ns = 0;
    rt_disarm(&t->slots[i].state);
    atomic_store(&t->slots[i].post.word, 0);
    t->slots[i].state.word = 0;
}

int main(int argc, char **argv)
{
    if (argc != 3)
        return 2;
    seed = strtoull(argv[1], NULL, 10);
    struct rt_table *t = aligned_alloc(64, (sizeof *t + 63) / 64 * 64);
    struct rt_view *view = malloc(sizeof *view);
    struct rt_event *copy = malloc(RT_TRACE * sizeof *copy);
    memset(t, 0, sizeof *t);
    require(!rt_init(t, 1), "init");
    int64_t now = 1000000000 + pick(1000000), due = 0;
    for (int turn = atoi(argv[2]); turn > 0; turn--) {
        int park = pick(2) != 0;
        if (park)
            for (int i = 0; i < RT_SLOTS; i++)  /* a change of back end starts clean */
                play(t, i, RT_OFF, 0, 0);
        for (int k = 0; k < 30; k++) {
            for (int n = (int)pick(40); n > 0; n--)
                disturb(t, (int)pick(RT_SLOTS));
            now = due > now && pick(3) ? due : now + pick(4000000);
            due = rt_turn(t, now, park, k == 0, rt_posted_cpu);
            require(t->trace_next - atomic_load(&t->trace_end) <= RT_TURN_MAX, "bound");
            rt_turn_end(t);
            require(!due || due > now, "the next event lies ahead");
            check(t, park);
        }
        if (pick(4) == 0)
            kill_amid_commit(t, now);
        rt_snapshot(&t->slots[pick(RT_SLOTS)], view);
        uint64_t first, end;
        rt_copy_trace(t, pick(1000), copy, &first, &end);
        for (int i = 0; i < RT_SLOTS; i++)
            play(t, i, RT_OFF, 0, 0);
        rt_turn(t, now, park, 0, rt_posted_cpu);
        rt_turn_end(t);
    }
    free(copy);
    free(view);
    free(t);
    return 0;
}
