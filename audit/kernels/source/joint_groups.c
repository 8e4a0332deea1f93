/* Tests of groups of candidate fields from the sums of joint_scores.c: what audit/joint/group_test.py does by numpy.
 *
 * A field is a function, or two of them with a factor each. Matrices are of one group: rows of MOST numbers, those from the
 * group's width on zero, so that loops over lanes need no end of their own. */
#include "kernel.h"

enum { LANES = 4, MOST = 32, TERMS = 2, MOST_TURNS = 40 };

/* One group of one image. c: its fields; w: these, filled up to lanes. */
typedef struct {
    int64_t c, w;
    double gram[MOST * MOST], meat[MOST * MOST], vector[MOST * MOST], root[MOST * MOST], spread[MOST * MOST];
    double score[MOST], scale[MOST], value[MOST], beside[MOST + 1], held[MOST], z[MOST];
    int64_t order[MOST];
} group;

INLINE double dot(const double *restrict a, const double *restrict b, int64_t w) {
    double sum[LANES] = {0.0};
    for (int64_t j = 0; j < w; j += LANES) {
        for (int l = 0; l < LANES; l++) sum[l] += a[j + l] * b[j + l];
    }
    return (sum[0] + sum[1]) + (sum[2] + sum[3]);
}

INLINE void add_row(double *restrict to, double x, const double *restrict from, int64_t w) {
    for (int64_t j = 0; j < w; j++) to[j] += x * from[j];
}

INLINE int64_t filled_up(int64_t c) { return (c + LANES - 1) / LANES * LANES; }

/* out (rows, w) = left (rows, num) right (num, w) */
INLINE void product(int64_t rows, int64_t num, const double *restrict left, const double *restrict right, int64_t w, double *restrict out) {
    for (int64_t i = 0; i < rows; i++) {
        double sum[MOST] = {0.0};
        for (int64_t k = 0; k < num; k++) {
            for (int64_t j = 0; j < w; j++) sum[j] += left[MOST * i + k] * right[MOST * k + j];
        }
        for (int64_t j = 0; j < w; j++) out[MOST * i + j] = sum[j];
    }
}

/* Reflect gram (c, c) to a tridiagonal matrix: value (c) its diagonal, beside[i] what couples i - 1 and i; vector: the product of
 * the reflections, so that vector gram vector^T is that matrix. gram is used up. */
INLINE void tridiagonal(group *g) {
    double *a = g->gram, *z = g->vector;
    double length[MOST] = {0.0};
    memset(z, 0, (size_t)(MOST * g->c) * sizeof *z);
    for (int64_t i = 0; i < g->c; i++) z[MOST * i + i] = 1.0;
    g->beside[0] = 0.0;
    for (int64_t i = g->c - 1; i > 0; i--) {
        double *v = a + MOST * i, along[MOST] = {0.0};
        int64_t w = filled_up(i);
        g->value[i] = v[i];
        for (int64_t j = i; j < w; j++) v[j] = 0.0;
        double last = v[i - 1], square = dot(v, v, w), norm = sqrt(square);
        if (!(square > last * last)) { /* nothing but the last one */
            g->beside[i] = last;
            continue;
        }
        double to = last > 0.0 ? -norm : norm;
        g->beside[i] = to;
        v[i - 1] = last - to;
        length[i] = 1.0 / (norm * (norm + fabs(last))); /* 2 / v^T v */
        for (int64_t j = 0; j < i; j++) add_row(along, v[j], a + MOST * j, w);
        for (int64_t j = 0; j < w; j++) along[j] = j < i ? along[j] * length[i] : 0.0;
        add_row(along, -0.5 * length[i] * dot(v, along, w), v, w);
        for (int64_t j = 0; j < i; j++) {
            double x = v[j], y = along[j];
            for (int64_t k = 0; k < w; k++) a[MOST * j + k] -= x * along[k] + y * v[k];
        }
    }
    g->value[0] = a[0];
    for (int64_t i = 2; i < g->c; i++) {
        const double *v = a + MOST * i;
        int64_t w = filled_up(i);
        for (int64_t r = 0; r < i && length[i] > 0.0; r++) add_row(z + MOST * r, -length[i] * dot(z + MOST * r, v, w), v, w);
    }
}

/* Eigenvalues of gram and, as rows of vector, its eigenvectors: implicit QL steps with shifts. 0 where they do not end. */
INLINE int decompose(group *g) {
    double *d = g->value, *e = g->beside, largest = 0.0;
    tridiagonal(g);
    for (int64_t i = 0; i < g->c; i++) {
        double here = fabs(d[i]) + fabs(e[i]);
        largest = here > largest ? here : largest;
        e[i] = i + 1 < g->c ? e[i + 1] : 0.0; /* from here on what couples i and i + 1 */
    }
    for (int64_t l = 0; l < g->c; l++) {
        for (int turn = 0;; turn++) {
            int64_t m = l;
            while (m + 1 < g->c && fabs(e[m]) > 0.5 * DBL_EPSILON * largest) m++;
            if (m == l) break;
            if (turn == MOST_TURNS) return 0;
            double half = (d[l + 1] - d[l]) / (2.0 * e[l]), shifted = sqrt(half * half + 1.0);
            double x = d[m] - d[l] + e[l] / (half + (half < 0.0 ? -shifted : shifted));
            double s = 1.0, c = 1.0, p = 0.0;
            int64_t i = m - 1;
            for (; i >= l; i--) {
                double f = s * e[i], b = c * e[i], r = sqrt(f * f + x * x);
                e[i + 1] = r;
                if (r == 0.0) break;
                s = f / r, c = x / r;
                x = d[i + 1] - p;
                r = (d[i] - x) * s + 2.0 * c * b;
                p = s * r;
                d[i + 1] = x + p;
                x = c * r - b;
                double *restrict low = g->vector + MOST * i, *restrict high = low + MOST;
                for (int64_t k = 0; k < g->w; k++) {
                    double u = high[k], v = low[k];
                    high[k] = s * v + c * u, low[k] = c * v - s * u;
                }
            }
            if (i >= l) {
                d[i + 1] -= p, e[m] = 0.0;
                continue;
            }
            d[l] -= p, e[l] = x, e[m] = 0.0;
        }
    }
    for (int64_t i = 0; i < g->c; i++) { /* ascending */
        int64_t k = i;
        while (k > 0 && d[g->order[k - 1]] > d[i]) g->order[k] = g->order[k - 1], k--;
        g->order[k] = i;
    }
    return 1;
}

/* z^T M^-1 z over the first r rows of spread, scaled to unit diagonal; NaN where M is singular: *sure is 0 where that is in doubt. */
INLINE double quadratic_form(group *g, int64_t r, double singular, int *sure) {
    double *m = g->spread, *x = g->held, sum = 0.0, smallest = 1.0;
    for (int64_t i = 0; i < r; i++) {
        double square = m[MOST * i + i];
        if (!(square > 0.0 && square <= DBL_MAX)) return NAN;
        g->scale[i] = sqrt(square);
    }
    for (int64_t i = 0; i < r; i++) {
        double *row = m + MOST * i;
        for (int64_t j = 0; j <= i; j++) row[j] = row[j] / g->scale[i] / g->scale[j];
        int64_t w = filled_up(i + 1);
        for (int64_t j = i + 1; j < w; j++) row[j] = 0.0;
        for (int64_t j = 0; j < i; j++) {
            double own = row[j];
            row[j] = 0.0; /* what is behind it is not known yet, and zero in the other row */
            double before = own - dot(row, m + MOST * j, filled_up(j + 1));
            row[j] = before / m[MOST * j + j];
        }
        double kept = row[i];
        row[i] = 0.0;
        double pivot = kept - dot(row, row, w);
        if (!(pivot > 0.0)) {
            *sure &= pivot < 0.1 * singular;
            return NAN;
        }
        smallest = pivot < smallest ? pivot : smallest;
        row[i] = sqrt(pivot);
        double rest = g->z[i] / g->scale[i];
        for (int64_t j = 0; j < i; j++) rest -= row[j] * x[j];
        x[i] = rest / row[i];
        sum += x[i] * x[i];
    }
    *sure &= smallest > 10.0 * singular || smallest < 0.1 * singular;
    return smallest > singular ? sum : NAN;
}

/* Sums of one image over its functions. */
typedef struct {
    int64_t functions, scalars;
    const double *gram, *meat, *score, *plain, *dense_plain;
    const int64_t *term;  /* (fields, TERMS), -1: none */
    const double *factor; /* (fields, TERMS) */
} sums;

/* Entry of two fields in a matrix of the functions. */
INLINE double of_fields(const sums *s, const double *matrix, int64_t a, int64_t b) {
    double sum = 0.0;
    for (int i = 0; i < TERMS && s->term[TERMS * a + i] >= 0; i++) {
        const double *row = matrix + s->functions * s->term[TERMS * a + i];
        double of_row = 0.0;
        for (int j = 0; j < TERMS && s->term[TERMS * b + j] >= 0; j++) of_row += s->factor[TERMS * b + j] * row[s->term[TERMS * b + j]];
        sum += s->factor[TERMS * a + i] * of_row;
    }
    return sum;
}

/* w E^T E of two functions; none mixes one with both components with any other. */
INLINE double plain_of(const sums *s, int64_t a, int64_t b) {
    if (a >= 2 * s->scalars || b >= 2 * s->scalars) return a == b ? s->dense_plain[a - 2 * s->scalars] : 0.0;
    if ((a < s->scalars) != (b < s->scalars)) return 0.0;
    return s->plain[s->scalars * (a % s->scalars) + b % s->scalars];
}

/* |E|^2 of a field; NaN where the sums over its functions cancel. */
INLINE double squared_length(const sums *s, int64_t a, double left_of_terms) {
    double sum = 0.0, largest = 0.0;
    for (int i = 0; i < TERMS && s->term[TERMS * a + i] >= 0; i++) {
        double f = s->factor[TERMS * a + i];
        int64_t row = s->term[TERMS * a + i];
        largest += f * f * plain_of(s, row, row);
        for (int j = 0; j < TERMS && s->term[TERMS * a + j] >= 0; j++) sum += f * s->factor[TERMS * a + j] * plain_of(s, row, s->term[TERMS * a + j]);
    }
    return sum < left_of_terms * largest ? NAN : sum;
}

INLINE double score_of(const sums *s, int64_t a) {
    double sum = 0.0;
    for (int i = 0; i < TERMS && s->term[TERMS * a + i] >= 0; i++) sum += s->factor[TERMS * a + i] * s->score[s->term[TERMS * a + i]];
    return sum;
}

/* Take the fields first <= a < first + c of an image; squares: of the lengths of all. */
INLINE void take(group *g, const sums *s, int64_t first, int64_t c, const double *squares) {
    g->c = c, g->w = filled_up(c);
    for (int64_t i = 0; i < c; i++) {
        g->scale[i] = squares[first + i] > 0.0 ? 1.0 / sqrt(squares[first + i]) : 0.0;
        g->score[i] = score_of(s, first + i);
    }
    for (int64_t i = 0; i < c; i++) {
        for (int64_t j = 0; j < g->w; j++) {
            g->gram[MOST * i + j] = j < c ? of_fields(s, s->gram, first + i, first + j) * g->scale[i] * g->scale[j] : 0.0;
            g->meat[MOST * i + j] = j < c ? of_fields(s, s->meat, first + i, first + j) : 0.0;
        }
    }
}

/* The numbers of a group: statistic, NaN where it is singular or the rank above the most; gain, rank; theta (c) = K^+ u. 0 where
 * numpy has to be asked. */
INLINE int judge(group *g, double kept_eigenvalue, double singular, int64_t most_rank, double *statistic, double *gain, int64_t *rank, double *theta) {
    int sure = 1;
    int64_t r = 0;
    if (!decompose(g)) return 0;
    for (int64_t k = 0; k < g->c; k++) {
        double value = g->value[g->order[k]];
        const double *from = g->vector + MOST * g->order[k];
        if (!(fabs(value - kept_eigenvalue) > 1e-8 * kept_eigenvalue)) return 0;
        if (value < kept_eigenvalue) continue;
        double *to = g->root + MOST * r++, size = sqrt(value);
        for (int64_t j = 0; j < g->w; j++) to[j] = j < g->c ? from[j] / size * g->scale[j] : 0.0;
    }
    for (int64_t j = g->c; j < g->w; j++) g->score[j] = 0.0;
    *rank = r, *gain = 0.0;
    for (int64_t j = 0; j < g->w; j++) g->held[j] = 0.0;
    for (int64_t i = 0; i < r; i++) {
        g->z[i] = dot(g->root + MOST * i, g->score, g->w);
        add_row(g->held, g->z[i], g->root + MOST * i, g->w);
        *gain += g->z[i] * g->z[i];
    }
    for (int64_t j = 0; j < g->c; j++) theta[j] = g->held[j];
    double *moved = g->vector, *turned = g->gram; /* both are used up */
    product(r, g->c, g->root, g->meat, g->w, moved);
    for (int64_t i = 0; i < MOST * g->c; i++) turned[i] = 0.0;
    for (int64_t i = 0; i < r; i++) {
        for (int64_t j = 0; j < g->c; j++) turned[MOST * j + i] = g->root[MOST * i + j];
    }
    product(r, g->c, moved, turned, filled_up(r), g->spread);
    double removed = 0.0;
    for (int64_t i = 0; i < r; i++) removed += g->spread[MOST * i + i];
    *gain -= removed;
    *statistic = r > most_rank ? NAN : quadratic_form(g, r, singular, &sure);
    return sure;
}

/* Whether no number is so large that products of two might not be finite. */
INLINE int is_small(const double *values, int64_t num) {
    int small = 1;
    for (int64_t i = 0; i < num; i++) small &= fabs(values[i]) <= 1e150;
    return small;
}

/* change (width) = - solution (width, functions) times the fields from `first` on times theta. */
INLINE void move(const sums *s, int64_t first, int64_t c, const double *theta, const double *solution, int64_t width, double *change) {
    for (int64_t k = 0; k < width; k++) {
        double sum = 0.0;
        for (int64_t j = 0; j < c; j++) {
            for (int i = 0; i < TERMS && s->term[TERMS * (first + j) + i] >= 0; i++) {
                sum += solution[s->functions * k + s->term[TERMS * (first + j) + i]] * (s->factor[TERMS * (first + j) + i] * theta[j]);
            }
        }
        change[k] = -sum;
    }
}

/* Test the groups of some images.
 *
 * Of num images: gram, meat (functions, functions), plain (scalars, scalars), dense_plain (functions - 2 scalars), score (functions),
 * solution (width, functions); factor (fields, TERMS). term (fields, TERMS): functions of each field, checked. ends (groups + 1): fields
 * ends[g] <= a < ends[g + 1] are of group g; of those behind them, where with_rest, the sums are given out as they are. num_tracks:
 * of each image, tracks_per_rank of them (at least 1) are needed for a statistic.
 * Out: status (in: of the sums); statistic, gain, rank (groups); change (groups, width): of the image's own columns, were the group
 * admitted; rest_square, rest_score (rest), rest_gram, rest_meat (rest, rest). */
KERNEL int64_t joint_group_tests(
    int64_t num, int64_t functions, int64_t scalars, int64_t width, const double *gram, const double *meat, const double *plain,
    const double *dense_plain, const double *score, const double *solution, int64_t fields, const int64_t *term, const double *factor,
    int64_t groups, const int64_t *ends, const int64_t *with_rest, const int64_t *num_tracks, double left_of_terms,
    double kept_eigenvalue, double singular, int64_t tracks_per_rank, int64_t *status, double *statistic, double *gain, int64_t *rank, double *change, double *rest_square, double *rest_score,
    double *rest_gram, double *rest_meat) {
    group *g = calloc(1, sizeof *g);
    double *squares = malloc((size_t)(fields + 1) * sizeof *squares);
    int64_t rest = fields - ends[groups], all = functions * functions, num_dense = functions - 2 * scalars;
    if (!g || !squares) {
        free(g), free(squares);
        return NO_MEMORY;
    }
    for (int64_t k = 0; k < num; k++) {
        if (status[k] != DONE) continue;
        sums s = {
            functions, scalars, gram + k * all, meat + k * all, score + k * functions, plain + k * scalars * scalars,
            dense_plain + k * num_dense, term, factor + k * fields * TERMS};
        const double *found = solution + k * width * functions;
        int64_t used = with_rest[k] ? fields : ends[groups];
        int is_sound = is_small(s.gram, all) && is_small(s.meat, all) && is_small(s.score, functions);
        for (int64_t a = 0; a < used && is_sound; a++) {
            squares[a] = squared_length(&s, a, left_of_terms);
            is_sound = squares[a] <= 1e150;
        }
        for (int64_t o = 0; o < groups && is_sound; o++) {
            double theta[MOST];
            int64_t first = ends[o], c = ends[o + 1] - first, at = k * groups + o;
            take(g, &s, first, c, squares);
            is_sound = judge(g, kept_eigenvalue, singular, num_tracks[k] / tracks_per_rank, statistic + at, gain + at, rank + at, theta);
            move(&s, first, c, theta, found, width, change + at * width);
        }
        status[k] = is_sound ? DONE : NEEDS_NUMPY;
        for (int64_t a = 0, first = ends[groups]; a < rest && is_sound && with_rest[k]; a++) {
            rest_square[k * rest + a] = squares[first + a], rest_score[k * rest + a] = score_of(&s, first + a);
            for (int64_t b = 0; b < rest; b++) {
                rest_gram[(k * rest + a) * rest + b] = of_fields(&s, s.gram, first + a, first + b);
                rest_meat[(k * rest + a) * rest + b] = of_fields(&s, s.meat, first + a, first + b);
            }
        }
    }
    free(g), free(squares);
    return DONE;
}
