// Preloaded (LD_PRELOAD), this library lets the processor describe itself as an older one, so that every library takes
// the code path that it would take there: numpy, OpenBLAS, PyTorch, oneDNN. OTHER_PROCESSOR=avx2 hides AVX-512
// and AMX; sse hides AVX and fused multiply-add too. Linux on x86-64, and a processor that can trap the instruction
// CPUID ("cpuid_fault" in /proc/cpuinfo). The instructions still work: what does not ask CPUID is not covered.
#define _GNU_SOURCE
#include <asm/prctl.h>
#include <cpuid.h>
#include <dlfcn.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <ucontext.h>
#include <unistd.h>

static int no_avx, trapping;
static struct sigaction other; // what the program itself wants to be done about faults
static int (*set)(int, const struct sigaction *, struct sigaction *);

static void answer(int number, siginfo_t *info, void *context) {
    greg_t *r = ((ucontext_t *)context)->uc_mcontext.gregs;
    unsigned char *code = (unsigned char *)r[REG_RIP];
    if (info->si_code != SI_KERNEL || code[0] != 0x0f || code[1] != 0xa2) { // a real fault: it occurs again, to others
        trapping = 0;
        set(number, &other, NULL);
        return;
    }
    unsigned leaf = r[REG_RAX], sub = r[REG_RCX], a, b, c, d;
    syscall(SYS_arch_prctl, ARCH_SET_CPUID, 1);
    __cpuid_count(leaf, sub, a, b, c, d);
    syscall(SYS_arch_prctl, ARCH_SET_CPUID, 0);
    if (leaf == 7 && sub == 0) {
        b &= ~(1u << 16 | 1u << 17 | 1u << 21 | 1u << 26 | 1u << 27 | 1u << 28 | 1u << 30 | 1u << 31); // AVX-512
        c &= ~(1u << 1 | 1u << 6 | 1u << 9 | 1u << 10 | 1u << 11 | 1u << 12 | 1u << 14);
        d &= ~(1u << 2 | 1u << 3 | 1u << 8 | 1u << 22 | 1u << 23 | 1u << 24 | 1u << 25); // AMX, AVX-512 FP16
        if (no_avx) b &= ~(1u << 5), c &= ~(1u << 9 | 1u << 10);
    }
    if (leaf == 7 && sub == 1) a = no_avx ? 0 : a & ~(1u << 5 | 1u << 21), d = 0;
    if (leaf == 1 && no_avx) c &= ~(1u << 12 | 1u << 28 | 1u << 29); // FMA, AVX, F16C
    r[REG_RAX] = a, r[REG_RBX] = b, r[REG_RCX] = c, r[REG_RDX] = d;
    r[REG_RIP] += 2;
}

int sigaction(int number, const struct sigaction *action, struct sigaction *old) {
    if (!set) set = dlsym(RTLD_NEXT, "sigaction");
    if (number != SIGSEGV || !trapping) return set(number, action, old);
    if (old) *old = other;
    if (action) other = *action;
    return 0;
}

__attribute__((constructor)) static void begin(void) {
    const char *kind = getenv("OTHER_PROCESSOR");
    if (!kind) return;
    no_avx = !strcmp(kind, "sse");
    struct sigaction action = {.sa_sigaction = answer, .sa_flags = SA_SIGINFO | SA_NODEFER | SA_ONSTACK};
    sigaction(SIGSEGV, &action, &other);
    trapping = 1;
    if (syscall(SYS_arch_prctl, ARCH_SET_CPUID, 0)) perror("this processor cannot trap CPUID"), exit(3);
}
