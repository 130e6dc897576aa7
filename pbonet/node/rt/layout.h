/* The core table: the whole state of a dispatcher, in memory shared per user and core.
 *
 * Writers (each field has one writer at a time):
 *   config  the RTPU process that owns the slot, under the edit lock, versioned by `gen`
 *   post    the task
 *   grant   the leading dispatcher; any process may write `bell` and `ask`, atomically
 *   state   the leading dispatcher alone; a standby reads it when it takes over
 *   next_ns the leading dispatcher; a task its own, once it has taken a release
 *   safe    the task and the leading dispatcher, in turns; see svar/safe.h
 *   stats   the task; `seq` lets readers detect a concurrent write
 *   signals the task increments counts, the RTPU process sets the mask; all atomic
 * No process waits for another one here, except for the edit lock among RTPU processes.
 */
#ifndef PBONET_LAYOUT_H
#define PBONET_LAYOUT_H

#ifndef _GNU_SOURCE
#define _GNU_SOURCE
#endif
#include <pthread.h>
#include <stdatomic.h>
#include <stddef.h>
#include <stdint.h>

#include "../../svar/safe.h"

enum {
    RT_SLOTS = 128,
    RT_MASKS = RT_SLOTS / 64,   /* words with a bit for every slot */
    RT_MEMBERS = 32,
    RT_NAME = 64,
    RT_TRACE = 1 << 15,      /* records; a turn writes at most RT_TURN_MAX */
    RT_TURN_MAX = 16 * RT_SLOTS + 2,
    RT_BINS = 416,           /* 16 below 1 us, then 16 an octave up to 2^25 us */
    RT_VERSION = 17,
    RT_SIGNALS = 32,         /* signals that a module may send to its master */
    RT_SECTIONS = 16,        /* timed sections of a task's cycle */
    RT_SECTION_NAME = 24,
    RT_PIECES = 8,           /* pending replenishments of a sporadic server */
    RT_COMMAND_LEVEL = 6,
    RT_DISPATCHER_LEVEL = 95,
};
#define RT_UNSET (-1)   /* a level that the last leader may have decided on but not set */
#define RT_MAGIC UINT64_C(0x31656e6f63626f70)
#define RT_MIN_PERIOD_NS INT64_C(100000)
#define RT_LEAD_NS INT64_C(100000)
#define RT_TAKEN_NS INT64_C(10000)       /* for which a turn keeps a cycle from running, about */
#define RT_MARGIN_NS INT64_C(20000)      /* minimum time ahead of a timer */
#define RT_HOLD_OFF_NS INT64_C(1000000)  /* how long a critical section defers a drop */
#define RT_WAIT_SPAN 10     /* a wait hangs that uses `hang` within so many times that */
#define RT_FLOOD 10          /* so many times as often as declared is a flood of events */
#define RT_HANDLER_NS INT64_C(1000000)   /* CPU time of a handler at its own priority */
#define RT_STALL_NS INT64_C(20000000)
#define RT_HANG_NS INT64_C(100000000)    /* default of `hang_ns` */
#define RT_NEVER INT64_MAX

enum rt_mode { RT_OFF = 0, RT_ON = 1, RT_COMMAND = 2, RT_STANDS = 3 };
enum rt_after { RT_ALONE = 0, RT_FALLBACK = 1, RT_HANDOVER = 2 };  /* see standby.h */
enum rt_overrun { RT_IN_TIME = 0, RT_OVER = 1, RT_LAST = 2, RT_HUNG = 3 };  /* see watch.h */
enum rt_kind { RT_PERIODIC = 0, RT_SYNCHRONOUS = 1, RT_DEFERRABLE = 2, RT_SPORADIC = 3,
               RT_BACKGROUND = 4 };
enum rt_backend { RT_NONE = 0, RT_FIFO = 1, RT_PARK = 2 };
enum rt_failure { RT_DEADLINE = 0, RT_MAXEXEC = 1, RT_MINEXEC = 2, RT_FAILURES = 3 };
/* In config.tells: the module has a failure handler; safe values at a kind of failure. */
enum { RT_TELLS = 1 };
#define RT_SAFE_AT(kind) (2 << (kind))
enum { RT_HANDLER_HANGS = 2 };         /* in post.locked: why the task killed itself */
enum { RT_FELL = 1, RT_FELL_ARMED = 2 };  /* in post.fell: was the task armed before? */
enum rt_ask { RT_ASK_COMMAND = 1, RT_ASK_ORPHAN = 2, RT_ASK_LAST = 4 };

/* One record of the trace; pbonet/analysis/schedule/events.py describes the kinds. */
struct rt_event {
    int64_t a, b;
    uint32_t arg;
    uint16_t slot;
    uint16_t kind;
};
enum rt_event_kind {
    RT_TURN = 1, RT_LIFE, RT_CONFIG, RT_DEAD, RT_MODE, RT_DONE, RT_BEGUN, RT_LEAD,
    RT_LIMITS, RT_USED, RT_HANDLED, RT_WISH, RT_EVENT, RT_UNLOCKED, RT_AFTER,
    RT_RELEASE = 16, RT_MISS, RT_LEVEL, RT_WAKE, RT_PARKED, RT_RESUME,
    RT_FAIL, RT_CRIT, RT_SKIP, RT_REFILL, RT_FORCE, RT_ENGAGE,
};

struct rt_config {
    _Atomic uint32_t gen;    /* odd while being written */
    _Atomic uint32_t life;   /* odd while allocated; incremented by every alloc and free */
    _Atomic uint32_t dead;   /* the life whose task has died or is an orphan */
    _Atomic int32_t pid;
    _Atomic int32_t kind, crit, priority;
    _Atomic int32_t member;
    _Atomic int64_t period_ns, deadline_ns;
    _Atomic int64_t minc_ns, maxc_ns;   /* 0: none; maxc of a server: its capacity */
    _Atomic int64_t hang_ns;            /* CPU time of a cycle beyond its period: it hangs */
    _Atomic int32_t drop;               /* criticality once maxc is used up */
    _Atomic int32_t handler;            /* of the failure handler; 0: the task's own */
    _Atomic int32_t tells;              /* RT_TELLS, and RT_SAFE_AT of kinds */
    _Atomic int32_t after_kind;         /* rt_after: what engages the task ... */
    _Atomic uint64_t after[RT_MASKS];   /* ... and which slots it depends on */
    _Atomic uint64_t callers;           /* callers that have not called yet; see call.h */
    char rtpu[RT_NAME], task[RT_NAME];
};

struct rt_post {
    _Alignas(64) _Atomic uint32_t word; /* mode | arming count << 2 | returns << 17 */
    _Atomic uint32_t begun;             /* number of the last grant begun ... */
    _Atomic uint32_t done;              /* ... and ended */
    _Atomic uint32_t events;            /* begins plus ends: odd while one is served */
    _Atomic uint32_t handled;           /* failures whose handler has returned */
    _Atomic uint32_t locked;            /* in a critical section */
    _Atomic uint32_t fell;              /* not 0: the task is in ERROR; values: above */
    _Atomic uint32_t wish;              /* changes with the two below */
    _Atomic int32_t wish_crit;          /* -1: none */
    _Atomic int64_t wish_dl_ns;         /* absolute; 0: none */
    _Atomic int64_t event_ns;           /* begin of the last event */
    _Atomic uint64_t cpu_ns;            /* the task's CPU clock, in virtual time only */
    _Atomic uint32_t meets;             /* the `look_life` whose timer the task can move */
    _Atomic int64_t lease_cpu_ns[2];    /* CPU clock of its process at a release taken: of
                                         * an even and of an odd grant */
};

struct rt_grant {
    _Alignas(64) _Atomic uint32_t bell; /* futex: changes when the task must wake up */
    _Atomic uint32_t seq;               /* number of the last grant */
    _Atomic uint32_t ask;               /* rt_ask bits */
    _Atomic uint32_t parked;            /* futex: not 0 while the task is held */
    _Atomic uint32_t skip;              /* number of a grant that must not begin */
    _Atomic uint32_t failed;            /* kinds of failure to deliver | grant << 3 */
    _Atomic uint32_t told;              /* number of failures sent to the handler */
    _Atomic uint32_t forced;            /* the grant whose critical section is cut short */
    _Atomic uint32_t owed;              /* a drop waits for the section's end */
    _Atomic uint32_t look;              /* number of the check that its end cancels */
    _Atomic int64_t failed_ns;          /* when the last failure was found */
    _Atomic int64_t rel_ns, dl_ns;      /* of the last grant */
    _Atomic int32_t crit;               /* current criticality */
    _Atomic uint64_t failures[RT_FAILURES];
    _Atomic uint64_t overruns, held_off; /* maxc used up; sections that took too long */
    _Atomic uint64_t merged;            /* failures that share the call of a waiting one */
    _Atomic uint64_t missed;            /* copy of `state`, for readers of the status */
    _Atomic int32_t level;              /* likewise */
    _Atomic uint32_t life;              /* the life that the dispatcher serves */
    _Atomic uint32_t fell;              /* a standby of this task is engaged at once */
    _Atomic uint32_t flooded;           /* events come without end, so `hung` is set, too */
    _Atomic uint32_t hung;              /* a cycle or `sync` does not return: others go first */
    _Atomic uint32_t lent_metered;      /* the CPU clock at a release is needed */
    _Atomic int64_t lent_period_ns, lent_length_ns;     /* of releases that it takes: lease/ */
    _Atomic int64_t lent_check_ns;      /* from a release to the first check */
};

struct rt_piece {
    int64_t at_ns, ns;                  /* when capacity is replenished, and how much */
};

struct rt_state {
    _Alignas(64) int64_t period, deadline, next_ns, rel_ns, dl_ns;
    uint64_t missed;
    uint32_t gen, life, word, seq;
    int32_t pid, crit, priority, kind, level;
    uint8_t dead, armed, ready, granted, begun, parked;
    /* for failures and reserves; see watch.h */
    uint8_t tells, spent, late, sure, skip, handling, owed, fresh, active, n_pieces;
    uint8_t engaged, fell;              /* see standby.h */
    uint8_t overrun;                    /* rt_overrun */
    int32_t rank, drop, handler;        /* rank: the current criticality */
    uint32_t told, handled, wish;
    uint32_t heard;                     /* `post.events` of a device, as last read */
    int64_t minc, maxc, hang;
    int64_t clock, mark;                /* CPU clock: last read; start of the reserve */
    int64_t check_ns;                   /* time of the next check; 0: none */
    int64_t locked_ns;                  /* when a critical section is forced to end */
    int64_t handler_mark;
    int64_t overrun_mark;               /* CPU clock when the cycle had used up its period */
    int64_t wait_ns, wait_from_ns;      /* when to look at a wait again; since when; see wait.h */
    int64_t wait_mark;                  /* CPU clock then; -1: not read yet */
    uint32_t wait_events;               /* `post.events` at that time */
    uint8_t wait_main;                  /* the clock is that of the main thread alone */
    uint8_t flooded;                    /* events of a device or server come without end */
    uint32_t early;                     /* how many of a device came early ... */
    int64_t early_from_ns;              /* ... since then; of servers see rt_count_spent */
    int64_t left;                       /* of a server's capacity */
    int64_t event_ns;
    uint64_t failures[RT_FAILURES], overruns, held_off;
    struct rt_piece pieces[RT_PIECES];
    int32_t after_kind;
    uint32_t ticket;                    /* of the calls that it waits for; 0: none */
    uint64_t after[RT_MASKS];
};

struct rt_section {                     /* a timed part of the cycle, written by the task */
    char name[RT_SECTION_NAME];
    _Atomic uint64_t count, total_ns, min_ns, max_ns;
};

enum rt_restart { RT_SINCE_ON = 0, RT_RESTART = 1, RT_RESTARTED = 2 };

struct rt_stats {
    _Alignas(64) _Atomic uint32_t seq;  /* odd while being written */
    _Atomic uint32_t restart;           /* rt_restart, of cpu_min_ns and cpu_max_ns */
    _Atomic uint64_t on_ns, last_rel_ns; /* last_rel_ns: 0 until a cycle has run */
    _Atomic uint64_t cycles, late, failed, stable, torn, stale, faults, ring_lost;
    _Atomic uint64_t on_cycles, on_missed, on_failed, on_cpu_ns, on_faults;
    _Atomic uint64_t cpu_total_ns, cpu_last_ns, cpu_min_ns, cpu_max_ns;
    _Atomic uint64_t cpu_first_ns;       /* of the first cycle after `on` */
    _Atomic uint64_t cpu_mark_ns;        /* the thread's CPU clock at this cycle's start */
    _Atomic uint64_t wall_total_ns;      /* time from begin to end of all cycles */
    _Atomic uint64_t held_ns;            /* time for which the dispatcher held the task */
    _Atomic uint64_t copy_in_ns, copy_out_ns, jitter_max_ns;
    _Atomic uint64_t aborted, skipped, handlers, stale_failures;
    _Atomic uint64_t delivery_last_ns, delivery_max_ns; /* failure to handler's start */
    _Atomic uint64_t jitter[RT_BINS], cpu[RT_BINS];
};

struct rt_signals {
    _Alignas(64) _Atomic uint32_t mask; /* bits that no program listens to */
    _Atomic uint64_t counts[RT_SIGNALS]; /* sent and not masked; never decrease */
};

struct rt_slot {
    _Alignas(64) struct rt_config config;
    pthread_mutex_t alive;              /* robust; the task holds it for life: vigil.h */
    struct rt_post post;
    struct rt_grant grant;
    struct rt_state state;
    _Alignas(64) struct pb_safe safe;   /* task and leader; see svar/safe.h */
    _Atomic uint64_t errors;            /* kernel calls of the dispatcher that failed */
    struct rt_stats stats;
    struct rt_signals signals;
    _Atomic uint32_t n_sections;
    struct rt_section sections[RT_SECTIONS];
};

struct rt_member {
    _Atomic int32_t pid;                /* 0: free */
    uint64_t start;                     /* start time of the process; detects reuse */
};

struct rt_table {
    uint64_t magic;                     /* written last by the creator */
    uint32_t version, size;
    int32_t core;
    uint32_t trace_size;
    struct rt_member members[RT_MEMBERS];   /* the fields so far are fixed in all versions */
    pthread_mutex_t leader;             /* robust; the leader holds it for life */
    pthread_mutex_t edit;               /* robust; members, lives and configs */

    _Alignas(64) _Atomic uint32_t mailbox;  /* futex: changes when there is news */
    _Atomic uint32_t fallen;            /* futex: changes when a task goes to ERROR */
    _Atomic uint32_t relevel;           /* asks the leader to set all levels again */
    _Atomic uint32_t waiting;           /* park: tasks that wait for a cycle to end */
    _Atomic uint32_t high;              /* slots ever used: the bound of every scan */
    _Atomic int32_t backend;            /* rt_backend of the leader */
    _Atomic int32_t leader_pid, leader_tid;
    _Atomic int32_t look_tid, look_fd;  /* the leader's; see look.h */
    _Atomic uint32_t look_life;         /* incremented for each new leader's timer */
    _Atomic int64_t since_ns;
    _Atomic uint64_t turns, releases, level_changes, errors, takeovers;
    _Atomic int64_t late_max_ns;        /* longest delay of a turn after its event */
    _Atomic uint64_t stalls, stalled_ns; /* turns later than RT_STALL_NS: the core stalled */
    _Atomic int64_t stall_end_ns;       /* when the last such turn came; 0: none yet */
    _Atomic int64_t virtual_ns;         /* the time, if it is virtual; else 0 */
    int64_t due_ns;                     /* when the next turn is due ... */
    _Atomic int64_t sure_ns;            /* ... even if every cycle ends before */
    _Atomic int64_t look_ns;            /* when the timer of a check expires; 0: stopped */
    _Atomic int64_t looked_ns;          /* when it was due to expire, until a turn reads it */
    _Atomic uint64_t look;              /* number << 32 | cycles still under way */
    _Atomic uint64_t spared;            /* checks that were cancelled in time */
    _Atomic uint64_t lease;             /* number << 40 | slot + 1 << 32 | grant; see lease/ */
    _Atomic int64_t lent_end_ns;        /* the first release that is the dispatcher's again */
    uint32_t leases;                    /* how many there were */
    _Alignas(64) _Atomic int64_t next_ns[RT_SLOTS]; /* next releases of periodic tasks; 0: none */

    uint32_t journal_slot;              /* the slot whose state is being replaced ... */
    _Atomic uint32_t journal_valid;
    struct rt_state journal;            /* ... and its new state */

    _Alignas(64) _Atomic uint64_t trace_end;  /* number of records of complete turns */
    uint64_t trace_next;                /* ... including the turn under way */
    struct rt_event trace[RT_TRACE];
    struct rt_slot slots[RT_SLOTS];
};

#define RT_PREFIX (offsetof(struct rt_table, leader))

#endif
