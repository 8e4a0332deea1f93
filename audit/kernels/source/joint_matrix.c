/* Symmetric matrices A + A^T made of the blocks of A between pairs of images (audit/joint/matrix.py).
 *
 * All take `num` blocks (height, width) of A at rows (num, height) and columns (num, width); `size` and more is padding. */
#include "kernel.h"

/* One line of a block: of block k its row `line` or, turned, its column. */
typedef struct {
    int32_t block, line, is_turned;
} block_line;

/* A + A^T as a sparse matrix (size, size), of `num` blocks (height, width) of A at rows (num, height) and columns (num, width);
 * `size` and more is padding. What falls on one place is added in the order of the blocks.
 *
 * starts (size + 1), indices and data (room): columns of a row ascending. Returns how many entries there are, -1 without memory,
 * -2 where they need more room. */
KERNEL int64_t joint_symmetric(
    int64_t size, int64_t num, int64_t height, int64_t width, const int64_t *rows, const int64_t *columns, const double *blocks,
    int64_t room, int64_t *starts, int32_t *indices, double *data) {
    int64_t words = size / 64 + 1, count = 0;
    int64_t *first = calloc((size_t)(size + 2), sizeof *first);
    block_line *line = malloc((size_t)(num * (height + width) + 1) * sizeof *line);
    double *sum = calloc((size_t)size + 1, sizeof *sum);
    uint64_t *is_there = calloc((size_t)words, sizeof *is_there);
    if (!first || !line || !sum || !is_there) {
        free(first), free(line), free(sum), free(is_there);
        return -1;
    }
    for (int64_t k = 0; k < num * height; k++) first[(rows[k] < size ? rows[k] : size) + 1]++;
    for (int64_t k = 0; k < num * width; k++) first[(columns[k] < size ? columns[k] : size) + 1]++;
    for (int64_t r = 0; r <= size; r++) first[r + 1] += first[r];
    for (int64_t k = 0; k < num; k++) { /* first[r] moves to the end of row r, which is where row r + 1 begins */
        for (int64_t a = 0; a < height + width; a++) {
            int64_t r = a < height ? rows[k * height + a] : columns[k * width + a - height];
            int64_t at = first[r < size ? r : size]++;
            line[at] = (block_line){(int32_t)k, (int32_t)(a < height ? a : a - height), a >= height};
        }
    }
    for (int64_t r = 0, at = 0; r < size && count >= 0; r++) {
        starts[r] = count;
        for (; at < first[r]; at++) {
            const double *block = blocks + line[at].block * height * width;
            int64_t length = line[at].is_turned ? height : width, step = line[at].is_turned ? width : 1;
            const int64_t *where = line[at].is_turned ? rows + line[at].block * height : columns + line[at].block * width;
            block += line[at].is_turned ? line[at].line : line[at].line * width;
            for (int64_t c = 0; c < length; c++) {
                if (where[c] >= size) continue;
                is_there[where[c] / 64] |= (uint64_t)1 << where[c] % 64;
                sum[where[c]] += block[c * step];
            }
        }
        for (int64_t w = 0; w < words && count >= 0; w++) {
            for (int64_t c = 64 * w; is_there[w]; c++, is_there[w] >>= 1) {
                if (!(is_there[w] & 1)) continue;
                if (count == room) {
                    count = -2;
                    break;
                }
                indices[count] = (int32_t)c, data[count++] = sum[c], sum[c] = 0.0;
            }
        }
    }
    if (count >= 0) starts[size] = count;
    free(first), free(line), free(sum), free(is_there);
    return count;
}

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
