#include "kernel.h"

/* The hash of the sources that this library was built from: the loader refuses one that is older than they are. */
KERNEL const char *sfm_audit_sources(void) { return SFM_SOURCES; }

/* Whether this processor has what the other sources were compiled for; this one is compiled for every processor. */
KERNEL int64_t sfm_audit_runs_here(void) {
#if defined(__x86_64__)
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
    return 1;
#endif
}
