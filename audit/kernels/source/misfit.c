/* Sums over the observations of images, of which the misfit tests are made (docs/method.md section 5).
 *
 * An observation has rows along x and along y: the q columns N of its image's own fit, the residual, the lens fields S
 * (radial 2, tangential 2) and the rolling shutter R (6); and 15 monomials m of the predicted point, degree 0 .. 4, which
 * are fields along x and along y. Fields are made when asked for, SIZE observations at a time, and never stored.
 * Monomials times monomials are moments: those of degree 0 .. 8 give all of them, along x and along y alike.
 */
#include "lanes.h"

enum { SIZE = 64, MONOMIALS = 15, HIGHEST = 10, LENS = 4, SHUTTER = 6, MAX_OWN = 32, MAX_ROWS = MAX_OWN + 1 + LENS + SHUTTER };
enum { NUM_FEATURES = LENS + SHUTTER + 2 * MONOMIALS, MAX_FEATURES = MAX_OWN + NUM_FEATURES };
/* x, y, x^2, y^2 .. y^4: these times the five monomials of degree 4 are all of degree 5 .. 8. */
enum { POWERS = 8, FIVE = 5 };
static const int POWER[POWERS] = {1, 2, 3, 5, 6, 9, 10, 14};
/* Numbers of an image: quaternion, translation, 3 x 3 from world gradients to the camera's, fx fy cx cy width height. */
enum { QUAT = 0, SHIFT = 4, TURN = 7, LENS_NUMBERS = 16, NUM_NUMBERS = 22 };
/* Facts of the camera model: distortion parameters, of which these are the radial and tangential groups (-1: none). */
enum { NUM_EXTRA = 0, NUM_FOCALS, IS_FISHEYE, RADIAL_0, RADIAL_1, TANGENTIAL_0, TANGENTIAL_1, NUM_FACTS };
static const double MAX_LEVERAGE = 1.0 - 1e-9, TINY_DEPTH = DBL_EPSILON;

typedef Lanes lanes __attribute__((may_alias));
typedef double row_t[SIZE] __attribute__((aligned(64)));

/* The model, as it lies in memory. residuals: 2 rows, jacobian: 6 rows of these strides. */
typedef struct {
    const double *xyz_world, *xy_px, *residuals, *jacobian;
    const int32_t *point;
    const int32_t *observation;
    const int64_t *facts;
    int64_t residual_stride, jacobian_stride;
} model_t;

typedef struct {
    int64_t start, stop;
    const double *numbers, *d_extra;
} image_t;

/* x, y: N, residual, S, R along x and y.   m: monomials.   Zero behind the observations that there are.
 * rows: which they are in the model.   in_a_row: whether one stands behind the other there. */
typedef struct {
    row_t x[MAX_ROWS], y[MAX_ROWS], m[MONOMIALS];
    int64_t rows[SIZE];
    int in_a_row;
} block_t;

/* What stands for an observation in the meat: rows N w, S w, R w, m w_x, m w_y; squares: w_x^2, w_x w_y, w_y^2; powers: times
 * powers of x and y.   left: y - N c. */
typedef struct {
    row_t g[MAX_FEATURES], squares[3], powers[3 * POWERS], w[2], left[2];
    double largest_leverage;
} scores_t;

typedef struct {
    block_t block;
    scores_t scores;
    row_t clusters[MAX_FEATURES];
} scratch_t;

static int own_columns(const int64_t *facts) { return (int)(6 + facts[NUM_FOCALS] + facts[NUM_EXTRA]); }

static void *aligned_scratch(size_t size, void **to_free) {
    *to_free = malloc(size + 64);
    return *to_free ? (void *)(((uintptr_t)*to_free + 63) & ~(uintptr_t)63) : NULL;
}

INLINE void copy_row(double *to, const double *from) {
    for (int k = 0; k < SIZE; k += 8) {
        const Lanes first = load(from + k), second = load(from + k + 4); /* a call of memcpy waits longer than it copies */
        store(to + k, first), store(to + k + 4, second);
    }
}

/* sums[r][c] += row r of a times row c of b, lane by lane: they are added when all is summed up (`sum`). */
INLINE void tile(const row_t *a, const row_t *b, const int rows, const int columns, lanes *sums, int64_t stride) {
    lanes s[3][8];
    for (int r = 0; r < rows; ++r)
        for (int c = 0; c < columns; ++c) s[r][c] = sums[r * stride + c];
    for (int k = 0; k < SIZE; k += 4)
        for (int r = 0; r < rows; ++r) {
            const lanes left = *(const lanes *)&a[r][k];
            for (int c = 0; c < columns; ++c) s[r][c] += left * *(const lanes *)&b[c][k];
        }
    for (int r = 0; r < rows; ++r)
        for (int c = 0; c < columns; ++c) sums[r * stride + c] = s[r][c];
}

/* All columns from ``c`` on, of a few rows. */
INLINE void stripe(const row_t *a, const int rows, const row_t *b, int c, int columns, lanes *sums, int64_t stride) {
    for (; rows == 1 && c + 8 <= columns; c += 8) tile(a, b + c, rows, 8, sums + c, stride);
    for (; c + 4 <= columns; c += 4) tile(a, b + c, rows, 4, sums + c, stride);
    if (columns - c == 3) tile(a, b + c, rows, 3, sums + c, stride);
    if (columns - c == 2) tile(a, b + c, rows, 2, sums + c, stride);
    if (columns - c == 1) tile(a, b + c, rows, 1, sums + c, stride);
}

/* Sums of each row of a times each row of b; of upper ones those below the diagonal are left as they come. */
INLINE void stripes(const row_t *a, int rows, const row_t *b, int columns, lanes *sums, int64_t stride, const int upper) {
    int r = 0;
    for (; r + 3 <= rows; r += 3) stripe(a + r, 3, b, upper * r, columns, sums + r * stride, stride);
    if (rows - r == 2) stripe(a + r, 2, b, upper * r, columns, sums + r * stride, stride);
    if (rows - r == 1) stripe(a + r, 1, b, upper * r, columns, sums + r * stride, stride);
}

static void products(const row_t *a, int rows, const row_t *b, int columns, lanes *sums, int64_t stride) {
    stripes(a, rows, b, columns, sums, stride, 0);
}

/* The same where the first rows of b are those of a: what lies below the diagonal is not used. */
static void upper_products(const row_t *a, int rows, int columns, lanes *sums, int64_t stride) {
    stripes(a, rows, a, columns, sums, stride, 1);
}

/* Monomials of (x, y), by degree, then by the power of y. */
INLINE void fill_monomials(block_t *b, const double *x, const double *y) {
    for (int k = 0; k < SIZE; ++k) b->m[0][k] = 1.0, b->m[1][k] = x[k], b->m[2][k] = y[k];
    for (int degree = 2; degree <= 4; ++degree) {
        const int first = degree * (degree + 1) / 2, above = first - degree;
        for (int j = 0; j < degree; ++j)
            for (int k = 0; k < SIZE; ++k) b->m[first + j][k] = b->m[above + j][k] * x[k];
        for (int k = 0; k < SIZE; ++k) b->m[first + degree][k] = b->m[first - 1][k] * y[k];
    }
}

/* Six columns of the pose along one axis, of the gradient (3) in the camera and the point there. */
INLINE void fill_pose(row_t *own, const row_t *gradient, const row_t *point) {
    for (int k = 0; k < SIZE; ++k) {
        const double jx = gradient[0][k], jy = gradient[1][k], jz = gradient[2][k];
        const double x = point[0][k], y = point[1][k], z = point[2][k];
        own[0][k] = jz * y - jy * z, own[1][k] = jx * z - jz * x, own[2][k] = jy * x - jx * y;
        own[3][k] = jx, own[4][k] = jy, own[5][k] = jz;
    }
}

INLINE void fill_points(const model_t *model, const image_t *image, const block_t *b, row_t *point) {
    const double *q = image->numbers + QUAT, *t = image->numbers + SHIFT;
    row_t world[3];
    for (int k = 0; k < SIZE; ++k)
        for (int j = 0; j < 3; ++j) world[j][k] = model->xyz_world[3 * (int64_t)model->point[b->rows[k]] + j];
    for (int k = 0; k < SIZE; ++k) { /* Eigen's order of operations, as loaders.model.moved */
        const double x = world[0][k], y = world[1][k], z = world[2][k];
        const double ux = 2.0 * (q[2] * z - q[3] * y), uy = 2.0 * (q[3] * x - q[1] * z), uz = 2.0 * (q[1] * y - q[2] * x);
        point[0][k] = x + q[0] * ux + (q[2] * uz - q[3] * uy) + t[0];
        point[1][k] = y + q[0] * uy + (q[3] * ux - q[1] * uz) + t[1];
        point[2][k] = z + q[0] * uz + (q[1] * uy - q[2] * ux) + t[2];
    }
}

/* Numbers of the observations of a block, where that of row ``first`` is from[0]. */
INLINE void take(const double *from, int64_t first, const block_t *b, double *to) {
    if (b->in_a_row) copy_row(to, from + (b->rows[0] - first));
    for (int k = 0; !b->in_a_row && k < SIZE; ++k) to[k] = from[b->rows[k] - first];
}

INLINE void fill_gradient(const model_t *model, const image_t *image, const block_t *b, int axis, row_t *gradient) {
    const double *turn = image->numbers + TURN;
    row_t world[3];
    for (int j = 0; j < 3; ++j) take(model->jacobian + (3 * axis + j) * model->jacobian_stride, 0, b, world[j]);
    for (int k = 0; k < SIZE; ++k) {
        const double x = world[0][k], y = world[1][k], z = world[2][k];
        for (int j = 0; j < 3; ++j) gradient[j][k] = turn[3 * j] * x + turn[3 * j + 1] * y + turn[3 * j + 2] * z;
    }
}

/* The undistorted point u: (X, Y) / Z, of fisheyes theta (X, Y) / rho. */
INLINE void undistorted(const row_t *point, int is_fisheye, double *ux, double *uy) {
    for (int k = 0; k < SIZE; ++k) {
        const double z = point[2][k] >= TINY_DEPTH ? point[2][k] : NAN;
        ux[k] = point[0][k] / z, uy[k] = point[1][k] / z;
    }
    for (int k = 0; is_fisheye && k < SIZE; ++k) {
        const double tan2 = ux[k] * ux[k] + uy[k] * uy[k], tangent = sqrt(tan2 < DBL_MIN ? DBL_MIN : tan2);
        const double gain = arctan(tangent) / tangent;
        ux[k] *= gain, uy[k] *= gain;
    }
}

INLINE void fill_lens(row_t *x, row_t *y, const double *ux, const double *uy, const double *lens) {
    const double fx = lens[0], fy = lens[1];
    for (int k = 0; k < SIZE; ++k) {
        const double r2 = ux[k] * ux[k] + uy[k] * uy[k], cross = 2.0 * ux[k] * uy[k];
        x[0][k] = ux[k] * fx * (r2 * r2), y[0][k] = uy[k] * fy * (r2 * r2);
        x[1][k] = x[0][k] * r2, y[1][k] = y[0][k] * r2;
        x[2][k] = cross * fx, y[2][k] = (r2 + 2.0 * uy[k] * uy[k]) * fy;
        x[3][k] = (r2 + 2.0 * ux[k] * ux[k]) * fx, y[3][k] = cross * fy;
    }
}

INLINE void fill_extra(const image_t *image, const block_t *b, int idx, double *x, double *y) {
    const int64_t num = image->stop - image->start;
    const double *along_x = image->d_extra + 2 * idx * num, *along_y = along_x + num;
    take(along_x, image->start, b, x), take(along_y, image->start, b, y);
}

INLINE void fill_focals(block_t *b, int num_focals, const double *vx, const double *vy) {
    copy_row(b->x[6], vx), copy_row(b->y[6], vy);
    if (num_focals < 2) return;
    copy_row(b->y[7], vy);
    memset(b->y[6], 0, sizeof(row_t)), memset(b->x[7], 0, sizeof(row_t));
}

/* All rows of the first ``count`` observations in b->rows. */
static void evaluate(const model_t *model, const image_t *image, int count, block_t *b) {
    const int64_t *facts = model->facts;
    const int q = own_columns(facts), num_rows = q + 1 + LENS + SHUTTER, first_extra = 6 + (int)facts[NUM_FOCALS];
    const double *lens = image->numbers + LENS_NUMBERS;
    const double half = 0.5 * (lens[4] > lens[5] ? lens[4] : lens[5]);
    row_t point[3], gradient[3], ux, uy, px, py, x, y;
    for (int k = count; k < SIZE; ++k) b->rows[k] = b->rows[count - 1];
    fill_points(model, image, b, point);
    for (int axis = 0; axis < 2; ++axis) {
        fill_gradient(model, image, b, axis, gradient);
        fill_pose(axis ? b->y : b->x, (const row_t *)gradient, (const row_t *)point);
    }
    take(model->residuals, 0, b, b->x[q]), take(model->residuals + model->residual_stride, 0, b, b->y[q]);
    for (int k = 0; k < SIZE; ++k) {
        const double *seen = model->xy_px + 2 * model->observation[b->rows[k]];
        px[k] = seen[0] - b->x[q][k], py[k] = seen[1] - b->y[q][k];
    }
    for (int k = 0; k < SIZE; ++k) {
        x[k] = (px[k] - 0.5 * lens[4]) / half, y[k] = (py[k] - 0.5 * lens[5]) / half;
        ux[k] = (px[k] - lens[2]) / lens[0], uy[k] = (py[k] - lens[3]) / lens[1];
    }
    fill_monomials(b, x, y);
    fill_focals(b, (int)facts[NUM_FOCALS], ux, uy);
    for (int e = 0; e < facts[NUM_EXTRA]; ++e) fill_extra(image, b, e, b->x[first_extra + e], b->y[first_extra + e]);
    undistorted((const row_t *)point, (int)facts[IS_FISHEYE], ux, uy);
    fill_lens(b->x + q + 1, b->y + q + 1, ux, uy, lens);
    for (int j = 0; j < LENS; ++j)
        if (facts[RADIAL_0 + j] >= 0) fill_extra(image, b, (int)facts[RADIAL_0 + j], b->x[q + 1 + j], b->y[q + 1 + j]);
    for (int j = 0; j < SHUTTER; ++j)
        for (int k = 0; k < SIZE; ++k) {
            const double row = (py[k] - 0.5 * lens[5]) / lens[5];
            b->x[q + 1 + LENS + j][k] = b->x[j][k] * row, b->y[q + 1 + LENS + j][k] = b->y[j][k] * row;
        }
    if (count == SIZE) return;
    const size_t empty = sizeof(double) * (size_t)(SIZE - count);
    for (int j = 0; j < num_rows; ++j) memset(&b->x[j][count], 0, empty), memset(&b->y[j][count], 0, empty);
    for (int j = 0; j < MONOMIALS; ++j) memset(&b->m[j][count], 0, empty);
}

static int fill_rows(int64_t from, int64_t stop, block_t *b) {
    const int count = stop - from < SIZE ? (int)(stop - from) : SIZE;
    for (int k = 0; k < count; ++k) b->rows[k] = from + k;
    b->in_a_row = count == SIZE;
    return count;
}

/* What lies anywhere in memory of an observation that is evaluated soon. */
INLINE void ask_ahead(const model_t *model, int64_t row) {
    SOON(model->xyz_world + 3 * (int64_t)model->point[row]), SOON(model->xy_px + 2 * model->observation[row]);
}

/* `fill_rows`, while the observations after these are on their way. */
static int next_rows(const model_t *model, const image_t *image, int64_t from, block_t *b) {
    const int64_t stop = image->stop < from + 2 * SIZE ? image->stop : from + 2 * SIZE;
    for (int64_t row = from + SIZE; row < stop; ++row) ask_ahead(model, row);
    return fill_rows(from, image->stop, b);
}

/* The sum of m_i m_j: low has the moments of degree 0 .. 4, row i of high those of m_(10 + i) times the powers. */
static double moment(const lanes *low, const lanes *high, int64_t stride, int i, int j) {
    int degree = 0, power = 0; /* of y */
    for (int k = 0; k < 2; ++k) {
        const int own = k ? j : i;
        int d = 0;
        while ((d + 1) * (d + 2) / 2 <= own) ++d;
        degree += d, power += own - d * (d + 1) / 2;
    }
    if (degree <= 4) return sum(low[degree * (degree + 1) / 2 + power]);
    const int above = degree - 4, of_y = power > 4;
    return sum(high[(of_y ? power - above : power) * stride + 2 * (above - 1) + of_y]);
}

static void set(double *out, int64_t size, int i, int j, double value) { out[i * size + j] = value, out[j * size + i] = value; }

typedef struct {
    lanes own[MAX_OWN * MAX_ROWS], on_y[LENS + SHUTTER], lens[LENS * LENS], shutter[SHUTTER * SHUTTER];
    lanes along_x[MONOMIALS * (MAX_OWN + 1)], along_y[MONOMIALS * (MAX_OWN + 1)], low[MONOMIALS], high[FIVE * POWERS];
} sums_t;

static void add_block(sums_t *s, const block_t *b, int q) {
    row_t powers[POWERS];
    for (int j = 0; j < POWERS; ++j) copy_row(powers[j], b->m[POWER[j]]);
    const int num_rows = q + 1 + LENS + SHUTTER, lens = q + 1, shutter = lens + LENS;
    for (int axis = 0; axis < 2; ++axis) {
        const row_t *rows = axis ? b->y : b->x;
        upper_products(rows, q, num_rows, s->own, MAX_ROWS);
        products(rows + q, 1, rows + lens, LENS + SHUTTER, s->on_y, LENS + SHUTTER);
        upper_products(rows + lens, LENS, LENS, s->lens, LENS);
        upper_products(rows + shutter, SHUTTER, SHUTTER, s->shutter, SHUTTER);
        products(b->m, MONOMIALS, rows, q + 1, axis ? s->along_y : s->along_x, MAX_OWN + 1);
    }
    products(b->m, 1, b->m, MONOMIALS, s->low, MONOMIALS);
    products(b->m + HIGHEST, FIVE, (const row_t *)powers, POWERS, s->high, POWERS);
}

/* gram (q + 40, q + 40) and on_y (q + 40); what the tests do not use stays zero. */
static void write_sums(const sums_t *s, int q, double *gram, double *on_y) {
    const int64_t size = q + NUM_FEATURES;
    const int shutter = q + LENS, along_x = shutter + SHUTTER, along_y = along_x + MONOMIALS;
    memset(gram, 0, sizeof(double) * (size_t)(size * size));
    for (int i = 0; i < q; ++i) {
        for (int j = 0; j <= i; ++j) set(gram, size, i, j, sum(s->own[j * MAX_ROWS + i]));
        for (int j = 0; j < LENS + SHUTTER; ++j) set(gram, size, i, q + j, sum(s->own[i * MAX_ROWS + q + 1 + j]));
        for (int j = 0; j < MONOMIALS; ++j) set(gram, size, i, along_x + j, sum(s->along_x[j * (MAX_OWN + 1) + i]));
        for (int j = 0; j < MONOMIALS; ++j) set(gram, size, i, along_y + j, sum(s->along_y[j * (MAX_OWN + 1) + i]));
        on_y[i] = sum(s->own[i * MAX_ROWS + q]);
    }
    for (int i = 0; i < LENS; ++i)
        for (int j = 0; j <= i; ++j) set(gram, size, q + i, q + j, sum(s->lens[j * LENS + i]));
    for (int i = 0; i < SHUTTER; ++i)
        for (int j = 0; j <= i; ++j) set(gram, size, shutter + i, shutter + j, sum(s->shutter[j * SHUTTER + i]));
    for (int i = 0; i < MONOMIALS; ++i)
        for (int j = 0; j <= i; ++j) {
            const double value = moment(s->low, s->high, POWERS, i, j);
            set(gram, size, along_x + i, along_x + j, value), set(gram, size, along_y + i, along_y + j, value);
        }
    for (int j = 0; j < LENS + SHUTTER; ++j) on_y[q + j] = sum(s->on_y[j]);
    for (int j = 0; j < MONOMIALS; ++j) on_y[along_x + j] = sum(s->along_x[j * (MAX_OWN + 1) + q]);
    for (int j = 0; j < MONOMIALS; ++j) on_y[along_y + j] = sum(s->along_y[j * (MAX_OWN + 1) + q]);
}

/* What all kernels here begin with: images, whose observations are rows[2 i] .. rows[2 i + 1] - 1, and the model. */
#define WINDOW                                                                                                         \
    int64_t num_images, const int64_t *rows, const double *numbers, const double *extra, const int64_t *extra_offsets, \
        const int64_t *facts, const double *xyz_world, const int32_t *point, const double *xy_px,                      \
        const int32_t *observation, const double *residuals, int64_t residual_stride, const double *jacobian,          \
        int64_t jacobian_stride
#define MODEL {xyz_world, xy_px, residuals, jacobian, point, observation, facts, residual_stride, jacobian_stride}
#define IMAGE(i) {rows[2 * (i)], rows[2 * (i) + 1], numbers + NUM_NUMBERS * (i), extra + extra_offsets[i]}

/* First pass: Gram matrices of N and all features, and their products with the residuals. */
KERNEL int64_t sfm_misfit_sums(WINDOW, double *gram, double *on_y) {
    const model_t model = MODEL;
    const int q = own_columns(facts);
    const int64_t size = q + NUM_FEATURES;
    void *to_free;
    struct {
        block_t block;
        sums_t sums;
    } *scratch = aligned_scratch(sizeof *scratch, &to_free);
    if (!scratch || q > MAX_OWN) {
        free(to_free);
        return scratch ? NEEDS_NUMPY : NO_MEMORY;
    }
    block_t *block = &scratch->block;
    for (int64_t i = 0; i < num_images; ++i) {
        const image_t image = IMAGE(i);
        memset(&scratch->sums, 0, sizeof scratch->sums);
        for (int64_t from = image.start; from < image.stop; from += SIZE) {
            evaluate(&model, &image, next_rows(&model, &image, from, block), block);
            add_block(&scratch->sums, block, q);
        }
        write_sums(&scratch->sums, q, gram + i * size * size, on_y + i * size);
    }
    free(to_free);
    return DONE;
}

/* w = (y - N c) / sqrt(1 - h) along x and y, h the squared length of the ``num`` rows of basis N. */
static void weigh(const block_t *b, int q, const double *basis, int num, const double *c, scores_t *s) {
    int length[MAX_OWN]; /* of each row of the basis, zeros at its end left out */
    for (int i = 0; i < num; ++i)
        for (length[i] = q; length[i] > 0 && basis[i * q + length[i] - 1] == 0.0;) --length[i];
    double largest = s->largest_leverage;
    for (int axis = 0; axis < 2; ++axis) {
        const row_t *own = axis ? b->y : b->x;
        row_t leverage;
        for (int k = 0; k < SIZE; k += 8) {
            lanes first = {0}, second = {0};
            for (int i = 0; i < num; ++i) {
                lanes left = {0}, right = {0};
                for (int j = 0; j < length[i]; ++j) {
                    left += basis[i * q + j] * *(const lanes *)&own[j][k];
                    right += basis[i * q + j] * *(const lanes *)&own[j][k + 4];
                }
                first += left * left, second += right * right;
            }
            *(lanes *)&leverage[k] = first, *(lanes *)&leverage[k + 4] = second;
        }
        for (int k = 0; k < SIZE; ++k) largest = leverage[k] > largest ? leverage[k] : largest;
        copy_row(s->w[axis], own[q]);
        for (int j = 0; j < q; ++j)
            for (int k = 0; k < SIZE; ++k) s->w[axis][k] -= c[j] * own[j][k];
        copy_row(s->left[axis], s->w[axis]);
        for (int k = 0; k < SIZE; ++k)
            s->w[axis][k] /= sqrt(1.0 - (leverage[k] < MAX_LEVERAGE ? leverage[k] : MAX_LEVERAGE));
    }
    s->largest_leverage = largest;
}

/* Both rows of each feature times w. */
static void fill_scores(const block_t *b, int q, scores_t *s) {
    const double *wx = s->w[0], *wy = s->w[1];
    for (int j = 0; j < q + LENS + SHUTTER; ++j) {
        const int from = j < q ? j : j + 1;
        for (int k = 0; k < SIZE; ++k) s->g[j][k] = b->x[from][k] * wx[k] + b->y[from][k] * wy[k];
    }
    row_t *along_x = s->g + q + LENS + SHUTTER, *along_y = along_x + MONOMIALS;
    for (int j = 0; j < MONOMIALS; ++j)
        for (int k = 0; k < SIZE; ++k) along_x[j][k] = b->m[j][k] * wx[k], along_y[j][k] = b->m[j][k] * wy[k];
}

typedef struct {
    lanes own[MAX_OWN * MAX_FEATURES], lens[LENS * LENS], shutter[SHUTTER * SHUTTER];
    lanes low[3 * MONOMIALS], high[FIVE * 3 * POWERS], smooth[4 * MONOMIALS * MONOMIALS];
} meat_t;

static void add_own(meat_t *meat, const row_t *g, int q) {
    upper_products(g, q, q + NUM_FEATURES, meat->own, MAX_FEATURES);
    upper_products(g + q, LENS, LENS, meat->lens, LENS);
    upper_products(g + q + LENS, SHUTTER, SHUTTER, meat->shutter, SHUTTER);
}

static void fill_squares(const block_t *b, scores_t *s) {
    const double *wx = s->w[0], *wy = s->w[1];
    for (int k = 0; k < SIZE; ++k)
        s->squares[0][k] = wx[k] * wx[k], s->squares[1][k] = wx[k] * wy[k], s->squares[2][k] = wy[k] * wy[k];
    for (int axes = 0; axes < 3; ++axes)
        for (int j = 0; j < POWERS; ++j)
            for (int k = 0; k < SIZE; ++k) s->powers[axes * POWERS + j][k] = b->m[POWER[j]][k] * s->squares[axes][k];
}

static void add_single(meat_t *meat, const block_t *b, scores_t *s, int q) {
    add_own(meat, (const row_t *)s->g, q);
    fill_squares(b, s);
    products((const row_t *)s->squares, 3, b->m, MONOMIALS, meat->low, MONOMIALS);
    products(b->m + HIGHEST, FIVE, (const row_t *)s->powers, 3 * POWERS, meat->high, 3 * POWERS);
}

static void add_clusters(meat_t *meat, row_t *sums, int count, int q) {
    for (int j = 0; j < q + NUM_FEATURES; ++j) memset(&sums[j][count], 0, sizeof(double) * (size_t)(SIZE - count));
    add_own(meat, (const row_t *)sums, q);
    const row_t *smooth = (const row_t *)sums + q + LENS + SHUTTER;
    upper_products(smooth, 2 * MONOMIALS, 2 * MONOMIALS, meat->smooth, 2 * MONOMIALS);
}

static void write_meat(const meat_t *meat, int q, double *out) {
    const int64_t size = q + NUM_FEATURES;
    const int shutter = q + LENS, smooth = shutter + SHUTTER;
    memset(out, 0, sizeof(double) * (size_t)(size * size));
    for (int i = 0; i < q; ++i)
        for (int j = i; j < size; ++j) set(out, size, i, j, sum(meat->own[i * MAX_FEATURES + j]));
    for (int i = 0; i < LENS; ++i)
        for (int j = 0; j <= i; ++j) set(out, size, q + i, q + j, sum(meat->lens[j * LENS + i]));
    for (int i = 0; i < SHUTTER; ++i)
        for (int j = 0; j <= i; ++j) set(out, size, shutter + i, shutter + j, sum(meat->shutter[j * SHUTTER + i]));
    for (int i = 0; i < 2 * MONOMIALS; ++i)
        for (int j = 0; j <= i; ++j) {
            const int axes = (i >= MONOMIALS) + (j >= MONOMIALS); /* 0: w_x^2, 1: w_x w_y, 2: w_y^2 */
            const lanes *low = meat->low + axes * MONOMIALS, *high = meat->high + axes * POWERS;
            const double single = moment(low, high, 3 * POWERS, i % MONOMIALS, j % MONOMIALS);
            set(out, size, smooth + i, smooth + j, single + sum(meat->smooth[j * 2 * MONOMIALS + i]));
        }
}

/* Observations of an image whose keypoints lie in one pixel. head: the first of each observation's pixel, size: how many
 * are there.   members: those of pixels of two and more, pixel by pixel. */
typedef struct {
    int64_t *head, *size, *members, *table, *column, *row;
    int64_t capacity, num_members, num_clusters, num_probes;
    void *memory;
} clusters_t;

static int make_clusters(int64_t longest, clusters_t *c) {
    c->capacity = 16;
    while (c->capacity < 2 * longest) c->capacity *= 2;
    int64_t *memory = malloc(sizeof(int64_t) * (size_t)(5 * longest + c->capacity));
    c->memory = memory;
    if (!memory) return NO_MEMORY;
    c->head = memory, c->size = memory + longest, c->members = memory + 2 * longest;
    c->column = memory + 3 * longest, c->row = memory + 4 * longest, c->table = memory + 5 * longest;
    return DONE;
}

static int64_t first_of_pixel(clusters_t *c, int64_t i, int64_t capacity) {
    uint64_t hash = (uint64_t)c->column[i] * 0x9E3779B97F4A7C15u + (uint64_t)c->row[i];
    hash *= 0xD6E8FEB86659FD93u;
    for (int64_t slot = (int64_t)((hash >> 32) & (uint64_t)(capacity - 1));; slot = (slot + 1) & (capacity - 1)) {
        const int64_t other = c->table[slot];
        c->num_probes += 1;
        if (other < 0) return c->table[slot] = i;
        if (c->column[other] == c->column[i] && c->row[other] == c->row[i]) return other;
    }
}

static int find_clusters(const model_t *model, const image_t *image, clusters_t *c) {
    const int64_t num = image->stop - image->start;
    int64_t capacity = 16, placed = 0;
    while (capacity < 2 * num) capacity *= 2;
    memset(c->table, -1, sizeof(int64_t) * (size_t)capacity);
    c->num_clusters = c->num_probes = 0;
    for (int64_t i = 0; i < num; ++i) {
        const double *seen = model->xy_px + 2 * model->observation[image->start + i];
        if (!(fabs(seen[0]) < 1e15 && fabs(seen[1]) < 1e15)) return NEEDS_NUMPY;
        c->column[i] = (int64_t)floor(seen[0]), c->row[i] = (int64_t)floor(seen[1]), c->size[i] = 0;
        c->head[i] = first_of_pixel(c, i, capacity);
        c->size[c->head[i]] += 1, c->num_clusters += c->head[i] == i;
        if (c->num_probes > 64 * num) return NEEDS_NUMPY; /* pixels made to meet in the table */
    }
    for (int64_t i = 0; i < num; ++i) /* column: where the pixel's next member goes */
        if (c->head[i] == i && c->size[i] > 1) c->column[i] = placed, placed += c->size[i];
    for (int64_t i = 0; i < num; ++i)
        if (c->size[c->head[i]] > 1) c->members[c->column[c->head[i]]++] = i;
    c->num_members = placed;
    return DONE;
}

/* Rows of members from the ``from``-th on; return how many. */
static int member_rows(const image_t *image, const clusters_t *c, int64_t from, block_t *b) {
    const int count = fill_rows(from, c->num_members, b);
    for (int k = 0; k < count; ++k) b->rows[k] = image->start + c->members[from + k];
    b->in_a_row = 0;
    return count;
}

/* What the profiled N of an image is: rows of an orthonormal basis (num, q) of it, and c (q) with y~ = y - N c. */
typedef struct {
    const double *basis, *on_y;
    int num;
} profile_t;

static void meat_of_singles(const model_t *model, const image_t *image, const profile_t *profile, const clusters_t *c,
                            scratch_t *scratch, meat_t *meat) {
    const int q = own_columns(model->facts);
    block_t *b = &scratch->block;
    for (int64_t from = image->start; from < image->stop; from += SIZE) {
        const int count = next_rows(model, image, from, b);
        evaluate(model, image, count, b);
        weigh(b, q, profile->basis, profile->num, profile->on_y, &scratch->scores);
        for (int k = 0; k < count; ++k)
            if (c->size[c->head[from - image->start + k]] > 1) scratch->scores.w[0][k] = scratch->scores.w[1][k] = 0.0;
        fill_scores(b, q, &scratch->scores);
        add_single(meat, b, &scratch->scores, q);
    }
}

static void meat_of_clusters(const model_t *model, const image_t *image, const profile_t *profile, const clusters_t *c,
                             scratch_t *scratch, meat_t *meat) {
    const int q = own_columns(model->facts), size = q + NUM_FEATURES;
    block_t *b = &scratch->block;
    int at = -1; /* the column of the pixel's sums */
    for (int64_t from = 0; from < c->num_members; from += SIZE) {
        const int count = member_rows(image, c, from, b);
        evaluate(model, image, count, b);
        weigh(b, q, profile->basis, profile->num, profile->on_y, &scratch->scores);
        fill_scores(b, q, &scratch->scores);
        for (int k = 0; k < count; ++k) {
            if (c->head[c->members[from + k]] == c->members[from + k]) {
                if (at == SIZE - 1) add_clusters(meat, scratch->clusters, SIZE, q), at = -1;
                ++at;
                for (int j = 0; j < size; ++j) scratch->clusters[j][at] = 0.0;
            }
            for (int j = 0; j < size; ++j) scratch->clusters[j][at] += scratch->scores.g[j][k];
        }
    }
    if (at >= 0) add_clusters(meat, scratch->clusters, at + 1, q);
}

/* Second pass: the meat, observations of a pixel as one, and how many there are. leverage: the largest. */
KERNEL int64_t sfm_misfit_meat(WINDOW, const double *basis, const double *on_y, double *meat, double *leverage, int64_t *num_clusters) {
    const model_t model = MODEL;
    const int q = own_columns(facts);
    const int64_t size = q + NUM_FEATURES;
    int64_t longest = 1;
    for (int64_t i = 0; i < num_images; ++i)
        if (rows[2 * i + 1] - rows[2 * i] > longest) longest = rows[2 * i + 1] - rows[2 * i];
    void *to_free;
    clusters_t clusters;
    struct {
        scratch_t common;
        meat_t meat;
    } *room = aligned_scratch(sizeof *room, &to_free);
    const int status = make_clusters(longest, &clusters);
    if (!room || status != DONE || q > MAX_OWN) {
        free(to_free), free(clusters.memory);
        return q > MAX_OWN ? NEEDS_NUMPY : NO_MEMORY;
    }
    scratch_t *scratch = &room->common;
    meat_t *sums = &room->meat;
    for (int64_t i = 0; i < num_images; ++i) {
        const image_t image = IMAGE(i);
        const profile_t profile = {basis + i * q * q, on_y + i * q, q};
        num_clusters[i] = -1;
        if (find_clusters(&model, &image, &clusters) != DONE) continue;
        memset(sums, 0, sizeof *sums);
        scratch->scores.largest_leverage = 0.0;
        meat_of_singles(&model, &image, &profile, &clusters, scratch, sums);
        meat_of_clusters(&model, &image, &profile, &clusters, scratch, sums);
        write_meat(sums, q, meat + i * size * size);
        leverage[i] = scratch->scores.largest_leverage, num_clusters[i] = clusters.num_clusters;
    }
    free(to_free), free(clusters.memory);
    return DONE;
}

/* The smooth fields once more, mixed and projected before they are summed up: u = m mix - N coefficients, along x and y. */
enum { SMOOTH = 2 * (MONOMIALS - 1) };
typedef struct {
    row_t u[2][SMOOTH], g[SMOOTH], clusters[SMOOTH];
    lanes gram[SMOOTH * SMOOTH], on_y[SMOOTH], meat[SMOOTH * SMOOTH];
} mixed_t;

typedef struct {
    scratch_t common;
    mixed_t mixed;
} mixed_scratch_t;

static void mix_fields(const block_t *b, int q, const double *mix, const double *coefficients, scores_t *s, mixed_t *out) {
    for (int axis = 0; axis < 2; ++axis) {
        const row_t *own = axis ? b->y : b->x;
        const double *factors = mix + axis * (MONOMIALS - 1) * SMOOTH;
        for (int k = 0; k < SIZE; k += 8)
            for (int j = 0; j < SMOOTH; ++j) {
                lanes left = {0}, right = {0};
                for (int i = 0; i < MONOMIALS - 1; ++i) {
                    const double factor = factors[i * SMOOTH + j];
                    left += factor * *(const lanes *)&b->m[i + 1][k], right += factor * *(const lanes *)&b->m[i + 1][k + 4];
                }
                for (int i = 0; i < q; ++i) {
                    const double factor = coefficients[i * SMOOTH + j];
                    left -= factor * *(const lanes *)&own[i][k], right -= factor * *(const lanes *)&own[i][k + 4];
                }
                *(lanes *)&out->u[axis][j][k] = left, *(lanes *)&out->u[axis][j][k + 4] = right;
            }
    }
    for (int j = 0; j < SMOOTH; ++j)
        for (int k = 0; k < SIZE; ++k) out->g[j][k] = out->u[0][j][k] * s->w[0][k] + out->u[1][j][k] * s->w[1][k];
}

typedef struct {
    const double *mix, *coefficients;
} mixing_t;

static void mixed_block(const model_t *model, const image_t *image, const profile_t *profile, const mixing_t *mixing,
                        int count, mixed_scratch_t *scratch, const clusters_t *alone) {
    const int q = own_columns(model->facts);
    block_t *b = &scratch->common.block;
    scores_t *s = &scratch->common.scores;
    evaluate(model, image, count, b);
    weigh(b, q, profile->basis, profile->num, profile->on_y, s);
    for (int k = 0; alone && k < count; ++k)
        if (alone->size[alone->head[b->rows[k] - image->start]] > 1) s->w[0][k] = s->w[1][k] = 0.0;
    mix_fields(b, q, mixing->mix, mixing->coefficients, s, &scratch->mixed);
}

static void add_mixed(const model_t *model, const image_t *image, const profile_t *profile, const mixing_t *mixing,
                      const clusters_t *c, mixed_scratch_t *scratch) {
    block_t *b = &scratch->common.block;
    mixed_t *m = &scratch->mixed;
    for (int64_t from = image->start; from < image->stop; from += SIZE) {
        mixed_block(model, image, profile, mixing, next_rows(model, image, from, b), scratch, c);
        for (int axis = 0; axis < 2; ++axis) {
            const row_t *u = (const row_t *)m->u[axis];
            upper_products(u, SMOOTH, SMOOTH, m->gram, SMOOTH);
            products((const row_t *)scratch->common.scores.left + axis, 1, u, SMOOTH, m->on_y, SMOOTH);
        }
        upper_products((const row_t *)m->g, SMOOTH, SMOOTH, m->meat, SMOOTH);
    }
    int at = -1;
    for (int64_t from = 0; from < c->num_members; from += SIZE) {
        const int count = member_rows(image, c, from, b);
        mixed_block(model, image, profile, mixing, count, scratch, NULL);
        for (int k = 0; k < count; ++k) {
            const int starts = c->head[c->members[from + k]] == c->members[from + k];
            if (starts && at == SIZE - 1) {
                upper_products((const row_t *)m->clusters, SMOOTH, SMOOTH, m->meat, SMOOTH);
                at = -1;
            }
            at += starts;
            for (int j = 0; j < SMOOTH; ++j) m->clusters[j][at] = m->g[j][k] + (starts ? 0.0 : m->clusters[j][at]);
        }
    }
    for (int j = 0; at >= 0 && j < SMOOTH; ++j)
        for (int k = at + 1; k < SIZE; ++k) m->clusters[j][k] = 0.0;
    if (at >= 0) upper_products((const row_t *)m->clusters, SMOOTH, SMOOTH, m->meat, SMOOTH);
}

/* The smooth fields of images whose digits do not last in plain sums: Gram matrix, products with y - N c, meat. */
KERNEL int64_t sfm_misfit_mixed(WINDOW, const double *basis, const double *on_y, const double *mix,
                                const double *coefficients, double *gram, double *scores, double *meat) {
    const model_t model = MODEL;
    const int q = own_columns(facts);
    int64_t longest = 1;
    for (int64_t i = 0; i < num_images; ++i)
        if (rows[2 * i + 1] - rows[2 * i] > longest) longest = rows[2 * i + 1] - rows[2 * i];
    void *to_free;
    clusters_t clusters;
    mixed_scratch_t *scratch = aligned_scratch(sizeof(mixed_scratch_t), &to_free);
    int status = make_clusters(longest, &clusters);
    if (!scratch || q > MAX_OWN) status = q > MAX_OWN ? NEEDS_NUMPY : NO_MEMORY;
    for (int64_t i = 0; status == DONE && i < num_images; ++i) {
        const image_t image = IMAGE(i);
        const profile_t profile = {basis + i * q * q, on_y + i * q, q};
        const mixing_t mixing = {mix + i * SMOOTH * SMOOTH, coefficients + i * q * SMOOTH};
        mixed_t *m = &scratch->mixed;
        status = find_clusters(&model, &image, &clusters);
        memset(m->gram, 0, sizeof m->gram), memset(m->on_y, 0, sizeof m->on_y), memset(m->meat, 0, sizeof m->meat);
        if (status == DONE) add_mixed(&model, &image, &profile, &mixing, &clusters, scratch);
        for (int j = 0; j < SMOOTH; ++j) scores[i * SMOOTH + j] = sum(m->on_y[j]);
        for (int j = 0; j < SMOOTH; ++j)
            for (int k = j; k < SMOOTH; ++k) {
                set(gram + i * SMOOTH * SMOOTH, SMOOTH, j, k, sum(m->gram[j * SMOOTH + k]));
                set(meat + i * SMOOTH * SMOOTH, SMOOTH, j, k, sum(m->meat[j * SMOOTH + k]));
            }
    }
    free(to_free), free(clusters.memory);
    return status;
}

/* g minus what the profile explains of it: g_j -= sum_i coefficients (q, 40) of (N w)_i. */
static void project_scores(scores_t *s, int q, const double *coefficients) {
    for (int k = 0; k < SIZE; k += 8)
        for (int j = 0; j < NUM_FEATURES; ++j) {
            lanes left = *(const lanes *)&s->g[q + j][k], right = *(const lanes *)&s->g[q + j][k + 4];
            for (int i = 0; i < q; ++i) {
                const double factor = coefficients[i * NUM_FEATURES + j];
                left -= factor * *(const lanes *)&s->g[i][k], right -= factor * *(const lanes *)&s->g[i][k + 4];
            }
            *(lanes *)&s->g[q + j][k] = left, *(lanes *)&s->g[q + j][k + 4] = right;
        }
}

/* Adds what the observations of a block say to the rows of their tracks, four features of four observations at a time. */
static void add_to_tracks(const row_t *g, int count, double *const *track) {
    for (int k = 0; k < count; k += 4)
        for (int j = 0; j < NUM_FEATURES; j += 4) {
            Lanes part[4];
            for (int i = 0; i < 4; ++i) part[i] = load(&g[j + i][k]);
            transpose(part);
            for (int i = 0; i < 4 && k + i < count; ++i) store(track[k + i] + j, load(track[k + i] + j) + part[i]);
        }
}

/* Puts the next observations whose tracks are first .. last - 1 into a block, up to ``stop``; returns where it went on to. */
static int64_t rows_of_tracks(const model_t *model, const int32_t *track_of_row, int64_t from, int64_t stop, int64_t first,
                              int64_t last, block_t *b, int *count) {
    *count = 0;
    for (; from < stop && *count < SIZE; ++from) {
        b->rows[*count] = from;
        *count += track_of_row[from] >= first && track_of_row[from] < last;
        if (from + 2 * SIZE < stop) ask_ahead(model, from + 2 * SIZE);
    }
    b->in_a_row = *count == SIZE && b->rows[SIZE - 1] - b->rows[0] == SIZE - 1;
    return from;
}

/* Second pass of images that share a camera: what each observation adds to its track, tracks first .. last - 1. */
KERNEL int64_t sfm_misfit_tracks(WINDOW, const double *basis, int64_t basis_rows, const double *on_y, const double *coefficients, const int32_t *track_of_row, int64_t first, int64_t last, double *per_track) {
    const model_t model = MODEL;
    const int q = own_columns(facts);
    void *to_free;
    scratch_t *scratch = aligned_scratch(sizeof(scratch_t), &to_free);
    if (!scratch || q > MAX_OWN) {
        free(to_free);
        return scratch ? NEEDS_NUMPY : NO_MEMORY;
    }
    block_t *b = &scratch->block;
    for (int64_t i = 0; i < num_images; ++i) {
        const image_t image = IMAGE(i);
        for (int64_t from = image.start; from < image.stop;) {
            int count;
            double *track[SIZE];
            from = rows_of_tracks(&model, track_of_row, from, image.stop, first, last, b, &count);
            if (!count) break;
            for (int k = 0; k < count; ++k) {
                track[k] = per_track + (track_of_row[b->rows[k]] - first) * NUM_FEATURES;
                for (int j = 0; j < NUM_FEATURES; j += 8) SOON(track[k] + j);
            }
            evaluate(&model, &image, count, b);
            weigh(b, q, basis + i * basis_rows * q, (int)basis_rows, on_y + i * q, &scratch->scores);
            fill_scores(b, q, &scratch->scores);
            project_scores(&scratch->scores, q, coefficients + i * q * NUM_FEATURES);
            add_to_tracks((const row_t *)scratch->scores.g + q, count, track);
        }
    }
    free(to_free);
    return DONE;
}
