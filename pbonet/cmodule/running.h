/* The method in C that runs, as the handler of timing failures sees it.
 *
 * There is one in the process. The handler adds to `failed`, then to `*must_end`.
 */
#ifndef PBONET_RUNNING_H
#define PBONET_RUNNING_H

#include <stdint.h>

struct pbo_running {
    volatile uint32_t *volatile must_end;   /* of its task; NULL: none runs */
    volatile uint32_t failed;               /* timing failures of this cycle, as bits */
};

#endif
