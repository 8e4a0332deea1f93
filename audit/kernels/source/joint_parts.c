/* What the joint system is made of (docs/method.md section 11): derivatives, the information on points, entries of an inverse. */
#include "kernel.h"

enum { TILE = 8, AHEAD = 16 };

/* V (P, 3, 3): sum of w J^T J over a point's views; jacobian (2, 3, n) and weight (n) are of all observations. Where the
 * weight is zero nothing is added, whatever the derivatives. views (P): how many have a weight above it. */
KERNEL int64_t joint_information(
    int64_t n, int64_t num_points, const double *jacobian, const double *weight, const int32_t *point_idx, double *out,
    int64_t *views) {
    memset(out, 0, (size_t)(9 * num_points) * sizeof *out);
    memset(views, 0, (size_t)num_points * sizeof *views);
    for (int64_t k = 0; k < n; k++) {
        if (k + AHEAD < n) SOON(out + 9 * point_idx[k + AHEAD]), SOON(out + 9 * point_idx[k + AHEAD] + 8);
        double w = weight[k], *v = out + 9 * point_idx[k];
        views[point_idx[k]] += w > 0.0;
        if (w == 0.0) continue;
        double x[3], y[3];
        for (int i = 0; i < 3; i++) x[i] = jacobian[i * n + k], y[i] = jacobian[(3 + i) * n + k];
        for (int i = 0; i < 3; i++) {
            for (int j = i; j < 3; j++) v[3 * i + j] += w * (x[i] * x[j] + y[i] * y[j]);
        }
    }
    for (int64_t p = 0; p < num_points; p++) {
        double *v = out + 9 * p;
        v[3] = v[1], v[6] = v[2], v[7] = v[5];
    }
    return DONE;
}

/* Determinants (P) of the matrices (P, 3, 3) scaled to unit diagonal; with invert their inverses in place, too: zero stays
 * zero. smallest: squares below it count as it. */
KERNEL int64_t joint_invert(int64_t num_points, double *matrices, double *determinant, double smallest, int64_t invert) {
    for (int64_t p = 0; p < num_points; p++) {
        double *v = matrices + 9 * p, s[3];
        for (int i = 0; i < 3; i++) s[i] = sqrt(v[4 * i] > smallest ? v[4 * i] : smallest);
        double a = v[0] / s[0] / s[0], b = v[1] / s[0] / s[1], c = v[2] / s[0] / s[2];
        double d = v[4] / s[1] / s[1], e = v[5] / s[1] / s[2], f = v[8] / s[2] / s[2];
        /* L D L^T: as many digits as V has, where cofactors would lose those of the determinant */
        double l10 = b / a, l20 = c / a, d1 = d - l10 * b, t = e - l10 * c, l21 = t / d1, d2 = f - l20 * c - l21 * t;
        int is_empty = v[0] == 0.0 && v[4] == 0.0 && v[8] == 0.0;
        determinant[p] = is_empty ? 0.0 : a * d1 * d2;
        if (!invert || is_empty) continue;
        double m20 = l10 * l21 - l20; /* below the diagonal of L^-1: -l10; m20, -l21 */
        double x22 = 1.0 / d2, x12 = -l21 * x22, x02 = m20 * x22;
        double x11 = 1.0 / d1 - l21 * x12, x01 = -l10 / d1 - l21 * x02, x00 = 1.0 / a + l10 * (l10 / d1) + m20 * x02;
        v[0] = x00 / s[0] / s[0], v[1] = v[3] = x01 / s[0] / s[1], v[2] = v[6] = x02 / s[0] / s[2];
        v[4] = x11 / s[1] / s[1], v[5] = v[7] = x12 / s[1] / s[2], v[8] = x22 / s[2] / s[2];
    }
    return DONE;
}

/* out (s, s): entries of a banded symmetric matrix at sorted places (s), from the rows of its blocks.
 *
 * first (num_blocks + 1): place where each block begins and the last one ends.    near: one block behind the other, each its
 * rows at the columns of the block and of those behind it; starts (num_blocks + 1), columns (num_blocks): where each begins, and
 * how many columns it has. */
KERNEL int64_t joint_near_entries(
    int64_t size, const int64_t *place, const int64_t *first, const double *near, const int64_t *starts, const int64_t *columns,
    int64_t num_blocks, double *out) {
    int64_t block = 0;
    for (int64_t i = 0; i < size; i++) {
        while (block < num_blocks && place[i] >= first[block + 1]) block++;
        if (place[i] < first[0] || block >= num_blocks || place[size - 1] - first[block] >= columns[block]) return NEEDS_NUMPY;
        int64_t origin = first[block];
        const double *row = near + starts[block] + (place[i] - origin) * columns[block];
        if (row + columns[block] > near + starts[block + 1]) return NEEDS_NUMPY;
        for (int64_t j = i; j < size; j++) out[i * size + j] = row[place[j] - origin];
    }
    for (int64_t i = 0; i < size; i += TILE) { /* the other half, in tiles */
        for (int64_t j = 0; j < i + TILE && j < size; j++) {
            for (int64_t k = i; k < i + TILE && k < size; k++) {
                if (k > j) out[k * size + j] = out[j * size + k];
            }
        }
    }
    return DONE;
}

/* out (s, s): entries of a symmetric matrix (size, size) at some columns (s). */
KERNEL int64_t joint_dense_entries(int64_t num, const int64_t *columns, int64_t size, const double *matrix, double *out) {
    for (int64_t i = 0; i < num; i++) {
        if (columns[i] < 0 || columns[i] >= size) return NEEDS_NUMPY;
    }
    for (int64_t i = 0; i < num; i++) {
        const double *row = matrix + columns[i] * size;
        for (int64_t j = 0; j < num; j++) out[i * num + j] = row[columns[j]];
    }
    return DONE;
}

/* The design (n, 2, width) of the chosen rows of images, one after the other: derivatives in the rotation, in the points, in the
 * own parameters; zero where an image has none.
 *
 * offsets (num + 1): where each image's rows begin.    facts (num, 25): R, its inverse, t, fx, fy, cx, cy.
 * own (num, width - 6): 0 focal length of both axes, 1 of x, 2 of y, 3 + e distortion parameter e, -1 none.
 * jacobian (2, 3, total), residuals (2, total); source (n): their columns.    first, counts, starts (num): of an image's inliers
 * the first column, their number, and where extra (e, 2, count) of them begins.    point_idx, observation_row (total): rows of
 * xyz (num_points, 3) world and observed (num_observations, 2) px. NEEDS_NUMPY: one of these leads outside. */
KERNEL int64_t joint_designs(
    int64_t num, int64_t width, int64_t total, const int64_t *offsets, const double *all_facts, const int64_t *all_own,
    const double *jacobian, const double *residuals, const int64_t *source, const int64_t *first, const int64_t *counts,
    const int64_t *starts, int64_t num_points, int64_t num_observations, const int32_t *point_idx, const int32_t *observation_row,
    const double *xyz, const double *observed, const double *extra, double *restrict out) {
    for (int64_t k = 0; k < (num ? offsets[num] : 0); k++) {
        int64_t point = point_idx[source[k]], row = observation_row[source[k]];
        if (point < 0 || point >= num_points || row < 0 || row >= num_observations) return NEEDS_NUMPY;
    }
    for (int64_t image = 0; image < num; image++) {
        const double *r = all_facts + 25 * image, *inverse = r + 9, *t = r + 18, *focal = r + 21, *centre = r + 23;
        const int64_t *own = all_own + image * (width - 6), count = counts[image];
        const double *of_image = extra + starts[image];
        for (int64_t k = offsets[image]; k < offsets[image + 1]; k++) {
            if (k + AHEAD < offsets[image + 1]) {
                int64_t later = source[k + AHEAD];
                SOON(xyz + 3 * point_idx[later]), SOON(observed + 2 * observation_row[later]), SOON(residuals + later);
                SOON(residuals + total + later);
                for (int i = 0; i < 6; i++) SOON(jacobian + i * total + later);
            }
            const double *p = xyz + 3 * point_idx[source[k]], *seen = observed + 2 * observation_row[source[k]];
            double x = r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + t[0], y = r[3] * p[0] + r[4] * p[1] + r[5] * p[2] + t[1];
            double z = r[6] * p[0] + r[7] * p[1] + r[8] * p[2] + t[2], along[2];
            for (int axis = 0; axis < 2; axis++) {
                const double *of_point = jacobian + 3 * axis * total + source[k];
                double *to = out + (2 * k + axis) * width, j[3] = {of_point[0], of_point[total], of_point[2 * total]}, cam[3];
                for (int i = 0; i < 3; i++) cam[i] = inverse[i] * j[0] + inverse[3 + i] * j[1] + inverse[6 + i] * j[2];
                to[0] = cam[2] * y - cam[1] * z, to[1] = cam[0] * z - cam[2] * x, to[2] = cam[1] * x - cam[0] * y;
                to[3] = j[0], to[4] = j[1], to[5] = j[2];
                along[axis] = (seen[axis] - residuals[axis * total + source[k]] - centre[axis]) / focal[axis];
            }
            for (int64_t c = 0; c < width - 6; c++) {
                const double *other = own[c] < 3 ? along : of_image + 2 * (own[c] - 3) * count + source[k] - first[image];
                double *to = out + 2 * k * width + 6 + c;
                to[0] = own[c] == 0 || own[c] == 1 || own[c] >= 3 ? other[0] : 0.0;
                to[width] = own[c] == 0 || own[c] == 2 || own[c] >= 3 ? other[own[c] < 3 ? 1 : count] : 0.0;
            }
        }
    }
    return DONE;
}

/* Points in the order in which the images first see them, and each image's rows in that order: what is asked for together
 * lies together.
 *
 * image_idx, point_idx (n): rows by image.    ends (num_images): where each image's rows begin, its end afterwards.
 * number (num_points): room.    Out: points (num_points): the first of them are the points that are seen; order (n): old row
 * of each new one; new_idx (n): its point's place in points; by_point (n): new rows by point, each point's in order; offsets
 * (num_points + 1): where each point's begin, for those that are seen.    Returns how many are seen, or -1. */
KERNEL int64_t joint_by_sight(
    int64_t n, int64_t num_images, int64_t num_points, const int32_t *image_idx, const int32_t *point_idx, int64_t *ends,
    int32_t *number, int64_t *points, int64_t *order, int32_t *new_idx, int32_t *by_point, int64_t *offsets) {
    int64_t count = 0;
    for (int64_t row = 0; row < n; row++) {
        if (point_idx[row] < 0 || point_idx[row] >= num_points || image_idx[row] < 0 || image_idx[row] >= num_images) return -1;
    }
    for (int64_t point = 0; point < num_points; point++) number[point] = -1;
    for (int64_t row = 0; row < n; row++) {
        int64_t point = point_idx[row];
        if (number[point] < 0) offsets[count] = 0, points[count] = point, number[point] = (int32_t)count++;
        offsets[number[point]]++;
    }
    for (int64_t k = 0, total = 0; k <= count; k++) {
        int64_t here = k < count ? offsets[k] : 0;
        offsets[k] = total, total += here;
    }
    for (int64_t row = 0; row < n; row++) by_point[offsets[number[point_idx[row]]]++] = (int32_t)row;
    for (int64_t k = count; k > 0; k--) offsets[k] = offsets[k - 1];
    offsets[0] = 0;
    for (int64_t k = 0; k < count; k++) {
        for (int64_t j = offsets[k]; j < offsets[k + 1]; j++) {
            int64_t row = by_point[j], here = ends[image_idx[row]]++;
            order[here] = row, new_idx[here] = (int32_t)k, by_point[j] = (int32_t)here;
        }
    }
    return count;
}

/* The first of all that a number hangs on, which then hangs on it. */
static int64_t first_of(int64_t *label, int64_t k) {
    int64_t root = k;
    while (label[root] != root) root = label[root];
    while (label[k] != root) {
        int64_t next = label[k];
        label[k] = root, k = next;
    }
    return root;
}

/* Which images hang together: those that see a point, and those that hung together before.
 *
 * point_offsets (num_points + 1), image_of: who sees each point.    label (num_images): an image that each hangs on, none behind
 * it; afterwards the first of all. */
KERNEL int64_t joint_components(
    int64_t num_images, int64_t num_points, const int64_t *point_offsets, const int32_t *image_of, int64_t *label) {
    for (int64_t point = 0; point < num_points; point++) {
        int64_t start = point_offsets[point], end = point_offsets[point + 1];
        for (int64_t k = start + 1; k < end; k++) {
            int64_t one = first_of(label, image_of[start]), other = first_of(label, image_of[k]);
            if (one != other) label[one > other ? one : other] = one > other ? other : one;
        }
    }
    for (int64_t image = 0; image < num_images; image++) label[image] = first_of(label, image);
    return DONE;
}

/* V (P, 3, 3) and J^T w y (P, 3) with two weights at once, of the design's columns.
 *
 * weight (n), values (n, 2) y, point_idx (n); plain (num_images): the second weight, of all rows of an image. */
KERNEL int64_t joint_two_informations(
    int64_t num_images, int64_t width, int64_t num_points, const int64_t *offsets, const double *design, const double *weight,
    const double *plain, const double *values, const int32_t *point_idx, double *out, double *other, double *pull,
    double *other_pull) {
    int64_t n = offsets[num_images];
    for (int64_t row = 0; row < n; row++) {
        if (point_idx[row] < 0 || point_idx[row] >= num_points) return NEEDS_NUMPY;
    }
    memset(out, 0, (size_t)(9 * num_points) * sizeof *out), memset(other, 0, (size_t)(9 * num_points) * sizeof *other);
    memset(pull, 0, (size_t)(3 * num_points) * sizeof *pull);
    memset(other_pull, 0, (size_t)(3 * num_points) * sizeof *other_pull);
    for (int64_t image = 0; image < num_images; image++) {
        for (int64_t row = offsets[image]; row < offsets[image + 1]; row++) {
            const double *x = design + row * 2 * width + 3, *y = x + width;
            double w = weight[row], u = plain[image];
            double *v = out + 9 * point_idx[row], *p = other + 9 * point_idx[row];
            double *g = pull + 3 * point_idx[row], *h = other_pull + 3 * point_idx[row];
            for (int i = 0; i < 3; i++) {
                double along = x[i] * values[2 * row] + y[i] * values[2 * row + 1];
                g[i] += w * along, h[i] += u * along;
                for (int j = i; j < 3; j++) {
                    double both = x[i] * x[j] + y[i] * y[j];
                    v[3 * i + j] += w * both, p[3 * i + j] += u * both;
                }
            }
        }
    }
    for (int64_t k = 0; k < 2 * num_points; k++) {
        double *v = k < num_points ? out + 9 * k : other + 9 * (k - num_points);
        v[3] = v[1], v[6] = v[2], v[7] = v[5];
    }
    return DONE;
}
