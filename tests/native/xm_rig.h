/* What the tests of semaphores and queues begin with. */
#ifndef PBONET_XM_RIG_H
#define PBONET_XM_RIG_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>

static inline void die(const char *what) {
    perror(what);
    abort();
}

static inline void *memory(uint64_t bytes) {
    void *at = mmap(NULL, bytes, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (at == MAP_FAILED) die("mmap");
    return at;
}

static inline uint32_t member(int m) {
    if (m < 0) die("member");
    return (uint32_t)m;
}

#endif
