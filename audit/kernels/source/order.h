/* Least, largest and any other of numbers by their order. */
#ifndef SFM_AUDIT_ORDER_H
#define SFM_AUDIT_ORDER_H

#include "lanes.h"

INLINE Lanes lesser(Lanes a, Lanes b) { return choose(a < b, a, b); }
INLINE LaneBits rows_below(int64_t k, int64_t m) { return (LaneBits){k, k + 1, k + 2, k + 3} < m; }
INLINE Lanes greater(Lanes a, Lanes b) { return choose(a > b, a, b); }

/* Least and largest of n numbers. */
INLINE void ends_of(int64_t n, const double *x, double *least, double *most)
{
    *least = *most = x[n - 1];
    Lanes low = all(*least), high = low;
    int64_t k = 0;
    for (; k + LANES <= n; k += LANES) {
        low = lesser(load(x + k), low);
        high = greater(load(x + k), high);
    }
    for (; k < n; k++) {
        low = lesser(all(x[k]), low);
        high = greater(all(x[k]), high);
    }
    for (int l = 0; l < LANES; l++) {
        *least = low[l] < *least ? low[l] : *least;
        *most = high[l] > *most ? high[l] : *most;
    }
}

INLINE int64_t bits_of(double x)
{
    int64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

/* k-th smallest (from 0) of n numbers that are not negative: their bits are in their order, and 8 are settled at once. */
INLINE double order_statistic(int64_t n, const double *x, int64_t rank, double *spare)
{
    int64_t left = n;
    for (int64_t i = 0; i < n; i++)
        spare[i] = x[i] + 0.0; /* -0 has other bits than 0 */
    for (;;) {
        double least, most;
        int32_t count[257] = {0};
        ends_of(left, spare, &least, &most);
        if (least == most)
            return least;
        const int64_t low = bits_of(least), range = bits_of(most) - low;
        const int shift = range > 255 ? 56 - __builtin_clzll((uint64_t)range) : 0;
        int64_t kept = 0, bucket = 0;
        for (int64_t i = 0; i < left; i++)
            count[(bits_of(spare[i]) - low) >> shift]++;
        for (; rank >= count[bucket]; bucket++)
            rank -= count[bucket];
        for (int64_t i = 0; i < left; i++) {
            const double value = spare[i];
            spare[kept] = value;
            kept += (bits_of(value) - low) >> shift == bucket;
        }
        left = kept;
    }
}

/* Linear interpolation between order statistics, as numpy.quantile. */
INLINE double quantile(int64_t n, const double *x, double q, double *spare)
{
    const double position = q * (double)(n - 1);
    const int64_t rank = (int64_t)position;
    const double own = order_statistic(n, x, rank, spare);
    LaneBits above = {0};
    Lanes next = all(DBL_MAX);
    for (int64_t k = 0; k < n; k += LANES) {
        const Lanes v = load(x + k);
        const LaneBits yes = (v > own) & rows_below(k, n);
        above += yes;
        next = lesser(choose(yes, v, next), next);
    }
    double following = own;
    if (n + total(above) <= rank + 1 && rank + 1 < n) { /* yes is -1 */
        following = next[0];
        for (int l = 1; l < LANES; l++)
            following = next[l] < following ? next[l] : following;
    }
    return own + (position - (double)rank) * (following - own);
}

#endif
