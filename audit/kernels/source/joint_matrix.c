/* Symmetric matrices A + A^T made of the blocks of A between pairs of images (audit/joint/matrix.py).
 *
 * All take `num` blocks (height, width) of A at rows (num, height) and columns (num, width); `size` and more is padding. */
#include "kernel.h"

/* out (size, count): A + A^T times values (size, count). */
KERNEL int64_t joint_times(
    int64_t size, int64_t num, int64_t height, int64_t width, const int64_t *rows, const int64_t *columns, const double *blocks,
    int64_t count, const double *values, double *out) {
    memset(out, 0, (size_t)(size * count) * sizeof *out);
    for (int64_t k = 0; k < num * height; k++) {
        const int64_t *where = columns + k / height * width, r = rows[k];
        for (int64_t b = 0; r < size && b < width; b++) {
            if (where[b] >= size) continue;
            double value = blocks[k * width + b], *one = out + r * count, *other = out + where[b] * count;
            for (int64_t c = 0; c < count; c++) {
                one[c] += value * values[where[b] * count + c];
                other[c] += value * values[r * count + c];
            }
        }
    }
    return DONE;
}

/* Where the entries of a band lie: see joint_band. */
typedef struct {
    int64_t num_banded, num_border;
    const int64_t *number, *starts, *at, *at_below;
    double *diagonal, *below, *border;
} band_places;

/* Add to the entry at places p (row) and q, if it is one of those that are kept; 0 where it lies outside of the band. */
INLINE int add_entry(const band_places *to, int64_t p, int64_t q, double value) {
    if (q >= to->num_banded) {
        to->border[p * to->num_border + q - to->num_banded] += value;
        return 1;
    }
    if (p >= to->num_banded) return 1;
    int64_t here = to->number[q], apart = to->number[p] - here, first = to->starts[here];
    int64_t columns = to->starts[here + 1] - first;
    if (apart == 0) to->diagonal[to->at[here] + (p - first) * columns + q - first] += value;
    else if (apart == 1) to->below[to->at_below[here] + (p - to->starts[here + 1]) * columns + q - first] += value;
    return apart >= -1 && apart <= 1;
}

/* E (A + A^T) E, E a diagonal matrix, in the order of a band (audit/joint/band.py).
 *
 * place (size): of each column; number (num_banded): which block has each place; starts (num_blocks + 1); scale (size): E.
 * at, at_below (num_blocks): where in `diagonal` the entries of each block begin, and in `below` those of the block below it; all
 * are zeros before, and border (size, num_border).    Returns NEEDS_NUMPY where an entry lies outside of the band. */
KERNEL int64_t joint_band(
    int64_t size, int64_t num, int64_t height, int64_t width, const int64_t *rows, const int64_t *columns, const double *blocks,
    const int64_t *place, const int64_t *number, const int64_t *starts, int64_t num_blocks, const int64_t *at,
    const int64_t *at_below, const double *scale, double *diagonal, double *below, double *border) {
    const band_places to = {starts[num_blocks], size - starts[num_blocks], number, starts, at, at_below, diagonal, below,
                            border};
    for (int64_t k = 0; k < num * height; k++) {
        const int64_t *where = columns + k / height * width, r = rows[k];
        for (int64_t b = 0; r < size && b < width; b++) {
            if (where[b] >= size) continue;
            double value = blocks[k * width + b] * (scale[r] * scale[where[b]]);
            int64_t p = place[r], q = place[where[b]];
            if (!add_entry(&to, p, q, value) || !add_entry(&to, q, p, value)) return NEEDS_NUMPY;
        }
    }
    return DONE;
}
