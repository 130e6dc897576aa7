/* Weak memory for the models of pbonet/svar: what a C11 compiler and a processor may do.
 *
 * Stores. A process does not write into memory: it issues a store into a pool, and a store
 * in the pool is performed (becomes visible, to all readers at once) at any later time and
 * in any order, except that it waits for
 *   - earlier stores to the same location,
 *   - all stores that happened before the last release fence of the process that issued it,
 *   - all stores that happened before it, when it is itself a release store.
 * Later stores may overtake a release store, as C11 allows. "Happened before" is carried
 * from process to process by the lock and by the kernel when it tells that a process has
 * died; neither of them performs anything. Stores that a killed process issued are still
 * performed: the processor does not forget them.
 *
 * Loads are performed by the readers in any order that acquire loads, acquire fences and
 * coherence allow; each model lists its loads and what each of them waits for.
 *
 * The including model defines LOCATIONS, CPUS, POOLS, POOL_OF(cpu) and the ghost PERFORMED(loc).
 * Bound: at most POOL stores are pending at a time; who issues one more waits.
 */
#ifndef POOL
#define POOL 4 /* a mask of pending stores is one byte: 8 at most */
#endif

typedef Pool {
    byte n;          /* pending stores, in the order of their issue */
    byte loc[POOL];
    short val[POOL];
    byte wait[POOL]; /* bit i: only after pending store i */
};

short mem[LOCATIONS];
Pool pool[POOLS];
byte before[CPUS]; /* pending stores that happened before the process's next step */
byte fenced[CPUS]; /* those that happened before its last release fence */
byte handed;       /* those that happened before the lock was given up */

hidden byte i_, j_, m_;

/* Take bit `i` out of a mask of pending stores; the bits above it move down. */
#define without(m, i) (((m) & ((1 << (i)) - 1)) | (((m) >> ((i) + 1)) << (i)))

inline release_fence(cpu) { fenced[cpu] = before[cpu] }

inline issue(cpu, at, what, last) {
    atomic {
        pool[POOL_OF(cpu)].n < POOL;
        d_step {
            m_ = last;
            i_ = 0;
            do
            :: i_ < pool[POOL_OF(cpu)].n ->
                if
                :: pool[POOL_OF(cpu)].loc[i_] == (at) -> m_ = m_ | (1 << i_)
                :: else
                fi;
                i_++
            :: else -> break
            od;
            pool[POOL_OF(cpu)].loc[i_] = at;
            pool[POOL_OF(cpu)].val[i_] = what;
            pool[POOL_OF(cpu)].wait[i_] = m_;
            before[cpu] = before[cpu] | (1 << i_);
            pool[POOL_OF(cpu)].n = i_ + 1;
            i_ = 0;
            m_ = 0
        }
    }
}

#define store(cpu, at, what) issue(cpu, at, what, fenced[cpu])
#define store_release(cpu, at, what) issue(cpu, at, what, before[cpu])

/* What a writer itself loads: its own newest store, or that of an earlier lock holder.
 * To be used inside d_step. */
inline load(cpu, at, to) {
    to = mem[at];
    i_ = 0;
    do
    :: i_ < pool[POOL_OF(cpu)].n ->
        if
        :: pool[POOL_OF(cpu)].loc[i_] == (at) -> to = pool[POOL_OF(cpu)].val[i_]
        :: else
        fi;
        i_++
    :: else -> break
    od;
    i_ = 0
}

inline perform(p, i) {
    d_step {
        m_ = pool[p].loc[i];
        mem[m_] = pool[p].val[i];
        PERFORMED(m_);
        j_ = i;
        do
        :: j_ + 1 < pool[p].n ->
            pool[p].loc[j_] = pool[p].loc[j_ + 1];
            pool[p].val[j_] = pool[p].val[j_ + 1];
            pool[p].wait[j_] = pool[p].wait[j_ + 1];
            j_++
        :: else -> break
        od;
        pool[p].loc[j_] = 0;
        pool[p].val[j_] = 0;
        pool[p].wait[j_] = 0;
        pool[p].n = j_;
        j_ = 0;
        do
        :: j_ < pool[p].n ->
            pool[p].wait[j_] = without(pool[p].wait[j_], i);
            j_++
        :: else -> break
        od;
        j_ = 0;
        do
        :: j_ < CPUS ->
            if
            :: POOL_OF(j_) == p ->
                before[j_] = without(before[j_], i);
                fenced[j_] = without(fenced[j_], i)
            :: else
            fi;
            j_++
        :: else -> break
        od;
        handed = without(handed, i);
        j_ = 0;
        m_ = 0
    }
}

#define may_perform(p, i) (i < pool[p].n && !pool[p].wait[i])

/* The memory: performs one pending store after the other, whenever it likes. */
active [POOLS] proctype Memory() {
end:
    do
    :: atomic { may_perform(_pid, 0) -> perform(_pid, 0) }
    :: atomic { may_perform(_pid, 1) -> perform(_pid, 1) }
    :: atomic { may_perform(_pid, 2) -> perform(_pid, 2) }
    :: atomic { may_perform(_pid, 3) -> perform(_pid, 3) }
#if POOL > 4
    :: atomic { may_perform(_pid, 4) -> perform(_pid, 4) }
#endif
#if POOL > 5
    :: atomic { may_perform(_pid, 5) -> perform(_pid, 5) }
#endif
#if POOL > 6
    :: atomic { may_perform(_pid, 6) -> perform(_pid, 6) }
#endif
#if POOL > 7
    :: atomic { may_perform(_pid, 7) -> perform(_pid, 7) }
#endif
    od
}
