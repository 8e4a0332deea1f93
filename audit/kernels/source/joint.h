/* What joint.c, joint_scores.c and joint_common.c share: the model of the joint system. */
#ifndef SFM_AUDIT_JOINT_H
#define SFM_AUDIT_JOINT_H

#include "kernel.h"

typedef double wide __attribute__((vector_size(32), aligned(8), may_alias));

enum { LANES = 4, SCALAR = 16, DENSE = 12, FIELDS = 2 * SCALAR + DENSE, ROWS = 8, MOST_COLUMNS = 32, AHEAD = 8 };

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
    const double *other_weight;  /* (n) of the second system, see joint_normal */
    const double *left;          /* (n, 2) */
    const double *point_inverse; /* (P, 3, 3) */
    const double *other_inverse; /* (P, 3, 3) */
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
