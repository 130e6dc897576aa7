/* What the programs that test the dispatcher's headers have in common. */
#ifndef PBONET_TESTS_RT_RIG_H
#define PBONET_TESTS_RT_RIG_H

#include <stdint.h>
#include <stdio.h>
#include <unistd.h>

static uint64_t seed;

/* A number below n, from `seed`. */
static inline uint32_t pick(uint32_t n)
{
    seed = seed * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
    return (uint32_t)(seed >> 33) % n;
}

/* End the process, whatever its other threads do, if something does not hold. */
static inline void require(int good, const char *what)
{
    if (!good) {
        fprintf(stderr, "broken: %s\n", what);
        _exit(1);
    }
}

#endif
