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

/* out (num, 2, ROWS): w J^T times chosen columns of the rows, through A (3, 2) of the own observation, less w where a view is
 * that observation itself. scores (num, width): w rows^T y~.    first: row of the first own observation.    num_left: of views, with
 * those that come later. */
INLINE void crossed(
    const joint_model *m, const int32_t *view, const int32_t *own, int64_t num, int64_t num_left, int64_t first, row_block block,
    int64_t column, const double *absorbing, double *out, double *scores) {
    int64_t count = block.width - column < ROWS ? block.width - column : ROWS;
    pair_of_rows pair = {{0.0}, {0.0}};
    for (int64_t k = 0; k < num; k++, out += 2 * ROWS) {
        soon(m, view, k, num_left);
        const double *design = m->design + view[k] * 2 * m->width, *rows = rows_of(block, view[k]) + column;
        const double *a = absorbing + 6 * own[k], *jx = design + 3, *jy = design + m->width + 3, *x = rows, *y = rows + block.width;
        double w = m->weight[view[k]], itself = view[k] == first + own[k] ? w : 0.0, *score = scores + k * block.width + column;
        double left_x = w * m->left[2 * view[k]], left_y = w * m->left[2 * view[k] + 1], last[ROWS];
        /* J A (2, 2): what moving the point by A does to this view */
        double xx = w * (jx[0] * a[0] + jx[1] * a[2] + jx[2] * a[4]) - itself, xy = w * (jx[0] * a[1] + jx[1] * a[3] + jx[2] * a[5]);
        double yx = w * (jy[0] * a[0] + jy[1] * a[2] + jy[2] * a[4]), yy = w * (jy[0] * a[1] + jy[1] * a[3] + jy[2] * a[5]) - itself;
        if (count < ROWS) take_rows(x, y, count, &pair), x = pair.x, y = pair.y;
        for (int c = 0; c < ROWS; c += LANES) {
            wide of_x = LOAD(x + c), of_y = LOAD(y + c);
            STORE(out + c) = of_x * xx + of_y * yx, STORE(out + ROWS + c) = of_x * xy + of_y * yy;
            STORE((count < ROWS ? last : score) + c) = of_x * left_x + of_y * left_y;
        }
        for (int64_t c = 0; count < ROWS && c < count; c++) score[c] = last[c];
    }
}

/* Up to three columns, of x or of y, times all scalars: as many sums as there are registers. */
INLINE void subtract_scalars(int columns, const int32_t *own, int64_t num, const double *through, const double *scalar, double *out) {
    wide sum[3][SCALAR / LANES] = {{{0}}};
    for (int64_t k = 0; k < num; k++) {
        const double *f = scalar + SCALAR * own[k], *t = through + 2 * ROWS * k;
        for (int c = 0; c < columns; c++) {
            wide a = {t[c], t[c], t[c], t[c]};
            for (int v = 0; v < SCALAR / LANES; v++) sum[c][v] += a * LOAD(f + LANES * v);
        }
    }
    for (int c = 0; c < columns; c++) {
        for (int v = 0; v < SCALAR / LANES; v++) STORE(out + FIELDS * c + LANES * v) -= sum[c][v];
    }
}

/* Up to four columns times all dense fields. */
INLINE void subtract_dense(int columns, const int32_t *own, int64_t num, const double *through, const double *dense, double *out) {
    wide sum[4][DENSE / LANES] = {{{0}}};
    for (int64_t k = 0; k < num; k++) {
        const double *d = dense + 2 * DENSE * own[k], *t = through + 2 * ROWS * k;
        for (int axis = 0; axis < 2; axis++, d += DENSE, t += ROWS) {
            for (int c = 0; c < columns; c++) {
                wide a = {t[c], t[c], t[c], t[c]};
                for (int v = 0; v < DENSE / LANES; v++) sum[c][v] += a * LOAD(d + LANES * v);
            }
        }
    }
    for (int c = 0; c < columns; c++) {
        for (int v = 0; v < DENSE / LANES; v++) STORE(out + FIELDS * c + LANES * v) -= sum[c][v];
    }
}

/* out (count, FIELDS) -= sum over views of (rows x A) fields: the fields of the own observation that A leads to. */
INLINE void subtract_fields(
    const int32_t *own, int64_t num, int64_t count, const double *through, const double *scalar, const double *dense,
    double *out) {
    for (int axis = 0; axis < 2; axis++) {
        const double *t = through + ROWS * axis;
        double *o = out + SCALAR * axis;
        int64_t c = 0;
        for (; c + 3 <= count; c += 3) subtract_scalars(3, own, num, t + c, scalar, o + FIELDS * c);
        if (c + 2 == count) subtract_scalars(2, own, num, t + c, scalar, o + FIELDS * c);
        else if (c + 1 == count) subtract_scalars(1, own, num, t + c, scalar, o + FIELDS * c);
    }
    int64_t c = 0;
    for (out += 2 * SCALAR; c + 4 <= count; c += 4) subtract_dense(4, own, num, through + c, dense, out + FIELDS * c);
    for (; c + 2 <= count; c += 2) subtract_dense(2, own, num, through + c, dense, out + FIELDS * c);
    if (c < count) subtract_dense(1, own, num, through + c, dense, out + FIELDS * c);
}

enum {
    MOMENTS = 48,               /* 45 monomials of degree 0 .. 8, padded */
    OBSERVATIONS = 16, VIEWS = 32, /* so many at once: what they need fits the first cache */
};

/* Where x^a y^b stands among the moments: by degree, then by the power of y, as among the scalars. */
static inline int moment_of(int a, int b) { return (a + b) * (a + b + 1) / 2 + b; }

/* Sums of products of own fields with weights P (2, 2): half of E^T P E. Scalars times scalars are moments of the point; scalars
 * times dense fields are not summed: nothing that is tested mixes them. */
typedef struct {
    double moments[4][MOMENTS]; /* by P_xx, P_xy, P_yy, w */
    double dd[DENSE][DENSE], dense_plain[DENSE]; /* w E^T E of the dense fields: its diagonal */
} own_gram;

/* What add_gram needs of each of some observations. */
typedef struct {
    double moment[OBSERVATIONS][MOMENTS], by_p[OBSERVATIONS][2][DENSE], p[OBSERVATIONS][4];
} gram_parts;

/* Add some observations, at most OBSERVATIONS: parts->p has P_xx, P_xy, P_yy and w of each. */
INLINE void add_gram(own_gram *g, gram_parts *parts, int64_t num, const double *scalar, const double *dense) {
    for (int64_t i = 0; i < num; i++) {
        const double *f = scalar + SCALAR * i, *d = dense + 2 * DENSE * i, *p = parts->p[i];
        double *moment = parts->moment[i];
        /* degrees 5 to 8: x^4 .. x y^3 times a power of x, x^3 y .. y^4 times one of y; where these meet both say the same */
        wide left = LOAD(f + 10), right = LOAD(f + 11);
        for (int j = 0; j < SCALAR; j += LANES) STORE(moment + j) = LOAD(f + j);
        STORE(moment + 17) = right * f[2], STORE(moment + 15) = left * f[1], moment[19] = f[14] * f[1];
        STORE(moment + 24) = right * f[5], STORE(moment + 21) = left * f[3], moment[25] = f[14] * f[3];
        STORE(moment + 32) = right * f[9], STORE(moment + 28) = left * f[6], moment[32] = f[14] * f[6];
        STORE(moment + 36) = left * f[10], STORE(moment + 41) = right * f[14], moment[40] = f[14] * f[10];
        for (int j = 0; j < DENSE; j++) {
            double x = d[j], y = d[DENSE + j];
            parts->by_p[i][0][j] = p[0] * x + p[1] * y, parts->by_p[i][1][j] = p[1] * x + p[2] * y;
            g->dense_plain[j] += p[3] * (x * x + y * y);
        }
    }
    add_products(4, MOMENTS / LANES, num, parts->p[0], 4, 1, parts->moment[0], MOMENTS, g->moments[0], MOMENTS);
    for (int i = 0; i < DENSE; i += LANES) { /* at and right of the diagonal; both axes one behind the other */
        add_products(LANES, (DENSE - i) / LANES, 2 * num, dense + i, DENSE, 1, parts->by_p[0][0] + i, DENSE, g->dd[i] + i, DENSE);
    }
}

/* From the sums to (FIELDS, FIELDS) E^T (w - ..) E, at and right of the diagonal, zero between scalars and dense fields, and w E^T E
 * of the scalars, of the dense fields its diagonal. */
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
            gram[i * FIELDS + j] = g->moments[0][k];
            gram[i * FIELDS + SCALAR + j] = gram[(SCALAR + j) * FIELDS + i] = g->moments[1][k];
            gram[(SCALAR + i) * FIELDS + SCALAR + j] = g->moments[2][k];
            plain[i * SCALAR + j] = g->moments[3][k];
        }
    }
    for (int i = 0; i < DENSE; i++) {
        for (int j = 0; j < DENSE; j++) gram[(2 * SCALAR + i) * FIELDS + 2 * SCALAR + j] = g->dd[i][j];
        dense_plain[i] = g->dense_plain[i];
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
        for (int b = a < 2 * SCALAR ? 0 : 2 * SCALAR; b < (a < 2 * SCALAR ? 2 * SCALAR : FIELDS); b++) {
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

/* An image and its fields, see joint_first. */
typedef struct {
    int64_t first; /* of its rows */
    const double *scalar, *dense;
    const int32_t *track;
    double *absorbing, *track_score;
} own_fields;

/* The rows of an image around: of its design, and of its included fields. */
static inline void rows_of_image(const joint_model *m, int64_t image, row_block *out) {
    int has_fields = m->extra_first[image] >= 0;
    out[0] = (row_block){m->design, 0, m->width};
    out[1] = (row_block){NULL, m->offsets[image], 0};
    if (has_fields) out[1].base = m->extra + m->extra_first[image], out[1].width = m->extra_width[image];
}

/* What the own observations are by themselves: V^-1 J^T, Gram sums, scores. */
INLINE void add_own(const joint_model *m, const own_fields *o, int64_t n, own_gram *sums) {
    gram_parts parts ALIGNED = {0};
    for (int64_t from = 0; from < n; from += OBSERVATIONS) {
        int64_t count = n - from < OBSERVATIONS ? n - from : OBSERVATIONS;
        for (int64_t i = from; i < from + count; i++) {
            int64_t row = o->first + i;
            const double *jx = m->design + row * 2 * m->width + 3, *jy = jx + m->width;
            double w = m->weight[row], *a = o->absorbing + 6 * i, *p = parts.p[i - from];
            if (i + AHEAD < n) {
                const double *later = m->point_inverse + 9 * m->point_idx[row + AHEAD];
                SOON(later), SOON(later + 8);
            }
            absorb(m, row, a);
            p[0] = w - w * (jx[0] * a[0] + jx[1] * a[2] + jx[2] * a[4]);
            p[1] = -w * (jx[0] * a[1] + jx[1] * a[3] + jx[2] * a[5]);
            p[2] = w - w * (jy[0] * a[1] + jy[1] * a[3] + jy[2] * a[5]);
            p[3] = w;
            double *score = o->track_score + FIELDS * (o->track[i] < 0 ? -1 - o->track[i] : o->track[i]);
            if (o->track[i] >= 0) memset(score, 0, FIELDS * sizeof *score);
            add_along(score, o->scalar + SCALAR * i, o->dense + 2 * DENSE * i, w * m->left[2 * row], w * m->left[2 * row + 1]);
        }
        add_gram(sums, &parts, count, o->scalar + SCALAR * from, o->dense + 2 * DENSE * from);
    }
}

/* gram less what own observations that show the same point have together: views of the image itself. */
static void subtract_pairs(
    const joint_model *m, const own_fields *o, const int32_t *view, const int32_t *own, int64_t num, double *gram) {
    for (int64_t j = 0; j < num; j++) {
        int64_t i = view[j] - o->first, l = own[j];
        if (i >= l) continue;
        const double *jx = m->design + view[j] * 2 * m->width + 3, *jy = jx + m->width, *a = o->absorbing + 6 * l;
        double w = m->weight[view[j]], p[4];
        p[0] = w * (jx[0] * a[0] + jx[1] * a[2] + jx[2] * a[4]), p[1] = w * (jx[0] * a[1] + jx[1] * a[3] + jx[2] * a[5]);
        p[2] = w * (jy[0] * a[0] + jy[1] * a[2] + jy[2] * a[4]), p[3] = w * (jy[0] * a[1] + jy[1] * a[3] + jy[2] * a[5]);
        const double *fi = o->scalar + SCALAR * i, *di = o->dense + 2 * DENSE * i;
        subtract_pair(gram, fi, di, o->scalar + SCALAR * l, o->dense + 2 * DENSE * l, p);
    }
}

/* What an image's candidate fields are to the base, before S^+ (first half of candidate_scores).
 *
 * scalar (n_i, SCALAR), dense (n_i, 2, DENSE): its fields: SCALAR functions in x, the same in y, DENSE with both.
 * track (n_i): which of its distinct points t a row shows; -1 - t where another row shows it first; num_tracks of them.
 * place (num_images): zeros, and zeros again afterwards.
 * Out: view (v), own (v), image (m), start (m + 1): see surroundings; num (2): m and rows of right.
 * absorbing (n_i, 3, 2).    right (rows, FIELDS): N^T E - W V^-1 J^T E without T, by image around: its design's columns,
 * then its included fields.    gram (FIELDS, FIELDS), at and right of the diagonal.    plain (SCALAR, SCALAR), dense_plain (DENSE):
 * E^T w E, its diagonal. score (FIELDS): E^T y~.    track_score (num_tracks, FIELDS): the same by track.
 * scores (max_scores): w rows^T y~ of all views, by image around: those of the design, then those of its included fields. */
int64_t joint_first(
    const joint_model *m, int64_t *place, int64_t image, const double *scalar, const double *dense, const int32_t *track,
    int64_t num_tracks, int64_t max_rows, int32_t *view, int32_t *own, int64_t *around, int64_t *start,
    int64_t *num, double *absorbing, double *right, double *gram, double *plain, double *dense_plain, double *score,
    double *track_score, double *scores, int64_t max_scores) {
    int64_t first = m->offsets[image], n = m->offsets[image + 1] - first, rows = 0, used = 0;
    own_fields o = {first, scalar, dense, track, absorbing, track_score};
    surroundings near = {view, own, around, start, 0, 0};
    collect(m, first, first + n, 0, place, &near);
    num[0] = near.num_images;
    for (int64_t k = 0; k < near.num_images; k++) {
        row_block blocks[2];
        rows_of_image(m, around[k], blocks);
        rows += blocks[0].width + blocks[1].width, used += (start[k + 1] - start[k]) * (blocks[0].width + blocks[1].width);
    }
    num[1] = rows;
    if (rows > max_rows || used > max_scores) return NEEDS_NUMPY;
    own_gram sums ALIGNED = {0};
    add_own(m, &o, n, &sums);
    memset(score, 0, FIELDS * sizeof *score);
    for (int64_t t = 0; t < num_tracks; t++) {
        for (int c = 0; c < FIELDS; c++) score[c] += track_score[t * FIELDS + c];
    }
    spread_gram(&sums, gram, plain, dense_plain);
    memset(right, 0, (size_t)(rows * FIELDS) * sizeof *right);
    for (int64_t k = 0; k < near.num_images; k++) {
        int64_t begin = start[k], count = start[k + 1] - begin;
        row_block blocks[2];
        rows_of_image(m, around[k], blocks);
        for (int b = 0; b < 2; b++) {
            int64_t width = blocks[b].width;
            for (int64_t column = 0; column < width; column += ROWS) {
                int64_t num_columns = width - column < ROWS ? width - column : ROWS;
                for (int64_t v = 0; v < count; v += VIEWS) {
                    int64_t here = begin + v, num_views = count - v < VIEWS ? count - v : VIEWS;
                    double through[VIEWS * 2 * ROWS] ALIGNED;
                    crossed(
                        m, view + here, own + here, num_views, near.num_views - here, first, blocks[b], column, absorbing, through,
                        scores + v * width);
                    subtract_fields(own + here, num_views, num_columns, through, scalar, dense, right + column * FIELDS);
                }
            }
            scores += count * width, right += width * FIELDS;
        }
        if (around[k] == image) subtract_pairs(m, &o, view + begin, own + begin, count, gram);
    }
    return DONE;
}

/* Some vectors of up to four views, from number v on: see subtract_scores. */
INLINE void subtract_some(
    int rows, int vectors, double *const *to, int v, int64_t width, const double *scores, const double *moved) {
    wide sum[4][3];
    for (int i = 0; i < rows; i++) {
        for (int u = 0; u < vectors; u++) sum[i][u] = LOAD(to[i] + v + LANES * u);
    }
    for (int64_t c = 0; c < width; c++) {
        for (int i = 0; i < rows; i++) {
            double x = scores[i * width + c];
            wide h = {x, x, x, x};
            for (int u = 0; u < vectors; u++) sum[i][u] -= h * LOAD(moved + c * FIELDS + v + LANES * u);
        }
    }
    for (int i = 0; i < rows; i++) {
        for (int u = 0; u < vectors; u++) STORE(to[i] + v + LANES * u) = sum[i][u];
    }
}

/* to (FIELDS) of each of up to four views -= its scores (width) times moved (width, FIELDS). */
INLINE void subtract_scores(double *const *to, int64_t count, int64_t width, const double *scores, const double *moved) {
    if (count == 4) {
        for (int v = 0; v < 9 * LANES; v += 3 * LANES) subtract_some(4, 3, to, v, width, scores, moved);
        subtract_some(4, 2, to, 9 * LANES, width, scores, moved);
    } else {
        for (int64_t i = 0; i < count; i++) {
            for (int v = 0; v < FIELDS; v += LANES) subtract_some(1, 1, to + i, v, width, scores + i * width, moved);
        }
    }
}

/* The scores of the tracks minus what the base does with them (second half of candidate_scores), in place.
 *
 * moved (rows, FIELDS): T B of each image around, in the order of joint_first's right.    track, scores: of joint_first. */
int64_t joint_second(
    const joint_model *m, int64_t num_around, const int32_t *own, const int64_t *around, const int64_t *start,
    const int32_t *track, const double *scores, const double *moved, double *track_score) {
    double unused[FIELDS] ALIGNED = {0.0}; /* where a track had this view already */
    for (int64_t k = 0; k < num_around; k++) {
        int64_t widths[2] = {m->width, m->extra_first[around[k]] >= 0 ? m->extra_width[around[k]] : 0};
        for (int b = 0; b < 2; b++) {
            int64_t width = widths[b];
            for (int64_t j = start[k]; width && j < start[k + 1];) {
                double *to[4];
                int64_t count = start[k + 1] - j < 4 ? start[k + 1] - j : 4;
                for (int64_t i = 0; i < count; i++) {
                    if (i && own[j + i] == own[j + i - 1]) count = i; /* the same track: after those before it */
                    else to[i] = track[own[j + i]] < 0 ? unused : track_score + FIELDS * track[own[j + i]];
                }
                subtract_scores(to, count, width, scores, moved);
                j += count, scores += count * width;
            }
            moved += width * FIELDS;
        }
    }
    return DONE;
}

/* steps (P, 3): V^-1 J^T w values (n, 2); J steps is taken off the values. */
KERNEL int64_t joint_off_points(
    const joint_model *m, const double *weight, const double *inverse, int64_t num_points, double *values, double *steps) {
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
        for (int64_t k = m->point_offsets[p]; k < m->point_offsets[p + 1]; k++) {
            int64_t row = m->by_point[k];
            const double *jx = m->design + row * 2 * m->width + 3, *jy = jx + m->width;
            values[2 * row] -= jx[0] * s[0] + jx[1] * s[1] + jx[2] * s[2];
            values[2 * row + 1] -= jy[0] * s[0] + jy[1] * s[1] + jy[2] * s[2];
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
int64_t joint_fields(
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
