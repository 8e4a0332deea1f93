#include "lanes.h"

/* What the tests of normality need of a sample of 2-vectors (method.md section 4): distances of distribution functions,
 * central moments, sums of Shapiro and Wilk. */

enum { KS, FITTED, LENGTHS, LENGTHS_UNSCALED, M2, M3, M4, /* SW: */ SQUARES, FIRST, SECOND, REST, SPAN1, SPAN2, SS, COLUMNS };
enum { MAX_SHAPIRO = 5000, CELLS = 64, LAST_NODE = 540 }; /* of the table of tails: nodes 1 / 64 apart, up to 8.4375 */

typedef struct {
    const double *tails; /* (LAST_NODE + 1, 2): 1 - Phi and density of the normal distribution at the nodes */
    double *sorted, *scratch;
    int32_t *bucket, *count;
} Room;

/* Distribution function of the normal distribution: to 1e-15 by a series of five terms about the next node, or to 1e-5
 * by one. */
INLINE Lanes normal_cdf(const double *tails, Lanes z, int roughly)
{
    const LaneBits negative = z < 0.0;
    Lanes a = choose(negative, -z, z);
    const Lanes end = all((double)LAST_NODE / CELLS);
    a = choose(a > end, end, a);
    const Lanes shifted = a * CELLS + WHOLE, node = (shifted - WHOLE) / CELLS, d = a - node, n2 = node * node;
    const LaneBits at = (LaneBits)shifted & 0x3ff;
    Lanes tail, density, s = all(0.0);
    for (int l = 0; l < LANES; l++) {
        tail[l] = tails[2 * at[l]];
        density[l] = tails[2 * at[l] + 1];
    }
    if (!roughly) {
        s = (n2 * n2 - 6.0 * n2 + 3.0) * (1.0 / 120.0) * d - (n2 - 3.0) * node * (1.0 / 24.0);
        s = ((s * d + (n2 - 1.0) * (1.0 / 6.0)) * d - 0.5 * node) * d;
    }
    const Lanes q = tail - density * ((s + 1.0) * d);
    return choose(negative, q, 1.0 - q);
}

/* Inverse of 1 - Phi, for 0.0001 < p <= 0.5: Wichura's rational functions (AS 241). */
INLINE Lanes central_score(Lanes p)
{
    static const double a[] = {2509.0809287301226727, 33430.575583588128105, 67265.770927008700853, 45921.953931549871457,
                               13731.693765509461125, 1971.5909503065514427, 133.14166789178437745, 3.387132872796366608};
    static const double b[] = {5226.495278852854561, 28729.085735721942674, 39307.89580009271061, 21213.794301586595867,
                               5394.1960214247511077, 687.1870074920579083, 42.313330701600911252, 1.0};
    const Lanes q = 0.5 - p, r = 0.180625 - q * q;
    Lanes up = all(a[0]), down = all(b[0]);
    for (int i = 1; i < 8; i++) {
        up = up * r + a[i];
        down = down * r + b[i];
    }
    return q * up / down;
}

INLINE Lanes outer_score(Lanes p)
{
    static const double c[] = {7.7454501427834140764e-4, 0.0227238449892691845833, 0.24178072517745061177, 1.27045825245236838258,
                               3.64784832476320460504, 5.7694972214606914055, 4.6303378461565452959, 1.42343711074968357734};
    static const double d[] = {1.05075007164441684324e-9, 5.475938084995344946e-4, 0.0151986665636164571966, 0.14810397642748007459,
                               0.68976733498510000455, 1.6763848301838038494, 2.05319162663775882187, 1.0};
    const Lanes r = root(-log_of(p)) - 1.6;
    Lanes up = all(c[0]), down = all(d[0]);
    for (int i = 1; i < 8; i++) {
        up = up * r + c[i];
        down = down * r + d[i];
    }
    return up / down;
}

static void merge_sort(int64_t n, double *x, double *scratch)
{
    for (int64_t width = 1; width < n; width *= 2) {
        for (int64_t low = 0; low < n; low += 2 * width) {
            const int64_t middle = low + width < n ? low + width : n, high = middle + width < n ? middle + width : n;
            for (int64_t i = low, j = middle, k = low; k < high; k++)
                scratch[k] = i < middle && (j >= high || x[i] <= x[j]) ? x[i++] : x[j++];
        }
        memcpy(x, scratch, (size_t)n * sizeof *x);
    }
}

/* Sort x into room->sorted. room->bucket holds where about in 0 .. n - 1 each belongs; x and scratch may be the same. */
static void sort(int64_t n, const double *x, Room *room)
{
    double *out = room->sorted;
    int64_t crowd = 0;
    memset(room->count, 0, (size_t)(n + 1) * sizeof *room->count);
    for (int64_t k = 0; k < n; k++)
        crowd += room->count[room->bucket[k] + 1]++;
    for (int64_t b = 0; b < n; b++)
        room->count[b + 1] += room->count[b];
    for (int64_t k = 0; k < n; k++)
        out[room->count[room->bucket[k]]++] = x[k];
    if (crowd > 8 * n) { /* pairs within a bucket: half as many in a sample of the distribution that was expected */
        merge_sort(n, out, room->scratch);
        return;
    }
    for (int pass = 0; pass < 2 && n > 0; pass++) { /* most are next to their place: these take no branches */
        double largest = out[0];
        for (int64_t k = 1; k < n; k++) {
            const double value = out[k];
            out[k - 1] = value < largest ? value : largest;
            largest = value < largest ? largest : value;
        }
        out[n - 1] = largest;
    }
    for (int64_t k = 1; k < n; k++) {
        const double value = out[k];
        int64_t at = k;
        for (; at > 0 && out[at - 1] > value; at--)
            out[at] = out[at - 1];
        out[at] = value;
    }
}

/* Where in 0 .. n - 1 numbers of a distribution function belong. n is below 2^31. */
INLINE void assign(Lanes cdf, int64_t n, int64_t used, int32_t *bucket)
{
    for (int l = 0; l < used; l++) {
        const double at = cdf[l] * (double)n;
        bucket[l] = !(at > 0.0) ? 0 : at >= (double)n ? (int32_t)n - 1 : (int32_t)at; /* NaN: the first */
    }
}

/* The four numbers at x, of which the last may be beyond the end: those are repeated. */
INLINE Lanes some(const double *x, int64_t used)
{
    if (used >= LANES)
        return load(x);
    return (Lanes){x[0], x[used > 1 ? 1 : 0], x[used > 2 ? 2 : used - 1], x[used - 1]};
}
#define USED(n, k) ((n) - (k) < LANES ? (n) - (k) : LANES)

enum { NORMAL, EXPONENTIAL };

INLINE Lanes cdf_of(int kind, const Room *room, Lanes x, double shift, double scale)
{
    return kind == NORMAL ? normal_cdf(room->tails, (x - shift) * scale, 0) : 1.0 - exp_of_negative(-x * scale);
}

/* F(x_(i)) - i / n, i from 1: where it is least, and where most. */
typedef struct {
    Lanes least, most;
} Excess;

INLINE void widen(Excess *excess, Lanes cdf, Lanes rank, double n)
{
    const Lanes own = cdf - rank / n;
    excess->least = choose(own < excess->least, own, excess->least);
    excess->most = choose(own > excess->most, own, excess->most);
}

INLINE void settle(Excess *excess)
{
    for (int l = 1; l < LANES; l++) {
        excess->least[0] = excess->least[l] < excess->least[0] ? excess->least[l] : excess->least[0];
        excess->most[0] = excess->most[l] > excess->most[0] ? excess->most[l] : excess->most[0];
    }
    excess->least = all(excess->least[0]);
    excess->most = all(excess->most[0]);
}

/* Kolmogorov's distance of n sorted numbers. Every STEP-th is asked, then those between two of them where it may be larger: a
 * distribution function rises nowhere by more than between its ends. Uses room->scratch. */
enum { STEP = 16 };

INLINE double distance(int kind, int64_t n, const Room *room, double shift, double scale)
{
    const double *x = room->sorted, size = (double)n;
    double *at = room->scratch;
    const int64_t num = (n + STEP - 2) / STEP + 1; /* 0, STEP, 2 STEP ... n - 1 */
    Excess d = {all(DBL_MAX), all(-DBL_MAX)};
    for (int64_t i = 0; i < num; i += LANES) {
        Lanes value = all(0.0), rank = all(0.0);
        for (int l = 0; l < LANES; l++) {
            const int64_t place = (i + l) * STEP < n ? (i + l) * STEP : n - 1;
            value[l] = x[place];
            rank[l] = (double)(place + 1);
        }
        const Lanes cdf = cdf_of(kind, room, value, shift, scale);
        widen(&d, cdf, rank, size);
        store(at + i, cdf);
    }
    settle(&d);
    for (int64_t i = 0; i + 1 < num; i++) {
        const int64_t from = i * STEP, to = from + STEP < n - 1 ? from + STEP : n - 1;
        const double high = at[i + 1] - (double)(from + 2) / size, low = at[i] - (double)to / size;
        if (!(high > d.most[0] || low < d.least[0]))
            continue;
        for (int64_t k = from; k < to; k += LANES) {
            if (n - k >= LANES)
                widen(&d, cdf_of(kind, room, load(x + k), shift, scale), (Lanes){1.0, 2.0, 3.0, 4.0} + (double)k, size);
            else
                for (int64_t one = k; one < n; one++)
                    widen(&d, cdf_of(kind, room, all(x[one]), shift, scale), all((double)(one + 1)), size);
        }
        settle(&d);
    }
    return d.most[0] + 1.0 / size > -d.least[0] ? d.most[0] + 1.0 / size : -d.least[0];
}

/* Mean and central moments of (n,) numbers; not DONE where they are not finite, all equal, or out of range. */
INLINE int moments(int64_t n, const double *x, double *mean, double m[3])
{
    Lanes s = all(0.0), least = all(DBL_MAX), most = all(-DBL_MAX), two = s, three = s, four = s;
    for (int64_t k = 0; k < n; k += LANES) {
        const int64_t used = USED(n, k);
        const Lanes v = some(x + k, used);
        least = choose(v < least, v, least);
        most = choose(v > most, v, most);
        s += v;
        for (int l = (int)used; l < LANES; l++)
            s[l] -= v[l];
    }
    *mean = sum(s) / (double)n;
    double low = least[0], high = most[0];
    for (int l = 1; l < LANES; l++) {
        low = least[l] < low ? least[l] : low;
        high = most[l] > high ? most[l] : high;
    }
    const double magnitude = high > -low ? high : -low;
    if (!(low < high && magnitude > 1e-70 && magnitude < 1e70 && *mean * 0.0 == 0.0))
        return NEEDS_NUMPY;
    for (int64_t k = 0; k < n; k += LANES) {
        const int64_t used = USED(n, k);
        Lanes v = some(x + k, used) - *mean;
        for (int l = (int)used; l < LANES; l++)
            v[l] = 0.0;
        const Lanes square = v * v;
        two += square;
        three += square * v;
        four += square * square;
    }
    m[0] = sum(two) / (double)n;
    m[1] = sum(three) / (double)n;
    m[2] = sum(four) / (double)n;
    return DONE;
}

INLINE void sort_normal(int64_t n, const double *x, Room *room)
{
    for (int64_t k = 0; k < n; k += LANES)
        assign(normal_cdf(room->tails, some(x + k, USED(n, k)), 1), n, USED(n, k), room->bucket + k);
    sort(n, x, room);
}

/* Sums of Shapiro and Wilk over n sorted numbers: of scores squared, the first two scores, the others times what lies
 * between the numbers, and what lies between the outermost two and the next. */
INLINE void shapiro(int64_t n, const double *sorted, double *out)
{
    const int64_t half = n / 2;
    const double by = 1.0 / ((double)n + 0.25);
    Lanes squares = all(0.0), rest = all(0.0), first = all(0.0), rank = {0.625, 1.625, 2.625, 3.625}, gap = all(0.0);
    for (int64_t k = 0; k < half; k += LANES, rank += (double)LANES) {
        const int64_t used = USED(half, k);
        const Lanes p = rank * by;
        Lanes score;
        if (p[LANES - 1] < 0.075)
            score = outer_score(p);
        else if (p[0] >= 0.075)
            score = central_score(p);
        else
            score = choose(p < 0.075, outer_score(p), central_score(p));
        for (int l = 0; l < used; l++)
            gap[l] = sorted[n - 1 - k - l] - sorted[k + l];
        for (int l = (int)used; l < LANES; l++)
            score[l] = 0.0;
        squares += score * score;
        if (k == 0) {
            first = score;
            out[SPAN1] = gap[0], out[SPAN2] = half > 1 ? gap[1] : 0.0;
            score[0] = score[1] = 0.0;
        }
        rest += score * gap;
    }
    out[SQUARES] = 2.0 * sum(squares);
    out[FIRST] = first[0], out[SECOND] = first[1];
    out[REST] = sum(rest);
}

/* Statistics of one sample z (n, 2). */
INLINE int statistics(int64_t n, const double *z, Room *room, double *out)
{
    const int64_t num_values = 2 * n, step = (num_values + MAX_SHAPIRO - 1) / MAX_SHAPIRO;
    double mean;
    if (n < 1 || moments(num_values, z, &mean, out + M2) != DONE)
        return NEEDS_NUMPY;
    const double by_sd = 1.0 / sqrt(out[M2] * (double)num_values / (double)(num_values - 1));
    sort_normal(num_values, z, room);
    out[KS] = distance(NORMAL, num_values, room, 0.0, 1.0);
    out[FITTED] = distance(NORMAL, num_values, room, mean, by_sd);
    out[SS] = out[M2] * (double)num_values;
    if (step == 1) {
        shapiro(num_values, room->sorted, out);
    } else {
        int64_t thinned = 0;
        double own[3];
        for (int64_t k = 0; k < n; k += step, thinned += 2)
            memcpy(room->scratch + thinned, z + 2 * k, 2 * sizeof *z);
        if (moments(thinned, room->scratch, &mean, own) != DONE)
            return NEEDS_NUMPY;
        out[SS] = own[0] * (double)thinned;
        sort_normal(thinned, room->scratch, room);
        shapiro(thinned, room->sorted, out);
    }
    Lanes total = all(0.0);
    for (int64_t k = 0; k < n; k += LANES) {
        const int64_t used = USED(n, k);
        Lanes half = all(0.0);
        for (int l = 0; l < used; l++)
            half[l] = 0.5 * (z[2 * (k + l)] * z[2 * (k + l)] + z[2 * (k + l) + 1] * z[2 * (k + l) + 1]);
        total += half;
        store(room->scratch + k, half);
        assign(1.0 - exp_of_negative(-half), n, used, room->bucket + k);
    }
    sort(n, room->scratch, room);
    const double by_mean = 1.0 / (sum(total) / (double)n);
    out[LENGTHS] = distance(EXPONENTIAL, n, room, 0.0, by_mean);
    out[LENGTHS_UNSCALED] = distance(EXPONENTIAL, n, room, 0.0, 1.0);
    return DONE;
}

/* Statistics (num_images, COLUMNS) of the samples z[offsets[i] : offsets[i + 1]] of rows (x, y). */
KERNEL int64_t normality_statistics(int64_t num_images, const int64_t *offsets, const double *z, const double *tails,
                                         double *out, uint8_t *status)
{
    int64_t most = 1;
    for (int64_t i = 0; i < num_images; i++)
        most = offsets[i + 1] - offsets[i] > most ? offsets[i + 1] - offsets[i] : most;
    const size_t size = 2 * (size_t)most + LANES + 1;
    double *numbers = malloc(2 * size * sizeof *numbers);
    int32_t *counts = malloc(2 * size * sizeof *counts);
    const int ready = most < INT32_MAX / 2 && numbers && counts;
    Room room = {tails, numbers, numbers ? numbers + size : NULL, counts, counts ? counts + size : NULL};
    for (int64_t i = 0; i < num_images && ready; i++)
        status[i] = (uint8_t)statistics(offsets[i + 1] - offsets[i], z + 2 * offsets[i], &room, out + i * COLUMNS);
    free(numbers);
    free(counts);
    return ready ? DONE : NO_MEMORY;
}
