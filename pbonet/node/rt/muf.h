/* Maximum urgency first: rank the ready tasks and assign FIFO priorities.
 *
 * A property test runs it in step with tests/oracles/plain_dispatcher/levels.py. It
 * allocates no memory and changes nothing but its arguments.
 */
#ifndef PBONET_MUF_H
#define PBONET_MUF_H

#include <stdint.h>

enum { MUF_MAX = 128, MUF_LOW = 7, MUF_HIGH = 84 };
enum { MUF_BACKGROUND_LOW = 1, MUF_BACKGROUND_HIGH = 4 };

/* Background tasks go after all cycles and commands, and cycles that hang have no level. */
enum muf_group { MUF_CYCLES = 0, MUF_BACKGROUND = 1, MUF_HUNG = 2 };

struct muf_item {
    int64_t deadline, since;    /* absolute; since: first come, first served */
    int32_t group;              /* muf_group: a later one goes after all others */
    int32_t crit, priority;
    int32_t last;               /* goes after all others of its criticality */
    int32_t level;              /* current one; 0: none */
    int32_t slot;
};

/* Whether `a` is more urgent: criticality, deadline, user priority, then FCFS. */
static inline int muf_before(const struct muf_item *a, const struct muf_item *b)
{
    if (a->group != b->group)
        return a->group < b->group;
    if (a->crit != b->crit)
        return a->crit > b->crit;
    if (a->last != b->last)
        return b->last;
    if (a->deadline != b->deadline)
        return a->deadline < b->deadline;
    if (a->priority != b->priority)
        return a->priority > b->priority;
    if (a->since != b->since)
        return a->since < b->since;
    return a->slot < b->slot;
}

/* Sort items, most urgent first. Insertion sort: few are ready at a time. */
static inline void muf_sort(struct muf_item *items, int n)
{
    for (int i = 1; i < n; i++) {
        struct muf_item item = items[i];
        int j = i;
        for (; j > 0 && muf_before(&item, &items[j - 1]); j--)
            items[j] = items[j - 1];
        items[j] = item;
    }
}

/* Choose the places whose levels can stay so that the others fit between them.
 *
 * Level plus place must strictly decrease from each kept task to the next; the longest
 * such choice is a longest decreasing subsequence, found with the usual array of ends.
 */
static inline int muf_keep(const struct muf_item *items, int n, int floor, int ceiling,
                           int *kept)
{
    int last[MUF_MAX], before[MUF_MAX], chains = 0;
    for (int i = 0; i < n; i++) {
        int value = items[i].level + i;
        if (value < floor || value > ceiling)
            continue;
        int lo = 0, hi = chains;
        while (lo < hi) {
            int mid = (lo + hi) / 2;
            if (items[last[mid]].level + last[mid] < value)
                hi = mid;
            else
                lo = mid + 1;
        }
        before[i] = lo ? last[lo - 1] : -1;
        last[lo] = i;
        if (lo == chains)
            chains++;
    }
    for (int i = chains ? last[chains - 1] : -1, k = chains - 1; i >= 0; i = before[i])
        kept[k--] = i;
    return chains;
}

/* Give ranked items strictly decreasing levels, `high` to `low`, with few changes. */
static inline void muf_assign(struct muf_item *items, int n, int low, int high)
{
    int kept[MUF_MAX], room = high - low + 1;
    if (n > room) {             /* the least urgent share the lowest level */
        for (int i = room - 1; i < n; i++)
            items[i].level = low;
        n = room - 1;
        low++;
    }
    int chains = muf_keep(items, n, low + n - 1, high, kept);
    int above = -1, level_above = high + 1;
    for (int k = 0; k <= chains; k++) {
        int below = k < chains ? kept[k] : n;
        int level_below = k < chains ? items[below].level : low - 1;
        int gap = below - above, span = level_above - level_below;
        for (int step = 1; step < gap; step++)
            items[above + step].level = level_above - step * span / gap;
        above = below;
        level_above = level_below;
    }
}

/* Give all ready items, ranked, the levels of their groups. */
static inline void muf_assign_groups(struct muf_item *ready, int n)
{
    int cycles = 0, background = 0;
    while (cycles < n && ready[cycles].group == MUF_CYCLES)
        cycles++;
    while (cycles + background < n && ready[cycles + background].group == MUF_BACKGROUND)
        background++;
    muf_assign(ready, cycles, MUF_LOW, MUF_HIGH);
    muf_assign(ready + cycles, background, MUF_BACKGROUND_LOW, MUF_BACKGROUND_HIGH);
    for (int k = cycles + background; k < n; k++)
        ready[k].level = 0;
}

#endif
