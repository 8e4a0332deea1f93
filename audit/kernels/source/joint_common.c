/* Candidate fields that many images have in common, as a principal point of all of them: each a pass over the observations
 * (docs/method.md section 11; audit/joint/common_scores.py). */
#include "joint.h"

enum { COMMON = 8, HALVES = COMMON / LANES }; /* so many fields at once */

/* What follows is compiled for one half of them and for both: `halves`, and `common` fields, those that nobody asked for zero. */

/* What the fields of some images are made of. */
typedef struct {
    const double *facts; /* (num, 27) and the next two (num) as joint_fields has them; NULL: 1 along x and y, nothing else */
    const int64_t *is_fisheye, *power;
    const double *made_of; /* (FIELDS, common) */
} common_fields;

/* Room for the fields of one image after the other, and which of the functions the fields are made of. */
typedef struct {
    double *xyz, *predicted, *scalar, *dense;
    int num_scalar, num_dense, of_scalar[SCALAR], of_dense[DENSE];
} field_space;

static int has_room(const joint_model *m, const common_fields *c, int halves, field_space *out) {
    int64_t most = 1, common = LANES * halves;
    for (int64_t i = 0; i < m->num_images; i++) {
        if (m->offsets[i + 1] - m->offsets[i] > most) most = m->offsets[i + 1] - m->offsets[i];
    }
    out->xyz = calloc((size_t)(most * (3 + 2 + SCALAR + 2 * DENSE)), sizeof *out->xyz);
    if (!out->xyz) return 0;
    out->predicted = out->xyz + 3 * most, out->scalar = out->predicted + 2 * most;
    out->dense = out->scalar + SCALAR * most;
    out->num_scalar = out->num_dense = 0;
    for (int f = 0; f < SCALAR + DENSE; f++) {
        int is_used = 0;
        for (int k = 0; k < common; k++) {
            is_used |= c->made_of[common * (f < SCALAR ? f : SCALAR + f) + k] != 0.0;
            is_used |= f < SCALAR && c->made_of[common * (SCALAR + f) + k] != 0.0;
        }
        if (is_used && f < SCALAR) out->of_scalar[out->num_scalar++] = f;
        if (is_used && f >= SCALAR) out->of_dense[out->num_dense++] = f - SCALAR;
    }
    if (!c->facts) {
        for (int64_t i = 0; i < most; i++) out->scalar[SCALAR * i] = 1.0;
    }
    return 1;
}

/* The functions of the k-th of the images. */
static int64_t look_at(
    const joint_model *m, const seen_points *p, const common_fields *c, int64_t k, int64_t image, const field_space *space) {
    int64_t first = m->offsets[image], n = m->offsets[image + 1] - first;
    if (!c->facts) return DONE;
    joint_look_up(m, p, first, n, space->xyz, space->predicted);
    return joint_fields(
        m, image, c->facts + 27 * k, space->xyz, space->predicted, c->is_fisheye[k], c->power[k], space->scalar, space->dense);
}

/* x, y (common): the fields of an image's row. */
INLINE void fields_of(const common_fields *c, const field_space *space, int halves, int64_t row, wide *x, wide *y) {
    const int common = LANES * halves;
    for (int h = 0; h < halves; h++) x[h] = y[h] = (wide){0.0, 0.0, 0.0, 0.0};
    for (int k = 0; k < space->num_scalar; k++) {
        int f = space->of_scalar[k];
        double s = space->scalar[SCALAR * row + f];
        for (int h = 0; h < halves; h++) {
            x[h] += s * LOAD(c->made_of + common * f + LANES * h);
            y[h] += s * LOAD(c->made_of + common * (SCALAR + f) + LANES * h);
        }
    }
    for (int k = 0; k < space->num_dense; k++) {
        const double *d = space->dense + 2 * DENSE * row + space->of_dense[k];
        const double *of = c->made_of + common * (2 * SCALAR + space->of_dense[k]);
        for (int h = 0; h < halves; h++) x[h] += d[0] * LOAD(of + LANES * h), y[h] += d[DENSE] * LOAD(of + LANES * h);
    }
}

/* E^T w O E of the fields E (one unknown each for all images, each once) with O taking values off the points.
 *
 * Out: absorbed (P, 3, common) V^-1 J^T w E; gram (common, common); length, score (common): E^T w E, E^T w y~;
 * is_seen (P). */
INLINE int64_t gram_of(
    int halves, const joint_model *m, const seen_points *p, const common_fields *c, int64_t num_points, int64_t num, const
    int64_t *images, double *absorbed, double *gram, double *length, double *score, uint8_t *is_seen) {
    const int common = LANES * halves;
    field_space space;
    if (!has_room(m, c, halves, &space)) return NO_MEMORY;
    int64_t status = DONE;
    wide of_score[HALVES] = {{0}};
    memset(absorbed, 0, (size_t)(3 * common * num_points) * sizeof *absorbed);
    memset(gram, 0, common * common * sizeof *gram);
    memset(is_seen, 0, (size_t)num_points);
    for (int64_t k = 0; k < num && status == DONE; k++) {
        int64_t first = m->offsets[images[k]], n = m->offsets[images[k] + 1] - first;
        status = look_at(m, p, c, k, images[k], &space);
        for (int64_t i = 0; i < n && status == DONE; i++) {
            int64_t row = first + i, point = m->point_idx[row];
            const double *jx = m->design + row * 2 * m->width + 3, *jy = jx + m->width;
            double w = m->weight[row], *to = absorbed + 3 * common * point;
            wide x[HALVES], y[HALVES];
            double plain_x[COMMON], plain_y[COMMON];
            fields_of(c, &space, halves, i, x, y);
            is_seen[point] = 1;
            for (int h = 0; h < halves; h++) {
                STORE(plain_x + LANES * h) = x[h], STORE(plain_y + LANES * h) = y[h];
                x[h] *= w, y[h] *= w;
                of_score[h] += m->left[2 * row] * x[h] + m->left[2 * row + 1] * y[h];
                for (int a = 0; a < 3; a++) STORE(to + common * a + LANES * h) += jx[a] * x[h] + jy[a] * y[h];
            }
            for (int a = 0; a < common; a++) {
                for (int h = 0; h < halves; h++) STORE(gram + common * a + LANES * h) += plain_x[a] * x[h] + plain_y[a] * y[h];
            }
        }
    }
    for (int h = 0; h < halves; h++) STORE(score + LANES * h) = of_score[h];
    for (int a = 0; a < common; a++) length[a] = gram[common * a + a];
    for (int64_t point = 0; point < num_points; point++) {
        const double *v = m->point_inverse + 9 * point;
        double *at = absorbed + 3 * common * point, crossed[3 * COMMON];
        if (!is_seen[point]) continue;
        memcpy(crossed, at, (size_t)(3 * common) * sizeof *crossed);
        for (int b = 0; b < 3; b++) {
            for (int a = 0; a < common; a++) {
                const double *of = crossed + a, *u = v + 3 * b;
                at[common * b + a] = u[0] * of[0] + u[1] * of[common] + u[2] * of[2 * common];
            }
        }
        for (int a = 0; a < common; a++) {
            double *to = gram + common * a;
            for (int d = 0; d < common; d++) {
                to[d] -= crossed[a] * at[d] + crossed[common + a] * at[common + d] + crossed[2 * common + a] * at[2 * common + d];
            }
        }
    }
    free(space.xyz);
    return status;
}

KERNEL int64_t joint_common_gram(
    int64_t halves, const joint_model *m, const seen_points *p, const common_fields *c, int64_t num_points, int64_t num, const
    int64_t *images, double *absorbed, double *gram, double *length, double *score, uint8_t *is_seen) {
    return halves == 1 ? gram_of(1, m, p, c, num_points, num, images, absorbed, gram, length, score, is_seen)
                       : gram_of(2, m, p, c, num_points, num, images, absorbed, gram, length, score, is_seen);
}

/* right (I, width, common): design^T w O E, by image; is_own (I): k of an image that has the fields, else -1. */
INLINE int64_t right_of(
    int halves, const joint_model *m, const seen_points *p, const common_fields *c, const int64_t *is_own, const double
    *absorbed, double *right) {
    const int common = LANES * halves;
    field_space space;
    int64_t status = DONE, width = m->width;
    if (!has_room(m, c, halves, &space)) return NO_MEMORY;
    memset(right, 0, (size_t)(m->num_images * width * common) * sizeof *right);
    for (int64_t image = 0; image < m->num_images && status == DONE; image++) {
        int64_t first = m->offsets[image], n = m->offsets[image + 1] - first;
        double *to = right + image * width * common;
        if (is_own[image] >= 0) status = look_at(m, p, c, is_own[image], image, &space);
        for (int64_t i = 0; i < n && status == DONE; i++) {
            int64_t row = first + i;
            const double *dx = m->design + row * 2 * width, *dy = dx + width;
            const double *a = absorbed + 3 * common * m->point_idx[row];
            double w = m->weight[row];
            wide x[HALVES] = {{0}}, y[HALVES] = {{0}};
            if (is_own[image] >= 0) fields_of(c, &space, halves, i, x, y);
            for (int h = 0; h < halves; h++) {
                for (int b = 0; b < 3; b++) {
                    wide step = LOAD(a + common * b + LANES * h);
                    x[h] -= dx[3 + b] * step, y[h] -= dy[3 + b] * step;
                }
                x[h] *= w, y[h] *= w;
            }
            for (int64_t d = 0; d < width; d++) {
                for (int h = 0; h < halves; h++) STORE(to + common * d + LANES * h) += dx[d] * x[h] + dy[d] * y[h];
            }
        }
    }
    free(space.xyz);
    return status;
}

KERNEL int64_t joint_common_right(
    int64_t halves, const joint_model *m, const seen_points *p, const common_fields *c, const int64_t *is_own, const double
    *absorbed, double *right) {
    return halves == 1 ? right_of(1, m, p, c, is_own, absorbed, right)
                       : right_of(2, m, p, c, is_own, absorbed, right);
}

/* track_score (P, common): sum over a point's views of w y~^T (E - N B), with moved (I, width, common) T B of each image. */
INLINE int64_t tracks_of(
    int halves, const joint_model *m, const seen_points *p, const common_fields *c, int64_t num_points, const int64_t *is_own,
    const double *moved, double *track_score) {
    const int common = LANES * halves;
    field_space space;
    int64_t status = DONE, width = m->width;
    if (!has_room(m, c, halves, &space)) return NO_MEMORY;
    memset(track_score, 0, (size_t)(num_points * common) * sizeof *track_score);
    for (int64_t image = 0; image < m->num_images && status == DONE; image++) {
        int64_t first = m->offsets[image], n = m->offsets[image + 1] - first;
        const double *from = moved + image * width * common;
        if (is_own[image] >= 0) status = look_at(m, p, c, is_own[image], image, &space);
        for (int64_t i = 0; i < n && status == DONE; i++) {
            int64_t row = first + i;
            const double *dx = m->design + row * 2 * width, *dy = dx + width;
            double *to = track_score + common * m->point_idx[row];
            double rx = m->weight[row] * m->left[2 * row], ry = m->weight[row] * m->left[2 * row + 1];
            wide x[HALVES] = {{0}}, y[HALVES] = {{0}}, sum[HALVES];
            if (is_own[image] >= 0) fields_of(c, &space, halves, i, x, y);
            for (int h = 0; h < halves; h++) sum[h] = rx * x[h] + ry * y[h];
            for (int64_t d = 0; d < width; d++) {
                double along = rx * dx[d] + ry * dy[d];
                for (int h = 0; h < halves; h++) sum[h] -= along * LOAD(from + common * d + LANES * h);
            }
            for (int h = 0; h < halves; h++) STORE(to + LANES * h) += sum[h];
        }
    }
    free(space.xyz);
    return status;
}

KERNEL int64_t joint_common_tracks(
    int64_t halves, const joint_model *m, const seen_points *p, const common_fields *c, int64_t num_points, const int64_t
    *is_own, const double *moved, double *track_score) {
    return halves == 1 ? tracks_of(1, m, p, c, num_points, is_own, moved, track_score)
                       : tracks_of(2, m, p, c, num_points, is_own, moved, track_score);
}
