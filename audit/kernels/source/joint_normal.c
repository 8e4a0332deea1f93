/* The normal equations of the joint system without the points, and its sandwich, image by image (docs/method.md section 11;
 * audit/joint/normal.py is the numpy twin). */
#include "joint.h"

enum { WIDES = MOST_COLUMNS / LANES, SQUARE = MOST_COLUMNS * MOST_COLUMNS };

/* Two rows of numbers, x and y. */
typedef struct {
    wide x[WIDES], y[WIDES];
} wide_rows;

/* Two systems: the robust weights of the model, and weights that all rows of an image have in common; V^-1 and the pull J^T w y
 * of each point with both. */
typedef struct {
    const double *plain;                /* (I) */
    const double *inverse[2], *pull[2]; /* (P, 3, 3), (P, 3) */
} two_systems;

/* Sums between an image and those that see its points too, in the order in which they are met. `padded` is the width, rounded up
 * to LANES. */
typedef struct {
    int64_t padded, size, num; /* numbers of each sum; how many images there are */
    int64_t *image, *place;    /* (I) who they are; (I) which of them each image is, counted from 1, 0 for none */
    double *sums;              /* (most, size) */
} around;

/* With room for the image of some that sees most. num_squares: of (padded, padded) numbers, between two images. */
static int has_room(const joint_model *m, int64_t num, const int64_t *images, int64_t num_squares, around *out) {
    int64_t most = 0;
    for (int64_t k = 0; k < num; k++) {
        int64_t seen = 0;
        for (int64_t row = m->offsets[images[k]]; row < m->offsets[images[k] + 1]; row++) {
            seen += m->point_offsets[m->point_idx[row] + 1] - m->point_offsets[m->point_idx[row]];
        }
        most = seen > most ? seen : most;
    }
    most = most > m->num_images ? m->num_images : most;
    out->padded = (m->width + LANES - 1) / LANES * LANES, out->num = 0;
    out->size = num_squares * out->padded * out->padded;
    out->image = NULL, out->sums = NULL;
    if (out->padded > MOST_COLUMNS) return 0;
    out->image = calloc((size_t)(2 * m->num_images + 1), sizeof *out->image);
    out->sums = malloc((size_t)(most * out->size + 1) * sizeof *out->sums);
    if (!out->image || !out->sums) return 0;
    out->place = out->image + m->num_images;
    return 1;
}

static void leave(around *space) { free(space->image), free(space->sums); }

/* The sums with an image, zero when it is met. */
INLINE double *sums_with(around *space, int64_t image) {
    if (!space->place[image]) {
        space->image[space->num++] = image, space->place[image] = space->num;
        memset(space->sums + (space->num - 1) * space->size, 0, (size_t)space->size * sizeof *space->sums);
    }
    return space->sums + (space->place[image] - 1) * space->size;
}

/* Ask for what rows behind this one need. */
INLINE void ask_ahead(const joint_model *m, int64_t row, int64_t last, int64_t image, const two_systems *of) {
    if (row + 2 * AHEAD < last) {
        int64_t point = m->point_idx[row + 2 * AHEAD];
        SOON(m->point_offsets + point);
        for (int k = 0; of && k < 2; k++) {
            SOON(of->inverse[k] + 9 * point), SOON(of->inverse[k] + 9 * point + 8), SOON(of->pull[k] + 3 * point);
        }
    }
    if (row + AHEAD < last) {
        int64_t start = m->point_offsets[m->point_idx[row + AHEAD]];
        SOON(m->image_of + start), SOON(m->by_point + start);
    }
    if (row + 2 >= last) return;
    int64_t point = m->point_idx[row + 2];
    for (int64_t k = view_from(m, point, image); k < m->point_offsets[point + 1]; k++) {
        const double *design = m->design + m->by_point[k] * 2 * m->width;
        for (int64_t c = 0; c < 2 * m->width; c += 8) SOON(design + c);
        SOON(m->weight + m->by_point[k]);
        if (!of) SOON(m->left + 2 * m->by_point[k]);
    }
}

/* Images around in rising order, if `room` holds them; 0 where it does not. */
static int in_order(const around *space, int64_t room, int64_t *found) {
    if (space->num > room) return 0;
    memcpy(found, space->image, (size_t)space->num * sizeof *found);
    qsort(found, (size_t)space->num, sizeof *found, by_number);
    return 1;
}

/* Make place for the next image; return how many were around this one. */
static int64_t forget(around *space) {
    int64_t num = space->num;
    for (int64_t k = 0; k < num; k++) space->place[space->image[k]] = 0;
    space->num = 0;
    return num;
}

/* scale J a of a row's J (2, 3) and of a (3, padded). */
INLINE void move_row(const double *jx, const double *jy, double scale, const double *a, int64_t padded, wide_rows *out) {
    double x[3], y[3];
    for (int i = 0; i < 3; i++) x[i] = scale * jx[i], y[i] = scale * jy[i];
    for (int64_t d = 0; d < padded / LANES; d++) {
        wide a0 = LOAD(a + LANES * d), a1 = LOAD(a + padded + LANES * d), a2 = LOAD(a + 2 * padded + LANES * d);
        out->x[d] = x[0] * a0 + x[1] * a1 + x[2] * a2, out->y[d] = y[0] * a0 + y[1] * a1 + y[2] * a2;
    }
}

/* to (padded, padded) += the product of a row's design (2, width), turned, and of the moved rows. */
INLINE void add_outer(const double *dx, int64_t width, const wide_rows *moved, int64_t padded, double *to) {
    const double *dy = dx + width;
    for (int64_t c = 0; c < width; c++) {
        double x = dx[c], y = dy[c];
        for (int64_t d = 0; d < padded / LANES; d++) STORE(to + c * padded + LANES * d) += x * moved->x[d] + y * moved->y[d];
    }
}

/* out (width, padded): a matrix (width, width), zeros behind its last column. */
INLINE void pad_square(const double *from, int64_t width, int64_t padded, double *out) {
    memset(out, 0, (size_t)(width * padded) * sizeof *out);
    for (int64_t c = 0; c < width; c++) memcpy(out + c * padded, from + c * width, (size_t)width * sizeof *out);
}

/* N (2, padded) = design T of a row, zeros behind the last column. T comes first: products of columns that all but cancel in it
 * (the depth of what a long lens sees) would lose twice the digits. */
INLINE void turn_row(const double *dx, int64_t width, const double *turn, int64_t padded, wide_rows *out) {
    for (int64_t d = 0; d < padded / LANES; d++) out->x[d] = out->y[d] = (wide){0.0, 0.0, 0.0, 0.0};
    for (int64_t c = 0; c < width; c++) {
        for (int64_t d = 0; d < padded / LANES; d++) {
            wide t = LOAD(turn + c * padded + LANES * d);
            out->x[d] += dx[c] * t, out->y[d] += dx[width + c] * t;
        }
    }
}

/* V^-1 W^T (3, padded) of a row; own: its N. */
INLINE void absorb_row(
    const double *jx, const double *jy, const wide_rows *own, int64_t padded, double weight, const double *v, double *out) {
    for (int i = 0; i < 3; i++) {
        double x = weight * (v[3 * i] * jx[0] + v[3 * i + 1] * jx[1] + v[3 * i + 2] * jx[2]);
        double y = weight * (v[3 * i] * jy[0] + v[3 * i + 1] * jy[1] + v[3 * i + 2] * jy[2]);
        for (int64_t d = 0; d < padded / LANES; d++) STORE(out + i * padded + LANES * d) = x * own->x[d] + y * own->y[d];
    }
}

/* out (width, width): scale T^T from (padded, padded), T (width, width) that of the rows. */
static void turn_back(const double *from, int64_t padded, int64_t width, const double *transform, double scale, double *out) {
    for (int64_t c = 0; c < width; c++) {
        double sum[MOST_COLUMNS] = {0.0};
        for (int64_t b = 0; b < width; b++) {
            double x = transform[b * width + c];
            for (int64_t d = 0; x != 0.0 && d < width; d++) sum[d] += x * from[b * padded + d];
        }
        for (int64_t d = 0; d < width; d++) out[c * width + d] = scale * sum[d];
    }
}

/* Of an image's own rows: N^T w N of one system, at and right of the diagonal, and what the other one has more; N^T w (y - J V^-1
 * J^T w y) of both. */
typedef struct {
    double gram[2][SQUARE], right[2][MOST_COLUMNS];
} own_sums;

/* gram (padded, padded) += scale N^T N of a row. */
INLINE void add_row_gram(int64_t padded, const wide_rows *own, double scale, double *gram) {
    double x[MOST_COLUMNS], y[MOST_COLUMNS];
    for (int64_t d = 0; d < padded / LANES; d++) {
        STORE(x + LANES * d) = scale * own->x[d], STORE(y + LANES * d) = scale * own->y[d];
    }
    for (int64_t c = 0; c < padded; c++) {
        for (int64_t d = c / LANES; d < padded / LANES; d++) {
            STORE(gram + c * padded + LANES * d) += x[c] * own->x[d] + y[c] * own->y[d];
        }
    }
}

/* right (padded) += N^T w y of a row less what is absorbed (3, padded) where the point is pulled. */
INLINE void add_right(
    int64_t padded, const wide_rows *own, double wx, double wy, const double *absorbed, const double *pull, double *right) {
    for (int64_t d = 0; d < padded / LANES; d++) {
        const double *a = absorbed + LANES * d;
        wide taken = pull[0] * LOAD(a) + pull[1] * LOAD(a + padded) + pull[2] * LOAD(a + 2 * padded);
        STORE(right + LANES * d) += wx * own->x[d] + wy * own->y[d] - taken;
    }
}

/* Of one row, and of the views of its point by images that are not before its own, for both systems: the sums of the own rows, and
 * W_k V^-1 W^T (padded, padded) between the image (columns) and each of them (rows, from the design without T), then what the
 * second system has more: of points whose weights differ, all others say the same twice. */
INLINE void add_normal_row(
    const joint_model *m, const two_systems *of, int64_t image, int64_t row, const double *turn, int64_t padded, around *space,
    own_sums *sums) {
    int64_t width = m->width, point = m->point_idx[row];
    const double *dx = m->design + row * 2 * width, *inverse = of->inverse[0] + 9 * point, *plain = of->inverse[1] + 9 * point;
    double w[2] = {m->weight[row], of->plain[image]}, absorbed[3 * MOST_COLUMNS], other[3 * MOST_COLUMNS];
    /* of a point whose weights are the same, the inverses are, to the last bit */
    int differs = 0;
    for (int i = 0; i < 9; i++) differs |= inverse[i] != plain[i];
    wide_rows own, moved, more;
    turn_row(dx, width, turn, padded, &own);
    absorb_row(dx + 3, dx + width + 3, &own, padded, w[0], inverse, absorbed);
    if (differs) absorb_row(dx + 3, dx + width + 3, &own, padded, w[1], plain, other);
    add_row_gram(padded, &own, w[0], sums->gram[0]);
    if (w[1] != w[0]) add_row_gram(padded, &own, w[1] - w[0], sums->gram[1]);
    for (int k = 0; k < 2; k++) {
        double wx = w[k] * m->left[2 * row], wy = w[k] * m->left[2 * row + 1];
        add_right(padded, &own, wx, wy, k && differs ? other : absorbed, of->pull[k] + 3 * point, sums->right[k]);
    }
    for (int64_t k = view_from(m, point, image); k < m->point_offsets[point + 1]; k++) {
        int64_t view = m->by_point[k], here = m->image_of[k];
        const double *design = m->design + view * 2 * width, *jx = design + 3, *jy = jx + width;
        double *slab = sums_with(space, here);
        move_row(jx, jy, m->weight[view], absorbed, padded, &moved);
        add_outer(design, width, &moved, padded, slab);
        if (!differs) continue;
        move_row(jx, jy, of->plain[here], other, padded, &more);
        for (int64_t d = 0; d < padded / LANES; d++) more.x[d] -= moved.x[d], more.y[d] -= moved.y[d];
        add_outer(design, width, &more, padded, slab + padded * padded);
    }
}

/* joint_normals of one image: how many are around it, -1 where `room` does not hold them. */
INLINE int64_t normal_of(
    const joint_model *m, const two_systems *of, int64_t image, int64_t padded, around *space, const double *transform,
    int64_t room, int64_t *found, double *slab, double *other_slab, double *grams, double *rights) {
    int64_t last = m->offsets[image + 1], width = m->width, square = width * width, size = padded * padded;
    double turn[SQUARE];
    own_sums sums = {{{0.0}, {0.0}}, {{0.0}, {0.0}}};
    pad_square(transform + image * square, width, padded, turn);
    for (int64_t row = m->offsets[image]; row < last; row++) {
        ask_ahead(m, row, last, image, of);
        add_normal_row(m, of, image, row, turn, padded, space, &sums);
    }
    for (int64_t c = 0; c < width; c++) {
        for (int64_t d = c; d < width; d++) {
            double value = sums.gram[0][c * padded + d], more = sums.gram[1][c * padded + d];
            grams[c * width + d] = grams[d * width + c] = value;
            grams[(width + c) * width + d] = grams[(width + d) * width + c] = value + more;
        }
        rights[c] = sums.right[0][c], rights[width + c] = sums.right[1][c];
    }
    if (!in_order(space, room, found)) return -1;
    for (int64_t k = 0; k < space->num; k++) {
        double *here = space->sums + (space->place[found[k]] - 1) * space->size, scale = k ? -1.0 : -0.5;
        const double *of_rows = transform + found[k] * square;
        for (int64_t c = 0; c < size; c++) here[size + c] += here[c];
        turn_back(here, padded, width, of_rows, scale, slab + k * square);
        turn_back(here + size, padded, width, of_rows, scale, other_slab + k * square);
    }
    for (int64_t c = 0; space->num && c < square; c++) {
        slab[c] += 0.5 * grams[c], other_slab[c] += 0.5 * grams[square + c];
    }
    return forget(space);
}

/* What images add to the normal equations without the points, of both systems (reduced_systems of audit/joint/normal.py), one
 * image after the other as long as `room` blocks hold it.
 *
 * images (num); transform (I, width, width): T.    plain (I): the second system's weight of each image's rows;
 * other_inverse (P, 3, 3), pull, other_pull (P, 3): see two_systems.
 * Out: counts (num): images of each, itself and those behind it that see its points; found (room): who they are; slabs,
 * other_slabs (room, width, width): block between each of them (rows) and the image (columns), its own one halved; grams (num,
 * 2, width, width), rights (num, 2, width). Returns how many images were done; fewer than there are where the next one finds no
 * room, -1 without memory or where there are too many columns. */
KERNEL int64_t joint_normals(
    const joint_model *m, int64_t num, const int64_t *images, const double *transform, const double *plain,
    const double *other_inverse, const double *pull, const double *other_pull, int64_t room, int64_t *counts, int64_t *found,
    double *slabs, double *other_slabs, double *grams, double *rights) {
    int64_t used = 0, done = 0, square = m->width * m->width;
    const two_systems of = {plain, {m->point_inverse, other_inverse}, {pull, other_pull}};
    around space;
    if (!has_room(m, num, images, 2, &space)) done = -1;
    for (; done >= 0 && done < num; done++) {
        int64_t image = images[done], free_room = room - used, count, *who = found + used;
        double *slab = slabs + used * square, *other = other_slabs + used * square;
        double *gram = grams + 2 * done * square, *right = rights + 2 * done * m->width;
        int64_t padded = space.padded;
        if (padded == 8) count = normal_of(m, &of, image, 8, &space, transform, free_room, who, slab, other, gram, right);
        else if (padded == 12) count = normal_of(m, &of, image, 12, &space, transform, free_room, who, slab, other, gram, right);
        else count = normal_of(m, &of, image, padded, &space, transform, free_room, who, slab, other, gram, right);
        if (count < 0) break;
        counts[done] = count, used += count;
    }
    leave(&space);
    return done;
}

/* out (padded): w design^T y~ of a view, zeros behind the last column. */
INLINE void weigh_view(const joint_model *m, int64_t view, int64_t padded, double *out) {
    int64_t width = m->width;
    const double *dx = m->design + view * 2 * width, *dy = dx + width;
    double w = m->weight[view], x = w * m->left[2 * view], y = w * m->left[2 * view + 1];
    if (width == padded) {
        for (int64_t c = 0; c < padded; c += LANES) STORE(out + c) = x * LOAD(dx + c) + y * LOAD(dy + c);
    } else {
        for (int64_t c = 0; c < padded; c++) out[c] = c < width ? dx[c] * x + dy[c] * y : 0.0;
    }
}

/* joint_meats of one image. */
INLINE int64_t meat_of(
    const joint_model *m, int64_t image, int64_t padded, around *space, const double *transform, int64_t room, int64_t *found,
    double *slab) {
    int64_t last = m->offsets[image + 1], width = m->width, square = width * width;
    double turn[SQUARE], value[MOST_COLUMNS];
    pad_square(transform + image * square, width, padded, turn);
    for (int64_t row = m->offsets[image]; row < last; row++) {
        int64_t point = m->point_idx[row], begin = view_from(m, point, image), end = m->point_offsets[point + 1];
        wide score[WIDES] = {{0}};
        ask_ahead(m, row, last, image, NULL);
        if (begin == end || m->by_point[begin] != row) continue; /* the image's first view of the point has spoken for all */
        for (int64_t k = begin; k < end && m->image_of[k] == image; k++) {
            weigh_view(m, m->by_point[k], padded, value);
            for (int64_t c = 0; c < width; c++) {
                for (int64_t d = 0; d < padded / LANES; d++) score[d] += value[c] * LOAD(turn + c * padded + LANES * d);
            }
        }
        for (int64_t k = begin; k < end; k++) {
            double *here = sums_with(space, m->image_of[k]);
            weigh_view(m, m->by_point[k], padded, value);
            for (int64_t c = 0; c < width; c++) {
                for (int64_t d = 0; d < padded / LANES; d++) STORE(here + c * padded + LANES * d) += value[c] * score[d];
            }
        }
    }
    if (!in_order(space, room, found)) return -1;
    for (int64_t k = 0; k < space->num; k++) {
        const double *here = space->sums + (space->place[found[k]] - 1) * space->size;
        turn_back(here, padded, width, transform + found[k] * square, k ? 1.0 : 0.5, slab + k * square);
    }
    return forget(space);
}

/* Sums over tracks of s_k s^T, s the sum of w y~^T N over an image's views of a track (columns), s_k that of everybody behind it
 * (rows); its own one is halved (score_meat).    The rest as joint_normals has it. */
KERNEL int64_t joint_meats(
    const joint_model *m, int64_t num, const int64_t *images, const double *transform, int64_t room, int64_t *counts,
    int64_t *found, double *slabs) {
    int64_t used = 0, done = 0;
    around space;
    if (!has_room(m, num, images, 1, &space)) done = -1;
    for (; done >= 0 && done < num; done++) {
        int64_t image = images[done], free_room = room - used, count, *who = found + used;
        double *slab = slabs + used * m->width * m->width;
        if (space.padded == 8) count = meat_of(m, image, 8, &space, transform, free_room, who, slab);
        else if (space.padded == 12) count = meat_of(m, image, 12, &space, transform, free_room, who, slab);
        else count = meat_of(m, image, space.padded, &space, transform, free_room, who, slab);
        if (count < 0) break;
        counts[done] = count, used += count;
    }
    leave(&space);
    return done;
}
