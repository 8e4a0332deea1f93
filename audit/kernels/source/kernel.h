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

/* Ask for memory that is needed some steps later; at worst in vain. */
#if defined(__GNUC__)
#define SOON(address) __builtin_prefetch(address)
#else
#define SOON(address) ((void)(address))
#endif

/* What a kernel returns for an image; everything but DONE sends it to the numpy path. */
enum { DONE = 0, NEEDS_NUMPY = 1, NO_MEMORY = 2 };

#define INLINE static inline __attribute__((always_inline))

/* arctan t, t >= 0: the series about 0, pi/8 or pi/4, of 1/t where t > 1; to two units in the last place. */
INLINE double arctan(double t) {
    const double near = 0.198912367379658, far = 0.668178637919299, mid = 0.414213562373095048802; /* tan pi/16 .. */
    const int above = t > 1.0, at_end = (t < near) | (t > 1.0 / near), in_mid = (t < far) | (t > 1.0 / far);
    const double c = at_end ? 0.0 : in_mid ? mid : 1.0;
    const double angle = at_end ? 0.0 : in_mid ? M_PI / 8.0 : M_PI / 4.0;
    const double s = (above ? c * t - 1.0 : t - c) / (above ? t + c : 1.0 + c * t);
    const double q = s * s;
    double sum = 1.0 / 25.0;
    sum = 1.0 / 23.0 - q * sum;
    sum = 1.0 / 21.0 - q * sum;
    sum = 1.0 / 19.0 - q * sum;
    sum = 1.0 / 17.0 - q * sum;
    sum = 1.0 / 15.0 - q * sum;
    sum = 1.0 / 13.0 - q * sum;
    sum = 1.0 / 11.0 - q * sum;
    sum = 1.0 / 9.0 - q * sum;
    sum = 1.0 / 7.0 - q * sum;
    sum = 1.0 / 5.0 - q * sum;
    sum = 1.0 / 3.0 - q * sum;
    const double rest = s - s * q * sum;
    return above ? (M_PI / 2.0 - angle) + rest : angle + rest;
}

#endif
