/* Does one thing to a semaphore or queue and kills itself at a given step of it.
 *
 *   xm_steps FILE p|v|wait|send|long|drop|receive|fetch|join STEP
 *
 * FILE is of the kind that the deed needs. A step lies before and behind every store that
 * others can see. Ends with 0 when the deed has fewer steps. */
#define _GNU_SOURCE 1
#include <signal.h>
#include <stdlib.h>

static long steps_left; /* 0: not counting */

static void step(void) {
    if (steps_left && --steps_left == 0) raise(SIGKILL);
}

#define PBONET_STEP(n) step()
#include "mail.h"
#include "sem.h"

#include <sys/mman.h>

#include "xm_rig.h"

static void *map(const char *path) {
    struct stat st;
    int fd = open(path, O_RDWR);
    void *base;
    if (fd < 0 || fstat(fd, &st)) die(path);
    base = mmap(NULL, (size_t)st.st_size, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (base == MAP_FAILED) die("mmap");
    return base;
}

static void on_semaphore(struct xm_sem *s, char what, long step_wanted) {
    int slot, code;
    uint32_t me = member(xm_sem_enter(s));
    steps_left = step_wanted;
    if (what == 'v') {
        xm_sem_give(s);
        return;
    }
    code = xm_sem_begin(s, me, 5, what == 'w', &slot);
    if (code == XM_AGAIN) {
        while (xm_sleep(s->o.slots + slot, XM_FOREVER)) xm_sem_patrol(s, me);
        if (xm_sem_called(s, me, slot) < XM_DIED) die("called");
    }
}

static void on_queue(struct xm_queue *q, char what, long step_wanted) {
    static uint8_t data[3000];
    struct xm_letter letter;
    uint32_t me = member(xm_queue_enter(q));
    uint32_t size = what == 'l' ? sizeof data : 100;
    memset(data, 'k', sizeof data);
    steps_left = step_wanted;
    if (what == 's' || what == 'l' || what == 'd') {
        if (xm_send(q, me, -1, data, size, 7, XM_DROP_OLDEST)) die("send");
        return;
    }
    if (xm_receive(q, me, -1, data, what == 'f' ? 0 : sizeof data, sizeof data, &letter))
        die("receive");
    if (what == 'f' && (xm_copy_out(q, letter.head, data) || xm_received(q, letter.head)))
        die("fetch");
}

int main(int argc, char **argv) {
    if (argc != 4) return 2;
    const long wanted = atol(argv[3]);
    struct xm_object *o = map(argv[1]);
    if (!strcmp(argv[2], "join")) {
        steps_left = wanted;
        member(o->kind == XM_SEM ? xm_sem_enter((struct xm_sem *)o)
                                 : xm_queue_enter((struct xm_queue *)o));
    } else if (o->kind == XM_SEM) {
        on_semaphore((struct xm_sem *)o, *argv[2], wanted);
    } else {
        on_queue((struct xm_queue *)o, *argv[2], wanted);
    }
    return 0;
}
