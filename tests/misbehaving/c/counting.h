/* What the misbehaving modules in C share: y[0] counts cycles. */
#include <pbonet.h>

struct counts {
    double *y;
};

static const pbo_port ports[] = {
    PBO_OUT_VAR(struct counts, y, "Y", "2", "none", "cycles"),
};

/* Count; return whether this is the tenth cycle. */
static inline int is_tenth(void *state)
{
    struct counts *self = state;
    self->y[0] += 1.0;
    return self->y[0] == 10.0;
}

#define MISBEHAVES(DOC) \
    PBO_MODULE(struct counts, DOC, PBO_PORTS(ports), .cycle = cycle)
