/* Writer and reader of a triple buffer in every order in which they can take turns with at
 * most five switches between any two of their steps. No thread, no luck: two coroutines,
 * and a scheduler that goes through all schedules. Memory is in order here; what orders
 * would allow, the thread sanitizer looks at. Prints what was found as JSON. */
#define _GNU_SOURCE 1
static void step(void);
#define PBONET_STEP(n) step()
#include "triple.h"

#include <stdio.h>
#include <stdlib.h>
#include <ucontext.h>

enum { WRITES = 5, READS = 4, SWITCHES = 5, WORDS = 8, BYTES = WORDS * 8, STACK = 65536 };

static struct tb_buffer *buffer;
static ucontext_t scheduler, turns[2];
static uint8_t stacks[2][STACK];
static int at, over[2], running, points[SWITCHES], used;
static uint64_t written, last;
static unsigned long long schedules, reads, wrote, torn, old, twice;

static void step(void) {
    if (used < SWITCHES && at == points[used]) {
        used++;
        at++;
        if (!over[!running]) {
            int me = running;
            running = !running;
            swapcontext(&turns[me], &turns[running]);
        }
    } else {
        at++;
    }
}

static void put(void) {
    uint64_t data[WORDS];
    struct tb_stamp stamp = {.number = tb_number(atomic_load(&buffer->word)) + 1};
    for (int i = 0; i < WORDS; i++) data[i] = stamp.number;
    tb_write(buffer, BYTES, &stamp, data);
    written = stamp.number;
    wrote++;
}

static void get(void) {
    uint64_t data[WORDS], before = written;
    struct tb_stamp stamp;
    const int found = tb_read(buffer, BYTES, &stamp, data, false);
    torn += found < 0;
    if (found <= 0) {
        old += last < before;
        return;
    }
    int bad = 0;
    for (int i = 0; i < WORDS; i++) bad |= data[i] != stamp.number;
    torn += bad;
    old += stamp.number < before;
    twice += stamp.number <= last;
    last = stamp.number;
    reads++;
}

static void work(int me) {
    for (int i = 0; i < (me ? READS : WRITES); i++) me ? get() : put();
    over[me] = 1;
    running = !me;
    if (over[running]) setcontext(&scheduler);
    setcontext(&turns[running]);
}

static int run(int first) {
    memset(buffer, 0, tb_size(BYTES));
    tb_make(buffer, BYTES, 1, "", 0);
    written = last = 0;
    at = used = over[0] = over[1] = 0;
    running = first;
    for (int i = 0; i < 2; i++) {
        getcontext(&turns[i]);
        turns[i].uc_stack.ss_sp = stacks[i];
        turns[i].uc_stack.ss_size = STACK;
        makecontext(&turns[i], (void (*)(void))work, 1, i);
    }
    swapcontext(&scheduler, &turns[first]);
    schedules++;
    return at;
}

/* Run with all places of the switches from `depth` on. */
static void choose(int first, int depth, int from, int longest) {
    if (depth == SWITCHES) {
        run(first);
        return;
    }
    for (points[depth] = from; points[depth] < longest; points[depth]++)
        choose(first, depth + 1, points[depth] + 1, longest);
}

int main(void) {
    enum { FAR = 1 << 20 };
    buffer = aligned_alloc(TB_ALIGN, (tb_size(BYTES) + 63) / 64 * 64);
    for (int first = 0; first < 2; first++) {
        for (int i = 0; i < SWITCHES; i++) points[i] = FAR;
        choose(first, 0, 0, run(first) + 8);
    }
    printf("{\"schedules\": %llu, \"written\": %llu, \"reads\": %llu, \"torn\": %llu, "
           "\"old\": %llu, \"twice\": %llu}\n", schedules, wrote, reads, torn, old, twice);
    return 0;
}
