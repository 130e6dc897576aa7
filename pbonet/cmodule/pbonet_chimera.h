/* Names of the thesis's C interface (Stewart 1994, listings 1, A-1 and A-2), for modules that
 * are ported. What a ported module adds: the table SAMPLEPorts before SBS_MODULE(SAMPLE);
 * ANSI prototypes; and `init` returns `void *`, since a pointer does not fit into an int.
 * docs/c-modules.md has an example.
 */
#ifndef PBONET_CHIMERA_H
#define PBONET_CHIMERA_H

#include "pbonet.h"

#define I_OK PBO_OK
#define I_ERROR PBO_ERROR
#define SBS_OFF PBO_OFF
#define SBS_CONTINUE PBO_CONTINUE
#define SBS_ERROR PBO_ERROR

typedef pbo_task sbsTask_t;
typedef struct pbo_svar sbsSvar_t;
typedef struct pbo_cfg cfgInfo_t;           /* the .rmod file is read by the runtime */
typedef struct pbo_errmod errModule_t;      /* errors are reported by errInvoke below */

#define svarTranslate(table, name) pbo_data((table), (name))
#define svarTranslateValue(table, name, type) ((type *)pbo_data((table), (name)))
#define errInvoke(stask, code, text) pbo_fail((stask), (code), "%s", (text))

/* The methods of module `q`, all of which it writes. */
#define SBS_MODULE(q) \
    void *q##Init(cfgInfo_t *, q##Local_t *, sbsTask_t *); \
    int q##On(q##Local_t *, sbsTask_t *); \
    int q##Cycle(q##Local_t *, sbsTask_t *); \
    int q##Off(q##Local_t *, sbsTask_t *); \
    int q##Kill(q##Local_t *, sbsTask_t *); \
    int q##Set(q##Local_t *, sbsTask_t *); \
    int q##Get(q##Local_t *, sbsTask_t *); \
    int q##Sync(q##Local_t *, sbsTask_t *); \
    int q##Reinit(q##Local_t *, sbsTask_t *); \
    int q##Error(q##Local_t *, sbsTask_t *, errModule_t *, char *, int); \
    int q##Clear(q##Local_t *, sbsTask_t *, errModule_t *, char *, int); \
    static int q##Init_(void *s, pbo_task *t) \
    { return q##Init(NULL, s, t) ? PBO_OK : PBO_ERROR; } \
    static int q##On_(void *s, pbo_task *t) { return q##On(s, t); } \
    static int q##Cycle_(void *s, pbo_task *t) { return q##Cycle(s, t); } \
    static int q##Off_(void *s, pbo_task *t) { return q##Off(s, t); } \
    static int q##Kill_(void *s, pbo_task *t) { return q##Kill(s, t); } \
    static int q##Sync_(void *s, pbo_task *t) { return q##Sync(s, t); } \
    static int q##Reinit_(void *s, pbo_task *t) { return q##Reinit(s, t); } \
    static int q##Error_(void *s, pbo_task *t) \
    { return q##Error(s, t, NULL, (char *)t->errmsg, t->errnum); } \
    static int q##Clear_(void *s, pbo_task *t) \
    { return q##Clear(s, t, NULL, (char *)t->errmsg, t->errnum); } \
    PBO_MODULE(q##Local_t, #q, PBO_PORTS(q##Ports), .init = q##Init_, .on = q##On_, \
               .cycle = q##Cycle_, .off = q##Off_, .kill = q##Kill_, .error = q##Error_, \
               .clear = q##Clear_, .reinit = q##Reinit_, .sync = q##Sync_)

#endif
