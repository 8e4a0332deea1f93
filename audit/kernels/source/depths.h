/* Depths of points before a camera, and their median. */
#ifndef SFM_AUDIT_DEPTHS_H
#define SFM_AUDIT_DEPTHS_H

#include "kernel.h"

/* Zc of a point, in the order of operations of loaders.model.moved. */
INLINE double depth_of(const double *q, double tz, const double *point)
{
    double ux = q[2] * point[2] - q[3] * point[1], uy = q[3] * point[0] - q[1] * point[2],
           uz = q[1] * point[1] - q[2] * point[0];
    ux += ux;
    uy += uy;
    uz += uz;
    return point[2] + q[0] * uz + (q[1] * uy - q[2] * ux) + tz;
}

/* The value of rank k among (n,), which are reordered: none before it is larger, none behind it smaller (Hoare). */
static inline double ranked(double *values, int64_t n, int64_t k)
{
    int64_t first = 0, last = n - 1;
    while (first < last) {
        const double a = values[first], b = values[(first + last) / 2], c = values[last];
        const double pivot = a < b ? (b < c ? b : a < c ? c : a) : (a < c ? a : b < c ? c : b);
        int64_t i = first, j = last;
        while (i <= j) {
            while (values[i] < pivot)
                i++;
            while (values[j] > pivot)
                j--;
            if (i <= j) {
                const double swapped = values[i];
                values[i++] = values[j];
                values[j--] = swapped;
            }
        }
        if (k <= j)
            last = j;
        else if (k >= i)
            first = i;
        else
            break;
    }
    return values[k];
}

/* Mean of the values of ranks lower and upper, which is lower or the next. */
static inline double middle(double *values, int64_t n, int64_t lower, int64_t upper)
{
    const double above = ranked(values, n, upper);
    double below = lower < upper ? values[0] : above;
    for (int64_t i = 1; i < upper && lower < upper; i++)
        below = values[i] > below ? values[i] : below;
    return 0.5 * (below + above);
}

enum { SAMPLE = 63, SPAN = 8, MANY = 512 };

/* Median of (n,), n > 0, which are reordered; NaN where one of them is. Of many numbers only those are put into order
 * that lie where the median of a sample lets expect it. within: (n,) room for them. */
static inline double median(double *values, int64_t n, double *within)
{
    int64_t num_odd = 0;
    for (int64_t i = 0; i < n; i++)
        num_odd += values[i] != values[i];
    if (num_odd)
        return NAN;
    const int64_t upper = n / 2, lower = (n - 1) / 2;
    if (n > MANY) {
        double sample[SAMPLE];
        for (int64_t k = 0; k < SAMPLE; k++)
            sample[k] = values[k * n / SAMPLE];
        const double high = ranked(sample, SAMPLE, SAMPLE / 2 + SPAN), low = ranked(sample, SAMPLE, SAMPLE / 2 - SPAN);
        int64_t num_below = 0, num = 0;
        for (int64_t i = 0; i < n; i++) {
            num_below += values[i] < low;
            within[num] = values[i];
            num += (values[i] >= low) & (values[i] <= high);
        }
        if (num_below <= lower && upper < num_below + num)
            return middle(within, num, lower - num_below, upper - num_below);
    }
    return middle(values, n, lower, upper);
}

#endif
