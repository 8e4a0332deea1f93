#include "lanes.h"

/* Points give way to their observations: whitening of tracks and the likelihood of their variances (method.md 3a, 3b).
 * An observation is told by its row; residual, Jacobian and track of observation k stand n apart: xy[k], xy[n + k]. */

enum { INVERSE = 0, STEP = 6, LENGTH = 9, POINT = 10 }; /* of a point: 3 x 3 upper triangle, vector, observations */
enum { AHEAD = 16 };

/* The points of an image lie all over memory: ask for one some observations before its turn. */
INLINE void expect(int64_t n, const int32_t *point_idx, int64_t k, const double *points)
{
    if (k + AHEAD >= n)
        return;
    SOON(points + (int64_t)point_idx[k + AHEAD] * POINT);
    SOON(points + (int64_t)point_idx[k + AHEAD] * POINT + POINT - 1); /* a point lies in two lines of the cache */
}

static inline int read_jacobian(int64_t n, const double *from, int64_t k, double j[6])
{
    double all = 0.0;
    for (int i = 0; i < 6; i++) {
        j[i] = from[i * n + k];
        all += j[i] * 0.0;
    }
    if (all == 0.0)
        return 1;
    memset(j, 0, 6 * sizeof *j); /* where a projection has no derivative its point is not moved */
    return 0;
}

/* Add up information, gradient and length of each track in points (P, 10), over the rows that are used. */
KERNEL int64_t track_sums(int64_t n, const double *residuals, const double *jacobian, const int32_t *point_idx,
                          const uint8_t *used, double *points)
{
    for (int64_t k = 0; k < n; k++) {
        expect(n, point_idx, k, points);
        if (!used[k])
            continue;
        double j[6], x = residuals[k], y = residuals[n + k];
        double *p = points + (int64_t)point_idx[k] * POINT;
        p[LENGTH] += 1.0;
        if (!read_jacobian(n, jacobian, k, j))
            continue;
        p[0] += j[0] * j[0] + j[3] * j[3];
        p[1] += j[0] * j[1] + j[3] * j[4];
        p[2] += j[0] * j[2] + j[3] * j[5];
        p[3] += j[1] * j[1] + j[4] * j[4];
        p[4] += j[1] * j[2] + j[4] * j[5];
        p[5] += j[2] * j[2] + j[5] * j[5];
        p[STEP] += j[0] * x + j[3] * y;
        p[STEP + 1] += j[1] * x + j[4] * y;
        p[STEP + 2] += j[2] * x + j[5] * y;
    }
    return DONE;
}

/* Replace information by its inverse and gradient by the step of the point; rank 255 and nothing done where the
 * determinant, of unit diagonal, is not above the least one. Returns how many those are. */
KERNEL int64_t track_inverses(int64_t num_points, double least_determinant, double *points, uint8_t *rank)
{
    int64_t left = 0;
    for (int64_t i = 0; i < num_points; i++) {
        double *p = points + i * POINT;
        rank[i] = 0;
        if (p[LENGTH] == 0.0)
            continue;
        const double xx = p[0], xy = p[1], xz = p[2], yy = p[3], yz = p[4], zz = p[5];
        const double a = yy * zz - yz * yz, b = xz * yz - xy * zz, c = xy * yz - xz * yy;
        const double det = xx * a + xy * b + xz * c;
        if (!(det > least_determinant * xx * yy * zz && det < DBL_MAX && det > DBL_MIN)) {
            rank[i] = 255;
            left++;
            continue;
        }
        const double g = p[STEP], h = p[STEP + 1], l = p[STEP + 2], by = 1.0 / det;
        p[0] = a * by, p[1] = b * by, p[2] = c * by;
        p[3] = (xx * zz - xz * xz) * by, p[4] = (xy * xz - xx * yz) * by, p[5] = (xx * yy - xy * xy) * by;
        p[STEP] = p[0] * g + p[1] * h + p[2] * l;
        p[STEP + 1] = p[1] * g + p[3] * h + p[4] * l;
        p[STEP + 2] = p[2] * g + p[4] * h + p[5] * l;
        rank[i] = 3;
    }
    return left;
}

static inline double form(const double *a, const double *u, const double *v)
{
    return u[0] * (a[0] * v[0] + a[1] * v[1] + a[2] * v[2]) + u[1] * (a[1] * v[0] + a[3] * v[1] + a[4] * v[2]) +
           u[2] * (a[2] * v[0] + a[4] * v[1] + a[5] * v[2]);
}

/* Whiten the used rows: e and whether verified, and each track's sum of squares (P,) off its point. removed: what
 * moving the points would take away of the sum of squares, and that sum. */
KERNEL int64_t track_whiten(int64_t n, const double *residuals, const double *jacobian, const int32_t *point_idx,
                            const uint8_t *used, const double *points, double min_length, double min_eigenvalue,
                            double *whitened, uint8_t *verified, double *track_sq, double *removed)
{
    for (int64_t k = 0; k < n; k++) {
        expect(n, point_idx, k, points);
        if (k + AHEAD < n)
            SOON(track_sq + point_idx[k + AHEAD]);
        if (!used[k])
            continue;
        double j[6];
        const double *p = points + (int64_t)point_idx[k] * POINT, *step = p + STEP;
        const int differentiable = read_jacobian(n, jacobian, k, j);
        const double mx = j[0] * step[0] + j[1] * step[1] + j[2] * step[2];
        const double my = j[3] * step[0] + j[4] * step[1] + j[5] * step[2];
        const double x = residuals[k] - mx, y = residuals[n + k] - my;
        removed[0] += mx * mx + my * my;
        removed[1] += residuals[k] * residuals[k] + residuals[n + k] * residuals[n + k];
        track_sq[point_idx[k]] += x * x + y * y;
        const double xx = 1.0 - form(p, j, j), xy = -form(p, j + 3, j), yy = 1.0 - form(p, j + 3, j + 3);
        const double half = 0.5 * (xx + yy), off = 0.5 * (xx - yy), smallest = half - sqrt(off * off + xy * xy);
        const double root = sqrt(xx * yy - xy * xy), by = 1.0 / (root * sqrt(2.0 * (half + root)));
        const int good = differentiable && p[LENGTH] >= min_length && smallest >= min_eigenvalue;
        verified[k] = (uint8_t)good;
        whitened[k] = good ? by * ((yy + root) * x - xy * y) : NAN;
        whitened[n + k] = good ? by * ((xx + root) * y - xy * x) : NAN;
    }
    return DONE;
}

/* What is left of a track without the observation, for rows from start on: sum of squares, degrees of freedom (num,). */
KERNEL int64_t track_others(int64_t n, int64_t start, int64_t num, const int32_t *point_idx, const double *track_sq,
                            const int32_t *track_dof, const double *whitened, const uint8_t *verified,
                            double *other_sq, int32_t *other_dof)
{
    const int32_t *point = point_idx + start;
    const double *e = whitened + start;
    for (int64_t k = 0; k < num; k++) {
        if (k + AHEAD < num) {
            SOON(track_sq + point[k + AHEAD]);
            SOON(track_dof + point[k + AHEAD]);
        }
        const double other = track_sq[point[k]] - (e[k] * e[k] + e[n + k] * e[n + k]);
        other_dof[k] = track_dof[point[k]];
        other_sq[k] = !verified[start + k] ? NAN : other < 0.0 ? 0.0 : other;
    }
    return DONE;
}

/* How many of the used observations have each number of degrees of freedom; or that one has another. */
KERNEL int64_t prior_counts(int64_t n, const uint8_t *used, const int32_t *dof, int64_t num_groups, int64_t *counts)
{
    for (int64_t k = 0; k < n; k++) {
        if (!used[k])
            continue;
        if (dof[k] < 0 || dof[k] >= num_groups)
            return NEEDS_NUMPY;
        counts[dof[k]]++;
    }
    return DONE;
}

/* Put |e|^2 and the others' sum of squares of the used rows from start on where those of equal degrees of freedom
 * stand together; next: where the next of each goes. used, e (2, n), or |e|^2 (n,): of all; other_sq, dof: (num,). */
KERNEL int64_t prior_groups(int64_t n, int64_t start, int64_t num, const uint8_t *used, const double *e,
                            int64_t is_squared, const double *other_sq, const int32_t *dof, int64_t *next,
                            double *sq_out, double *other_out)
{
    for (int64_t k = 0; k < num; k++) {
        const int64_t row = start + k;
        if (!used[row])
            continue;
        const int64_t at = next[dof[k]]++;
        sq_out[at] = is_squared ? e[row] : e[row] * e[row] + e[n + row] * e[n + row];
        other_out[at] = other_sq[k];
    }
    return DONE;
}

enum { RUN = 256 * LANES }; /* 256 mantissas, each below 2, have a product in range */

/* For each group, with b = P + c: sums of ln(b / (b + q)), ln(b + q), 1 / b, 1 / (b + q) and their squares: out
 * (num_groups, 6).
 A sum of logarithms is that of a product whose factors' exponents are counted. Groups are filled up to
 * a multiple of LANES with q = 0 and c = 2^1000, which add nothing but exponents of 1000. */
KERNEL int64_t prior_sums(int64_t num_groups, const int64_t *starts, const int64_t *counts, const double *sq,
                               const double *other_sq, double prior, double *out)
{
    for (int64_t g = 0; g < num_groups; g++) {
        Lanes sums[4] = {all(0.0), all(0.0), all(0.0), all(0.0)};
        LaneBits exponents_ratio = {0}, exponents_bq = {0};
        double log_ratio = 0.0, log_bq = 0.0;
        for (int64_t at = starts[g]; at < starts[g + 1]; at += RUN) {
            const int64_t end = at + RUN < starts[g + 1] ? at + RUN : starts[g + 1];
            Lanes of_ratio = all(1.0), of_bq = all(1.0);
            for (int64_t k = at; k < end; k += LANES) {
                const Lanes b = load(other_sq + k) + prior, bq = b + load(sq + k), by_b = 1.0 / b, by_bq = 1.0 / bq;
                const Lanes ratio = b * by_bq;
                sums[0] += by_b;
                sums[1] += by_bq;
                sums[2] += by_b * by_b;
                sums[3] += by_bq * by_bq;
                of_ratio *= mantissa(ratio);
                of_bq *= mantissa(bq);
                exponents_ratio += biased_exponent(ratio);
                exponents_bq += biased_exponent(bq);
            }
            log_ratio += sum(log_of(of_ratio));
            log_bq += sum(log_of(of_bq));
        }
        const int64_t rows = starts[g + 1] - starts[g], filled = rows - counts[g];
        out[6 * g] = log_ratio + (double)(total(exponents_ratio) - 1023 * rows) * M_LN2;
        out[6 * g + 1] = log_bq + (double)(total(exponents_bq) - 1023 * rows - 1000 * filled) * M_LN2;
        for (int i = 0; i < 4; i++)
            out[6 * g + 2 + i] = sum(sums[i]);
    }
    return DONE;
}
