/* Median depths of the points that images see in a joint system. Twin: JointSystem.median_depths. */
#include "depths.h"

enum { AHEAD = 16 };

/* images (num): rows of the image table, whose observations are offsets[i] .. offsets[i + 1] of point_idx, rows of points, rows of
 * xyz_world. quaternions (I, 4), translations (I, 3): cam_from_world. Out: depth (num), NaN without observations. NEEDS_NUMPY: a point is not
 * among num_points. */
KERNEL int64_t joint_depths(
    int64_t num, const int64_t *images, const int64_t *offsets, const int32_t *point_idx, const int64_t *points, const double *xyz_world,
    int64_t num_points, const double *quaternions, const double *translations, double *depth) {
    int64_t most = 0;
    for (int64_t k = 0; k < num; k++) {
        int64_t n = offsets[images[k] + 1] - offsets[images[k]];
        most = n > most ? n : most;
    }
    double *z = malloc((size_t)(2 * most + 1) * sizeof *z);
    if (!z) return NO_MEMORY;
    int64_t status = DONE;
    for (int64_t k = 0; k < num && status == DONE; k++) {
        int64_t first = offsets[images[k]], n = offsets[images[k] + 1] - first;
        for (int64_t i = 0; i < n && status == DONE; i++) {
            int64_t point = points[point_idx[first + i]];
            if (i + AHEAD < n) SOON(xyz_world + 3 * points[point_idx[first + i + AHEAD]]);
            if (point < 0 || point >= num_points) status = NEEDS_NUMPY;
            else z[i] = depth_of(quaternions + 4 * images[k], translations[3 * images[k] + 2], xyz_world + 3 * point);
        }
        if (status == DONE) depth[k] = n ? median(z, n, z + most) : NAN;
    }
    free(z);
    return status;
}
