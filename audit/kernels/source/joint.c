/* The sums of the joint system (docs/method.md sections 11 and 11b; audit/joint/normal.py and candidates.py are the numpy
 * twins). An image's points and everybody who sees them are gone through image by image, so that what is added to stays
 * in the first cache. */
#include "joint.h"

/* Rows of a view: (2, width) of its design, or of the included fields of its image. */
typedef struct {
    const double *base;
    int64_t first_row, width;
} row_block;

static inline const double *rows_of(row_block block, int64_t view) {
    return block.base + (view - block.first_row) * 2 * block.width;
}

/* out (num, 2, ROWS): w J^T times chosen columns of the rows, through A (3, 2) of the own observation.
 * scores (num, width): w rows^T y~. */
INLINE void crossed(
    const joint_model *m, const int32_t *view, const int32_t *own, int64_t num, row_block block, int64_t column,
    const double *absorbing, double *out, double *scores) {
    int64_t count = block.width - column < ROWS ? block.width - column : ROWS;
    pair_of_rows pair = {{0.0}, {0.0}};
    for (int64_t k = 0; k < num; k++, out += 2 * ROWS) {
        soon(m, view, k, num);
        if (k + AHEAD < num) SOON(m->left + 2 * view[k + AHEAD]);
        const double *design = m->design + view[k] * 2 * m->width, *rows = rows_of(block, view[k]) + column;
        const double *a = absorbing + 6 * own[k], *jx = design + 3, *jy = design + m->width + 3;
        double w = m->weight[view[k]];
        /* J A (2, 2): what moving the point by A does to this view */
        double xx = w * (jx[0] * a[0] + jx[1] * a[2] + jx[2] * a[4]), xy = w * (jx[0] * a[1] + jx[1] * a[3] + jx[2] * a[5]);
        double yx = w * (jy[0] * a[0] + jy[1] * a[2] + jy[2] * a[4]), yy = w * (jy[0] * a[1] + jy[1] * a[3] + jy[2] * a[5]);
        if (count == ROWS) take_rows(rows, rows + block.width, ROWS, &pair);
        else take_rows(rows, rows + block.width, count, &pair);
        for (int c = 0; c < ROWS; c++) out[c] = pair.x[c] * xx + pair.y[c] * yx;
        for (int c = 0; c < ROWS; c++) out[ROWS + c] = pair.x[c] * xy + pair.y[c] * yy;
        double x = w * m->left[2 * view[k]], y = w * m->left[2 * view[k] + 1], *score = scores + k * block.width + column;
        for (int64_t c = 0; c < count; c++) score[c] = pair.x[c] * x + pair.y[c] * y;
    }
}

/* out (count, FIELDS) -= sum over views of (rows x A) fields: the fields of the own observation that A leads to. Scalars for one
 * row after the other, dense fields for four rows at a time: as many sums as there are registers. */
INLINE void subtract_fields(
    const int32_t *own, int64_t num, int64_t count, const double *through, const double *scalar, const double *dense,
    double *out) {
    for (int64_t c = 0; c < count; c++) {
        wide x0 = {0}, x1 = {0}, x2 = {0}, x3 = {0}, y0 = {0}, y1 = {0}, y2 = {0}, y3 = {0};
        for (int64_t k = 0; k < num; k++) {
            const double *f = scalar + SCALAR * own[k], *t = through + 2 * ROWS * k + c;
            wide ax = {t[0], t[0], t[0], t[0]}, ay = {t[ROWS], t[ROWS], t[ROWS], t[ROWS]};
            wide f0 = LOAD(f), f1 = LOAD(f + 4), f2 = LOAD(f + 8), f3 = LOAD(f + 12);
            x0 += ax * f0, x1 += ax * f1, x2 += ax * f2, x3 += ax * f3;
            y0 += ay * f0, y1 += ay * f1, y2 += ay * f2, y3 += ay * f3;
        }
        double *o = out + FIELDS * c;
        STORE(o) -= x0, STORE(o + 4) -= x1, STORE(o + 8) -= x2, STORE(o + 12) -= x3;
        STORE(o + 16) -= y0, STORE(o + 20) -= y1, STORE(o + 24) -= y2, STORE(o + 28) -= y3;
    }
    for (int64_t c = 0; c < count; c += 2) { /* through has zeros behind the last row */
        wide d0 = {0}, d1 = {0}, d2 = {0}, e0 = {0}, e1 = {0}, e2 = {0};
        for (int64_t k = 0; k < num; k++) {
            const double *d = dense + 2 * DENSE * own[k], *t = through + 2 * ROWS * k + c;
            wide ax = {t[0], t[0], t[0], t[0]}, ay = {t[ROWS], t[ROWS], t[ROWS], t[ROWS]};
            wide bx = {t[1], t[1], t[1], t[1]}, by = {t[ROWS + 1], t[ROWS + 1], t[ROWS + 1], t[ROWS + 1]};
            wide p0 = LOAD(d), p1 = LOAD(d + 4), p2 = LOAD(d + 8);
            wide q0 = LOAD(d + DENSE), q1 = LOAD(d + DENSE + 4), q2 = LOAD(d + DENSE + 8);
            d0 += ax * p0 + ay * q0, d1 += ax * p1 + ay * q1, d2 += ax * p2 + ay * q2;
            e0 += bx * p0 + by * q0, e1 += bx * p1 + by * q1, e2 += bx * p2 + by * q2;
        }
        double *o = out + FIELDS * c + 2 * SCALAR;
        STORE(o) -= d0, STORE(o + 4) -= d1, STORE(o + 8) -= d2;
        if (c + 1 < count) STORE(o + FIELDS) -= e0, STORE(o + FIELDS + 4) -= e1, STORE(o + FIELDS + 8) -= e2;
    }
}

enum { DEGREE = 8, MOMENTS = 48 }; /* 45 monomials of degree 0 .. 8, padded */

/* Where x^a y^b stands among the moments: by degree, then by the power of y, as among the scalars. */
static inline int moment_of(int a, int b) { return (a + b) * (a + b + 1) / 2 + b; }

/* Sums of products of own fields with weights P (2, 2): half of E^T P E. Scalars times scalars are moments of the point. */
typedef struct {
    double xx[MOMENTS], xy[MOMENTS], yy[MOMENTS], plain[MOMENTS];
    double xd[SCALAR][DENSE], yd[SCALAR][DENSE], dd[DENSE][DENSE], dense_plain[DENSE][DENSE];
} own_gram;

INLINE void add_gram(
    own_gram *g, const double *f, const double *d, double w, double pxx, double pxy, double pyy) {
    double dx[DENSE], dy[DENSE], moment[MOMENTS] = {0.0};
    for (int j = 0; j < SCALAR - 1; j++) moment[j] = f[j];
    for (int degree = 5, k = 15; degree <= DEGREE; degree++, k++) {
        for (int j = 0; j < degree; j++, k++) moment[k] = moment[k - degree] * f[1];
        moment[k] = moment[k - degree - 1] * f[2];
    }
    for (int j = 0; j < MOMENTS; j++) {
        g->xx[j] += pxx * moment[j], g->xy[j] += pxy * moment[j], g->yy[j] += pyy * moment[j], g->plain[j] += w * moment[j];
    }
    for (int j = 0; j < DENSE; j++) {
        double x = d[j], y = d[DENSE + j];
        dx[j] = pxx * x + pxy * y, dy[j] = pxy * x + pyy * y;
    }
    for (int i = 0; i < SCALAR; i++) {
        for (int j = 0; j < DENSE; j++) g->xd[i][j] += f[i] * dx[j];
        for (int j = 0; j < DENSE; j++) g->yd[i][j] += f[i] * dy[j];
    }
    for (int i = 0; i < DENSE; i++) {
        double x = w * d[i], y = w * d[DENSE + i];
        for (int j = 0; j < DENSE; j++) g->dd[i][j] += d[i] * dx[j] + d[DENSE + i] * dy[j];
        for (int j = i / LANES * LANES; j < DENSE; j++) g->dense_plain[i][j] += x * d[j] + y * d[DENSE + j];
    }
}

/* From the sums to (FIELDS, FIELDS) E^T (w - ..) E, and w E^T E of the scalars and of the dense fields. */
static void spread_gram(const own_gram *g, double *gram, double *plain, double *dense_plain) {
    int power_x[SCALAR], power_y[SCALAR];
    for (int degree = 0, k = 0; degree <= 4; degree++) {
        for (int j = 0; j <= degree; j++, k++) power_x[k] = degree - j, power_y[k] = j;
    }
    memset(gram, 0, FIELDS * FIELDS * sizeof *gram);
    memset(plain, 0, SCALAR * SCALAR * sizeof *plain);
    for (int i = 0; i < SCALAR - 1; i++) {
        for (int j = 0; j < SCALAR - 1; j++) {
            int k = moment_of(power_x[i] + power_x[j], power_y[i] + power_y[j]);
            gram[i * FIELDS + j] = g->xx[k];
            gram[i * FIELDS + SCALAR + j] = gram[(SCALAR + j) * FIELDS + i] = g->xy[k];
            gram[(SCALAR + i) * FIELDS + SCALAR + j] = g->yy[k];
            plain[i * SCALAR + j] = g->plain[k];
        }
    }
    for (int i = 0; i < SCALAR; i++) {
        for (int j = 0; j < DENSE; j++) {
            gram[i * FIELDS + 2 * SCALAR + j] = gram[(2 * SCALAR + j) * FIELDS + i] = g->xd[i][j];
            gram[(SCALAR + i) * FIELDS + 2 * SCALAR + j] = gram[(2 * SCALAR + j) * FIELDS + SCALAR + i] = g->yd[i][j];
        }
    }
    for (int i = 0; i < DENSE; i++) {
        for (int j = 0; j < DENSE; j++) gram[(2 * SCALAR + i) * FIELDS + 2 * SCALAR + j] = g->dd[i][j];
        for (int j = 0; j < DENSE; j++) dense_plain[i * DENSE + j] = i < j ? g->dense_plain[i][j] : g->dense_plain[j][i];
    }
}

/* (FIELDS) vector E^T v of one observation, v (2). */
INLINE void add_along(double *out, const double *f, const double *d, double x, double y) {
    for (int i = 0; i < SCALAR; i++) out[i] += f[i] * x, out[SCALAR + i] += f[i] * y;
    for (int i = 0; i < DENSE; i++) out[2 * SCALAR + i] += d[i] * x + d[DENSE + i] * y;
}

/* Two rows of an image that show one point: the part of (J^T E)^T V^-1 (J^T E) that both have together. */
static void subtract_pair(double *gram, const double *fi, const double *di, const double *fj, const double *dj, const double *p) {
    double left[FIELDS][2], right[FIELDS][2];
    for (int side = 0; side < 2; side++) {
        const double *f = side ? fj : fi, *d = side ? dj : di;
        double(*to)[2] = side ? right : left;
        for (int c = 0; c < SCALAR; c++) to[c][0] = f[c], to[c][1] = 0.0, to[SCALAR + c][0] = 0.0, to[SCALAR + c][1] = f[c];
        for (int c = 0; c < DENSE; c++) to[2 * SCALAR + c][0] = d[c], to[2 * SCALAR + c][1] = d[DENSE + c];
    }
    for (int a = 0; a < FIELDS; a++) {
        double x = left[a][0] * p[0] + left[a][1] * p[2], y = left[a][0] * p[1] + left[a][1] * p[3];
        for (int b = 0; b < FIELDS; b++) {
            double value = x * right[b][0] + y * right[b][1];
            gram[a * FIELDS + b] -= value, gram[b * FIELDS + a] -= value;
        }
    }
}

/* w V^-1 J^T (3, 2) of an observation. */
static inline void absorb(const joint_model *m, int64_t row, double *a) {
    const double *design = m->design + row * 2 * m->width, *v = m->point_inverse + 9 * m->point_idx[row];
    double w = m->weight[row];
    for (int i = 0; i < 3; i++) {
        for (int axis = 0; axis < 2; axis++) {
            const double *j = design + axis * m->width + 3;
            a[2 * i + axis] = w * (v[3 * i] * j[0] + v[3 * i + 1] * j[1] + v[3 * i + 2] * j[2]);
        }
    }
}

/* What an image's candidate fields are to the base, before S^+ (first half of candidate_scores).
 *
 * scalar (n_i, SCALAR), dense (n_i, 2, DENSE): its fields: SCALAR functions in x, the same in y, DENSE with both.
 * track (n_i): which of its distinct points t a row shows; -1 - t where another row shows it first; num_tracks of them.
 * place (num_images): zeros, and zeros again afterwards.
 * Out: view (v), own (v), image (m), start (m + 1): see surroundings; num (2): m and rows of right.
 * absorbing (n_i, 3, 2).    right (rows, FIELDS): N^T E - W V^-1 J^T E without T, by image around: its design's columns,
 * then its included fields.    gram (FIELDS, FIELDS).    plain (SCALAR, SCALAR), dense_plain (DENSE, DENSE): E^T w E.
 * score (FIELDS): E^T y~.    track_score (num_tracks, FIELDS): the same by track.
 * scores (max_scores): w rows^T y~ of all views, by image around: those of the design, then those of its included fields. */
WIDE int64_t joint_first(
    const joint_model *m, int64_t *place, int64_t image, const double *scalar, const double *dense, const int32_t *track,
    int64_t num_tracks, int64_t max_rows, int32_t *view, int32_t *own, int64_t *around, int64_t *start,
    int64_t *num, double *absorbing, double *right, double *gram, double *plain, double *dense_plain, double *score,
    double *track_score, double *scores, int64_t max_scores) {
    int64_t first = m->offsets[image], last = m->offsets[image + 1], n = last - first;
    surroundings near = {view, own, around, start, 0, 0};
    collect(m, first, last, 0, place, &near);
    int64_t most = 1;
    for (int64_t k = 0; k < near.num_images; k++) most = start[k + 1] - start[k] > most ? start[k + 1] - start[k] : most;
    double *through = malloc((size_t)most * 2 * ROWS * sizeof *through);
    own_gram *sums = calloc(1, sizeof *sums);
    if (!through || !sums) {
        free(through), free(sums);
        return NO_MEMORY;
    }
    memset(track_score, 0, (size_t)num_tracks * FIELDS * sizeof *track_score);
    memset(score, 0, FIELDS * sizeof *score);
    for (int64_t i = 0; i < n; i++) {
        const double *f = scalar + SCALAR * i, *d = dense + 2 * DENSE * i;
        const double *jx = m->design + (first + i) * 2 * m->width + 3, *jy = jx + m->width;
        double w = m->weight[first + i], *a = absorbing + 6 * i;
        if (i + AHEAD < n) SOON(m->point_inverse + 9 * m->point_idx[first + i + AHEAD]);
        absorb(m, first + i, a);
        double pxx = w - w * (jx[0] * a[0] + jx[1] * a[2] + jx[2] * a[4]);
        double pxy = -w * (jx[0] * a[1] + jx[1] * a[3] + jx[2] * a[5]);
        double pyy = w - w * (jy[0] * a[1] + jy[1] * a[3] + jy[2] * a[5]);
        add_gram(sums, f, d, w, pxx, pxy, pyy);
        int64_t t = track[i] < 0 ? -1 - track[i] : track[i];
        add_along(track_score + FIELDS * t, f, d, w * m->left[2 * (first + i)], w * m->left[2 * (first + i) + 1]);
    }
    for (int64_t t = 0; t < num_tracks; t++) {
        for (int c = 0; c < FIELDS; c++) score[c] += track_score[t * FIELDS + c];
    }
    spread_gram(sums, gram, plain, dense_plain);
    int64_t rows = 0, used = 0, status = DONE;
    for (int64_t k = 0; k < near.num_images && status == DONE; k++) {
        int64_t other = around[k], begin = start[k], count = start[k + 1] - begin;
        row_block blocks[2] = {{m->design, 0, m->width}, {NULL, m->offsets[other], 0}};
        if (m->extra_first[other] >= 0) {
            blocks[1].base = m->extra + m->extra_first[other], blocks[1].width = m->extra_width[other];
        }
        used += count * (blocks[0].width + blocks[1].width);
        if (rows + blocks[0].width + blocks[1].width > max_rows || used > max_scores) {
            status = NEEDS_NUMPY;
            break;
        }
        for (int b = 0; b < 2; b++) {
            double *to = right + rows * FIELDS;
            memset(to, 0, (size_t)blocks[b].width * FIELDS * sizeof *to);
            for (int64_t column = 0; column < blocks[b].width; column += ROWS) {
                int64_t wide_count = blocks[b].width - column < ROWS ? blocks[b].width - column : ROWS;
                crossed(m, view + begin, own + begin, count, blocks[b], column, absorbing, through, scores);
                subtract_fields(own + begin, count, wide_count, through, scalar, dense, to + column * FIELDS);
            }
            scores += count * blocks[b].width;
            if (other == image) {
                for (int64_t i = 0; i < n; i++) {
                    const double *r = rows_of(blocks[b], first + i);
                    double w = m->weight[first + i];
                    for (int64_t c = 0; c < blocks[b].width; c++) {
                        add_along(to + c * FIELDS, scalar + SCALAR * i, dense + 2 * DENSE * i, w * r[c], w * r[blocks[b].width + c]);
                    }
                }
            }
            rows += blocks[b].width;
        }
        for (int64_t j = begin; other == image && j < start[k + 1]; j++) {
            int64_t i = view[j] - first, l = own[j]; /* another own row that shows the same point */
            if (i < l) {
                const double *jx = m->design + view[j] * 2 * m->width + 3, *jy = jx + m->width, *a = absorbing + 6 * l;
                double w = m->weight[view[j]], p[4];
                p[0] = w * (jx[0] * a[0] + jx[1] * a[2] + jx[2] * a[4]), p[1] = w * (jx[0] * a[1] + jx[1] * a[3] + jx[2] * a[5]);
                p[2] = w * (jy[0] * a[0] + jy[1] * a[2] + jy[2] * a[4]), p[3] = w * (jy[0] * a[1] + jy[1] * a[3] + jy[2] * a[5]);
                subtract_pair(gram, scalar + SCALAR * i, dense + 2 * DENSE * i, scalar + SCALAR * l, dense + 2 * DENSE * l, p);
            }
        }
    }
    num[0] = near.num_images, num[1] = rows;
    free(through), free(sums);
    return status;
}

/* The scores of the tracks minus what the base does with them (second half of candidate_scores), in place.
 *
 * moved (rows, FIELDS): T B of each image around, in the order of joint_first's right.    track, scores: of joint_first. */
WIDE int64_t joint_second(
    const joint_model *m, int64_t num_around, const int32_t *own, const int64_t *around, const int64_t *start,
    const int32_t *track, const double *scores, const double *moved, double *track_score) {
    for (int64_t k = 0; k < num_around; k++) {
        int64_t widths[2] = {m->width, m->extra_first[around[k]] >= 0 ? m->extra_width[around[k]] : 0};
        for (int b = 0; b < 2; b++) {
            int64_t width = widths[b];
            for (int64_t j = start[k]; width && j < start[k + 1]; j++, scores += width) {
                if (track[own[j]] < 0) continue; /* the track had this view already */
                double *to = track_score + FIELDS * track[own[j]];
                wide s0 = LOAD(to), s1 = LOAD(to + 4), s2 = LOAD(to + 8), s3 = LOAD(to + 12), s4 = LOAD(to + 16);
                wide s5 = LOAD(to + 20), s6 = LOAD(to + 24), s7 = LOAD(to + 28), s8 = LOAD(to + 32), s9 = LOAD(to + 36);
                wide s10 = LOAD(to + 40);
                for (int64_t c = 0; c < width; c++) {
                    const double *from = moved + c * FIELDS;
                    wide h = {scores[c], scores[c], scores[c], scores[c]};
                    s0 -= h * LOAD(from), s1 -= h * LOAD(from + 4), s2 -= h * LOAD(from + 8), s3 -= h * LOAD(from + 12);
                    s4 -= h * LOAD(from + 16), s5 -= h * LOAD(from + 20), s6 -= h * LOAD(from + 24), s7 -= h * LOAD(from + 28);
                    s8 -= h * LOAD(from + 32), s9 -= h * LOAD(from + 36), s10 -= h * LOAD(from + 40);
                }
                STORE(to) = s0, STORE(to + 4) = s1, STORE(to + 8) = s2, STORE(to + 12) = s3, STORE(to + 16) = s4;
                STORE(to + 20) = s5, STORE(to + 24) = s6, STORE(to + 28) = s7, STORE(to + 32) = s8, STORE(to + 36) = s9;
                STORE(to + 40) = s10;
            }
            moved += width * FIELDS;
        }
    }
    return DONE;
}

/* steps (P, 3): V^-1 J^T w values (n, 2); cleaned (n, 2): values minus J steps, where asked for (not NULL). */
KERNEL int64_t joint_off_points(
    const joint_model *m, const double *weight, const double *inverse, int64_t num_points, const double *values,
    double *steps, double *cleaned, int64_t with_cleaned) {
    for (int64_t p = 0; p < num_points; p++) {
        double pull[3] = {0.0, 0.0, 0.0};
        for (int64_t k = m->point_offsets[p]; k < m->point_offsets[p + 1]; k++) {
            int64_t row = m->by_point[k];
            if (k + 2 * AHEAD < m->point_offsets[num_points]) {
                int64_t later = m->by_point[k + 2 * AHEAD];
                SOON(m->design + later * 2 * m->width + 3), SOON(m->design + (later * 2 + 1) * m->width + 5);
                SOON(weight + later), SOON(values + 2 * later);
            }
            const double *jx = m->design + row * 2 * m->width + 3, *jy = jx + m->width;
            double w = weight[row];
            for (int i = 0; i < 3; i++) pull[i] += (jx[i] * values[2 * row] + jy[i] * values[2 * row + 1]) * w;
        }
        const double *v = inverse + 9 * p;
        double *s = steps + 3 * p;
        for (int i = 0; i < 3; i++) s[i] = v[3 * i] * pull[0] + v[3 * i + 1] * pull[1] + v[3 * i + 2] * pull[2];
        for (int64_t k = m->point_offsets[p]; with_cleaned && k < m->point_offsets[p + 1]; k++) {
            int64_t row = m->by_point[k];
            const double *jx = m->design + row * 2 * m->width + 3, *jy = jx + m->width;
            cleaned[2 * row] = values[2 * row] - (jx[0] * s[0] + jx[1] * s[1] + jx[2] * s[2]);
            cleaned[2 * row + 1] = values[2 * row + 1] - (jy[0] * s[0] + jy[1] * s[1] + jy[2] * s[2]);
        }
    }
    return DONE;
}

/* left (n, 2) -= N step: design times moved (I, width) = T step of each image, row by row. */
KERNEL int64_t joint_subtract_step(const joint_model *m, const double *moved, double *left) {
    for (int64_t row = 0; row < m->offsets[m->num_images]; row++) {
        const double *dx = m->design + row * 2 * m->width, *dy = dx + m->width, *s = moved + m->width * m->image_idx[row];
        double x = 0.0, y = 0.0;
        for (int64_t c = 0; c < m->width; c++) x += dx[c] * s[c], y += dy[c] * s[c];
        left[2 * row] -= x, left[2 * row + 1] -= y;
    }
    return DONE;
}

/* The fields of an image: scalar (n, SCALAR) 1, x, y, x^2, .. y^4 of the predicted point, 0; dense (n, 2, DENSE): radial,
 * tangential, derivatives in the pose times the row coordinate, the next radial term, 0 (audit/misfit/fields.py, audit/joint).
 *
 * facts: R (9), t (3) of cam_from_world, fx, fy, half width, half height, half of the larger one, height, R^-1 (9).
 * xyz (n, 3) world, predicted (n, 2) px. fisheye: u is theta (X, Y) / rho. power: of r^2 in the next term, 0 for none. */
WIDE int64_t joint_fields(
    const joint_model *m, int64_t image, const double *facts, const double *xyz, const double *predicted, int64_t fisheye,
    int64_t power, double *scalar, double *dense) {
    int64_t first = m->offsets[image], n = m->offsets[image + 1] - first;
    const double *r = facts, *t = facts + 9, *inverse = facts + 18;
    double all = 0.0; /* of everything: NaN or infinite where a field is */
    double fx = facts[12], fy = facts[13], middle_x = facts[14], middle_y = facts[15], half = facts[16], height = facts[17];
    for (int64_t i = 0; i < n; i++) {
        const double *p = xyz + 3 * i, *dx = m->design + (first + i) * 2 * m->width, *dy = dx + m->width;
        double *f = scalar + SCALAR * i, *d = dense + 2 * DENSE * i, *e = d + DENSE;
        double z = r[6] * p[0] + r[7] * p[1] + r[8] * p[2] + t[2];
        double u = (r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + t[0]) / z, v = (r[3] * p[0] + r[4] * p[1] + r[5] * p[2] + t[1]) / z;
        if (!(z >= DBL_EPSILON)) return NEEDS_NUMPY;
        if (fisheye) {
            double rho = sqrt(u * u + v * v > DBL_MIN ? u * u + v * v : DBL_MIN), gain = atan(rho) / rho;
            u *= gain, v *= gain;
        }
        double r2 = u * u + v * v, sx = fx * u, sy = fy * v, cross = 2.0 * u * v;
        double x = (predicted[2 * i] - middle_x) / half, y = (predicted[2 * i + 1] - middle_y) / half;
        double along = (predicted[2 * i + 1] - middle_y) / height, next = power ? 1.0 : 0.0;
        f[0] = 1.0, f[1] = x, f[2] = y;
        for (int degree = 2, k = 3; degree <= 4; degree++) {
            for (int j = 0; j < degree; j++, k++) f[k] = f[k - degree] * x;
            f[k] = f[k - degree - 1] * y;
            k++;
        }
        f[15] = 0.0;
        for (int64_t k = 0; k < power; k++) next *= r2;
        d[0] = sx * (r2 * r2), e[0] = sy * (r2 * r2), d[1] = d[0] * r2, e[1] = e[0] * r2;
        d[2] = fx * cross, e[2] = fy * (r2 + 2.0 * v * v), d[3] = fx * (r2 + 2.0 * u * u), e[3] = fy * cross;
        for (int c = 0; c < 3; c++) { /* in the camera's axes: along the view a long lens sees next to nothing */
            d[4 + c] = dx[c] * along, e[4 + c] = dy[c] * along;
            d[7 + c] = (dx[3] * inverse[c] + dx[4] * inverse[3 + c] + dx[5] * inverse[6 + c]) * along;
            e[7 + c] = (dy[3] * inverse[c] + dy[4] * inverse[3 + c] + dy[5] * inverse[6 + c]) * along;
        }
        d[10] = sx * next, e[10] = sy * next, d[11] = 0.0, e[11] = 0.0;
        for (int c = 0; c < 2 * DENSE; c++) all += d[c];
        all += f[10] + f[14];
    }
    return all - all == 0.0 ? DONE : NEEDS_NUMPY;
}
