#include "order.h"

/* Reprojection errors of images, summed up (audit/engine/error_summary.py). */

enum { RMS, MEAN, MEDIAN, P95, LARGEST, SUMMARY };

/* Of n residuals (x, y); length: room for n numbers and LANES more, spare: for n. */
INLINE int sum_up(int64_t n, const double *x, const double *y, double *length, double *spare, double *out)
{
    Lanes squares = all(0.0), lengths = all(0.0);
    for (int64_t k = 0; k < n; k++)
        length[k] = x[k] * x[k] + y[k] * y[k];
    for (int64_t k = n; k < n + LANES; k++)
        length[k] = 0.0;
    for (int64_t k = 0; k < n; k += LANES) {
        const Lanes own = load(length + k), root_of = root(own);
        squares += own;
        lengths += root_of;
        store(length + k, root_of);
    }
    const double sum_of_squares = sum(squares);
    double least;
    if (!(n > 0 && sum_of_squares <= DBL_MAX)) /* only finite numbers have an order */
        return NEEDS_NUMPY;
    out[RMS] = sqrt(sum_of_squares / (double)n);
    out[MEAN] = sum(lengths) / (double)n;
    out[MEDIAN] = quantile(n, length, 0.5, spare);
    out[P95] = quantile(n, length, 0.95, spare);
    ends_of(n, length, &least, out + LARGEST);
    return DONE;
}

/* Summaries (num_images, SUMMARY) of columns offsets[i] : offsets[i + 1] of residuals (2, n). */
KERNEL int64_t error_summaries(int64_t num_images, int64_t n, const int64_t *offsets, const double *residuals,
                                    double *out, uint8_t *status)
{
    int64_t most = 0;
    for (int64_t i = 0; i < num_images; i++)
        most = offsets[i + 1] - offsets[i] > most ? offsets[i + 1] - offsets[i] : most;
    double *room = malloc((size_t)(2 * most + 2 * LANES) * sizeof *room);
    if (!room)
        return NO_MEMORY;
    for (int64_t i = 0; i < num_images; i++) {
        const double *own = residuals + offsets[i];
        const int64_t size = offsets[i + 1] - offsets[i];
        status[i] = (uint8_t)sum_up(size, own, own + n, room, room + most + LANES, out + i * SUMMARY);
    }
    free(room);
    return DONE;
}
