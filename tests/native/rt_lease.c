/* A lone task releases itself under a lease, and every turn finds what it did.
 *
 * usage: rt_lease SEED ROUNDS; exits 0 when no release was lost or run twice, whatever came
 * between two steps of the task. Turns are taken at times of this program; `now` of the task
 * is the real clock, so periods are long and releases lie in the past or far ahead.
 */
#define _GNU_SOURCE
#include <sys/timerfd.h>

/* Every timer that the headers set is set here: in which order, and what comes between. */
static int set_timer(int fd, int flags, const struct itimerspec *to, struct itimerspec *old);
#define timerfd_settime set_timer
#include "slot.h"
#include "loop.h"
#undef timerfd_settime
#include "rt_rig.h"

enum { PERIOD = 20000000 };

static struct rt_table table;
static struct rt_task task = {.table = &table, .slot = &table.slots[0]};
static struct rt_state *state = &table.slots[0].state;
static int64_t grid;            /* the release that the first turn of a round grants */
static int timers[2], n_timers; /* the last ones that were set, and how many */
static void (*amid)(void);      /* what comes after the first of them */

static int set_timer(int fd, int flags, const struct itimerspec *to, struct itimerspec *old)
{
    int done = timerfd_settime(fd, flags, to, old);
    timers[n_timers++ & 1] = fd;
    if (n_timers == 1 && amid)
        amid();
    return done;
}

static int64_t no_cpu(const struct rt_slot *slot, int main)
{
    (void)slot, (void)main;
    return 1000;
}

static void turn(int64_t now)
{
    rt_turn(&table, now, 0, 0, no_cpu);
    rt_turn_end(&table);
    require(!atomic_load(&table.slots[0].grant.lease), "a turn calls the lease back");
}

/* A turn that grants the release `grid`, and lends those after it. */
static void begin(int64_t maxc, int tells)
{
    struct rt_settings s = {.pid = 1, .crit = 5, .priority = 0, .kind = -1,
                            .period_ns = PERIOD, .deadline_ns = 0, .drop = 3, .handler = -1,
                            .tells = tells, .minc_ns = -1, .maxc_ns = maxc, .hang_ns = -1};
    grid = rt_now() / PERIOD * PERIOD - PERIOD;
    rt_arm(&task);
    rt_configure(&table, 0, &s);
    turn(grid - PERIOD);
    turn(grid);
    require(state->granted && state->rel_ns == grid, "granted by a turn");
    require(rt_wait(&task, 0) == RT_RELEASED && rt_begin(&task), "begun");
    atomic_store(&task.slot->post.meets, atomic_load(&table.look_life));
    rt_lend(&table);
    require(atomic_load(&task.slot->grant.lease) != 0, "lent");
    require(table.sure_ns > grid + PERIOD, "the dispatcher sleeps longer");
}

/* End the cycle without a report, as if it had ended in time. */
static void done(void)
{
    atomic_store(&task.slot->post.done, task.seq);
}

/* Take the next release as if it were due `late` after that of the last cycle. */
static int take(int64_t late)
{
    int64_t until, shift = task.rel_ns + PERIOD - (rt_now() - late);
    int64_t lent = atomic_load(&task.slot->grant.lent_ns);
    atomic_store(&task.slot->grant.lent_ns, lent - shift);
    int took = rt_take(&table, task.slot, &task.seq, &until);
    atomic_store(&task.slot->grant.lent_ns, lent);
    if (!took)
        return 0;
    atomic_fetch_add(&task.slot->grant.rel_ns, shift);
    atomic_fetch_add(&task.slot->grant.dl_ns, shift);
    require(rt_begin(&task), "a release that was taken begins");
    return 1;
}

static void finish(void)
{
    done();
    rt_leave(&task, RT_OFF);
    turn(state->next_ns);
    require(!state->armed && !state->ready, "off");
}

/* Two releases are taken; a turn amid the second cycle, or after it, knows both. */
static void play(void)
{
    int ended = (int)pick(2);
    uint32_t seq;
    uint64_t releases = atomic_load(&table.releases), missed;
    begin(pick(2) ? PERIOD / 2 : 0, (int)pick(2));
    missed = state->missed;
    for (int k = 0; k < 2; k++) {
        done();
        require(take(0), "a release that is due is taken");
        require(task.rel_ns == grid + (k + 1) * PERIOD, "on the grid, none left out");
    }
    seq = task.seq;
    if (ended)
        done();
    turn(grid + 2 * PERIOD + 1000);
    require(state->seq == seq && state->rel_ns == grid + 2 * PERIOD, "the turn knows");
    require(state->ready == !ended && state->begun == !ended, "and whether it still runs");
    require(state->next_ns == grid + 3 * PERIOD, "the next release is the dispatcher's");
    require(state->missed == missed, "none was missed");
    require(atomic_load(&table.releases) == releases + 2, "both are counted");
    require(!rt_take(&table, task.slot, &seq, &grid), "nothing is taken without a lease");
    finish();
}

/* A turn that comes between the check of the lease and the taking of a release: the word
 * has changed. A leader that is killed after its commit leaves a lease that goes on. */
static void interrupt(void)
{
    begin(0, 0);
    done();
    struct rt_lent before = rt_lent(&task.slot->grant);
    turn(grid + 1000);
    require(!atomic_compare_exchange_strong(&task.slot->grant.lease, &before.lease,
                                            before.lease + 1), "the old lease is void");
    finish();
    begin(0, 0);
    done();
    require(take(0), "taken");
    struct rt_state s = *state;
    rt_latch_lease(&table, 0, &s);
    rt_commit(&table, 0, &s);   /* and here the leader dies */
    done();
    require(take(0), "the task does not notice");
    turn(grid + 2 * PERIOD + 1000);
    require(state->rel_ns == grid + 2 * PERIOD && state->seq == task.seq, "counted once");
    finish();
}

/* A leader is killed between two steps of a task that takes a release: its successor changes
 * neither the release nor its deadline. */
static void succeed(void)
{
    int64_t until, at = rt_now();
    begin(0, 0);
    done();
    atomic_store(&task.slot->grant.lent_ns, at);            /* due now */
    require(rt_take(&table, task.slot, &task.seq, &until), "taken");
    rt_recover(&table);
    require(rt_begin(&task) && task.rel_ns == at, "the release that it took");
    require(task.dl_ns == at + PERIOD, "with its deadline");
    turn(grid + PERIOD + 1000);
    finish();
}

/* A task that was interrupted since it looked for a grant takes no later release before
 * that; and none when it is OFF, though nobody has called its lease back. */
static void wait_its_turn(void)
{
    int64_t until;
    begin(0, 0);
    atomic_store(&task.slot->grant.lent_ns, rt_now());      /* due now */
    require(!rt_take(&table, task.slot, &task.seq, &until), "its grant comes first");
    done();
    atomic_fetch_and(&task.slot->post.word, ~UINT32_C(3));
    require(!rt_take(&table, task.slot, &task.seq, &until), "it is OFF");
    atomic_fetch_or(&task.slot->post.word, RT_ON);
    finish();
}

/* Leases that follow one another without a grant: the number of the grant follows, so it
 * is never 2^31 behind, which would be a grant. A damaged lease is called back, too. */
static void follow(void)
{
    begin(0, 0);
    done();
    require(take(0), "taken");
    turn(grid + PERIOD + 1000);
    rt_lend(&table);
    require(atomic_load(&task.slot->grant.seq) == task.seq, "the number follows");
    state->taken = 3;
    turn(grid + PERIOD + 2000);
    finish();
}

/* Who slept through a release, or worked through one, leaves it to the dispatcher. */
static void overrun(void)
{
    uint32_t mail;
    begin(0, 0);
    done();
    mail = atomic_load(&table.mailbox);
    require(!take(PERIOD) && atomic_load(&table.mailbox) != mail, "slept through: told");
    require(atomic_load(&table.looked_ns) != 0, "and since when");
    finish();
    begin(0, 0);                /* its deadline has passed: the real clock is past it */
    mail = atomic_load(&table.mailbox);
    rt_own_up(&table, task.slot, grid + PERIOD);
    require(atomic_load(&table.mailbox) != mail, "a late end is told before it counts");
    turn(grid + PERIOD + 1000);
    require(state->missed && state->begun && state->failures[RT_DEADLINE], "and is a miss");
    finish();
    begin(0, 0);                /* it has run past two releases: as two turns would count */
    uint64_t missed = state->missed, failed = state->failures[RT_DEADLINE];
    turn(grid + 2 * PERIOD + 1000);
    require(state->missed == missed + 2, "both are missed");
    require(state->failures[RT_DEADLINE] == failed + 2, "and both deadlines");
    finish();
}

/* Nobody who is not alone, or has something to be told, gets a lease. */
static void others(void)
{
    struct rt_settings s = {.pid = 2, .crit = 5, .priority = 0, .kind = -1,
                            .period_ns = PERIOD, .deadline_ns = -1, .drop = -1, .handler = -1,
                            .tells = -1, .minc_ns = -1, .maxc_ns = -1, .hang_ns = -1};
    struct rt_task other = {.table = &table, .slot = &table.slots[1]};
    begin(0, 0);
    rt_configure(&table, 1, &s);
    rt_arm(&other);
    turn(grid + 1000);
    rt_lend(&table);
    require(!atomic_load(&task.slot->grant.lease), "two are armed");
    rt_leave(&other, RT_OFF);
    turn(grid + 2000);
    atomic_store(&task.slot->post.meets, 7);
    rt_lend(&table);
    require(!atomic_load(&task.slot->grant.lease), "it has another leader's timer");
    finish();
}

static int64_t expires(int fd)
{
    struct itimerspec left;
    require(!timerfd_gettime(fd, &left), "a timer");
    return left.it_value.tv_sec * 1000000000 + left.it_value.tv_nsec;
}

/* A task with checks has ended its cycle, and has a lease for the release at `at`. */
static struct rt_look ended(int64_t at)
{
    begin(PERIOD / 2, 1);
    done();
    atomic_store(&task.slot->grant.lent_ns, at);
    atomic_store(&task.slot->grant.lent_end_ns, at + PERIOD);
    n_timers = 0;
    return (struct rt_look){.life = atomic_load(&table.look_life),
                            .fd = timerfd_create(CLOCK_MONOTONIC, 0)};
}

static void close_timers(struct rt_look *look)
{
    close(look->release_fd);
    close(look->fd);
    amid = NULL;
    finish();
}

/* The timer of the checks is moved to the next cycle's first check, after a timer of the
 * task's own for the release before that; so it is not the next event while it is moved. */
static void move_check(void)
{
    int64_t at = rt_now() + 1000 * (int64_t)PERIOD;     /* far from both */
    struct rt_look look = ended(at);
    rt_check_next(&table, task.slot, &look);
    require(atomic_load(&table.look_ns) == at + PERIOD / 2, "the next check");
    require(n_timers == 2 && timers[0] == look.release_fd && timers[1] == look.fd,
            "the release first");
    int64_t release = expires(look.release_fd), check = expires(look.fd);
    require(release && check > release, "behind the release");
    atomic_store(&task.slot->grant.lent_end_ns, at);    /* the dispatcher's from there */
    rt_check_next(&table, task.slot, &look);
    require(!expires(look.fd) && !atomic_load(&table.look_ns), "there is none to come");
    close_timers(&look);
}

static void turn_amid(void)
{
    turn(grid + 1000);
}

static void release_amid(void)
{
    turn(grid + PERIOD);
    rt_lend(&table);
    require(atomic_load(&task.slot->grant.lease) != 0, "lent again with its next cycle");
}

/* A turn comes between the two timers: it calls the lease back, and may lend anew. The check
 * may be another one then, so the dispatcher is woken to set it. */
static void turn_between(void)
{
    struct rt_look look = ended(rt_now() + 1000 * (int64_t)PERIOD);
    amid = pick(2) ? turn_amid : release_amid;
    uint32_t mail = atomic_load(&table.mailbox);
    rt_check_next(&table, task.slot, &look);
    require(n_timers == 2, "both were set");
    require(atomic_load(&table.mailbox) != mail, "the dispatcher looks again");
    close_timers(&look);
}

/* A task without room for another descriptor has its check as before. */
static void no_room(void)
{
    int64_t at = rt_now() + 1000 * (int64_t)PERIOD;
    struct rt_look look = ended(at);
    look.release_fd = -1;
    rt_check_next(&table, task.slot, &look);
    require(look.release_fd == -1 && expires(look.fd), "the check is set");
    require(atomic_load(&table.look_ns) == at + PERIOD / 2, "and is known");
    close_timers(&look);
}

int main(int argc, char **argv)
{
    if (argc != 3)
        return 2;
    seed = strtoull(argv[1], NULL, 10);
    require(!rt_init(&table, 0), "init");
    atomic_store(&table.look_life, 1);
    int member = rt_join(&table);
    require(rt_alloc(&table, member, "rtpu", "task") == 0, "alloc");
    require(rt_alloc(&table, member, "rtpu", "other") == 1, "alloc");
    for (int64_t round = atoll(argv[2]); round > 0; round--) {
        play();
        interrupt();
        succeed();
        wait_its_turn();
        follow();
        overrun();
        others();
        move_check();
        turn_between();
        no_room();
    }
    return 0;
}
