/* Rights that a task's process gives up: a module must not take the machine along.
 *
 * A filter of the kernel (seccomp) refuses calls that change a priority or a core, and
 * signals to the processes that the task depends on. The node's own calls pass: the
 * kernel ignores the upper half of a process id, and the filter does not. This stops
 * mistakes; what stops malice is the loss of the capabilities and of the priority limit.
 */
#ifndef PBONET_RESTRICT_H
#define PBONET_RESTRICT_H

#include "sys.h"

#include <errno.h>
#include <linux/audit.h>
#include <linux/capability.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "layout.h"

#if defined(__x86_64__)
#define RT_AUDIT_ARCH AUDIT_ARCH_X86_64
#elif defined(__aarch64__)
#define RT_AUDIT_ARCH AUDIT_ARCH_AARCH64
#elif defined(__riscv) && __riscv_xlen == 64
#define RT_AUDIT_ARCH AUDIT_ARCH_RISCV64
#endif

enum { RT_GUARDED = 8, RT_FILTER = 64 };  /* processes named at most; instructions */

struct rt_filter {
    struct sock_filter code[RT_FILTER];
    unsigned short length;
};

static inline void rt_filter_add(struct rt_filter *f, unsigned short op, uint32_t k,
                                 unsigned char yes, unsigned char no)
{
    f->code[f->length++] = (struct sock_filter)BPF_JUMP(op, k, yes, no);
}

static inline void rt_filter_load(struct rt_filter *f, size_t offset)
{
    rt_filter_add(f, BPF_LD | BPF_W | BPF_ABS, (uint32_t)offset, 0, 0);
}

static inline void rt_filter_equal(struct rt_filter *f, uint32_t k, unsigned char yes,
                                   unsigned char no)
{
    rt_filter_add(f, BPF_JMP | BPF_JEQ | BPF_K, k, yes, no);
}

static inline void rt_filter_return(struct rt_filter *f, uint32_t what)
{
    rt_filter_add(f, BPF_RET | BPF_K, what, 0, 0);
}

/* Little-endian halves of the first argument; all supported machines are. */
#define RT_ARG0_LOW offsetof(struct seccomp_data, args[0])
#define RT_ARG0_HIGH (offsetof(struct seccomp_data, args[0]) + 4)
#define RT_ARG1_LOW offsetof(struct seccomp_data, args[1])

/* Refuse `calls` unless the first argument has the node's own upper half. */
static inline void rt_filter_own(struct rt_filter *f, const uint32_t *calls, size_t n)
{
    for (size_t i = 0; i < n; i++)
        rt_filter_equal(f, calls[i], (unsigned char)(n - 1 - i), i == n - 1 ? 4 : 0);
    rt_filter_load(f, RT_ARG0_HIGH);
    rt_filter_equal(f, RT_OWN_CALL, 0, 1);
    rt_filter_return(f, SECCOMP_RET_ALLOW);
    rt_filter_return(f, SECCOMP_RET_ERRNO | EPERM);
}

/* Refuse `calls` that send a signal to one of `pids`; 0 only asks whether it is there. */
static inline void rt_filter_signals(struct rt_filter *f, const uint32_t *calls, size_t n,
                                     const int32_t *pids, size_t count, size_t signal)
{
    unsigned char body = (unsigned char)(count + 5);
    for (size_t i = 0; i < n; i++)
        rt_filter_equal(f, calls[i], (unsigned char)(n - 1 - i), i == n - 1 ? body : 0);
    rt_filter_load(f, signal);
    rt_filter_equal(f, 0, (unsigned char)(count + 1), 0);
    rt_filter_load(f, RT_ARG0_LOW);
    for (size_t i = 0; i < count; i++)
        rt_filter_equal(f, (uint32_t)pids[i], (unsigned char)(count - i), 0);
    rt_filter_return(f, SECCOMP_RET_ALLOW);
    rt_filter_return(f, SECCOMP_RET_ERRNO | EPERM);
}

/* Restrict this thread, and those that it starts; an errno value where that is refused.
 * `pids` are the processes that the task must not send signals to. */
static inline int rt_restrict(const int32_t *pids, size_t count)
{
#ifdef RT_AUDIT_ARCH
    static const uint32_t levels[] = {SYS_sched_setscheduler, SYS_sched_setparam,
                                      SYS_sched_setattr, SYS_sched_setaffinity};
    static const uint32_t to_process[] = {SYS_kill, SYS_tkill, SYS_rt_sigqueueinfo};
    static const uint32_t to_thread[] = {SYS_tgkill, SYS_rt_tgsigqueueinfo};
    struct rt_filter f = {.length = 0};
    if (count > RT_GUARDED)
        return EINVAL;
    rt_filter_load(&f, offsetof(struct seccomp_data, arch));
    rt_filter_equal(&f, RT_AUDIT_ARCH, 1, 0);
    rt_filter_return(&f, SECCOMP_RET_ALLOW);
    rt_filter_load(&f, offsetof(struct seccomp_data, nr));
    rt_filter_own(&f, levels, 4);
    rt_filter_signals(&f, to_process, 3, pids, count, RT_ARG1_LOW);
    rt_filter_signals(&f, to_thread, 2, pids, count,
                      offsetof(struct seccomp_data, args[2]));
    rt_filter_return(&f, SECCOMP_RET_ALLOW);
    struct sock_fprog program = {.len = f.length, .filter = f.code};
    if (prctl(PR_SET_NO_NEW_PRIVS, 1UL, 0UL, 0UL, 0UL))
        return errno;
    if (syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_SPEC_ALLOW,
                &program))
        return errno;
    return 0;
#else
    (void)pids, (void)count;
    return ENOSYS;
#endif
}

static inline int rt_has_capability(int which)
{
    struct __user_cap_header_struct head = {_LINUX_CAPABILITY_VERSION_3, 0};
    struct __user_cap_data_struct data[2];
    if (syscall(SYS_capget, &head, data))
        return 0;
    return data[which / 32].effective >> (which % 32) & 1;
}

/* Limit the priorities that this process may request to that of commands; false if the
 * limit must stay. It applies to the dispatcher too where that has no capability, and
 * only CAP_SYS_RESOURCE raises one that is lower. */
static inline int rt_limit_priority(void)
{
    struct rlimit limit = {RT_COMMAND_LEVEL, RT_COMMAND_LEVEL};
    return rt_has_capability(CAP_SYS_NICE) && !setrlimit(RLIMIT_RTPRIO, &limit);
}

/* Give up the capabilities that reach beyond a module's own devices and files, and
 * priorities above that of commands; an errno value if the kernel refuses. */
static inline int rt_drop_rights(void)
{
    static const int dropped[] = {
        CAP_KILL,       CAP_SETGID,   CAP_SETUID,     CAP_SETPCAP,      CAP_SYS_MODULE,
        CAP_SYS_PTRACE, CAP_SYS_ADMIN, CAP_SYS_BOOT,  CAP_SYS_NICE,     CAP_SYS_RESOURCE,
        CAP_SYS_TIME,   CAP_MAC_ADMIN, 38 /* perfmon */, 39 /* bpf */,
    };
    struct __user_cap_header_struct head = {_LINUX_CAPABILITY_VERSION_3, 0};
    struct __user_cap_data_struct data[2];
    int limited = rt_limit_priority();
    if (syscall(SYS_capget, &head, data))
        return errno;
    for (size_t i = 0; i < sizeof dropped / sizeof *dropped; i++) {
        if (dropped[i] == CAP_SYS_NICE && !limited)
            continue;
        uint32_t bit = UINT32_C(1) << (dropped[i] % 32);
        struct __user_cap_data_struct *one = &data[dropped[i] / 32];
        prctl(PR_CAPBSET_DROP, (unsigned long)dropped[i], 0UL, 0UL, 0UL);
        one->effective &= ~bit;
        one->permitted &= ~bit;
        one->inheritable &= ~bit;
    }
    return syscall(SYS_capset, &head, data) ? errno : 0;
}

#endif
