/* The core table's file: creating, opening and leaving it; slots and their configuration.
 *
 * The file exists as long as an RTPU process is attached. Attaching and leaving happen
 * under flock, which the kernel releases when its holder ends. A member is a process id
 * together with its start time, so that a killed member is recognized: a table whose
 * members are all gone is stale; its file is unlinked and a new one made. Tasks that still
 * have the old one mapped do not interfere.
 */
#ifndef PBONET_TABLE_H
#define PBONET_TABLE_H

#include "layout.h"
#include "sys.h"

#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>

/* Results of rt_attach besides errno values. */
enum { RT_NO_TABLE = -1, RT_FOREIGN = -2, RT_BAD_VERSION = -3, RT_DAMAGED = -4,
       RT_MEMBERS_FULL = -5 };

struct rt_map {
    struct rt_table *table;
    int fd, member;             /* member: index, -1 for one that only uses the table */
    pid_t pid;
};

#define RT_UNKNOWN UINT64_MAX

/* When a process started, in clock ticks since boot; 0 when it is gone or a zombie,
 * RT_UNKNOWN when that cannot be read now. */
static inline uint64_t rt_start_time(pid_t pid)
{
    char path[32], text[512], *at;
    snprintf(path, sizeof path, "/proc/%d/stat", (int)pid);
    int fd = open(path, O_RDONLY | O_CLOEXEC);
    ssize_t n = fd < 0 ? -1 : read(fd, text, sizeof text - 1);
    if (fd >= 0)
        close(fd);
    if (n <= 0)
        return !kill(pid, 0) || errno != ESRCH ? RT_UNKNOWN : 0;
    text[n] = 0;
    at = strrchr(text, ')');    /* the name may hold anything */
    if (!at || at[1] != ' ' || at[2] == 'Z' || at[2] == 'X')
        return 0;
    for (int field = 2; field < 22 && at; field++)
        at = strchr(at + 1, ' ');
    return at ? strtoull(at, NULL, 10) : 0;
}

static inline int rt_member_lives(const struct rt_member *m)
{
    int32_t pid = atomic_load(&m->pid);
    uint64_t now = pid ? rt_start_time(pid) : 0;
    return now && (now == m->start || now == RT_UNKNOWN || m->start == RT_UNKNOWN);
}

/* The current time of the table's tasks. */
static inline int64_t rt_time(const struct rt_table *t)
{
    int64_t at = atomic_load_explicit(&t->virtual_ns, memory_order_relaxed);
    return at ? at : rt_now();
}

static inline int rt_is_virtual(const struct rt_table *t)
{
    return atomic_load_explicit(&t->virtual_ns, memory_order_relaxed) != 0;
}

static inline void rt_kick(struct rt_table *t)
{
    atomic_fetch_add(&t->mailbox, 1);
    rt_futex_wake(&t->mailbox);
}

/* Wake the task of a slot, after a change of what it reads. */
static inline void rt_ring(struct rt_slot *slot)
{
    atomic_fetch_add(&slot->grant.bell, 1);
    rt_futex_wake(&slot->grant.bell);
}

/* Ask the leader to set the levels of all tasks again: another program changed one. */
static inline void rt_relevel(struct rt_table *t)
{
    atomic_store(&t->relevel, 1);
    rt_kick(t);
}

static inline int rt_init_mutex(pthread_mutex_t *mutex)
{
    pthread_mutexattr_t attr;
    pthread_mutexattr_init(&attr);
    pthread_mutexattr_setpshared(&attr, PTHREAD_PROCESS_SHARED);
    pthread_mutexattr_setrobust(&attr, PTHREAD_MUTEX_ROBUST);
    int error = pthread_mutex_init(mutex, &attr);
    pthread_mutexattr_destroy(&attr);
    return error;
}

/* What the edit lock protects is valid at every step, so a dead holder does no harm. */
static inline void rt_edit_lock(struct rt_table *t)
{
    if (pthread_mutex_lock(&t->edit) == EOWNERDEAD)
        pthread_mutex_consistent(&t->edit);
}

static inline int rt_any_member(const struct rt_table *t)
{
    for (int i = 0; i < RT_MEMBERS; i++)
        if (rt_member_lives(&t->members[i]))
            return 1;
    return 0;
}

/* Whether any slot still refers to the member. */
static inline int rt_member_used(const struct rt_table *t, int member)
{
    for (int i = 0; i < RT_SLOTS; i++)
        if ((atomic_load(&t->slots[i].config.life) & 1) &&
            atomic_load(&t->slots[i].config.member) == member)
            return 1;
    return 0;
}

static inline void rt_free(struct rt_table *t, int i)
{
    struct rt_config *c = &t->slots[i].config;
    uint32_t life = atomic_load(&c->life);
    if (life & 1)
        atomic_compare_exchange_strong(&c->life, &life, life + 1);
}

/* Free the slots whose RTPU process and task are both gone; under the edit lock. Returns
 * how many. */
static inline int rt_reap(struct rt_table *t)
{
    int freed = 0;
    for (int i = 0; i < RT_SLOTS; i++) {
        struct rt_config *c = &t->slots[i].config;
        if (!(atomic_load(&c->life) & 1))
            continue;
        int member = atomic_load(&c->member);
        if (member >= 0 && member < RT_MEMBERS && rt_member_lives(&t->members[member]))
            continue;
        int32_t pid = atomic_load(&c->pid);
        if (!pid || rt_start_time(pid) == 0) {
            rt_free(t, i);
            freed++;
        }
    }
    return freed;
}

/* Free the remains of other RTPUs of the core that ended together with their tasks: their
 * end was not detected, and a dead task with a granted cycle may block others. Called now
 * and then; does not wait for the edit lock. */
static inline void rt_reap_others(struct rt_table *t, int me)
{
    int others = 0;
    for (int i = 0; i < RT_SLOTS; i++)
        others += (atomic_load(&t->slots[i].config.life) & 1) &&
                  atomic_load(&t->slots[i].config.member) != me;
    int error = others ? pthread_mutex_trylock(&t->edit) : EBUSY;
    if (error == EOWNERDEAD)
        error = pthread_mutex_consistent(&t->edit);
    if (error)
        return;
    int freed = rt_reap(t);
    pthread_mutex_unlock(&t->edit);
    if (freed)
        rt_kick(t);
}

static inline int rt_join(struct rt_table *t)
{
    rt_edit_lock(t);
    rt_reap(t);
    int member = RT_MEMBERS_FULL;
    for (int i = 0; i < RT_MEMBERS && member < 0; i++)
        if (!rt_member_lives(&t->members[i]) && !rt_member_used(t, i))
            member = i;
    if (member >= 0) {
        t->members[member].start = rt_start_time(getpid());
        atomic_store(&t->members[member].pid, getpid());
    }
    pthread_mutex_unlock(&t->edit);
    return member;
}

static inline int rt_init(struct rt_table *t, int core)
{
    int error = rt_init_mutex(&t->leader);
    if (!error)
        error = rt_init_mutex(&t->edit);
    for (int i = 0; i < RT_SLOTS && !error; i++)
        error = rt_init_mutex(&t->slots[i].alive);
    t->version = RT_VERSION;
    t->size = sizeof *t;
    t->core = core;
    t->trace_size = RT_TRACE;
    /* SYNC POINT: a process that maps the table reads `magic` first. */
    atomic_thread_fence(memory_order_release);
    t->magic = RT_MAGIC;
    return error;
}

/* Whether an open file is private to us: regular, our user's, no access for others. */
static inline int rt_is_ours(const struct stat *s)
{
    return S_ISREG(s->st_mode) && s->st_uid == geteuid() && !(s->st_mode & 077);
}

static inline int rt_same_file(int fd, const char *path)
{
    struct stat a, b;
    return !fstat(fd, &a) && !stat(path, &b) && a.st_ino == b.st_ino &&
           a.st_dev == b.st_dev;
}

static inline int rt_map_file(struct rt_map *map)
{
    void *at = mmap(NULL, sizeof(struct rt_table), PROT_READ | PROT_WRITE, MAP_SHARED,
                    map->fd, 0);
    if (at == MAP_FAILED)
        return errno;
    madvise(at, sizeof(struct rt_table), MADV_DONTFORK);  /* a module may fork */
    map->table = at;
    return 0;
}

/* Make the pages present for writing, so that no turn and no cycle faults; MAP_POPULATE
 * would do so for reading only. Kernels before 5.14 refuse, and each page faults once. */
static inline void rt_prefault(struct rt_map *map)
{
    madvise(map->table, sizeof(struct rt_table), 23 /* MADV_POPULATE_WRITE */);
}

/* The same for what a process that is no member touches: not the trace, which the leader
 * writes, and no slot that has never been used. A task touches one that is used later only
 * to hand over to it: its page faults once, when the task reads whether that slot expects
 * its call, which is before it ends. */
static inline void rt_prefault_used(struct rt_map *map)
{
    struct rt_table *t = map->table;
    size_t page = (size_t)sysconf(_SC_PAGESIZE), from = (size_t)t->slots & ~(page - 1);
    uint32_t high = atomic_load(&t->high);
    if (high > RT_SLOTS)        /* another program has written there */
        high = RT_SLOTS;
    madvise(t, offsetof(struct rt_table, trace), 23 /* MADV_POPULATE_WRITE */);
    madvise((void *)from, (size_t)&t->slots[high] - from, 23);
}

static inline int rt_check(const struct rt_table *t, const struct stat *s)
{
    if (t->magic != RT_MAGIC)
        return RT_DAMAGED;
    if (t->version != RT_VERSION || t->size != sizeof *t || t->trace_size != RT_TRACE)
        return RT_BAD_VERSION;
    return (uint64_t)s->st_size < sizeof *t ? RT_DAMAGED : 0;
}

/* With the lock held: map the file, or fill the one that we have just made. EAGAIN:
 * unlinked as stale. An empty file that another process made is not filled: members may
 * have it mapped, and it was truncated. They die as they use it; filled, it would be their
 * table again, without their tasks. */
static inline int rt_open_locked(struct rt_map *map, const char *path, int core, int fresh)
{
    struct stat s;
    int error;
    if (!rt_same_file(map->fd, path) || fstat(map->fd, &s))
        return EAGAIN;
    if (fresh && (error = posix_fallocate(map->fd, 0, sizeof(struct rt_table)))) {
        unlink(path);
        return error;
    }
    if (!fresh && (uint64_t)s.st_size < RT_PREFIX) {
        unlink(path);
        return EAGAIN;
    }
    if ((error = rt_map_file(map)))
        return error;
    if (fresh)
        error = rt_init(map->table, core);
    else
        error = rt_check(map->table, &s);
    if (error == RT_DAMAGED || (!fresh && !rt_any_member(map->table))) {
        unlink(path);           /* stale: its makers are gone */
        return EAGAIN;
    }
    if (error)
        return error;
    rt_prefault(map);
    map->member = rt_join(map->table);
    return map->member < 0 ? map->member : 0;
}

static inline void rt_unmap(struct rt_map *map)
{
    if (map->table)
        munmap(map->table, sizeof(struct rt_table));
    map->table = NULL;
    if (map->fd >= 0)
        close(map->fd);         /* drops the flock too */
    map->fd = -1;
}

static inline int rt_attach_member(struct rt_map *map, const char *path, int core)
{
    for (int tries = 0; tries < 100; tries++) {
        struct stat s;
        map->fd = open(path, O_RDWR | O_CLOEXEC | O_NOFOLLOW | O_CREAT | O_EXCL, 0600);
        int fresh = map->fd >= 0;
        if (!fresh && errno == EEXIST) {
            map->fd = open(path, O_RDWR | O_CLOEXEC | O_NOFOLLOW);
            if (map->fd < 0 && errno == ENOENT)
                continue;
        }
        if (map->fd < 0)
            return errno == EACCES || errno == ELOOP ? RT_FOREIGN : errno;
        int error = fstat(map->fd, &s) ? errno : rt_is_ours(&s) ? 0 : RT_FOREIGN;
        if (!error && flock(map->fd, LOCK_EX))
            error = errno;
        if (!error)
            error = rt_open_locked(map, path, core, fresh);
        if (!error) {
            flock(map->fd, LOCK_UN);
            return 0;
        }
        rt_unmap(map);
        if (error != EAGAIN && error != EINTR)
            return error;
    }
    return EAGAIN;
}

static inline int rt_attach_user(struct rt_map *map, const char *path)
{
    struct stat s;
    map->fd = open(path, O_RDWR | O_CLOEXEC | O_NOFOLLOW);
    if (map->fd < 0)
        return errno == ENOENT ? RT_NO_TABLE
               : errno == EACCES || errno == ELOOP ? RT_FOREIGN : errno;
    int error = fstat(map->fd, &s) ? errno : rt_is_ours(&s) ? 0 : RT_FOREIGN;
    if (!error && (uint64_t)s.st_size < sizeof(struct rt_table))
        error = RT_DAMAGED;
    if (!error)
        error = rt_map_file(map);
    if (!error)
        error = rt_check(map->table, &s);
    if (error)
        rt_unmap(map);
    else
        rt_prefault_used(map);
    return error;
}

/* Attach; 0, an errno value, or one of the negative results above. */
static inline int rt_attach(struct rt_map *map, const char *path, int core, int member)
{
    *map = (struct rt_map){.fd = -1, .member = -1, .pid = getpid()};
    return member ? rt_attach_member(map, path, core) : rt_attach_user(map, path);
}

/* Leave; the last living member removes the file. */
static inline void rt_detach(struct rt_map *map, const char *path)
{
    if (map->table && map->member >= 0 && map->pid == getpid()) {
        while (flock(map->fd, LOCK_EX) && errno == EINTR)
            ;
        atomic_store(&map->table->members[map->member].pid, 0);
        if (!rt_any_member(map->table) && rt_same_file(map->fd, path))
            unlink(path);
    }
    rt_unmap(map);
}

/* Change a configuration: all changes between begin and end take effect in one turn.
 *
 * SYNC POINT: pairs with rt_latch_config. A writer killed in between leaves `gen` odd;
 * the dispatcher then keeps its old copy until the slot is configured again. */
static inline uint32_t rt_config_begin(struct rt_config *c)
{
    uint32_t gen = atomic_load_explicit(&c->gen, memory_order_relaxed) | 1;
    atomic_store_explicit(&c->gen, gen, memory_order_relaxed);
    atomic_thread_fence(memory_order_release);
    return gen;
}

static inline void rt_config_end(struct rt_config *c, uint32_t gen)
{
    /* SYNC POINT: as in rt_config_begin. */
    atomic_store_explicit(&c->gen, gen + 1, memory_order_release);
}

static inline void rt_reset_watch(struct rt_slot *slot)
{
    struct rt_post *post = &slot->post;
    struct rt_grant *g = &slot->grant;
    _Atomic uint32_t *words[] = {&post->events, &post->handled, &post->locked, &post->wish,
                                 &post->fell,
                                 &g->skip, &g->failed, &g->told, &g->forced, &g->owed,
                                 &g->look, &slot->n_sections};
    for (size_t k = 0; k < sizeof words / sizeof *words; k++)
        atomic_store(words[k], 0);
    for (int k = 0; k < RT_FAILURES; k++)
        atomic_store(&g->failures[k], 0);
    atomic_store(&g->merged, 0);
    atomic_store(&slot->signals.mask, 0);
    for (int k = 0; k < RT_SIGNALS; k++)
        atomic_store(&slot->signals.counts[k], 0);
    atomic_store(&post->event_ns, 0);
    atomic_store(&post->cpu_ns, 0);
    atomic_store(&post->meets, 0);
    atomic_store(&g->overruns, 0);
    atomic_store(&g->held_off, 0);
}

static inline void rt_reset(struct rt_slot *slot, int member, const char *rtpu,
                            const char *task)
{
    struct rt_config *c = &slot->config;
    uint32_t gen = rt_config_begin(c);
    atomic_store(&c->pid, 0);
    atomic_store(&c->kind, RT_PERIODIC);
    atomic_store(&c->crit, 0);
    atomic_store(&c->priority, 0);
    atomic_store(&c->member, member);
    atomic_store(&c->period_ns, INT64_C(1000000000));
    atomic_store(&c->deadline_ns, 0);
    atomic_store(&c->minc_ns, 0);
    atomic_store(&c->maxc_ns, 0);
    atomic_store(&c->hang_ns, RT_HANG_NS);
    atomic_store(&c->drop, 0);
    atomic_store(&c->handler, 0);
    atomic_store(&c->tells, 0);
    atomic_store(&c->after_kind, RT_ALONE);
    for (int k = 0; k < RT_MASKS; k++)
        atomic_store(&c->after[k], 0);
    atomic_store(&c->callers, 0);
    rt_init_mutex(&slot->alive);
    memset(c->rtpu, 0, RT_NAME);
    memset(c->task, 0, RT_NAME);
    memcpy(c->rtpu, rtpu, strnlen(rtpu, RT_NAME - 1));
    memcpy(c->task, task, strnlen(task, RT_NAME - 1));
    atomic_store(&slot->post.word, 0);
    memset(&slot->safe, 0, sizeof slot->safe);
    rt_reset_watch(slot);
    atomic_store(&slot->post.begun, 0);
    atomic_store(&slot->post.done, 0);
    atomic_store(&slot->grant.seq, 0);
    atomic_store(&slot->grant.ask, 0);
    atomic_store(&slot->grant.parked, 0);
    atomic_store(&slot->grant.rel_ns, 0);
    atomic_store(&slot->grant.missed, 0);
    atomic_store(&slot->grant.level, 0);
    memset(&slot->stats, 0, sizeof slot->stats);
    atomic_store(&slot->errors, 0);
    rt_config_end(c, gen);
}

/* Take a free slot, preferably one that the dispatcher has released; -1: none. */
static inline int rt_alloc(struct rt_table *t, int member, const char *rtpu,
                           const char *task)
{
    int found = -1;
    rt_edit_lock(t);
    rt_reap(t);
    for (int i = RT_SLOTS - 1; i >= 0; i--) {
        uint32_t life = atomic_load(&t->slots[i].config.life);
        if (!(life & 1) && (found < 0 || atomic_load(&t->slots[i].grant.life) == life))
            found = i;
    }
    if (found >= 0) {
        struct rt_slot *slot = &t->slots[found];
        rt_reset(slot, member, rtpu, task);
        atomic_store(&t->next_ns[found], 0);
        atomic_fetch_add(&slot->config.life, 1);
        if (atomic_load(&t->high) <= (uint32_t)found)
            atomic_store(&t->high, (uint32_t)found + 1);
    }
    pthread_mutex_unlock(&t->edit);
    return found;
}

/* New settings of a slot; -1 leaves a value as it is. */
struct rt_settings {
    int32_t pid, crit, priority, kind, drop, handler, tells;
    int64_t period_ns, deadline_ns, minc_ns, maxc_ns, hang_ns;
};

static inline void rt_set32(_Atomic int32_t *to, int32_t value)
{
    if (value >= 0)
        atomic_store_explicit(to, value, memory_order_relaxed);
}

static inline void rt_set64(_Atomic int64_t *to, int64_t value)
{
    if (value >= 0)
        atomic_store_explicit(to, value, memory_order_relaxed);
}

static inline void rt_configure(struct rt_table *t, int i, const struct rt_settings *s)
{
    struct rt_config *c = &t->slots[i].config;
    rt_edit_lock(t);
    uint32_t gen = rt_config_begin(c);
    rt_set32(&c->pid, s->pid);
    rt_set32(&c->crit, s->crit);
    rt_set32(&c->priority, s->priority);
    rt_set32(&c->kind, s->kind);
    rt_set64(&c->period_ns, s->period_ns);
    rt_set64(&c->deadline_ns, s->deadline_ns);
    rt_set32(&c->drop, s->drop);
    rt_set32(&c->handler, s->handler);
    rt_set32(&c->tells, s->tells);
    rt_set64(&c->minc_ns, s->minc_ns);
    rt_set64(&c->maxc_ns, s->maxc_ns);
    rt_set64(&c->hang_ns, s->hang_ns);
    rt_config_end(c, gen);
    pthread_mutex_unlock(&t->edit);
}

/* Set what engages a standby: the fall of one of these slots, or the last of these callers
 * (call.h); RT_ALONE: nothing. */
static inline void rt_follow(struct rt_table *t, int i, int kind, const uint64_t *after,
                             uint64_t callers)
{
    struct rt_config *c = &t->slots[i].config;
    rt_edit_lock(t);
    uint32_t gen = rt_config_begin(c);
    atomic_store_explicit(&c->after_kind, kind, memory_order_relaxed);
    for (int k = 0; k < RT_MASKS; k++)
        atomic_store_explicit(&c->after[k], after[k], memory_order_relaxed);
    atomic_store(&c->callers, callers);
    rt_config_end(c, gen);
    pthread_mutex_unlock(&t->edit);
}

static inline void rt_died(struct rt_table *t, int i)
{
    struct rt_config *c = &t->slots[i].config;
    atomic_store(&c->dead, atomic_load(&c->life));
}

#endif
