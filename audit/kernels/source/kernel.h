/* What every kernel shares. See docs/kernels.md for the rules that all of them keep. */
#ifndef SFM_AUDIT_KERNEL_H
#define SFM_AUDIT_KERNEL_H

#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define KERNEL __declspec(dllexport)
#else
#define KERNEL __attribute__((visibility("default")))
#endif

/* Wider registers where the processor has them. Products and sums are never fused (-ffp-contract=off) and no sum is
 * reordered by the compiler, so that both versions give the same bits. */
#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(SFM_ONE_CLONE)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

/* What a kernel returns for an image; everything but DONE sends it to the numpy path. */
enum { DONE = 0, NEEDS_NUMPY = 1, NO_MEMORY = 2 };

#endif
