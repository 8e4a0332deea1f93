#include "order.h"

/* The noise of images: one robust scale for all residuals, and the factor that makes what tracks predict of an image
 * standard normal, with the paper's two variances (method.md 2 and 3, audit/noise/fits.py and predictive.py). */

#define CUTOFF_SQ 4.0
enum { MAX_ITERATIONS = 100, NUM_EXPECTED = 2, CELLS_PER_UNIT = 32, LAST_CELL = 192, TABLE_ROW = 4 * (LAST_CELL + 1) };
enum { FACTOR_SQ, DETECTOR, STRUCTURE, CONVERGED, MEDIAN_SCALE, NOISE_COLUMNS };
enum { FIT_NEEDS_NUMPY = 3 };

INLINE int64_t padded(int64_t n) { return (n + LANES - 1) / LANES * LANES; }

/* Root of mean(min(y / theta, c^2)) = kappa over n numbers, filled up with zeros to whole lanes. */
INLINE int constant_variance(int64_t n, const double *y, double kappa, double *theta)
{
    Lanes s = all(0.0);
    for (int64_t k = 0; k < n; k += LANES)
        s += load(y + k);
    const double all_of_them = sum(s);
    if (!(all_of_them > 0.0 && all_of_them < DBL_MAX))
        return NEEDS_NUMPY;
    *theta = all_of_them / ((double)n * kappa);
    for (int i = 0; i < MAX_ITERATIONS; i++) {
        const Lanes limit = all(CUTOFF_SQ * *theta);
        LaneBits clipped = {0};
        s = all(0.0);
        for (int64_t k = 0; k < n; k += LANES) {
            const Lanes v = load(y + k);
            const LaneBits inside = v < limit;
            s += choose(inside, v, all(0.0));
            clipped += inside + 1;
        }
        const double unclipped = sum(s), left = (double)n * kappa - (double)total(clipped) * CUTOFF_SQ;
        if (!(left > 0.0 && unclipped > 0.0))
            return NEEDS_NUMPY;
        const double before = *theta;
        *theta = unclipped / left;
        if (fabs(*theta - before) <= 1e-14 * *theta)
            return DONE;
    }
    return NEEDS_NUMPY;
}

/* theta (num_images,) of columns offsets[i] : offsets[i + 1] of residuals (2, n). */
KERNEL int64_t constant_noises(int64_t num_images, int64_t n, const int64_t *offsets, const double *residuals,
                                    double kappa, double *theta, uint8_t *status)
{
    int64_t most = 0;
    for (int64_t i = 0; i < num_images; i++)
        most = offsets[i + 1] - offsets[i] > most ? offsets[i + 1] - offsets[i] : most;
    double *y = malloc((size_t)(2 * most + LANES) * sizeof *y);
    if (!y)
        return NO_MEMORY;
    for (int64_t i = 0; i < num_images; i++) {
        const int64_t own = offsets[i + 1] - offsets[i];
        for (int axis = 0; axis < 2; axis++)
            for (int64_t k = 0; k < own; k++) {
                const double x = residuals[axis * n + offsets[i] + k];
                y[axis * own + k] = x * x;
            }
        memset(y + 2 * own, 0, LANES * sizeof *y);
        status[i] = (uint8_t)constant_variance(2 * own, y, kappa, theta + i);
    }
    free(y);
    return DONE;
}

/* Of one image, m observations, in arrays that are filled up with zeros to whole lanes. */
typedef struct {
    int64_t m;
    double nu0, kappa;
    double *t[2], *nu, *by_nu, *slope[2]; /* e over the predicted scale, degrees of freedom, d z / d ln t */
    double *found[2], *z;         /* |z|, and z (m, 2) */
    int64_t *row;                 /* of the tables */
    double *y[2], *a, *scale;     /* e^2, a^2, predicted scale */
    double *spare;                /* (2 m) */
    const double *table[2];       /* of z / w */
} Image;

enum { ARRAYS = 16 }; /* of the size of an image, in an Image */

/* |z| = w R(w) of four w, and how it grows with ln t: over is u / (1 + u), rows those of the table. */
INLINE Lanes to_normal(const double *table, const int64_t *row, Lanes nu, Lanes w, Lanes over, Lanes *growth,
                       LaneBits *outside)
{
    const Lanes last = all(LAST_CELL);
    Lanes at = w * CELLS_PER_UNIT;
    *outside = at >= last;
    at = lesser(at, last);
    const Lanes shifted = (at - 0.5) + WHOLE, x = at - (shifted - WHOLE);
    const LaneBits cell = (LaneBits)shifted & 0xff;
    Lanes c[LANES];
    for (int l = 0; l < LANES; l++)
        c[l] = load(table + row[l] * TABLE_ROW + 4 * cell[l]);
    transpose(c);
    const Lanes ratio = ((c[3] * x + c[2]) * x + c[1]) * x + c[0];
    const Lanes steepness = (double)CELLS_PER_UNIT * ((3.0 * c[3] * x + 2.0 * c[2]) * x + c[1]);
    /* d w / d ln t = nu u / ((1 + u) w), 0 at w = 0 */
    *growth = (ratio + w * steepness) * choose(w > 0.0, nu * over / w, all(0.0));
    return w * ratio;
}

typedef struct {
    double excess, slope; /* mean(min(z^2, c^2)) - kappa, and minus its derivative in ln f */
} Balance;

enum { BLOCK = 64 };

/* |z| of the image at ln f and its growth with ln t, of every step-th block. First all w of a block, then all z: the
 * processor does not wait for one before it begins the next. */
INLINE Balance transform(const Image *image, double log_f, int64_t step)
{
    const double by_f = exp_of_negative(all(-fabs(log_f)))[0], shrink = log_f < 0.0 ? 1.0 / by_f : by_f;
    double w[2][BLOCK], over[2][BLOCK], share[BLOCK];
    Lanes mass = all(0.0), falls = all(0.0);
    int64_t asked = 0;
    for (int64_t start = 0; start < image->m; start += step * BLOCK) {
        const int64_t size = image->m - start < BLOCK ? image->m - start : BLOCK;
        for (int64_t k = 0; k < size; k += LANES) {
            const Lanes nu = load(image->nu + start + k);
            const Lanes x = load(image->t[0] + start + k) * shrink, y = load(image->t[1] + start + k) * shrink;
            const Lanes x2 = x * x, y2 = y * y, u = x2 * load(image->by_nu + start + k), rest = nu + x2;
            const Lanes by_rest = 1.0 / rest, v = y2 * by_rest;
            store(w[0] + k, root(nu * log_1p(u)));
            store(w[1] + k, root((nu + 1.0) * log_1p(v)));
            store(over[0] + k, x2 * by_rest);           /* u / (1 + u) = x^2 / (nu + x^2) */
            store(over[1] + k, y2 / (rest + y2));       /* v / (1 + v) */
            store(share + k, nu * by_rest);             /* the scale of y grows with x */
        }
        for (int64_t k = 0; k < size; k += LANES) {
            const Lanes nu = load(image->nu + start + k);
            for (int axis = 0; axis < 2; axis++) {
                Lanes growth;
                LaneBits outside;
                const Lanes z = to_normal(image->table[axis], image->row + start + k, nu + (double)axis, load(w[axis] + k),
                                          load(over[axis] + k), &growth, &outside);
                growth *= axis ? load(share + k) : all(1.0);
                const Lanes z_sq = z * z;
                const LaneBits inside = z_sq < CUTOFF_SQ;
                mass += choose(inside, z_sq, all(CUTOFF_SQ));
                falls += choose(inside, z * growth, all(0.0));
                if (step == 1) {
                    store(image->slope[axis] + start + k, choose(outside, all(NAN), growth));
                    store(image->found[axis] + start + k, z);
                }
            }
        }
        asked += size;
    }
    const double by_count = 0.5 / (double)asked;
    return (Balance){sum(mass) * by_count - image->kappa, 2.0 * sum(falls) * by_count};
}

/* ln f at which the robust variance of z is 1, from ln f = start; 1 where it was found. */
INLINE int solve(const Image *image, int64_t step, double tolerance, double *log_f, double *last_step)
{
    double low = -DBL_MAX, high = DBL_MAX, x = *log_f;
    for (int i = 0; i < MAX_ITERATIONS; i++) {
        const Balance now = transform(image, x, step);
        if (now.excess > 0.0)
            low = x;
        else
            high = x;
        double move = now.slope > 1e-3 ? now.excess / now.slope : now.excess > 0.0 ? 3.0 : -3.0;
        move = move > 3.0 ? 3.0 : move < -3.0 ? -3.0 : move;
        *log_f = x;
        *last_step = move;
        if (now.excess == now.excess && now.slope > 1e-3 && fabs(move) <= tolerance)
            return 1;
        x += move;
        if (!(x > low && x < high)) {
            if (low == -DBL_MAX || high == DBL_MAX)
                return 0;
            x = 0.5 * (low + high);
        }
    }
    return 0;
}

/* Sum over both axes of min(y / s, c^2) / kappa - 1, and 0 beyond the end. */
INLINE Lanes excess_of(const Image *image, int64_t k, Lanes by_s)
{
    const Lanes most = all(CUTOFF_SQ);
    const Lanes mass = lesser(load(image->y[0] + k) * by_s, most) + lesser(load(image->y[1] + k) * by_s, most);
    return choose(rows_below(k, image->m), mass / image->kappa - 2.0, all(0.0));
}

/* Estimating equation (2) and its derivative (3: 11, 12, 22) at theta; expected: as y / s has it on average if it is the
 * square of a normal number. */
INLINE void estimating_equation(const Image *image, const double theta[2], int expected, double equation[2],
                                double derivative[3])
{
    const double unclipped = 0.73853587005088943782; /* E z^2 of |z| < c */
    Lanes e0 = all(0.0), e1 = e0, d00 = e0, d01 = e0, d11 = e0;
    for (int64_t k = 0; k < image->m; k += LANES) {
        const Lanes a = load(image->a + k), s = theta[0] + theta[1] * a, by_s = 1.0 / choose(s > DBL_MIN, s, all(DBL_MIN));
        const Lanes first = excess_of(image, k, by_s) * by_s;
        Lanes slope = all(0.0);
        for (int axis = 0; axis < 2; axis++) {
            const Lanes ratio = load(image->y[axis] + k) * by_s;
            slope += choose(ratio < CUTOFF_SQ, ratio, all(0.0));
        }
        slope = (slope * by_s * (1.0 / image->kappa) + first) * by_s;
        if (expected)
            slope = choose(rows_below(k, image->m), by_s * by_s * (2.0 * unclipped / image->kappa), all(0.0));
        e0 += first, e1 += first * a;
        d00 += slope, d01 += slope * a, d11 += slope * a * a;
    }
    equation[0] = sum(e0), equation[1] = sum(e1);
    derivative[0] = -sum(d00), derivative[1] = -sum(d01), derivative[2] = -sum(d11);
}

/* One step of Newton's that stays near theta > 0; 0 where there is none. expected: with the slope of normal numbers. */
INLINE int newton_step(const Image *image, const double theta[2], int expected, double next[2])
{
    double e[2], d[3];
    if (!(theta[0] > 0.0 && theta[1] > 0.0))
        return 0;
    estimating_equation(image, theta, expected, e, d);
    const double determinant = d[0] * d[2] - d[1] * d[1];
    if (!(determinant > 0.0 && d[0] < 0.0))
        return 0;
    next[0] = theta[0] - (d[2] * e[0] - d[1] * e[1]) / determinant;
    next[1] = theta[1] - (d[0] * e[1] - d[1] * e[0]) / determinant;
    return next[0] > 0.1 * theta[0] && next[1] > 0.1 * theta[1] && next[0] < 10.0 * theta[0] && next[1] < 10.0 * theta[1];
}

/* One scoring step: a line through winsorised responses with weights 1 / s^2, theta >= 0; 0 where it is not determined. */
INLINE int scoring_step(const Image *image, const double theta[2], double next[2])
{
    Lanes g00 = all(0.0), g01 = g00, g11 = g00, r0 = g00, r1 = g00;
    for (int64_t k = 0; k < image->m; k += LANES) {
        const Lanes a = load(image->a + k), s = theta[0] + theta[1] * a;
        const LaneBits used = rows_below(k, image->m) & (s > 0.0);
        const Lanes by_s = choose(used, 1.0 / s, all(0.0)), weight = 2.0 * by_s * by_s, most = all(CUTOFF_SQ);
        const Lanes mass = lesser(load(image->y[0] + k) * by_s, most) + lesser(load(image->y[1] + k) * by_s, most);
        const Lanes response = mass * by_s / image->kappa;
        g00 += weight, g01 += weight * a, g11 += weight * a * a;
        r0 += response, r1 += response * a;
    }
    const double g[3] = {sum(g00), sum(g01), sum(g11)}, r[2] = {sum(r0), sum(r1)}, det = g[0] * g[2] - g[1] * g[1];
    if (!(det > 1e-9 * g[0] * g[2]))
        return 0;
    next[0] = (g[2] * r[0] - g[1] * r[1]) / det;
    next[1] = (g[0] * r[1] - g[1] * r[0]) / det;
    if (next[0] >= 0.0 && next[1] >= 0.0)
        return 1;
    const int constant = -r[0] * r[0] / g[0] <= -r[1] * r[1] / g[2]; /* the edge where the sum of squares is smaller */
    next[0] = constant ? r[0] / g[0] : 0.0;
    next[1] = constant ? 0.0 : r[1] / g[2];
    return 1;
}

/* The fit where its two boundaries are not it, from the first scoring step on; least, most: of a. */
INLINE int fit_both(const Image *image, double variance, double least, double most, double out[NOISE_COLUMNS])
{
    Lanes s = all(0.0), up = s, down = s, up_origin = s, down_origin = s;
    for (int64_t k = 0; k < image->m; k += LANES)
        s += load(image->a + k);
    const double mean = sum(s) / (double)image->m;
    for (int64_t k = 0; k < image->m; k += LANES) {
        const Lanes a = load(image->a + k), centred = choose(rows_below(k, image->m), a - mean, all(0.0));
        const Lanes excess = excess_of(image, k, all(1.0 / variance));
        up += excess * centred;
        down += centred * centred;
        up_origin += variance * (1.0 + 0.5 * excess) * a;
        down_origin += a * a;
    }
    double theta[2];
    theta[1] = variance * sum(up) / sum(down) / 2.0;
    theta[0] = variance - theta[1] * mean;
    if (!(theta[1] * mean <= variance)) {
        theta[0] = 0.0;
        theta[1] = sum(up_origin) / sum(down_origin);
    }
    for (int i = 0; i < MAX_ITERATIONS; i++) {
        double next[2];
        const int newton = newton_step(image, theta, i < NUM_EXPECTED, next);
        if (!newton && !scoring_step(image, theta, next))
            return FIT_NEEDS_NUMPY;
        const double ends[2] = {least, most}, tolerance = newton && i >= NUM_EXPECTED ? 1e-6 : 1e-8;
        int still = 1;
        for (int j = 0; j < 2; j++) {
            const double before = theta[0] + theta[1] * ends[j], after = next[0] + next[1] * ends[j];
            still = still && fabs(after - before) <= tolerance * before;
        }
        theta[0] = next[0], theta[1] = next[1];
        if (still) {
            out[DETECTOR] = theta[0], out[STRUCTURE] = theta[1];
            return DONE;
        }
    }
    return FIT_NEEDS_NUMPY;
}

/* fit_variance of audit/noise/fits.py; numpy is to do it where no step is determined or the steps do not end. */
INLINE int fit_variance(const Image *image, double out[NOISE_COLUMNS])
{
    const int64_t m = image->m;
    double least, most, variance, scale;
    memcpy(image->spare, image->y[0], (size_t)m * sizeof(double));
    memcpy(image->spare + m, image->y[1], (size_t)m * sizeof(double));
    memset(image->spare + 2 * m, 0, LANES * sizeof(double));
    if (constant_variance(2 * m, image->spare, image->kappa, &variance) != DONE)
        return FIT_NEEDS_NUMPY;
    ends_of(m, image->a, &least, &most);
    out[DETECTOR] = variance, out[STRUCTURE] = 0.0, out[CONVERGED] = 1.0;
    if (least == most)
        return DONE;
    Lanes s = all(0.0);
    for (int64_t k = 0; k < m; k += LANES)
        s += excess_of(image, k, all(1.0 / variance)) * load(image->a + k);
    const double rise = sum(s);
    if (!(rise > 0.0))
        return rise <= 0.0 ? DONE : FIT_NEEDS_NUMPY;
    if (least > 0.0) {
        for (int64_t k = 0; k < m; k++) {
            image->spare[k] = image->y[0][k] / image->a[k];
            image->spare[m + k] = image->y[1][k] / image->a[k];
        }
        if (constant_variance(2 * m, image->spare, image->kappa, &scale) == DONE) {
            s = all(0.0);
            for (int64_t k = 0; k < m; k += LANES) {
                const Lanes by_s = 1.0 / (scale * choose(rows_below(k, m), load(image->a + k), all(1.0)));
                s += excess_of(image, k, by_s) * by_s;
            }
            if (sum(s) <= 0.0) {
                out[DETECTOR] = 0.0, out[STRUCTURE] = scale;
                return DONE;
            }
        }
    }
    return fit_both(image, variance, least, most, out);
}

/* Take the image's verified observations out of the model's columns; 0 where a number cannot be used. */
INLINE int take(Image *image, int64_t n, int64_t begin, int64_t end, const double *whitened, const uint8_t *verified,
                const double *other_sq, const int32_t *dof, const double *prior, const int32_t *row_of_dof)
{
    int64_t at = 0;
    for (int64_t k = begin; k < end; k++) { /* what is not verified is written over */
        image->nu[at] = dof[k];
        image->t[0][at] = whitened[k];
        image->t[1][at] = whitened[n + k];
        image->a[at] = other_sq[k];
        at += verified[k] != 0;
    }
    image->m = at;
    for (int64_t k = at; k < padded(at); k++) {
        image->nu[k] = 1.0;
        image->a[k] = image->t[0][k] = image->t[1][k] = 0.0;
    }
    for (int64_t k = 0; k < padded(at); k++)
        image->row[k] = k < at ? row_of_dof[(int32_t)image->nu[k]] : 0;
    const double prior_sq = prior[0] * prior[1] * prior[1];
    Lanes check = all(0.0);
    LaneBits zeros = {0};
    for (int64_t k = 0; k < at; k += LANES) {
        const Lanes own = load(image->nu + k), nu = own + prior[0], other = load(image->a + k);
        const Lanes scale = root((prior_sq + other) / nu), a = other / own;
        for (int axis = 0; axis < 2; axis++) {
            const Lanes e = load(image->t[axis] + k), t = e / scale, y = e * e;
            store(image->t[axis] + k, t);
            store(image->y[axis] + k, y);
            zeros += (t == 0.0) & rows_below(k, at);
            check += choose(other >= 0.0, (t + y + a) * 0.0, all(NAN));
        }
        store(image->nu + k, nu);
        store(image->by_nu + k, 1.0 / nu);
        store(image->scale + k, scale);
        store(image->a + k, a);
    }
    return at > 0 && sum(check) == 0.0 && (double)(2 * at + total(zeros)) * CUTOFF_SQ > (double)(2 * at) * image->kappa;
}

/* z after a last step in ln f that is so small that z is a line in it; t where that is beyond the tables. */
INLINE void write_z(const Image *image, double move, double shrink, uint8_t *outside)
{
    const int64_t m = image->m;
    LaneBits beyond = {0};
    for (int64_t k = 0; k < m; k += LANES) {
        double z[2][LANES];
        for (int axis = 0; axis < 2; axis++) {
            const Lanes slope = load(image->slope[axis] + k), length = load(image->found[axis] + k) - slope * move;
            const LaneBits sign = (LaneBits)load(image->t[axis] + k) & INT64_MIN;
            beyond |= slope != slope;
            store(z[axis], (Lanes)((LaneBits)length | sign));
        }
        for (int64_t l = 0; l < LANES && k + l < m; l++) {
            image->z[2 * (k + l)] = z[0][l];
            image->z[2 * (k + l) + 1] = z[1][l];
        }
    }
    for (int64_t k = 0; k < m && total(beyond); k++) {
        const double x = image->t[0][k] * shrink, y = image->t[1][k] * shrink, nu = image->nu[k];
        const double t[2] = {x, y * sqrt((nu + 1.0) / (nu + x * x))};
        for (int axis = 0; axis < 2; axis++)
            if (image->slope[axis][k] != image->slope[axis][k]) {
                image->z[2 * k + axis] = t[axis];
                outside[2 * k + axis] = 1;
            }
    }
}

INLINE int noise_of(Image *image, double out[NOISE_COLUMNS], uint8_t *outside)
{
    const int64_t m = image->m;
    double log_f = 0.0, move = 0.0;
    if (m >= 4 * BLOCK && !solve(image, 8, 0.02, &log_f, &move))
        log_f = move = 0.0;
    log_f += move;
    if (!solve(image, 1, 1e-6, &log_f, &move))
        return NEEDS_NUMPY;
    log_f += move;
    const double f = 1.0 / exp_of_negative(all(-fabs(log_f)))[0], shrink = log_f < 0.0 ? f : 1.0 / f;
    write_z(image, move, shrink, outside);
    out[FACTOR_SQ] = 1.0 / (shrink * shrink);
    out[MEDIAN_SCALE] = quantile(m, image->scale, 0.5, image->spare);
    const double limit = quantile(m, image->a, 0.99, image->spare);
    for (int64_t k = 0; k < m; k++)
        image->a[k] = image->a[k] < limit ? image->a[k] : limit;
    return fit_variance(image, out);
}

/* The noise of images under the noise model of tracks: z (rows, 2), where numpy is to transform what stands there, and
 * columns out. prior: nu0, s0. tables: (distinct dof, LAST_CELL + 1, 4) for x and for y given x. */
KERNEL int64_t track_noises(int64_t num_images, int64_t n, const int64_t *offsets, const int64_t *verified_offsets,
                                 const double *whitened, const uint8_t *verified, const double *other_sq,
                                 const int32_t *dof, const double *prior, double kappa, const int32_t *row_of_dof,
                                 const double *first, const double *second, double *z, uint8_t *outside, double *out,
                                 uint8_t *status)
{
    int64_t most = 0;
    for (int64_t i = 0; i < num_images; i++)
        most = offsets[i + 1] - offsets[i] > most ? offsets[i + 1] - offsets[i] : most;
    const size_t size = (size_t)most + 2 * LANES;
    double *room = malloc(ARRAYS * size * sizeof *room);
    if (!room)
        return NO_MEMORY;
    Image image = {0};
    double **arrays[] = {&image.t[0], &image.t[1], &image.nu, &image.by_nu, &image.slope[0],
                         &image.slope[1], &image.found[0], &image.found[1], &image.y[0], &image.y[1], &image.a, &image.scale};
    double *next = room;
    for (size_t i = 0; i < sizeof arrays / sizeof *arrays; i++, next += size)
        *arrays[i] = next;
    image.row = (int64_t *)next, image.spare = next + size;
    image.nu0 = prior[0], image.kappa = kappa, image.table[0] = first, image.table[1] = second;
    for (int64_t i = 0; i < num_images; i++) {
        const int64_t at = 2 * (verified_offsets[i] - verified_offsets[0]);
        image.z = z + at;
        status[i] = NEEDS_NUMPY;
        if (take(&image, n, offsets[i], offsets[i + 1], whitened, verified, other_sq, dof, prior, row_of_dof) &&
            image.m == verified_offsets[i + 1] - verified_offsets[i])
            status[i] = (uint8_t)noise_of(&image, out + i * NOISE_COLUMNS, outside + at);
    }
    free(room);
    return DONE;
}
