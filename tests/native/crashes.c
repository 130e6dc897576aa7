/* A C extension that fails in each way in which a processor says so. */
#define _GNU_SOURCE
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>

void sigfpe(void)
{
    volatile int zero = 0, one = 1;
    one = one / zero;
    raise(SIGFPE); /* processors that do not mind */
}

void sigbus(void)
{
    FILE *file = tmpfile();
    volatile char *at = mmap(NULL, 4096, PROT_READ, MAP_PRIVATE, fileno(file), 0);
    (void)*at; /* beyond the file's end */
}

void sigill(void)
{
#ifdef __x86_64__
    __asm__ volatile("ud2");
#else
    raise(SIGILL);
#endif
}

void sigsegv(void)
{
    volatile char *volatile nowhere = NULL;
    *nowhere = 1;
}

void sigabrt(void)
{
    abort();
}
