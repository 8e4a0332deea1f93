/* Who sees which point, who should, and what pairs of images have in common. Twins: audit/witnesses/covisibility.py,
 * should_see.py, fold.py. All indices are in range: the Python module has looked. */
#include "lanes.h"

static int ascending(const void *a, const void *b)
{
    const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

enum { LAST = 1 << 30, AHEAD = 16 }; /* LAST: on the last image of each point, while pairs are counted */

/* Turns (n,) observations round: next[p] moves to the end of the images that see point p, ascending, each once, which
 * start at starts[p] of seen_image (n,). place: (n,) where the image stands in it, -1 where it has been before. */
static void turn_round(int64_t num_images, const int64_t *offsets, const int32_t *point_idx, const int64_t *starts,
                       int32_t *next, int32_t *seen_image, int32_t *place)
{
    const int64_t num = offsets[num_images];
    for (int64_t i = 0; i < num_images; i++)
        for (int64_t k = offsets[i]; k < offsets[i + 1]; k++) {
            const int64_t p = point_idx[k];
            const int32_t at = next[p];
            if (k + 2 * AHEAD < num)
                SOON(next + point_idx[k + 2 * AHEAD]);
            if (k + AHEAD < num)
                SOON(seen_image + next[point_idx[k + AHEAD]]);
            const int again = at && seen_image[at - 1] == i && at > starts[p];
            place[k] = again ? -1 : at;
            if (!again) {
                seen_image[at] = (int32_t)i;
                next[p]++;
            }
        }
}

typedef struct {
    int64_t num, capacity;
    int64_t *first, *second, *num_shared;
} Pairs;

/* The pairs of image i with images behind it. row: (I,) zeros before and after. */
static void count_shared(int64_t i, const int32_t *place, int64_t size, const int32_t *seen_image, int64_t *row,
                         int64_t *touched, Pairs *pairs)
{
    int64_t num_touched = 0;
    for (int64_t k = 0; k < size; k++) {
        if (k + AHEAD < size && place[k + AHEAD] >= 0)
            SOON(seen_image + place[k + AHEAD]);
        if (place[k] >= 0)
            for (int64_t o = place[k]; !(seen_image[o] & LAST);) {
                const int32_t other = seen_image[++o] & ~LAST;
                if (!row[other]++)
                    touched[num_touched++] = other;
            }
    }
    qsort(touched, num_touched, sizeof *touched, ascending);
    for (int64_t t = 0; t < num_touched; t++, pairs->num++) {
        if (pairs->num < pairs->capacity) {
            pairs->first[pairs->num] = i;
            pairs->second[pairs->num] = touched[t];
            pairs->num_shared[pairs->num] = row[touched[t]];
        }
        row[touched[t]] = 0;
    }
}

/* seen_offsets (num_points + 1), seen_image (n,): the images that see each point, ascending, each once. first < second,
 * num_shared (capacity,) each: pairs of images with the points that they share, by first and then by second.
 * Returns the number of pairs, of which those that fit are written; negative without memory. */
KERNEL int64_t witness_shared(int64_t num_images, int64_t num_points, const int64_t *offsets, const int32_t *point_idx,
                              int64_t *seen_offsets, int32_t *seen_image, int64_t capacity, int64_t *first,
                              int64_t *second, int64_t *num_shared)
{
    int64_t *touched = malloc((num_images + 1) * sizeof *touched), *row = calloc(num_images + 1, sizeof *row);
    int32_t *next = malloc((num_points + 1) * sizeof *next);
    int32_t *place = malloc((offsets[num_images] + 1) * sizeof *place);
    Pairs pairs = {next && touched && row && place ? 0 : -1, capacity, first, second, num_shared};
    if (!pairs.num) {
        memset(seen_offsets, 0, (num_points + 1) * sizeof *seen_offsets);
        for (int64_t k = 0; k < offsets[num_images]; k++)
            seen_offsets[point_idx[k] + 1]++;
        for (int64_t p = 0; p < num_points; p++)
            seen_offsets[p + 1] += seen_offsets[p];
        for (int64_t p = 0; p < num_points; p++)
            next[p] = (int32_t)seen_offsets[p];
        turn_round(num_images, offsets, point_idx, seen_offsets, next, seen_image, place);
        for (int64_t p = 0; p < num_points; p++)
            if (next[p] > seen_offsets[p])
                seen_image[next[p] - 1] |= LAST;
        for (int64_t i = 0; i < num_images; i++)
            count_shared(i, place + offsets[i], offsets[i + 1] - offsets[i], seen_image, row, touched, &pairs);
        int64_t end = 0;
        for (int64_t p = 0; p < num_points; p++) { /* close the gaps of second observations */
            const int64_t start = seen_offsets[p];
            seen_offsets[p] = end;
            for (int64_t o = start; o < next[p]; o++)
                seen_image[end++] = seen_image[o] & ~LAST;
        }
        seen_offsets[num_points] = end;
    }
    free(next);
    free(touched);
    free(row);
    free(place);
    return pairs.num;
}

/* Bridges and articulation vertices of a graph whose vertex v has the neighbours neighbour[offsets[v]:offsets[v + 1]],
 * by Tarjan's depth-first search. bridges: (num, 2). Returns the number of bridges; negative without memory. */
KERNEL int64_t witness_cuts(int64_t num, const int64_t *offsets, const int64_t *neighbour, int64_t *bridges,
                            uint8_t *articulation)
{
    int64_t *order = malloc((5 * num + 1) * sizeof *order);
    if (!order)
        return -1;
    int64_t *low = order + num, *parent = low + num, *next = parent + num, *path = next + num;
    int64_t num_visited = 0, num_bridges = 0;
    memset(articulation, 0, num);
    for (int64_t v = 0; v < num; v++) {
        order[v] = -1;
        next[v] = offsets[v];
    }
    for (int64_t root = 0; root < num; root++) {
        if (order[root] >= 0)
            continue;
        int64_t depth = 0, num_children = 0;
        path[0] = root;
        parent[root] = -1;
        order[root] = low[root] = num_visited++;
        while (depth >= 0) {
            const int64_t v = path[depth];
            if (next[v] < offsets[v + 1]) {
                const int64_t w = neighbour[next[v]++];
                if (order[w] < 0) {
                    parent[w] = v;
                    order[w] = low[w] = num_visited++;
                    path[++depth] = w;
                } else if (w != parent[v] && order[w] < low[v])
                    low[v] = order[w];
                continue;
            }
            const int64_t u = parent[v];
            depth--;
            if (u < 0)
                continue;
            num_children += u == root;
            if (low[v] < low[u])
                low[u] = low[v];
            if (low[v] > order[u]) {
                bridges[2 * num_bridges] = u < v ? u : v;
                bridges[2 * num_bridges++ + 1] = u < v ? v : u;
            }
            if (low[v] >= order[u] && u != root)
                articulation[u] = 1;
        }
        articulation[root] = num_children > 1;
    }
    free(order);
    return num_bridges;
}

/* Who sees the points, image after image: those of image i begin at starts[i]. */
typedef struct {
    int64_t *starts; /* (I + 1,) */
    double *numbers; /* four rows of ``room``: x, y, z of the ray from the point to the image, its length */
    int32_t *point;
    double *farthest; /* (I,) length */
    int64_t room;
} Sights;

/* starts, farthest: zeros. offsets, seen_image, seen_ray, seen_distance: as of witness_should_see. */
static void by_image(Sights *sights, int64_t num_images, int64_t num_points, const int64_t *offsets,
                     const int64_t *seen_image, const double *seen_ray, const double *seen_distance)
{
    const int64_t num = offsets[num_points];
    int64_t *starts = sights->starts;
    for (int64_t o = 0; o < num; o++) {
        starts[seen_image[o]]++;
        if (seen_distance[o] > sights->farthest[seen_image[o]])
            sights->farthest[seen_image[o]] = seen_distance[o];
    }
    for (int64_t i = 0, end = 0; i <= num_images; i++) /* ends, which move to the starts while they are filled */
        end = starts[i] += end;
    for (int64_t p = num_points - 1; p >= 0; p--)
        for (int64_t o = offsets[p + 1] - 1; o >= offsets[p]; o--) {
            const int64_t at = --starts[seen_image[o]];
            sights->point[at] = (int32_t)p;
            for (int a = 0; a < 3; a++)
                sights->numbers[a * sights->room + at] = seen_ray[a * num + o];
            sights->numbers[3 * sights->room + at] = seen_distance[o];
        }
}

/* How far apart two distances of a point may be, squared, and the cosine of the angle between its rays, squared. */
typedef struct {
    double sq_ratio, sq_cosine;
} Alike;

/* Of the points first .. last that one image sees those that another should see, whose centre is ``apart`` from its own:
 * by the law of cosines. Returns how many. */
static int64_t close_by(const Sights *sights, int64_t first, int64_t last, const double *apart, Alike alike,
                             int32_t *found)
{
    const double *x = sights->numbers, *y = x + sights->room, *z = y + sights->room, *length = z + sights->room;
    const double sq_apart = apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2];
    int64_t num = 0;
    for (int64_t o = first; o < last; o += LANES) {
        const Lanes there = load(length + o), sq_there = there * there;
        const Lanes shift = load(x + o) * apart[0] + load(y + o) * apart[1] + load(z + o) * apart[2];
        const Lanes along = there + shift, sq_own = sq_there + 2.0 * there * shift + sq_apart;
        const LaneBits close = (sq_own < alike.sq_ratio * sq_there) & (sq_own * alike.sq_ratio > sq_there) &
                               (along > 0.0) & (along * along > alike.sq_cosine * sq_own);
        for (int l = 0; l < LANES; l++) {
            found[num] = sights->point[o + l];
            num += close[l] & (o + l < last);
        }
    }
    return num;
}

/* The points that image j sees, or should see because of an image close by: bits of ``sees`` and ``should``. */
static void ask(const Sights *sights, int64_t j, int64_t num_images, const double *centre, double reach, Alike alike,
                int32_t *found, uint64_t *sees, uint64_t *should)
{
    for (int64_t o = sights->starts[j]; o < sights->starts[j + 1]; o++) {
        sees[sights->point[o] / 64] |= (uint64_t)1 << (sights->point[o] % 64);
        should[sights->point[o] / 64] |= (uint64_t)1 << (sights->point[o] % 64);
    }
    for (int64_t i = 0; i < num_images; i++) {
        double apart[3], sq = 0.0;
        for (int a = 0; a < 3; a++) {
            apart[a] = centre[3 * j + a] - centre[3 * i + a];
            sq += apart[a] * apart[a];
        }
        if (i == j || !(sqrt(sq) <= reach * sights->farthest[i]))
            continue;
        const int64_t num = close_by(sights, sights->starts[i], sights->starts[i + 1], apart, alike, found);
        for (int64_t k = 0; k < num; k++)
            should[found[k] / 64] |= (uint64_t)1 << (found[k] % 64);
    }
}

/* Whether a point lies before an image and inside of its photo; the ray from it to the image, and its length. */
static int is_inside(const double *point, const double *rotation, const double *centre, const double *limits,
                     double *ray, double *distance)
{
    const double x = point[0] - centre[0], y = point[1] - centre[1], z = point[2] - centre[2];
    const double depth = rotation[6] * x + rotation[7] * y + rotation[8] * z, limit = depth * limits[0];
    if (!(fabs(rotation[0] * x + rotation[1] * y + rotation[2] * z) < limit * limits[1] &&
          fabs(rotation[3] * x + rotation[4] * y + rotation[5] * z) < limit * limits[2] && depth > 0.0))
        return 0;
    *distance = sqrt(x * x + y * y + z * z);
    const double length = *distance > DBL_MIN ? *distance : DBL_MIN;
    ray[0] = -x / length;
    ray[1] = -y / length;
    ray[2] = -z / length;
    return 1;
}

/* The points that each image should see, image after image, points ascending: (capacity,) each, ray (capacity, 3).
 * offsets: (num_points + 1,) the images (n,) that see each point, ray (3, n) to them, distance (n,).
 * limits: (I, 3) share of the depth per px, width, height. Returns how many there are, of which those that fit are
 * written; negative without memory. */
KERNEL int64_t witness_should_see(int64_t num_images, int64_t num_points, const double *xyz, const int64_t *offsets,
                                  const int64_t *seen_image, const double *seen_ray, const double *seen_distance,
                                  const uint8_t *usable, const double *rotation, const double *centre,
                                  const double *limits, double reach, double ratio, double cosine, int64_t capacity,
                                  int64_t *point, int64_t *image, uint8_t *sees, double *ray, double *distance)
{
    const int64_t num_words = num_points / 64 + 1, room = offsets[num_points] + LANES;
    const Alike alike = {ratio * ratio, cosine * cosine};
    Sights sights = {calloc(num_images + 1, sizeof(int64_t)), calloc(4 * room, sizeof(double)),
                     calloc(room, sizeof(int32_t)), calloc(num_images + 1, sizeof(double)), room};
    uint64_t *saw = calloc(num_words, sizeof *saw), *should = calloc(num_words, sizeof *should);
    int32_t *found = malloc(room * sizeof *found);
    const int is_ready = sights.starts && sights.numbers && sights.point && sights.farthest && saw && should && found;
    int64_t num = is_ready ? 0 : -1;
    if (is_ready)
        by_image(&sights, num_images, num_points, offsets, seen_image, seen_ray, seen_distance);
    for (int64_t j = 0; is_ready && j < num_images; j++) {
        if (!usable[j])
            continue;
        ask(&sights, j, num_images, centre, reach, alike, found, saw, should);
        for (int64_t w = 0; w < num_words; saw[w++] = 0)
            for (; should[w]; should[w] &= should[w] - 1) {
                const int64_t p = 64 * w + __builtin_ctzll(should[w]);
                const double x[3] = {xyz[p], xyz[num_points + p], xyz[2 * num_points + p]};
                double way[3], length;
                if (!is_inside(x, rotation + 9 * j, centre + 3 * j, limits + 3 * j, way, &length))
                    continue;
                if (num < capacity) {
                    point[num] = p;
                    image[num] = j;
                    sees[num] = (saw[w] >> (p % 64)) & 1;
                    memcpy(ray + 3 * num, way, sizeof way);
                    distance[num] = length;
                }
                num++;
            }
    }
    free(sights.starts);
    free(sights.numbers);
    free(sights.point);
    free(sights.farthest);
    free(saw);
    free(should);
    free(found);
    return num;
}

enum { NUM_SUMS = 6 };

/* One image that should see a point; rest: what it sees beyond the point's rate. */
typedef struct {
    int64_t image;
    double sees, ray[3], log_distance, rest;
} View;

/* Rows of sums: num, both, either, cosine, log of the ratio of distances, rest. */
static void compare(const View *a, const View *b, double *sums)
{
    sums[0] += 1.0;
    sums[1] += a->sees * b->sees;
    sums[2] += a->sees + b->sees - a->sees * b->sees;
    sums[3] += a->ray[0] * b->ray[0] + a->ray[1] * b->ray[1] + a->ray[2] * b->ray[2];
    sums[4] += a->log_distance - b->log_distance;
    sums[5] += a->rest * b->rest;
}

/* The rows (m,) in the order of points; offsets (num_points + 1,): those of point p end at offsets[p]. */
static void by_point(int64_t num_points, int64_t num_rows, const int64_t *point, int64_t *offsets, int64_t *order)
{
    for (int64_t row = 0; row < num_rows; row++)
        offsets[point[row] + 1]++;
    for (int64_t p = 0; p < num_points; p++)
        offsets[p + 1] += offsets[p];
    for (int64_t row = 0; row < num_rows; row++)
        order[offsets[point[row]]++] = row;
}

/* Compares the images that should see each point. point, image, sees, ray (m, 3), log_distance: (m,), image by image.
 * number: (I, I) zeros, in which pairs are numbered from 1 as they are met.
 * first, second: (capacity,), sums: (capacity, 6), own_rest: (I,) zeros. Returns the number of pairs; negative without
 * memory, or if the images are not in order. */
KERNEL int64_t witness_pair_sums(int64_t num_images, int64_t num_points, int64_t num_rows, const int64_t *point,
                                 const int64_t *image, const uint8_t *sees, const double *ray,
                                 const double *log_distance, int32_t *number, int64_t capacity, int64_t *first,
                                 int64_t *second, double *sums, double *own_rest)
{
    View *views = malloc((num_images + 1) * sizeof *views);
    int64_t *ends = calloc(num_points + 1, sizeof *ends), *order = malloc((num_rows + 1) * sizeof *order);
    int64_t num = views && ends && order ? 0 : -1;
    if (!num)
        by_point(num_points, num_rows, point, ends, order);
    for (int64_t p = 0; num >= 0 && p < num_points; p++) {
        const int64_t start = p ? ends[p - 1] : 0, size = ends[p] - start;
        double rate = 0.0;
        for (int64_t k = 0; num >= 0 && k < size; k++) {
            const int64_t row = order[start + k];
            if (k && image[row] <= views[k - 1].image)
                num = -1;
            else
                views[k] = (View){image[row], sees[row], {ray[3 * row], ray[3 * row + 1], ray[3 * row + 2]},
                                  log_distance[row], 0.0};
            rate += sees[row];
        }
        rate /= size ? (double)size : 1.0;
        for (int64_t k = 0; num >= 0 && k < size; k++) {
            views[k].rest = views[k].sees - rate;
            own_rest[views[k].image] += views[k].rest * views[k].rest;
        }
        for (int64_t k = 0; num >= 0 && k < size; k++)
            for (int64_t l = k + 1; l < size; l++) {
                int32_t *own = number + views[k].image * num_images + views[l].image;
                if (!*own) {
                    if (num == capacity)
                        continue;
                    first[num] = views[k].image;
                    second[num] = views[l].image;
                    memset(sums + NUM_SUMS * num, 0, NUM_SUMS * sizeof *sums);
                    *own = (int32_t)++num;
                }
                compare(views + k, views + l, sums + NUM_SUMS * (*own - 1));
            }
    }
    free(views);
    free(ends);
    free(order);
    return num;
}
