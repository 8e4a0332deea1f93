/* Symmetric matrices A + A^T made of the blocks of A between pairs of images (audit/joint/matrix.py).
 *
 * All take `num` blocks (height, width) of A at rows (num, height) and columns (num, width); `size` and more is padding. */
#include "joint.h"

enum { MOST = 32, VECTORS = 2 }; /* columns of a block whose values are held apart, of so many times four vectors */

/* One vector: the block's part of it is looked up once, and what it adds to the columns is added at the end. */
INLINE void times_one(
    int64_t size, int64_t num, int64_t height, int64_t width, const int64_t *rows, const int64_t *columns, const double *blocks,
    const double *values, double *out) {
    for (int64_t k = 0; k < num; k++, rows += height, columns += width, blocks += height * width) {
        double from[MOST], to[MOST] = {0};
        for (int64_t b = 0; b < width; b++) from[b] = columns[b] < size ? values[columns[b]] : 0.0;
        for (int64_t a = 0; a < height; a++) {
            if (rows[a] >= size) continue;
            double sum = 0.0, value = values[rows[a]];
            const double *block = blocks + a * width;
            for (int64_t b = 0; b < width; b++) {
                if (columns[b] < size) sum += block[b] * from[b];
            }
            for (int64_t b = 0; b < width; b++) to[b] += block[b] * value;
            out[rows[a]] += sum;
        }
        for (int64_t b = 0; b < width; b++) {
            if (columns[b] < size) out[columns[b]] += to[b];
        }
    }
}

/* The same of up to eight of all `count` vectors. */
INLINE void times_some(
    int64_t some, int64_t size, int64_t num, int64_t height, int64_t width, const int64_t *rows, const int64_t *columns,
    const double *blocks, int64_t count, const double *values, double *out) {
    for (int64_t k = 0; k < num; k++, rows += height, columns += width, blocks += height * width) {
        wide from[MOST][VECTORS] = {{{0}}}, to[MOST][VECTORS] = {{{0}}};
        for (int64_t b = 0; b < width; b++) {
            if (columns[b] < size) memcpy(from[b], values + columns[b] * count, (size_t)some * sizeof *values);
        }
        for (int64_t a = 0; a < height; a++) {
            if (rows[a] >= size) continue;
            wide sum[VECTORS] = {{0}}, value[VECTORS] = {{0}};
            memcpy(value, values + rows[a] * count, (size_t)some * sizeof *values);
            for (int64_t b = 0; b < width; b++) {
                if (columns[b] >= size) continue;
                double x = blocks[a * width + b];
                wide factor = {x, x, x, x};
                for (int v = 0; v < VECTORS; v++) sum[v] += factor * from[b][v], to[b][v] += factor * value[v];
            }
            for (int64_t c = 0; c < some; c++) out[rows[a] * count + c] += sum[c / LANES][c % LANES];
        }
        for (int64_t b = 0; b < width; b++) {
            for (int64_t c = 0; c < some && columns[b] < size; c++) out[columns[b] * count + c] += to[b][c / LANES][c % LANES];
        }
    }
}

/* out (size, count): A + A^T times values (size, count). */
KERNEL int64_t joint_times(
    int64_t size, int64_t num, int64_t height, int64_t width, const int64_t *rows, const int64_t *columns, const double *blocks,
    int64_t count, const double *values, double *out) {
    if (width > MOST) return NEEDS_NUMPY;
    memset(out, 0, (size_t)(size * count) * sizeof *out);
    if (count == 1) times_one(size, num, height, width, rows, columns, blocks, values, out);
    for (int64_t c = 0; count > 1 && c < count; c += LANES * VECTORS) {
        int64_t some = count - c < LANES * VECTORS ? count - c : LANES * VECTORS;
        times_some(some, size, num, height, width, rows, columns, blocks, count, values + c, out + c);
    }
    return DONE;
}

/* Where the entries of a band lie: see joint_band. */
typedef struct {
    int64_t num_banded, num_border, num_blocks;
    const int64_t *number, *starts, *at, *at_below;
    double *diagonal, *below, *border;
} band_places;

/* Which block has a place; one behind the last for the border. */
INLINE int64_t block_of(const band_places *to, int64_t place) {
    return place < to->num_banded ? to->number[place] : to->num_blocks;
}

/* Add to the entries at places p and q, and q and p, one or both of them in the border. */
INLINE void add_to_border(const band_places *to, int64_t p, int64_t q, double value) {
    if (q >= to->num_banded) to->border[p * to->num_border + q - to->num_banded] += value;
    if (p >= to->num_banded) to->border[q * to->num_border + p - to->num_banded] += value;
}

/* Add values (count) at place p of block `here` and at the places of columns that are all in block `there`, and the other way
 * round; 0 where that is outside of the band. */
INLINE int add_row(
    const band_places *to, int64_t p, int64_t here, int64_t there, int64_t count, const int64_t *place, const int64_t *columns,
    const double *values, double row_scale, const double *scale) {
    int64_t apart = here - there, upper = apart < 0 ? here : there; /* the block whose columns are meant */
    int64_t first = to->starts[upper], across = to->starts[upper + 1] - first, along = apart < 0 ? to->starts[there] : to->starts[here];
    if (apart < -1 || apart > 1) return 0;
    double *out = apart ? to->below + to->at_below[upper] : to->diagonal + to->at[upper];
    for (int64_t b = 0; b < count; b++) {
        int64_t q = place[columns[b]];
        double value = values[b] * (row_scale * scale[columns[b]]);
        if (apart >= 0) out[(p - along) * across + q - first] += value;
        if (apart <= 0) out[(q - along) * across + p - first] += value;
    }
    return 1;
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
    const band_places to = {
        starts[num_blocks], size - starts[num_blocks], num_blocks, number, starts, at, at_below, diagonal, below, border};
    for (int64_t k = 0; k < num; k++, rows += height, columns += width, blocks += height * width) {
        for (int64_t b = 0, end; b < width; b = end) { /* columns of one block of the band after the other */
            end = b + 1;
            if (columns[b] >= size) continue;
            int64_t there = block_of(&to, place[columns[b]]);
            while (end < width && columns[end] < size && block_of(&to, place[columns[end]]) == there) end++;
            for (int64_t a = 0; a < height; a++) {
                if (rows[a] >= size) continue;
                int64_t p = place[rows[a]], here = block_of(&to, p);
                const double *values = blocks + a * width;
                if (here < num_blocks && there < num_blocks) {
                    if (!add_row(&to, p, here, there, end - b, place, columns + b, values + b, scale[rows[a]], scale)) return NEEDS_NUMPY;
                    continue;
                }
                for (int64_t c = b; c < end; c++) {
                    add_to_border(&to, p, place[columns[c]], values[c] * (scale[rows[a]] * scale[columns[c]]));
                }
            }
        }
    }
    return DONE;
}
