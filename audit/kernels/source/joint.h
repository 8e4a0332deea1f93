/* What joint.c, joint_normal.c, joint_scores.c and joint_common.c share: the model of the joint system. */
#ifndef SFM_AUDIT_JOINT_H
#define SFM_AUDIT_JOINT_H

#include "kernel.h"

typedef double wide __attribute__((vector_size(32), aligned(8), may_alias));

enum { LANES = 4, SCALAR = 16, DENSE = 12, FIELDS = 2 * SCALAR + DENSE, ROWS = 8, MOST_COLUMNS = 32, AHEAD = 8 };

#define ALIGNED __attribute__((aligned(64)))
#define LOAD(address) (*(const wide *)(address))
#define STORE(address) (*(wide *)(address))

/* The model as JointObservations holds it. Arrays are C-contiguous; the Python module has checked all indices. */
typedef struct {
    int64_t num_images, width;
    const int64_t *offsets, *point_offsets;
    const int32_t *image_idx, *point_idx, *by_point;
    const int32_t *image_of;     /* (n) in the order of by_point */
    const double *design;        /* (n, 2, width) */
    const double *weight;        /* (n) */
    const double *left;          /* (n, 2) */
    const double *point_inverse; /* (P, 3, 3) */
    const int64_t *extra_first;  /* (I) first number in extra, -1 without included fields */
    const int64_t *extra_width;  /* (I) */
    const double *extra;         /* per image (n_i, 2, r) */
} joint_model;

/* Where the points, and what was observed, are found. */
typedef struct {
    const double *xyz, *observed, *residuals; /* (.., 3), (.., 2), (2, num_residuals) */
    const int64_t *points, *source;           /* (P) rows of xyz, (n) columns of residuals */
    const int32_t *observation_row;           /* (num_residuals) rows of observed */
    int64_t num_residuals;
} seen_points;

/* Who sees the points of an image: views (v) by image, which row of the image's own shows the point, who they are. */
typedef struct {
    int32_t *view, *own;
    int64_t *image, *start; /* (m), (m + 1) */
    int64_t num_images, num_views;
} surroundings;

static int by_number(const void *left, const void *right) {
    int64_t a = *(const int64_t *)left, b = *(const int64_t *)right;
    return (a > b) - (a < b);
}

/* Where the views of a point by images from `from` on begin; they are in the order of the images. */
static inline int64_t view_from(const joint_model *m, int64_t point, int64_t from) {
    int64_t k = m->point_offsets[point], end = m->point_offsets[point + 1];
    while (k < end && m->image_of[k] < from) k++;
    return k;
}

/* Collect the views of the points of rows first <= row < last of an image, those of images before `from` left out. A point
 * that the image shows twice has its views twice, once for each of the rows. place: (num_images) zeros, zeros again at the
 * end. */
static inline void collect(const joint_model *m, int64_t first, int64_t last, int64_t from, int64_t *place, surroundings *out) {
    int64_t count = 0, total = 0;
    for (int64_t row = first; row < last; row++) {
        int64_t point = m->point_idx[row];
        if (row + 2 * AHEAD < last) SOON(m->point_offsets + m->point_idx[row + 2 * AHEAD]);
        if (row + AHEAD < last) SOON(m->image_of + m->point_offsets[m->point_idx[row + AHEAD]]);
        for (int64_t k = view_from(m, point, from); k < m->point_offsets[point + 1]; k++) {
            int64_t image = m->image_of[k];
            if (!place[image]++) out->image[count++] = image;
        }
    }
    qsort(out->image, (size_t)count, sizeof *out->image, by_number);
    for (int64_t k = 0; k < count; k++) {
        int64_t here = place[out->image[k]];
        out->start[k] = place[out->image[k]] = total;
        total += here;
    }
    out->start[count] = total;
    out->num_images = count, out->num_views = total;
    for (int64_t row = first; row < last; row++) {
        int64_t point = m->point_idx[row];
        for (int64_t k = view_from(m, point, from); k < m->point_offsets[point + 1]; k++) {
            int64_t at = place[m->image_of[k]]++;
            out->view[at] = m->by_point[k], out->own[at] = (int32_t)(row - first);
        }
    }
    for (int64_t k = 0; k < count; k++) place[out->image[k]] = 0;
}

/* Rows of views follow each other at random: ask for those that come soon. Always inline: a call that only asks counts as one that
 * does nothing, and gcc drops it. */
INLINE void soon(const joint_model *m, const int32_t *view, int64_t j, int64_t end) {
    if (j + AHEAD < end) {
        const double *design = m->design + view[j + AHEAD] * 2 * m->width;
        for (int64_t c = 0; c < 2 * m->width; c += 8) SOON(design + c);
        SOON(m->weight + view[j + AHEAD]), SOON(m->left + 2 * view[j + AHEAD]);
    }
}

/* Two rows of numbers, padded with zeros so that loops over them have a length that the compiler knows. */
typedef struct {
    double x[MOST_COLUMNS], y[MOST_COLUMNS];
} pair_of_rows;

/* out (rows, 4 vectors) += sum over k of left[k] (rows) times right[k] (4 vectors): at most four rows and three vectors, whose
 * sums stay in registers. Numbers of left are `across` apart, one k after the other `next`. */
INLINE void add_few_products(
    int rows, int vectors, int64_t num, const double *left, int64_t next, int64_t across, const double *right, int64_t right_next,
    double *out, int64_t out_next) {
    wide sum[4][3];
    for (int i = 0; i < rows; i++) {
        for (int v = 0; v < vectors; v++) sum[i][v] = LOAD(out + out_next * i + LANES * v);
    }
    for (int64_t k = 0; k < num; k++, left += next, right += right_next) {
        for (int i = 0; i < rows; i++) {
            double x = left[across * i];
            wide f = {x, x, x, x};
            for (int v = 0; v < vectors; v++) sum[i][v] += f * LOAD(right + LANES * v);
        }
    }
    for (int i = 0; i < rows; i++) {
        for (int v = 0; v < vectors; v++) STORE(out + out_next * i + LANES * v) = sum[i][v];
    }
}

/* The same of any number of rows and vectors. */
INLINE void add_products(
    int64_t rows, int64_t vectors, int64_t num, const double *left, int64_t next, int64_t across, const double *right,
    int64_t right_next, double *out, int64_t out_next) {
    int64_t i = 0;
    for (; i + 4 <= rows; i += 4) {
        int64_t v = 0;
        for (; v + 3 <= vectors; v += 3) {
            add_few_products(4, 3, num, left + across * i, next, across, right + LANES * v, right_next, out + out_next * i + LANES * v, out_next);
        }
        if (v + 2 == vectors) {
            add_few_products(4, 2, num, left + across * i, next, across, right + LANES * v, right_next, out + out_next * i + LANES * v, out_next);
        } else if (v + 1 == vectors) {
            add_few_products(4, 1, num, left + across * i, next, across, right + LANES * v, right_next, out + out_next * i + LANES * v, out_next);
        }
    }
    for (; i < rows; i++) {
        for (int64_t v = 0; v < vectors; v++) {
            add_few_products(1, 1, num, left + across * i, next, across, right + LANES * v, right_next, out + out_next * i + LANES * v, out_next);
        }
    }
}

INLINE void take_rows(
    const double *x, const double *y, int64_t count, pair_of_rows *out) {
    for (int64_t c = 0; c < count; c++) out->x[c] = x[c], out->y[c] = y[c];
}

/* joint_scores.c */
void joint_look_up(const joint_model *m, const seen_points *p, int64_t first, int64_t n, double *xyz, double *predicted);

/* joint.c */
int64_t joint_first(
    const joint_model *m, int64_t *place, int64_t image, const double *scalar, const double *dense, const int32_t *track,
    int64_t num_tracks, int64_t max_rows, int32_t *view, int32_t *own, int64_t *around, int64_t *start,
    int64_t *num, double *absorbing, double *right, double *gram, double *plain, double *dense_plain, double *score,
    double *track_score, double *scores, int64_t max_scores);
int64_t joint_second(
    const joint_model *m, int64_t num_around, const int32_t *own, const int64_t *around, const int64_t *start,
    const int32_t *track, const double *scores, const double *moved, double *track_score);
int64_t joint_fields(
    const joint_model *m, int64_t image, const double *facts, const double *xyz, const double *predicted, int64_t fisheye,
    int64_t power, double *scalar, double *dense);

#endif
