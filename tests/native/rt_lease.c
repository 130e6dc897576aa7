/* Tasks of one core release themselves under a lease, and every turn finds what they did.
 *
 * usage: rt_lease SEED ROUNDS; exits 0 when no release was lost or run twice, no two cycles
 * were under way that no turn had ranked, and the dispatcher's timer stood early enough,
 * whatever came between two steps: a turn, other releases, the end of the leader amid its
 * turn. Time, timers and the core are this program's own; a step is an access that orders
 * others (sequentially consistent).
 */
#define _GNU_SOURCE
#include <pthread.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <sys/syscall.h>
#include <sys/timerfd.h>
#include <time.h>
#include <unistd.h>

static void step(void);
static int set_timer(int fd, int flags, const struct itimerspec *to, struct itimerspec *old);
static int read_clock(clockid_t clock, struct timespec *to);
static long call_kernel(long number, ...);
#undef atomic_load
#undef atomic_store
#undef atomic_fetch_add
#undef atomic_fetch_and
#undef atomic_compare_exchange_strong
#define atomic_load(at) (step(), atomic_load_explicit(at, memory_order_seq_cst))
#define atomic_store(at, to) (step(), atomic_store_explicit(at, to, memory_order_seq_cst))
#define atomic_fetch_add(at, n) \
    (step(), atomic_fetch_add_explicit(at, n, memory_order_seq_cst))
#define atomic_fetch_and(at, n) \
    (step(), atomic_fetch_and_explicit(at, n, memory_order_seq_cst))
#define atomic_compare_exchange_strong(at, old, to)                                   \
    (step(), atomic_compare_exchange_strong_explicit(at, old, to, memory_order_seq_cst, \
                                                     memory_order_seq_cst))
#define timerfd_settime set_timer
#define timerfd_create(clock, flags) OWN_TIMER
#define clock_gettime read_clock
#define syscall call_kernel
#define close(fd) ((void)(fd))
enum { TASKS = 3, CHECKS = 9, OWN_TIMER = 10, FDS = 11, US = 1000 };
#include "slot.h"
#include "loop.h"
#undef close
#undef syscall
#include "rt_rig.h"

static struct rt_table table;
static struct rt_looker looker = {.table = &table, .running = 1, .fd = CHECKS};
static struct rt_task tasks[TASKS];
static int64_t now, timers[FDS];
static int order[2], n_timers;          /* which timers were set last, and how many */
static int64_t firsts[TASKS], lasts[TASKS], runs[TASKS], taken;
static int runs_now[TASKS], leads, amid_turn, has_kicked;
static int blocks;                      /* whether others run amid a turn */
static uint32_t slept_bell;             /* the bell of the first task as it fell asleep ... */
static int64_t slept_until;             /* ... and until when; 0: until it is woken */
static int woken;                       /* it has been woken since */
static int64_t steps_left = -1;         /* until something happens; -1: nothing will */
static void (*happens)(void);
static jmp_buf killed;

static void die(void);

/* Between two turns anything may come, but a turn is one step of the core, unless its leader
 * is killed or blocked. */
static void step(void)
{
    if (steps_left >= 0 && (!amid_turn || blocks || happens == die) && !steps_left--)
        happens();
}

static int read_clock(clockid_t clock, struct timespec *to)
{
    *to = rt_timespec(clock == CLOCK_MONOTONIC ? now : 1000);
    return 0;
}

static int64_t nanoseconds(const struct timespec *at)
{
    return at->tv_sec * INT64_C(1000000000) + at->tv_nsec;
}

static int set_timer(int fd, int flags, const struct itimerspec *to, struct itimerspec *old)
{
    (void)flags, (void)old;
    order[n_timers++ & 1] = fd;
    timers[fd] = nanoseconds(&to->it_value);
    return 0;
}

static int64_t no_cpu(const struct rt_slot *slot, int main)
{
    (void)slot, (void)main;
    return 1000;
}

/* A turn with all that the dispatcher's thread does about leases and timers. */
static void turn(int lead)
{
    amid_turn = 1;
    int64_t due = rt_turn(&table, now, 0, lead, no_cpu);
    rt_turn_end(&table);
    due = rt_lend(&table, due);
    rt_sleep(&looker, 0, due);
    amid_turn = 0;
}

/* The dispatcher is above all tasks of its core: a turn comes where it is woken. */
static long call_kernel(long number, ...)
{
    va_list rest;
    if (number != SYS_futex)
        return CHECKS;          /* the leader's timer */
    va_start(rest, number);
    void *at = va_arg(rest, void *);
    int op = va_arg(rest, int);
    uint32_t value = va_arg(rest, uint32_t);
    const struct timespec *until = va_arg(rest, const struct timespec *);
    va_end(rest);
    if (at == &table.mailbox && op == FUTEX_WAKE) {
        has_kicked = 1;
        if (leads && !amid_turn)
            turn(0);
    }
    if (at == &tasks[0].slot->grant.bell && op == FUTEX_WAKE)
        woken = *(_Atomic uint32_t *)at != slept_bell;
    if (at == &tasks[0].slot->grant.bell && op == FUTEX_WAIT_BITSET) {
        slept_bell = value;
        slept_until = until ? nanoseconds(until) : 0;
        woken = 0;
    }
    errno = EINTR;
    if (op == FUTEX_WAIT_BITSET && *(_Atomic uint32_t *)at != value)
        errno = EAGAIN;
    else if (op == FUTEX_WAIT_BITSET && until && nanoseconds(until) <= now)
        errno = ETIMEDOUT;
    return -1;
}

/* A dispatcher that was killed amid its turn is followed by another one. */
static void succeed(void)
{
    amid_turn = 0;
    leads = 1;
    rt_recover(&table);
    timers[CHECKS] = 0;
    atomic_store(&table.look_ns, 0);
    atomic_fetch_add(&table.look_life, 1);
    turn(1);
}

/* It is killed while it sleeps, or another one follows. */
static void change_leader(void)
{
    if (leads)
        leads = 0;
    else
        succeed();
}

static void die(void)
{
    longjmp(killed, 1);
}

static void kill_amid_turn(void)
{
    if (!setjmp(killed)) {
        happens = die;
        steps_left = pick(2) ? pick(12) : pick(400);
        turn(0);
        steps_left = -1;
        return;
    }
    amid_turn = leads = 0;
    if (pick(2))
        succeed();
}

/* Wake the dispatcher, as far as a timer of its has run out. */
static void expire(void)
{
    int runs_out = timers[CHECKS] && timers[CHECKS] <= now;
    if (runs_out)
        timers[CHECKS] = 0;
    if (leads && !amid_turn && (runs_out || atomic_load(&table.sure_ns) <= now))
        turn(0);
}

/* While a cycle is under way, the timer stands at the first instant at which another release
 * comes, unless the dispatcher's own sleep ends before. */
static void check_timer(int i)
{
    int64_t first = atomic_load(&table.lent_end_ns);
    if (!rt_is_lent(&table) || !leads)
        return;
    for (int k = 0; k < TASKS; k++) {
        int64_t next = atomic_load(&table.next_ns[k]);
        if (k != i && next && next < first)
            first = next;
    }
    int64_t check = tasks[i].rel_ns + atomic_load(&tasks[i].slot->grant.lent_check_ns);
    if (check > tasks[i].rel_ns && check < first)
        first = check;
    require(first >= atomic_load(&table.lent_end_ns) || (timers[CHECKS] && timers[CHECKS] <= first),
            "the check stands early enough");
}

/* Whether the task has released itself, and no turn has read that and lent again. */
static int is_own(const struct rt_task *task)
{
    return task->seq != atomic_load(&task->slot->grant.seq);
}

static void wake(int i)
{
    struct rt_task *task = &tasks[i];
    if (runs_now[i] || rt_wait(task, 1) != RT_RELEASED)
        return;
    int self = is_own(task);
    for (int k = 0; k < TASKS; k++)
        require(!self || k == i || !runs_now[k], "no cycle beside one that no turn has ranked");
    runs_now[i] = 1;            /* from here on others may come */
    require(rt_begin(task), "begun");
    require(task->rel_ns > lasts[i], "no release is run twice");
    require(task->rel_ns <= now, "nor too early");
    require(task->rel_ns % table.slots[i].state.period == 0, "on the grid");
    lasts[i] = task->rel_ns;
    firsts[i] = firsts[i] ? firsts[i] : task->rel_ns;
    runs[i]++;
    taken += self;
    steps_left = -1;            /* what is checked stands still */
    if (is_own(task))           /* and no turn has come since */
        check_timer(i);
}

static void finish(int i)
{
    rt_end(&tasks[i]);
    runs_now[i] = 0;
}

/* The one of the tasks above `level` that the core would run; -1: none. */
static int top(int level)
{
    int found = -1;
    for (int i = 0; i < TASKS; i++)
        if (table.slots[i].state.level > level) {
            int64_t next = atomic_load(&table.next_ns[i]);
            const struct rt_slot *slot = tasks[i].slot;
            int granted = (int32_t)(atomic_load(&slot->grant.seq) -
                                    atomic_load(&slot->post.done)) > 0;
            if (runs_now[i] || granted || (next && next <= now)) {
                found = i;
                level = table.slots[i].state.level;
            }
        }
    return found;
}

/* Time passes, and what is more urgent than the task that was interrupted runs. */
static int under;
static void preempt(void)
{
    now += pick(4) ? pick(400) * US : pick(4000) * US;
    expire();
    for (int n = 0, i; n < TASKS; n++) {
        i = top(table.slots[under].state.level);
        if (i < 0 || i == under || runs_now[i])
            return;
        wake(i);
        if (runs_now[i])
            finish(i);
    }
}

static void kick(void)
{
    rt_kick(&table);
}

/* Do one thing of a task, and another thing after any of its steps. */
static void disturbed(void (*thing)(int), int i)
{
    static void (*const all[])(void) = {kick, preempt, kill_amid_turn};
    if (pick(2)) {
        happens = all[pick(leads ? 3 : 2)];
        steps_left = pick(60);
        under = i;
    }
    thing(i);
    steps_left = -1;
}

/* Whatever the core does next. */
static void go_on(void)
{
    int64_t next = leads ? atomic_load(&table.sure_ns) : RT_NEVER;
    int i = top(0);
    if (i >= 0) {
        int64_t next_here = atomic_load(&table.next_ns[i]);
        int ran = runs_now[i];
        if (ran) {
            now += pick(8) ? pick(50) * US : pick(2500) * US;
            expire();
            if (top(0) == i)
                disturbed(finish, i);
            return;
        }
        disturbed(wake, i);
        if (runs_now[i] || next_here > now || atomic_load(&table.next_ns[i]) != next_here)
            return;             /* otherwise it waits for the dispatcher */
    }
    if (leads && timers[CHECKS] && timers[CHECKS] < next)
        next = timers[CHECKS];
    for (int k = 0; k < TASKS; k++) {
        int64_t own = atomic_load(&table.next_ns[k]);
        if (own > now && own < next)
            next = own;
    }
    if (next == RT_NEVER)
        next = now + 100 * US;
    if (next > now)
        now = next;
    expire();
}

static void configure(int i, int64_t period, int64_t maxc, int tells)
{
    struct rt_settings s = {.pid = i + 1, .crit = 5, .priority = 0, .kind = -1,
                            .period_ns = period, .deadline_ns = 0, .drop = 5, .handler = -1,
                            .tells = tells, .minc_ns = 0, .maxc_ns = maxc, .hang_ns = -1};
    rt_configure(&table, i, &s);
}

/* Tasks with periods of their own, until all are off again. */
static void play(void)
{
    static const int64_t periods[] = {1000 * US, 1370 * US, 2000 * US, 2110 * US, 7000 * US};
    int64_t missed[TASKS];
    int n = 1 + (int)pick(TASKS);
    for (int i = 0; i < n; i++) {
        configure(i, periods[pick(5)], pick(3) ? 0 : 400 * US, (int)pick(2));
        firsts[i] = lasts[i] = runs[i] = 0;
        missed[i] = (int64_t)table.slots[i].state.missed;
        rt_arm(&tasks[i]);
    }
    for (int k = 0; k < 300; k++) {
        if (leads ? !pick(80) : !pick(10))
            change_leader();
        go_on();
    }
    if (!leads)
        succeed();
    for (int i = 0; i < n; i++)
        if (runs_now[i])
            finish(i);
    for (int i = 0; i < n; i++) {
        const struct rt_state *s = &table.slots[i].state;
        turn(0);
        if (s->ready)           /* granted, and not begun */
            wake(i), finish(i);
    }
    turn(0);
    for (int i = 0; i < n; i++) {
        const struct rt_state *s = &table.slots[i].state;
        require(!s->ready, "none is under way");
        int64_t all = firsts[i] ? (s->next_ns - firsts[i]) / s->period : 0;
        int64_t before = (int64_t)s->missed - missed[i] + runs[i] - all;
        require(before >= 0 && (before == 0 || !firsts[i] || before < 40), "none was lost");
        rt_leave(&tasks[i], RT_OFF);
    }
}

/* One task, whose cycle is under way in a lease. */
static void begin(int64_t period, int64_t maxc)
{
    configure(0, period, maxc, maxc != 0);
    rt_meet_dispatcher(&tasks[0]);
    rt_arm(&tasks[0]);
    now = table.slots[0].state.next_ns;
    turn(0);
    wake(0);
    require(runs_now[0] && rt_is_lent(&table), "lent with its cycle");
    require(table.sure_ns > now + period, "the dispatcher sleeps longer");
    has_kicked = 0;
}

static void rest(void)
{
    if (runs_now[0])
        finish(0);
    rt_leave(&tasks[0], RT_OFF);
    require(!table.slots[0].state.armed && !rt_is_lent(&table), "off");
}

/* Who slept through a release, or worked through one, leaves it to the dispatcher. */
static void overrun(void)
{
    enum { PERIOD = 2000 * US };
    const struct rt_state *s = &table.slots[0].state;
    begin(PERIOD, 0);
    finish(0);
    uint64_t missed = s->missed, failed;
    now += 2 * PERIOD + PERIOD / 2;
    wake(0);
    require(has_kicked && runs_now[0] && s->missed == missed + 1, "slept through one");
    rest();
    begin(PERIOD, 0);
    missed = s->missed, failed = s->failures[RT_DEADLINE];
    now += 2 * PERIOD + PERIOD / 2;
    finish(0);
    require(has_kicked, "a late end is known before it counts");
    require(s->missed == missed + 2 && s->failures[RT_DEADLINE] == failed + 2, "two misses");
    rest();
}

/* A turn amid a cycle that the task has released itself knows it, and when it was released. */
static void amid(void)
{
    const struct rt_state *s = &table.slots[0].state;
    begin(2000 * US, 1000 * US);
    finish(0);
    now = atomic_load(&table.next_ns[0]);
    wake(0);
    int64_t release = now;
    require(runs_now[0] && s->seq != tasks[0].seq, "taken");
    now += 100 * US;
    uint64_t releases = atomic_load(&table.releases);
    kick();
    require(s->seq == tasks[0].seq && s->begun && s->rel_ns == release, "the turn knows");
    require(atomic_load(&table.releases) == releases + 1, "and has counted it");
    rest();
}

/* A task that is OFF takes nothing, though no turn has called its lease back. */
static void off(void)
{
    begin(2000 * US, 0);
    finish(0);
    now = atomic_load(&table.next_ns[0]);
    atomic_fetch_and(&tasks[0].slot->post.word, ~UINT32_C(3));
    wake(0);
    require(!runs_now[0], "it is OFF");
    atomic_store(&tasks[0].slot->post.word, atomic_load(&tasks[0].slot->post.word) | RT_ON);
    rest();
}

/* The timer of the checks is moved to the next cycle's first check, after a timer of the
 * task's own for the release before that; so it is not the next event while it is moved.
 * Without checks it is stopped, and not set again. */
static void move_check(void)
{
    begin(2000 * US, 1000 * US);
    int64_t release = atomic_load(&table.next_ns[0]);
    n_timers = 0;
    finish(0);
    require(n_timers == 2 && order[0] == OWN_TIMER && order[1] == CHECKS, "the release first");
    require(timers[OWN_TIMER] == release && timers[CHECKS] == release + 1000 * US, "when");
    rest();
    begin(2000 * US, 0);
    finish(0);
    require(!timers[CHECKS], "no check");
    now = atomic_load(&table.next_ns[0]);
    wake(0);
    n_timers = 0;
    finish(0);
    require(!n_timers, "none is set");
    rest();
}

/* Whether the cycle of the first task is under way in a lease and the second one's release
 * comes next. */
static int is_met(void)
{
    int64_t next = atomic_load(&table.next_ns[1]);
    return runs_now[0] && rt_is_lent(&table) && next < atomic_load(&table.next_ns[0]) &&
           next < atomic_load(&table.lent_end_ns);
}

/* Two releases come nearly at once: the second one is left to the dispatcher. A release that comes
 * amid another task's cycle has to wait for the turn, which ranks both. */
static void meet(void)
{
    const struct rt_state *one = &table.slots[0].state, *two = &table.slots[1].state;
    const int64_t periods[] = {2000 * US, 3010 * US};
    for (int i = 0; i < 2; i++) {
        configure(i, periods[i], 0, 0);
        rt_meet_dispatcher(&tasks[i]);
        rt_arm(&tasks[i]);
    }
    for (int n = 0; !is_met(); n++) {
        require(n < 1000, "they meet");
        for (int i = 0; i < 2; i++)
            if (runs_now[i])
                finish(i);
        int64_t first = atomic_load(&table.next_ns[0]), other = atomic_load(&table.next_ns[1]);
        int near = first - other < RT_APART_NS && other - first < RT_APART_NS;
        now = first < other ? first : other;
        int64_t second = first < other ? other : first;
        require(!near || !rt_is_lent(&table) || atomic_load(&table.lent_end_ns) <= second,
                "nearly at once");
        expire();
        for (int i = 0; i < 2; i++)
            if (two->ready || i == (other < first))
                wake(i);
    }
    now = atomic_load(&table.next_ns[1]);
    has_kicked = 0;
    wake(1);
    require(has_kicked && runs_now[1] && one->ready && two->ready, "by a turn");
    require((one->level > two->level) == (one->dl_ns < two->dl_ns), "which has ranked them");
    require(!rt_is_lent(&table), "two are ready");
    finish(1);
    rt_leave(&tasks[1], RT_OFF);
    rest();
}

/* A turn lends before the task's release, and the task goes on when that has come. */
static void lend_before(void)
{
    turn(0);
    now = atomic_load(&table.next_ns[0]) + 10 * US;
}

/* A task that has seen no lease, or an older one, and finds its release due after that is not
 * left asleep, wherever the new lease came between its steps. */
static void lent_meanwhile(void)
{
    int before = 0;
    for (int64_t steps = 0; steps < 20; steps++) {
        begin(2000 * US, 0);
        finish(0);
        now += 500 * US;
        if (steps & 1)
            rt_recall(&table);
        happens = lend_before;
        steps_left = steps / 2;
        wake(0);
        require(runs_now[0] || steps_left >= 0, "it takes its release");
        before += runs_now[0];
        steps_left = -1;
        rest();
    }
    require(before > 5, "between its steps");
}

static void end_now(void)
{
    finish(0);
}

/* A cycle that ends while the dispatcher lends does not stay in the word. */
static void end_amid_lend(void)
{
    for (int64_t steps = 0; steps < 40; steps++) {
        begin(2000 * US, 0);
        int64_t due = rt_turn(&table, now, 0, 0, no_cpu);
        rt_turn_end(&table);
        happens = end_now;
        steps_left = steps;
        rt_lend(&table, due);
        int has_ended = !runs_now[0];
        steps_left = -1;
        uint64_t lease = atomic_load(&table.lease);
        require(!has_ended || !rt_is_open(lease) || !rt_under_way(lease), "taken out");
        rest();
    }
}

/* A release that comes while the dispatcher is about to lend is seen by the one or the other. */
static void lend_late(void)
{
    begin(2000 * US, 0);
    finish(0);
    int64_t due = rt_turn(&table, now, 0, 0, no_cpu);
    rt_turn_end(&table);
    now = atomic_load(&table.next_ns[0]);
    wake(0);
    require(!runs_now[0], "it sees no lease, and sleeps");
    due = rt_lend(&table, due);
    require(rt_is_lent(&table) && due <= now, "the dispatcher takes another turn");
    rest();
}

/* A turn has granted a release, and no lease has followed yet; returns the next event. */
static int64_t grant_before_lend(void)
{
    begin(2000 * US, 0);
    finish(0);
    rt_recall(&table);
    now = atomic_load(&table.next_ns[0]);
    int64_t due = rt_turn(&table, now, 0, 0, no_cpu);
    rt_turn_end(&table);
    wake(0);
    require(runs_now[0], "granted");
    return due;
}

/* A task that ends its cycle before the dispatcher says when the next one is sleeps until it
 * is woken. So there is no lease, and the task is woken to read it: the next turn lends. */
static void end_before_lend(void)
{
    int64_t due = grant_before_lend();
    finish(0);
    wake(0);
    require(!runs_now[0] && !slept_until, "it sleeps");
    require(rt_lend(&table, due) == due && !rt_is_lent(&table), "its next release is a turn's");
    require(woken, "it reads when that is");
    kick();
    require(rt_is_lent(&table), "or its own, after another turn");
    rest();
}

static void publish_now(void)
{
    rt_publish_next(&table);
}

/* The dispatcher says when the next release is, wherever the task is as it ends its cycle and
 * falls asleep: the task sleeps until then, or is woken, or its release is a turn's. */
static void publish_amid_end(void)
{
    int slept = 0;
    for (int64_t steps = 0; steps < 20; steps++) {
        int64_t due = grant_before_lend();
        happens = publish_now;
        steps_left = steps;
        finish(0);
        wake(0);
        slept += steps_left < 0;
        steps_left = -1;
        rt_lend(&table, due);
        kick();
        require(rt_is_lent(&table), "its next release is its own");
        require(woken || slept_until == atomic_load(&table.next_ns[0]), "it knows when");
        rest();
    }
    require(slept > 5, "between its steps");
}

/* The release comes while the dispatcher is blocked, and then its MINC fits no more. */
static void come_and_pass(void)
{
    now = atomic_load(&table.next_ns[0]);
    wake(0);
    now += 600 * US;
}

/* A task whose release comes amid a turn, wherever that is blocked, does not sleep through the
 * next one: also not if the release is given up before it is granted, and a lease follows. */
static void blocked_turn(void)
{
    static const struct rt_settings minc = {
        .pid = -1, .crit = -1, .priority = -1, .kind = -1, .drop = -1, .handler = -1,
        .tells = -1, .period_ns = -1, .deadline_ns = -1, .minc_ns = 1500 * US,
        .maxc_ns = -1, .hang_ns = -1};
    int given_up = 0;
    for (int64_t steps = 0; steps < 100; steps++) {
        const struct rt_state *s = &table.slots[0].state;
        begin(2000 * US, 0);
        rt_configure(&table, 0, &minc);
        finish(0);
        now += 100 * US;
        kick();
        uint64_t missed = s->missed;
        happens = come_and_pass;
        steps_left = steps;
        amid_turn = blocks = 1;
        int64_t due = rt_turn(&table, now, 0, 0, no_cpu);
        rt_turn_end(&table);
        due = rt_lend(&table, due);
        amid_turn = blocks = 0;
        int has_come = steps_left < 0, ran = runs_now[0];
        steps_left = -1;
        if (due <= now)
            turn(0);
        int gone = !ran && s->missed > missed;
        given_up += gone && rt_is_lent(&table);
        require(!gone || woken || slept_until == atomic_load(&table.next_ns[0]),
                "it wakes up at its next release");
        require(has_come || !gone, "given up for that");
        configure(0, 2000 * US, 0, 0);
        rest();
    }
    require(given_up > 5, "given up, and lent after that");
}

/* No lease is much longer than 50 ms, however far away the next release is. */
static void slow(void)
{
    begin(INT64_C(10000000) * US, 0);
    require(table.sure_ns == atomic_load(&table.next_ns[0]) + RT_LEND_NS, "after a while");
    rest();
}

/* With a new period the task comes back to the grid by a turn, not by its lease. */
static void other_period(void)
{
    const struct rt_state *s = &table.slots[0].state;
    begin(3000 * US, 0);
    finish(0);
    if (atomic_load(&table.next_ns[0]) % (2000 * US) == 0) {
        now = atomic_load(&table.next_ns[0]);
        wake(0);
        finish(0);
    }
    configure(0, 2000 * US, 0, 0);
    kick();
    require(s->next_ns % s->period != 0 && !rt_is_lent(&table), "off the grid");
    now = s->next_ns;
    expire();
    require(s->ready && s->next_ns % s->period == 0, "the dispatcher's; the next is on it");
    rest();
}

/* Another task has the slot of one that has had very many grants: it has taken none. */
static void other_life(void)
{
    begin(2000 * US, 0);
    finish(0);
    kick();
    table.slots[0].state.seq = UINT32_C(1) << 31 | 5;
    atomic_store(&tasks[0].slot->post.done, 0);
    atomic_store(&tasks[0].slot->grant.seq, 0);
    atomic_fetch_add(&tasks[0].slot->config.life, 2);
    uint64_t releases = atomic_load(&table.releases);
    kick();
    require(atomic_load(&table.releases) == releases, "it has taken none");
    rest();
}

int main(int argc, char **argv)
{
    if (argc != 3)
        return 2;
    seed = strtoull(argv[1], NULL, 10);
    now = INT64_C(1000000000);
    require(!rt_init(&table, 0), "init");
    int member = rt_join(&table);
    for (int i = 0; i < TASKS; i++) {
        require(rt_alloc(&table, member, "rtpu", "task") == i, "alloc");
        tasks[i] = (struct rt_task){.table = &table, .slot = &table.slots[i]};
    }
    succeed();
    for (int i = 0; i < TASKS; i++)
        rt_meet_dispatcher(&tasks[i]);
    for (int64_t round = atoll(argv[2]); round > 0; round--) {
        play();
        overrun();
        amid();
        off();
        move_check();
        meet();
        lent_meanwhile();
        end_amid_lend();
        lend_late();
        end_before_lend();
        publish_amid_end();
        blocked_turn();
        slow();
        other_period();
        other_life();
    }
    require(taken > 20 * atoll(argv[2]), "they took releases themselves");
    return 0;
}
