/* lease/lend.h and lease/take.h: one task of a core, whose dispatcher may be blocked at any
 * step, so that the task runs between two steps of a turn.
 *
 * Both may wake up at any time.
 *
 * Proved: the task and the dispatcher never both sleep past the task's next release, nor
 * while a cycle is granted. Each release is run once, given up or missed, and the task runs
 * what the dispatcher counts. No release is taken between the start of a turn and its lease.
 * When a turn ranks, it knows the cycle that is under way. Time goes on between any two
 * steps. Both are on one core, so each sees the other's stores in their order, and plain
 * memory will do.
 *
 * The period is two instants: a release, and a time that is too late for the task's MINC,
 * when a turn chooses freely whether it gives the release up. A lease ends LENT instants
 * after the next release. A number of a lease is not used again, so what the task has read
 * of the word is the number of the present lease, or of one that is past, or none. A bell is
 * what its reader has heard of it.
 *
 * Mutations are explained in test_spin_models.py.
 */
#ifndef INSTANTS
#define INSTANTS 6
#endif
#define PERIOD 2
#define LENT 4

byte now;

/* The word of the core: whether there is a lease, and the grant under way (0: none). */
bool is_open;
byte under_way;

/* What the task has read of it. */
mtype = { NONE, PRESENT, PAST };
mtype number = NONE;
byte cycle;
#ifdef END_LATE
mtype kept = NONE;
byte kept_cycle;
#endif

/* What else both use: the next release, the end of the lease, what is granted, and what the
 * task posts. The CPU clock at a release that was taken is the number of its grant here. */
byte next, end, grant_rel, grant_seq, begun, done, cpu[2];

/* Whether the bell was heard, and sleep until a time (0: until woken): of the task, of the
 * dispatcher. */
bool heard, asleep, mail, rests;
byte until, rests_until;

/* The dispatcher's state. */
byte seq, rel, due = PERIOD, missed;
bool ready, granted, begins, overrun, skips;

/* Ghosts: between the start of a turn and its lease; the grant that the task runs, the
 * release that it ran last, and the end of the lease as its turn has chosen it. */
bool turns;
byte runs, last, chosen;

#ifdef ONE_CLOCK
#define CPU cpu[0]
#else
#define CPU cpu[(done + 1) % 2]
#endif

#define IS_SAME (cycle == under_way && is_open == (number == PRESENT) && number != PAST)
#define COMES (done > seq -> due + PERIOD * (done - seq) : due)
#define WAKES (until && until <= COMES || rests_until <= COMES)
#define CHECK_SLEEP assert(!asleep || !rests || grant_seq <= done && WAKES)

inline kick() { atomic { mail = false; rests = false } }

/* Time passes before it is read: between two reads nothing else depends on it. */
inline pass() { do :: now < INSTANTS -> now++ :: break od }

/* The dispatcher's turn. */
inline recall() {
    atomic {
        is_open = false; turns = true;
#ifdef FORGET_CYCLE
        under_way = 0;
#endif
        if :: number == PRESENT -> number = PAST :: else fi;
#ifdef END_LATE
        if :: kept == PRESENT -> kept = PAST :: else fi
#endif
    }
}

inline over() {
    rel = 0; ready = false; granted = false; begins = false; skips = false; overrun = false
}

/* rt_last_taken, to n. */
inline read_taken() {
    n = under_way;
    if :: n -> skip :: else -> n = done fi
}

/* rt_latch with rt_latch_lease. */
inline latch() {
    read_taken();
    atomic {
        if
        :: n > seq ->
#ifdef ONE_CLOCK
            assert(cpu[0] == n);
#else
            assert(cpu[n % 2] == n);
#endif
            over();
            rel = due + PERIOD * (n - seq - 1);
            due = rel + PERIOD;
            seq = n;
            ready = true; granted = true; begins = true
        :: else
        fi;
        n = 0
    };
    if
    :: granted ->
        if
        :: atomic { done == seq -> over() }
        :: else -> if :: begins -> skip :: else -> begins = begun == seq fi
        fi
    :: else
    fi
}

/* rt_watch: release what is due at the turn's time; give up what has not begun. */
inline watch() {
    if
    :: atomic { due <= at ->
            missed = missed + ready + (at - due) / PERIOD;
            due = at - at % PERIOD + PERIOD;
            ready = true;
            if
            :: begins -> overrun = true
            :: else ->
                rel = due - PERIOD;
                if :: granted -> grant_rel = rel :: else fi
            fi };
        if :: begins -> skip :: else -> skips = false fi
    :: else
    fi;
    if
    :: atomic { ready && !begins && !skips && at > rel ->
            if
            :: granted -> skips = true
            :: else -> over(); missed++
            fi }
    :: true
    fi
}

/* rt_rank with rt_publish, and then rt_act. */
inline rank() {
    atomic {
        assert(!runs || ready && granted && runs == seq);
        assert(due == PERIOD * (1 + seq + missed + (ready && !granted)))
    };
    if
    :: atomic { ready && !granted -> granted = true; seq++ };
#ifdef GRANT_FIRST
        grant_seq = seq; grant_rel = rel; heard = false;
#else
#ifdef BELL_FIRST
        grant_rel = rel; heard = false; grant_seq = seq;
#else
        grant_rel = rel; grant_seq = seq; heard = false;
#endif
#endif
        asleep = false
    :: else
    fi
}

#ifdef RING_GRANTED
#define RINGS (ready && done == seq)
#else
#define RINGS (!ready || done == seq)
#endif

inline publish_next() {
    if
    :: next != due ->
#ifdef RING_FIRST
        if :: RINGS -> heard = false :: else fi;
        next = due;
        asleep = false
#else
        next = due;
#ifndef NO_RING
        if :: RINGS -> heard = false; asleep = false :: else fi
#endif
#endif
    :: else
    fi
}

/* rt_open, with the cycle n. */
inline store_word() { atomic { is_open = true; under_way = n; turns = false } }

inline open_word() {
    atomic {
        assert(first == due);
        if :: chosen = first + LENT :: chosen = first + 1 fi
    };
#ifdef WORD_FIRST
    store_word();
    end = chosen;
#else
    end = chosen;
    store_word();
#endif
#ifndef NO_LOOK_AT_END
    if
    :: n && done == n ->
        atomic { if :: is_open && under_way == n -> under_way = 0 :: else fi }
    :: else
    fi
#endif
}

inline read_time() { atomic { pass(); is_late = now >= first } }

#ifdef LEND_OVERRUN
#define IS_PLAIN !skips
#else
#define IS_PLAIN (!overrun && !skips)
#endif

/* rt_lend, which gives the time until which to sleep. */
inline lend() {
#ifndef NEXT_LAST
    publish_next();
#endif
    if
    :: atomic { IS_PLAIN && ready == (done != seq) -> n = (ready -> seq : 0) };
#ifdef NEXT_LAST
        first = due;
#else
        first = next;
#endif
        grant_seq = seq;
#ifdef TIME_FIRST
        read_time();
        open_word();
#else
        open_word();
#ifdef NEXT_LAST
        publish_next();
#endif
#ifndef NO_TIME
        read_time();
#endif
#endif
        atomic { sleep_to = (is_late -> first : end); n = 0; first = 0; is_late = false }
    :: else ->
#ifdef NEXT_LAST
        publish_next();
#endif
        sleep_to = due
    fi
}

active proctype Dispatcher() {
    byte at, n, first, sleep_to;
    bool is_late;
turn:
#ifndef MAIL_LATE
    mail = true;
#endif
    atomic { pass(); at = now };
#ifndef RECALL_LATE
    recall();
#endif
    read_taken(); /* rt_news */
    if :: n > seq || granted -> latch() :: else fi;
#ifdef RECALL_LATE
    recall();
#endif
    watch();
    atomic { at = 0; n = 0 };
    rank();
    lend();
#ifdef MAIL_LATE
    mail = true;
#endif
    atomic { turns = false;
        if
        :: mail -> rests = true; rests_until = sleep_to; CHECK_SLEEP
        :: else
        fi;
        sleep_to = 0 };
    /* Its time has come, or it is woken, which others may do at any time. */
    if
    :: atomic { now < INSTANTS -> rests = false; rests_until = 0; mail = false; goto turn }
    :: now == INSTANTS
    fi
}

/* The task. */
inline read_word() {
    atomic { number = (is_open -> PRESENT : NONE); cycle = under_way }
}

/* rt_end. */
inline mark_end() { atomic { done = mine; runs = 0 } }

/* rt_give_back, after it has read the word. */
inline give_back() {
    if
    :: number == PRESENT && cycle == mine ->
        atomic {
#ifdef GIVE_BACK_UNASKED
            is_open = true; under_way = 0
#else
            if :: IS_SAME -> under_way = 0 :: else -> kick() fi
#endif
        }
    :: else
    fi
}

#ifdef END_LATE
/* The end of a cycle amid rt_take, which has loaded the word and the release. */
inline end_late() {
    atomic { kept = number; kept_cycle = cycle };
    mark_end();
    read_word();
    give_back();
    atomic {
        number = kept; cycle = kept_cycle; kept = NONE; kept_cycle = 0; mine = 0
    }
}
#endif

#ifdef LIMIT_FIRST
#define LIMIT limit
#else
#define LIMIT end
#endif

#ifdef SLEEP_AFTER_LOSS
#define AGAIN 0
#else
#define AGAIN release
#endif

active proctype Task() {
    byte release, late, mine, ends;
#ifdef LIMIT_FIRST
    byte limit;
#endif
wait:
#ifndef BELL_LATE
    heard = true;
#endif
    if
    :: atomic { grant_seq > (mine -> mine : done) -> mine = grant_seq; runs = mine; goto begin }
    :: else
    fi;
    /* rt_take */
#ifdef LIMIT_FIRST
    limit = end;
#endif
#ifdef RELEASE_FIRST
    release = next;
    read_word();
#else
    read_word();
    release = next;
#endif
#ifdef END_LATE
    if :: mine -> end_late() :: else fi;
#endif
#ifdef BELL_LATE
    heard = true;
#endif
    atomic {
        pass();
        if
        :: !release || now < release -> until = release; goto sleep
        :: else -> late = now - release
        fi
    };
    if
    :: number == NONE -> goto refused
    :: number != NONE && release >= LIMIT -> goto refused
    :: else -> if :: cycle -> goto refused :: else fi
    fi;
    if
    :: late >= PERIOD ->
#ifndef NO_KICK
        kick();
#endif
        goto sleep
    :: else
    fi;
#ifndef CPU_LATE
    CPU = done + 1;
#endif
    atomic {
        if
#ifdef TAKE_UNASKED
        :: true ->
#else
        :: IS_SAME ->
#endif
#ifdef TAKE_UNASKED
            is_open = true;
#endif
            assert(!turns && release < chosen);
            mine = done + 1; under_way = mine; runs = mine
        :: else -> until = AGAIN; goto sleep
        fi
    };
#ifdef CPU_LATE
    CPU = done + 1;
#endif
    grant_rel = release;
    next = release + PERIOD;
    /* A jump from one atomic sequence into another makes both one step: skip parts them. */
begin:
    skip;
    atomic { number = NONE; cycle = 0; release = 0; late = 0; begun = mine };
    atomic { assert(grant_rel > last && grant_rel <= now); last = grant_rel };
    /* rt_own_up */
    ends = (next < last + PERIOD -> next : last + PERIOD);
    if :: is_open -> atomic { pass(); if :: now >= ends -> kick() :: else fi } :: else fi;
    ends = 0;
#if defined(END_LATE)
    skip; /* in rt_take */
#elif defined(GIVE_BACK_FIRST)
    read_word();
    give_back();
    mark_end();
#elif defined(END_AFTER_WORD)
    read_word();
    mark_end();
    give_back();
#else
    mark_end();
    read_word();
    give_back();
#endif
#ifndef END_LATE
    atomic { number = NONE; cycle = 0; mine = 0 };
#endif
    goto wait;
refused:
#ifndef NO_SECOND_LOOK
    skip;
    atomic { if :: IS_SAME -> skip :: else -> until = release fi };
#endif
sleep:
    skip;
    atomic {
        number = NONE; cycle = 0; release = 0; late = 0;
        if
        :: heard -> asleep = true; CHECK_SLEEP
        :: else -> until = 0; goto wait
        fi
    };
    if
    :: atomic { !asleep || now < INSTANTS -> asleep = false; until = 0; goto wait }
    :: atomic { asleep && until && until <= INSTANTS ->
            if :: now < until -> now = until :: else fi;
            asleep = false; until = 0; goto wait }
    :: now == INSTANTS && asleep && (!until || until > INSTANTS)
    fi
}
