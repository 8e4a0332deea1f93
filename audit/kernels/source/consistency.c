/* Observed = A projected + b, robustly, of every image of a model.
 *
 * Twin: sfm_audit.audit.consistency.affine. A round is two passes over the image: sums with the weights of the residuals
 * that the last round left, and the new residuals; their median is found by counting, a bracket at a time. */
#include "kernel.h"

enum { MAX_ROUNDS = 20, NUM_TERMS = 3, NUM_SUMS = 12, FEW = 64, LANES = 4 };
enum { SLOPE = 0, SHIFT = 4, CENTRE = 6, SPREAD = 8, MEDIAN = 10, REST_RMS = 11, STORED_RMS = 12, NUM_VALUES = 13 };

static const double ROUND_TOLERANCE = 1e-3, SURELY_REGULAR = 1e-8, SMALLEST_SQUARE = 1e-200, MAX_MAGNITUDE = 1e12;

#define INLINE static inline __attribute__((always_inline))

typedef struct {
    int64_t n;
    double *dx, *dy, *rx, *ry, *ex, *ey; /* design, residuals, what is left of them */
    double *squares, *weights;           /* squared length of what is left; all padded with zeros to whole lanes */
    double knee;                         /* of the weights, over the median */
} Image;

INLINE int64_t bits_of(double value) {
    int64_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}
INLINE int64_t count_up_to(const double *values, int64_t n, int64_t limit) {
    int64_t count = 0;
    for (int64_t k = 0; k < n; k++)
        count += bits_of(values[k]) <= limit;
    return count;
}

/* The upper median of values >= 0, n > 0: the order of their bits is theirs. least, most: where it is expected. */
INLINE double upper_median(const double *values, int64_t n, double least, double most) {
    const int64_t rank = n / 2;
    int64_t low = bits_of(least), high = bits_of(most), below = count_up_to(values, n, low - 1);
    int64_t up_to = count_up_to(values, n, high);
    if (below > rank)
        high = low - 1, up_to = below, low = 0, below = 0;
    else if (up_to <= rank)
        low = high + 1, below = up_to, high = INT64_MAX, up_to = n;
    while (up_to - below > FEW && low < high) {
        const int64_t middle = low + (high - low) / 2, count = count_up_to(values, n, middle);
        if (count > rank)
            high = middle, up_to = count;
        else
            low = middle + 1, below = count;
    }
    double few[FEW], found;
    if (low == high) {
        memcpy(&found, &low, sizeof found);
        return found;
    }
    int num = 0;
    for (int64_t k = 0; k < n && num < FEW; k++) {
        if (bits_of(values[k]) < low || bits_of(values[k]) > high)
            continue;
        int at = num++;
        for (; at > 0 && few[at - 1] > values[k]; at--)
            few[at] = few[at - 1];
        few[at] = values[k];
    }
    return few[rank - below];
}

INLINE double added(const double *lanes) { return (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]); }

INLINE double sum_of(const double *values, int64_t n) {
    double lanes[LANES] = {0.0};
    for (int64_t k = 0; k < n; k += LANES)
        for (int l = 0; l < LANES; l++)
            lanes[l] += values[k + l];
    return added(lanes);
}

/* Sums of weight (1, dx, dy) (1, dx, dy, rx, ry) over the image, weights 1 / (1 + length^2 / knee^2). */
INLINE void weighted_sums(const Image *im, double knee, double *sums) {
    const double over = 1.0 / (knee * knee);
    double lanes[NUM_SUMS][LANES] = {{0.0}};
    for (int64_t k = 0; k < im->n; k++)
        im->weights[k] = 1.0 / (1.0 + im->squares[k] * over);
    for (int64_t k = 0; k < im->n; k += LANES) {
        const double *w = im->weights + k, *dx = im->dx + k, *dy = im->dy + k, *rx = im->rx + k, *ry = im->ry + k;
        double wx[LANES], wy[LANES];
        for (int l = 0; l < LANES; l++)
            wx[l] = w[l] * dx[l], wy[l] = w[l] * dy[l];
        for (int l = 0; l < LANES; l++) lanes[0][l] += w[l];
        for (int l = 0; l < LANES; l++) lanes[1][l] += wx[l];
        for (int l = 0; l < LANES; l++) lanes[2][l] += wy[l];
        for (int l = 0; l < LANES; l++) lanes[3][l] += wx[l] * dx[l];
        for (int l = 0; l < LANES; l++) lanes[4][l] += wx[l] * dy[l];
        for (int l = 0; l < LANES; l++) lanes[5][l] += wy[l] * dy[l];
        for (int l = 0; l < LANES; l++) lanes[6][l] += w[l] * rx[l];
        for (int l = 0; l < LANES; l++) lanes[7][l] += w[l] * ry[l];
        for (int l = 0; l < LANES; l++) lanes[8][l] += wx[l] * rx[l];
        for (int l = 0; l < LANES; l++) lanes[9][l] += wx[l] * ry[l];
        for (int l = 0; l < LANES; l++) lanes[10][l] += wy[l] * rx[l];
        for (int l = 0; l < LANES; l++) lanes[11][l] += wy[l] * ry[l];
    }
    for (int i = 0; i < NUM_SUMS; i++)
        sums[i] = added(lanes[i]);
}

/* Coefficients (3, 2) of the weighted least squares; false where the points may lie on a line. */
static int solve(const double *s, double c[NUM_TERMS][2]) {
    const double scale[NUM_TERMS] = {1.0 / sqrt(s[0]), 1.0 / sqrt(s[3]), 1.0 / sqrt(s[5])};
    const double a = s[1] * scale[0] * scale[1], b = s[2] * scale[0] * scale[2], d = s[4] * scale[1] * scale[2];
    const double second = 1.0 - a * a, rest = (d - a * b) / sqrt(second), third = 1.0 - b * b - rest * rest;
    if (!(second > 0.0) || !(second * third > SURELY_REGULAR)) /* the smallest eigenvalue is above 4/9 of it */
        return 0;
    const double l11 = sqrt(second), l22 = sqrt(third);
    for (int axis = 0; axis < 2; axis++) {
        const double r0 = s[6 + axis] * scale[0];
        const double r1 = (s[8 + axis] * scale[1] - a * r0) / l11;
        const double r2 = (s[10 + axis] * scale[2] - b * r0 - rest * r1) / l22;
        const double x2 = r2 / l22, x1 = (r1 - rest * x2) / l11, x0 = r0 - a * x1 - b * x2;
        c[0][axis] = x0 * scale[0], c[1][axis] = x1 * scale[1], c[2][axis] = x2 * scale[2];
    }
    return 1;
}

/* New residuals and their squared lengths; returns the largest change of one. */
INLINE double leave(const Image *im, double c[NUM_TERMS][2]) {
    const double ax = c[0][0], bx = c[1][0], cx = c[2][0], ay = c[0][1], by = c[1][1], cy = c[2][1];
    int64_t change = 0;
    for (int64_t k = 0; k < im->n; k++) {
        const double ex = im->rx[k] - (ax + bx * im->dx[k] + cx * im->dy[k]);
        const double ey = im->ry[k] - (ay + by * im->dx[k] + cy * im->dy[k]);
        const int64_t moved_x = bits_of(fabs(ex - im->ex[k])), moved_y = bits_of(fabs(ey - im->ey[k]));
        const int64_t larger = moved_x > moved_y ? moved_x : moved_y;
        change = larger > change ? larger : change;
        im->ex[k] = ex, im->ey[k] = ey;
        im->squares[k] = ex * ex + ey * ey;
    }
    double found;
    memcpy(&found, &change, sizeof found);
    return found;
}

/* Residuals, projected points and padding of an image. */
INLINE void fill(Image *im, const double *residuals, int64_t total, const int32_t *rows, const double *xy_px) {
    for (int64_t k = 0; k < im->n; k++) {
        const double rx = residuals[k], ry = residuals[total + k];
        im->rx[k] = im->ex[k] = rx, im->ry[k] = im->ey[k] = ry;
        im->dx[k] = xy_px[2 * rows[k]] - rx, im->dy[k] = xy_px[2 * rows[k] + 1] - ry;
        im->squares[k] = rx * rx + ry * ry;
    }
    for (int64_t k = im->n; k % LANES; k++)
        im->rx[k] = im->ry[k] = im->dx[k] = im->dy[k] = im->squares[k] = im->weights[k] = 0.0;
}

/* From the mean of the projected points on, as a share of the largest coordinate, which is returned. */
INLINE double centre(Image *im, double *mean) {
    int64_t extent = 0;
    for (int64_t k = 0; k < im->n; k++) {
        const int64_t x = bits_of(fabs(im->dx[k])), y = bits_of(fabs(im->dy[k])), larger = x > y ? x : y;
        extent = larger > extent ? larger : extent;
    }
    double size;
    memcpy(&size, &extent, sizeof size);
    mean[0] = sum_of(im->dx, im->n) / (double)im->n, mean[1] = sum_of(im->dy, im->n) / (double)im->n;
    for (int64_t k = 0; k < im->n; k++) {
        im->dx[k] = (im->dx[k] - mean[0]) / size;
        im->dy[k] = (im->dy[k] - mean[1]) / size;
    }
    return size;
}

INLINE double spread_of(Image *im, const double *design, double size) {
    for (int64_t k = 0; k < im->n; k++)
        im->weights[k] = design[k] * design[k];
    return sqrt(sum_of(im->weights, im->n) / (double)im->n) * size;
}

static int fit(Image *im, const double *residuals, int64_t total, const int32_t *rows, const double *xy_px,
                    int with_affine, double *out) {
    const double n = (double)im->n, largest = MAX_MAGNITUDE * MAX_MAGNITUDE * n;
    fill(im, residuals, total, rows, xy_px);
    double mean[2], sums[NUM_SUMS], c[NUM_TERMS][2], sum = sum_of(im->squares, im->n);
    if (!(sum >= SMALLEST_SQUARE) || !(sum <= largest))
        return NEEDS_NUMPY;
    out[STORED_RMS] = sqrt(sum / n);
    if (!with_affine)
        return DONE;
    const double size = centre(im, mean);
    if (im->n < 4 || !(size > 0.0) || !(size <= MAX_MAGNITUDE))
        return NEEDS_NUMPY;
    /* half of the values are below twice their mean */
    double median = sqrt(upper_median(im->squares, im->n, sum / n / 64.0, 2.0 * sum / n));
    for (int round = 0; round < MAX_ROUNDS; round++) {
        if (!(median * median >= SMALLEST_SQUARE))
            return NEEDS_NUMPY;
        weighted_sums(im, im->knee * median, sums);
        if (!solve(sums, c))
            return NEEDS_NUMPY;
        const double change = leave(im, c), before = median * median;
        sum = sum_of(im->squares, im->n);
        if (!(sum >= SMALLEST_SQUARE) || !(sum <= largest))
            return NEEDS_NUMPY;
        median = sqrt(upper_median(im->squares, im->n, 0.7 * before, 1.2 * before));
        if (change <= ROUND_TOLERANCE * median)
            break;
    }
    for (int axis = 0; axis < 2; axis++) {
        out[SLOPE + 2 * axis] = c[1][axis] / size, out[SLOPE + 2 * axis + 1] = c[2][axis] / size;
        out[SHIFT + axis] = c[0][axis], out[CENTRE + axis] = mean[axis];
        out[SPREAD + axis] = spread_of(im, axis ? im->dy : im->dx, size);
    }
    out[MEDIAN] = median, out[REST_RMS] = sqrt(sum / n);
    int is_sane = out[SPREAD] > 0.0 && out[SPREAD + 1] > 0.0;
    for (int i = 0; i < NUM_VALUES; i++)
        is_sane &= fabs(out[i]) <= MAX_MAGNITUDE;
    return is_sane ? DONE : NEEDS_NUMPY;
}

/* Fit images first .. last - 1.
 *
 * offsets (I + 1): columns of residuals (2, total) and of rows (total), which are rows of xy_px (M, 2). wanted (I): 0 =
 * nothing, 1 = the RMS of the residuals, 2 = the affine map too. knee: of the weights, in medians. out (I, 13): slope
 * (2, 2), shift, centre and spread (2), median, RMS of what is left, RMS of the residuals. Returns how many images are
 * left to numpy. */
KERNEL int64_t sfm_consistency(int64_t first, int64_t last, const int64_t *offsets, int64_t total,
                               const double *residuals, const int32_t *rows, const double *xy_px,
                               const int64_t *wanted, double knee, double *out, int64_t *status) {
    int64_t most = LANES, num_left = 0;
    for (int64_t image = first; image < last; image++) {
        const int64_t n = offsets[image + 1] - offsets[image];
        most = n > most ? n : most;
    }
    most += LANES;
    double *buffer = malloc(sizeof(double) * (size_t)most * 8);
    Image im = {0, buffer, buffer + most, buffer + 2 * most, buffer + 3 * most, buffer + 4 * most, buffer + 5 * most,
                buffer + 6 * most, buffer + 7 * most, knee};
    for (int64_t image = first; image < last; image++) {
        const int64_t start = offsets[image];
        im.n = offsets[image + 1] - start;
        if (buffer == NULL)
            status[image] = NO_MEMORY;
        else if (im.n == 0 || wanted[image] == 0)
            status[image] = NEEDS_NUMPY;
        else
            status[image] = fit(&im, residuals + start, total, rows + start, xy_px, wanted[image] > 1,
                                out + NUM_VALUES * image);
        num_left += status[image] != DONE;
    }
    free(buffer);
    return num_left;
}
