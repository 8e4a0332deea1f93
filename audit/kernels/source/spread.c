/* Where the inliers of images lie: area of their hull, cells of a grid that they occupy, median depth. Twins:
 * audit/camera_quality/coverage.py, expected_error.median_depth. All indices are in range: the Python module has looked. */
#include "depths.h"
#include "lanes.h"

enum { CORNERS = 8, AHEAD = 16 };
static const double FLAT = 1e-13; /* of the squared size: what is smaller is rounding of points on one line */

typedef struct {
    double x, y;
} Point;

static int by_x_then_y(const void *a, const void *b)
{
    const Point *p = a, *q = b;
    return p->x != q->x ? (p->x > q->x) - (p->x < q->x) : (p->y > q->y) - (p->y < q->y);
}

/* Twice the area of a triangle, positive where c lies to the left of the way from a to b. */
static double turn(const Point *a, const Point *b, const Point *c)
{
    return (b->x - a->x) * (c->y - a->y) - (b->y - a->y) * (c->x - a->x);
}

/* Points strictly inside of the polygon of the extreme points in eight directions, which are on no hull, are left out.
 * x, y: (n,) padded to a multiple of LANES. Returns how many are left in ``outer``. */
static int64_t outside(const double *x, const double *y, int64_t n, Point *outer)
{
    int64_t corner[CORNERS], num = 0;
    Lanes farthest[CORNERS];
    LaneBits place[CORNERS], here = {0, 1, 2, 3};
    for (int c = 0; c < CORNERS; c++) {
        farthest[c] = all(-INFINITY);
        place[c] = here - here;
    }
    for (int64_t i = 0; i < n; i += LANES, here += LANES) {
        const Lanes px = load(x + i), py = load(y + i), sum = px + py, difference = px - py;
        /* One direction after the other, around. */
        const Lanes far[CORNERS] = {px, sum, py, -difference, -px, -sum, -py, difference};
        for (int c = 0; c < CORNERS; c++) {
            const LaneBits further = (far[c] > farthest[c]) & (here < n);
            farthest[c] = choose(further, far[c], farthest[c]);
            place[c] = (further & here) | (~further & place[c]);
        }
    }
    for (int c = 0; c < CORNERS; c++) {
        int best = 0;
        for (int l = 1; l < LANES; l++)
            if (farthest[c][l] > farthest[c][best])
                best = l;
        corner[c] = place[c][best];
    }
    double start_x[CORNERS], start_y[CORNERS], edge_x[CORNERS], edge_y[CORNERS];
    int num_edges = 0;
    for (int c = 0; c < CORNERS; c++) {
        const int64_t from = corner[c], to = corner[(c + 1) % CORNERS];
        start_x[num_edges] = x[from];
        start_y[num_edges] = y[from];
        edge_x[num_edges] = x[to] - x[from];
        edge_y[num_edges] = y[to] - y[from];
        num_edges += edge_x[num_edges] != 0.0 || edge_y[num_edges] != 0.0;
    }
    for (int64_t i = 0; i < n; i += LANES) {
        const Lanes px = load(x + i), py = load(y + i);
        LaneBits inside = {-1, -1, -1, -1};
        for (int e = 0; e < num_edges; e++)
            inside &= edge_x[e] * (py - start_y[e]) - edge_y[e] * (px - start_x[e]) > 0.0;
        for (int64_t l = 0; l < LANES && i + l < n; l++)
            if (!inside[l])
                outer[num++] = (Point){x[i + l], y[i + l]};
    }
    return num;
}

/* Twice the area of the triangles from ``origin`` to the edges of the hull from the first to the last of sorted points,
 * which turns left everywhere: one half of Andrew's monotone chain. step: 1, or -1 from the last of them backwards. */
static double half(const Point *points, int64_t num, int64_t step, const Point *origin, const Point **hull)
{
    int64_t size = 0;
    const Point *point = step > 0 ? points : points + num - 1;
    for (int64_t k = 0; k < num; k++, point += step) {
        while (size > 1 && !(turn(hull[size - 2], hull[size - 1], point) > 0.0))
            size--;
        hull[size++] = point;
    }
    double twice = 0.0;
    for (int64_t k = 1; k < size; k++)
        twice += turn(origin, hull[k - 1], hull[k]);
    return twice;
}

static double hull_area(const double *x, const double *y, int64_t n, Point *outer, const Point **hull)
{
    const int64_t num = outside(x, y, n, outer);
    if (num < 3)
        return 0.0;
    qsort(outer, num, sizeof *outer, by_x_then_y);
    double low = outer[0].y, high = outer[0].y;
    for (int64_t k = 1; k < num; k++) {
        low = outer[k].y < low ? outer[k].y : low;
        high = outer[k].y > high ? outer[k].y : high;
    }
    const double twice = half(outer, num, 1, outer, hull) + half(outer, num, -1, outer, hull);
    const double wide = outer[num - 1].x - outer[0].x, tall = high - low;
    return twice > FLAT * (wide * wide + tall * tall) ? 0.5 * twice : 0.0;
}

static int64_t cells(const double *x, const double *y, int64_t n, double width, double height, int64_t grid,
                     uint8_t *occupied)
{
    int64_t num = 0;
    if (!(width > 0.0 && height > 0.0))
        return 0;
    memset(occupied, 0, grid * grid);
    const double across = grid / width, down = grid / height;
    for (int64_t i = 0; i < n; i++) {
        const double column = x[i] * across, row = y[i] * down;
        if (column >= 0.0 && column < grid && row >= 0.0 && row < grid) {
            uint8_t *cell = occupied + (int64_t)column * grid + (int64_t)row;
            num += !*cell;
            *cell = 1;
        }
    }
    return num;
}

/* images: (num,) rows of the image table; their inliers are offsets[i] .. offsets[i + 1] of observation_row, point_idx.
 * quaternions (I, 4), translations (I, 3): cam_from_world. size_px: (num, 2). Out, (num,) each: hull_px2,
 * occupied_cells, depth: median Zc. */
KERNEL int64_t image_spread(int64_t num, const int64_t *images, const int64_t *offsets, const int32_t *observation_row,
                            const int32_t *point_idx, const double *xy_px, const double *xyz_world,
                            const double *quaternions, const double *translations, const double *size_px, int64_t grid,
                            double *hull_px2, int64_t *occupied_cells, double *depth)
{
    int64_t most = 0;
    for (int64_t b = 0; b < num; b++) {
        const int64_t n = offsets[images[b] + 1] - offsets[images[b]];
        most = n > most ? n : most;
    }
    const int64_t room = most + LANES;
    double *x = malloc(4 * room * sizeof *x);
    Point *outer = malloc(room * sizeof *outer);
    const Point **hull = malloc(room * sizeof *hull);
    uint8_t *occupied = malloc(grid * grid + 1);
    const int64_t status = x && outer && hull && occupied ? DONE : NO_MEMORY;
    for (int64_t b = 0; status == DONE && b < num; b++) {
        const int64_t first = offsets[images[b]], n = offsets[images[b] + 1] - first;
        const double *q = quaternions + 4 * images[b], tz = translations[3 * images[b] + 2];
        double *y = x + room, *z = y + room;
        for (int64_t i = 0; i < n; i++) {
            const double *seen = xy_px + 2 * observation_row[first + i], *point = xyz_world + 3 * (int64_t)point_idx[first + i];
            if (i + AHEAD < n)
                SOON(xyz_world + 3 * (int64_t)point_idx[first + i + AHEAD]);
            x[i] = seen[0];
            y[i] = seen[1];
            z[i] = depth_of(q, tz, point);
        }
        for (int64_t i = n; i < n + LANES; i++)
            x[i] = y[i] = 0.0;
        hull_px2[b] = hull_area(x, y, n, outer, hull);
        occupied_cells[b] = cells(x, y, n, size_px[2 * b], size_px[2 * b + 1], grid, occupied);
        depth[b] = n ? median(z, n, z + room) : NAN;
    }
    free(x);
    free(outer);
    free(hull);
    free(occupied);
    return status;
}
