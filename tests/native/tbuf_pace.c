/* When a sender expects the next record: times of records go in, what it expects comes out.
 * Also whether a writer has to ring while its record is late. Prints JSON. */
#define _GNU_SOURCE 1
#include "doze.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>

enum { PERIOD = 1000000, BYTES = 8 };

static struct tb_buffer *buffer;

/* How far behind the grid the next record is expected, after `n` regular ones and one that
 * is late by `late`, before which `lost` were missed. */
static long long expected(int n, long long late, int lost) {
    struct tb_pace pace = {0};
    long long at = 0;
    for (int i = 0; i < n; i++) tb_paced(&pace, at += PERIOD, 0);
    at += PERIOD * (lost + 1);
    tb_paced(&pace, at + late, (unsigned)lost);
    return pace.steady ? pace.due_ns - (at + PERIOD) : -1;
}

static void *sleep_paced(void *found) {
    struct tb_pace pace = {.last_ns = tb_now(), .period_ns = 100 * PERIOD, .steady = true};
    pace.due_ns = tb_now() - TB_LATE; /* it is late already, and looked for now and then */
    *(int *)found = tb_doze_paced(buffer, &pace, tb_now() + INT64_C(60000000000));
    return NULL;
}

/* Whether a record that is a little late is found, and whether its writer had to ring. */
static int found_late(int *rung) {
    int found = -1;
    pthread_t sleeper;
    atomic_store(&buffer->bell, 1); /* as it was left */
    pthread_create(&sleeper, NULL, sleep_paced, &found);
    while (atomic_load(&buffer->bell)) {} /* until it looks without a bell */
    struct tb_stamp stamp = {.number = 1};
    *rung = tb_write(buffer, BYTES, &stamp, &stamp);
    if (*rung) tb_wake(&buffer->bell);
    pthread_join(sleeper, NULL);
    tb_read(buffer, BYTES, &stamp, &(uint64_t){0}, false);
    return found;
}

int main(void) {
    int rung = 0, found = -1;
    buffer = aligned_alloc(TB_ALIGN, tb_size(BYTES) + TB_ALIGN);
    memset(buffer, 0, tb_size(BYTES));
    tb_make(buffer, BYTES, 1, "", 0);
    for (int tries = 0, done = 0; tries < 50 && !done; tries++) {
        found = found_late(&rung); /* who is kept from running for 5 ms has to ring */
        done = found || !rung;
    }
    printf("{\"regular\": %lld, \"late\": %lld, \"lost\": %lld, \"pause\": %lld, "
           "\"found\": %d, \"rung\": %d}\n",
           expected(10, 0, 0), expected(10, 200000, 0), expected(10, 0, 2),
           expected(10, 50LL * PERIOD, 0), found, rung);
    return 0;
}
