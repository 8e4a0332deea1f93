/* Four numbers at a time, in the vector notation of gcc and clang, and the functions of them that libm has not. */
#ifndef SFM_AUDIT_LANES_H
#define SFM_AUDIT_LANES_H

#include "kernel.h"

#define LN2_HIGH 0.693147180369123816490 /* its last 20 bits are 0: times a whole number it is exact */
#define LN2_LOW 1.90821492927058770002e-10
#define WHOLE 6755399441055744.0 /* 1.5 * 2^52: added to a number, the last bits are its nearest whole number */

enum { LANES = 4 };
typedef double Lanes __attribute__((vector_size(LANES * sizeof(double))));
typedef int64_t LaneBits __attribute__((vector_size(LANES * sizeof(int64_t))));
#pragma GCC diagnostic ignored "-Wpsabi" /* everything that takes lanes is inlined */

INLINE Lanes load(const double *from)
{
    Lanes x;
    memcpy(&x, from, sizeof x);
    return x;
}

INLINE void store(double *to, Lanes x) { memcpy(to, &x, sizeof x); }
INLINE Lanes all(double x) { return (Lanes){x, x, x, x}; }
INLINE double sum(Lanes x) { return (x[0] + x[1]) + (x[2] + x[3]); }

INLINE int64_t total(LaneBits x) { return x[0] + x[1] + x[2] + x[3]; }

/* Where yes (all bits) a, elsewhere b. */
INLINE Lanes choose(LaneBits yes, Lanes a, Lanes b)
{
    return (Lanes)((yes & (LaneBits)a) | (~yes & (LaneBits)b));
}

INLINE void transpose(Lanes c[LANES])
{
    const Lanes a = c[0], b = c[1], d = c[2], e = c[3];
    for (int i = 0; i < LANES; i++)
        c[i] = (Lanes){a[i], b[i], d[i], e[i]};
}

INLINE Lanes root(Lanes x)
{
    Lanes out;
    for (int l = 0; l < LANES; l++)
        out[l] = sqrt(x[l]);
    return out;
}

/* Of positive normal numbers: a number in [1, 2), and the exponent with its bias of 1023. */
INLINE Lanes mantissa(Lanes x) { return (Lanes)(((LaneBits)x & 0x000fffffffffffff) | 0x3ff0000000000000); }
INLINE LaneBits biased_exponent(Lanes x) { return ((LaneBits)x >> 52) & 0x7ff; }

/* ln x of normal x > 0, to 1e-13 of itself or 1e-16. */
INLINE Lanes log_of(Lanes x)
{
    Lanes m = mantissa(x);
    const LaneBits upper = m > 1.4142135623730951;
    m = choose(upper, 0.5 * m, m);
    const LaneBits e = biased_exponent(x) - upper; /* true is -1 */
    const Lanes exponent = (Lanes)(e | 0x4330000000000000) - (4503599627370496.0 + 1023.0);
    const Lanes f = (m - 1.0) / (m + 1.0), t = f * f, t2 = t * t; /* ln m = 2 (f + f^3 / 3 + f^5 / 5 ...), t < 0.0295 */
    const Lanes even = ((t2 * (1.0 / 15.0) + 1.0 / 11.0) * t2 + 1.0 / 7.0) * t2 + 1.0 / 3.0;
    const Lanes odd = ((t2 * (1.0 / 17.0) + 1.0 / 13.0) * t2 + 1.0 / 9.0) * t2 + 1.0 / 5.0;
    return exponent * LN2_HIGH + (2.0 * f + (2.0 * f * t * (even + t * odd) + exponent * LN2_LOW));
}

/* ln(1 + u), u >= 0, 1 + u finite, to 1e-13 of itself. */
INLINE Lanes log_1p(Lanes u)
{
    const Lanes x = 1.0 + u;
    return log_of(x) + choose(x < 2.0, u - (x - 1.0), all(0.0)); /* what the sum has lost; elsewhere it is nothing */
}

/* exp(x), x <= 0; 0 below -708. */
INLINE Lanes exp_of_negative(Lanes x)
{
    const LaneBits gone = x < -708.0;
    x = choose(gone, all(0.0), x);
    const Lanes shifted = x * 1.4426950408889634 + WHOLE;
    const Lanes k = shifted - WHOLE;
    const Lanes r = (x - k * LN2_HIGH) - k * LN2_LOW; /* |r| <= 0.347 */
    static const double by_factorial[] = {1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040,
                                          1.0 / 40320, 1.0 / 362880, 1.0 / 3628800, 1.0 / 39916800, 1.0 / 479001600};
    Lanes p = all(1.0 / 6227020800.0);
    for (int i = 12; i >= 0; i--)
        p = p * r + by_factorial[i];
    return choose(gone, all(0.0), (Lanes)((LaneBits)p + ((LaneBits)shifted << 52)));
}

#endif
