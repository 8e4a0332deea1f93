/* The normal equations of the joint system without the points, and its sandwich, image by image (docs/method.md section 11;
 * audit/joint/normal.py is the numpy twin). */
#include "joint.h"

/* Room for one image after the other. */
typedef struct {
    surroundings near;
    double *nuisance, *absorbed, *other, *scores;
    unsigned char *differs;
    int64_t *place;
} normal_space;

/* Two systems: the robust weights of the model, and weights that all rows of an image have in common; V^-1 and the pull J^T w y
 * of each point with both. */
typedef struct {
    const double *plain;                /* (I) */
    const double *inverse[2], *pull[2]; /* (P, 3, 3), (P, 3) */
} two_systems;

enum { WIDES = MOST_COLUMNS / LANES };

/* Two rows of numbers, x and y. */
typedef struct {
    wide x[WIDES], y[WIDES];
} wide_rows;

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

/* `padded` is the width, rounded up to LANES.
 *
 * slab (padded, padded): W_k V^-1 W^T between an image (columns) and one that sees its points too (rows, from the design
 * without T).    more_slab: what the second system has more: of points whose weights differ, all others say the same twice. */
INLINE void add_slab(
    const joint_model *m, int64_t padded, const surroundings *near, int64_t k, const double *absorbed,
    const double *other_absorbed, const unsigned char *differs, double plain, double *slab, double *more_slab) {
    int64_t width = m->width;
    wide_rows moved, other;
    for (int64_t j = near->start[k]; j < near->start[k + 1]; j++) {
        soon(m, near->view, j, near->start[k + 1]);
        const double *dx = m->design + near->view[j] * 2 * width, *jx = dx + 3, *jy = jx + width;
        int64_t own = near->own[j];
        move_row(jx, jy, m->weight[near->view[j]], absorbed + 3 * padded * own, padded, &moved);
        add_outer(dx, width, &moved, padded, slab);
        if (!differs[own]) continue;
        move_row(jx, jy, plain, other_absorbed + 3 * padded * own, padded, &other);
        for (int64_t d = 0; d < padded / LANES; d++) other.x[d] -= moved.x[d], other.y[d] -= moved.y[d];
        add_outer(dx, width, &other, padded, more_slab);
    }
}

/* out (width, padded): a matrix (width, width), zeros behind its last column. */
INLINE void pad_square(const double *from, int64_t width, int64_t padded, double *out) {
    memset(out, 0, (size_t)(width * padded) * sizeof *out);
    for (int64_t c = 0; c < width; c++) memcpy(out + c * padded, from + c * width, (size_t)width * sizeof *out);
}

/* N (n, 2, padded) = design T of an image's rows, zeros behind the last column. T comes first: products of columns that all but
 * cancel in it (the depth of what a long lens sees) would lose twice the digits. */
INLINE void turn_rows(
    const joint_model *m, int64_t padded, int64_t first, int64_t n, const double *transform, double *out) {
    double turn[MOST_COLUMNS * MOST_COLUMNS];
    int64_t width = m->width;
    pad_square(transform, width, padded, turn);
    for (int64_t row = 0; row < 2 * n; row++) {
        const double *given = m->design + (2 * first + row) * width;
        wide sum[WIDES] = {{0}};
        for (int64_t c = 0; c < width; c++) {
            for (int64_t d = 0; d < padded; d += LANES) sum[d / LANES] += given[c] * LOAD(turn + c * padded + d);
        }
        for (int64_t d = 0; d < padded; d += LANES) STORE(out + row * padded + d) = sum[d / LANES];
    }
}

/* V^-1 W^T (3, padded) of a row; nuisance (2, padded): its N. */
INLINE void absorb_row(
    const joint_model *m, int64_t row, const double *nuisance, int64_t padded, double weight, const double *inverse,
    double *out) {
    const double *jx = m->design + row * 2 * m->width + 3, *jy = jx + m->width, *v = inverse + 9 * m->point_idx[row];
    for (int i = 0; i < 3; i++) {
        double x = weight * (v[3 * i] * jx[0] + v[3 * i + 1] * jx[1] + v[3 * i + 2] * jx[2]);
        double y = weight * (v[3 * i] * jy[0] + v[3 * i + 1] * jy[1] + v[3 * i + 2] * jy[2]);
        for (int64_t d = 0; d < padded; d += LANES) {
            STORE(out + i * padded + d) = x * LOAD(nuisance + d) + y * LOAD(nuisance + padded + d);
        }
    }
}

/* V^-1 W^T of all rows of an image, of both systems; differs (n): whether they do. */
INLINE void absorb_rows(
    const joint_model *m, const two_systems *of, double plain, int64_t first, int64_t n, int64_t padded, const double *nuisance,
    double *absorbed, double *other, unsigned char *differs) {
    for (int64_t i = 0; i < n; i++) {
        if (i + AHEAD < n) {
            int64_t point = m->point_idx[first + i + AHEAD];
            for (int k = 0; k < 2; k++) SOON(of->inverse[k] + 9 * point), SOON(of->inverse[k] + 9 * point + 8);
        }
        const double *mine = nuisance + 2 * padded * i;
        int64_t point = m->point_idx[first + i];
        /* of a point whose weights are the same, the inverses are, to the last bit */
        differs[i] = memcmp(of->inverse[0] + 9 * point, of->inverse[1] + 9 * point, 9 * sizeof(double)) != 0;
        absorb_row(m, first + i, mine, padded, m->weight[first + i], of->inverse[0], absorbed + 3 * padded * i);
        if (differs[i]) absorb_row(m, first + i, mine, padded, plain, of->inverse[1], other + 3 * padded * i);
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

/* gram (padded, padded) += scale N^T N of a row, at and right of the diagonal. */
INLINE void add_row_gram(int64_t padded, const double *nuisance, double scale, double *gram) {
    for (int64_t c = 0; c < padded; c++) {
        double x = scale * nuisance[c], y = scale * nuisance[padded + c];
        for (int64_t d = c / LANES * LANES; d < padded; d += LANES) {
            STORE(gram + c * padded + d) += x * LOAD(nuisance + d) + y * LOAD(nuisance + padded + d);
        }
    }
}

/* Of an image's own rows and both systems: grams (2, width, width) N^T w N, rights (2, width) N^T w (y - J V^-1 J^T w y). */
INLINE void add_own(
    const joint_model *m, const two_systems *of, double plain, int64_t first, int64_t n, int64_t padded,
    const normal_space *space, double *grams, double *rights) {
    double gram[2][MOST_COLUMNS * MOST_COLUMNS] = {{0.0}}, right[2][MOST_COLUMNS] = {{0.0}};
    int64_t width = m->width;
    for (int64_t i = 0; i < n; i++) {
        const double *own = space->nuisance + i * 2 * padded, *y = m->left + 2 * (first + i);
        double w[2] = {m->weight[first + i], plain};
        add_row_gram(padded, own, w[0], gram[0]);
        if (w[1] != w[0]) add_row_gram(padded, own, w[1] - w[0], gram[1]); /* what the second system has more */
        for (int k = 0; k < 2; k++) {
            const double *a = (k && space->differs[i] ? space->other : space->absorbed) + 3 * padded * i;
            const double *pull = of->pull[k] + 3 * m->point_idx[first + i];
            double wx = w[k] * y[0], wy = w[k] * y[1];
            for (int64_t d = 0; d < padded; d += LANES) {
                wide taken = pull[0] * LOAD(a + d) + pull[1] * LOAD(a + padded + d) + pull[2] * LOAD(a + 2 * padded + d);
                STORE(right[k] + d) += wx * LOAD(own + d) + wy * LOAD(own + padded + d) - taken;
            }
        }
    }
    for (int64_t c = 0; c < width; c++) {
        for (int64_t d = c; d < width; d++) {
            double value = gram[0][c * padded + d], more = gram[1][c * padded + d];
            grams[c * width + d] = grams[d * width + c] = value;
            grams[(width + c) * width + d] = grams[(width + d) * width + c] = value + more;
        }
        rights[c] = right[0][c], rights[width + c] = right[1][c];
    }
}

/* With room for the largest of some images. */
static int has_room(const joint_model *m, int64_t num, const int64_t *images, int64_t padded, normal_space *out) {
    int64_t rows = 0, views = 0;
    for (int64_t k = 0; k < num; k++) {
        int64_t first = m->offsets[images[k]], last = m->offsets[images[k] + 1], seen = 0;
        for (int64_t row = first; row < last; row++) {
            seen += m->point_offsets[m->point_idx[row] + 1] - m->point_offsets[m->point_idx[row]];
        }
        rows = last - first > rows ? last - first : rows, views = seen > views ? seen : views;
    }
    out->near.view = malloc((size_t)(2 * views + 1) * sizeof *out->near.view);
    out->near.own = out->near.view + views;
    out->near.image = calloc((size_t)(3 * m->num_images + 2), sizeof *out->near.image);
    out->nuisance = malloc((size_t)(9 * padded * rows + 1) * sizeof *out->nuisance);
    out->differs = malloc((size_t)rows + 1);
    if (!out->near.view || !out->near.image || !out->nuisance || !out->differs) return 0;
    out->near.start = out->near.image + m->num_images, out->place = out->near.start + m->num_images + 1;
    out->absorbed = out->nuisance + 2 * padded * rows, out->other = out->absorbed + 3 * padded * rows;
    out->scores = out->other + 3 * padded * rows;
    return 1;
}

static void leave(normal_space *space) {
    free(space->near.view), free(space->near.image), free(space->nuisance), free(space->differs);
}

/* joint_normals of one image, its views collected. */
INLINE void normal_of(
    const joint_model *m, const two_systems *of, int64_t image, int64_t padded, const normal_space *space,
    const double *transform, double *slab, double *other_slab, double *grams, double *rights) {
    int64_t first = m->offsets[image], n = m->offsets[image + 1] - first, width = m->width, size = padded * padded;
    int64_t square = width * width;
    const surroundings *near = &space->near;
    double plain = of->plain[image];
    turn_rows(m, padded, first, n, transform + image * square, space->nuisance);
    absorb_rows(m, of, plain, first, n, padded, space->nuisance, space->absorbed, space->other, space->differs);
    for (int64_t k = 0; k < near->num_images; k++) {
        double here[2][MOST_COLUMNS * MOST_COLUMNS], scale = k ? -1.0 : -0.5;
        const double *of_rows = transform + near->image[k] * square;
        memset(here[0], 0, (size_t)size * sizeof(double)), memset(here[1], 0, (size_t)size * sizeof(double));
        add_slab(
            m, padded, near, k, space->absorbed, space->other, space->differs, of->plain[near->image[k]], here[0], here[1]);
        for (int64_t c = 0; c < size; c++) here[1][c] += here[0][c];
        turn_back(here[0], padded, width, of_rows, scale, slab + k * square);
        turn_back(here[1], padded, width, of_rows, scale, other_slab + k * square);
    }
    add_own(m, of, plain, first, n, padded, space, grams, rights);
    for (int64_t c = 0; near->num_images && c < square; c++) {
        slab[c] += 0.5 * grams[c], other_slab[c] += 0.5 * grams[square + c];
    }
}

/* What images add to the normal equations without the points, of both systems (reduced_systems of audit/joint/normal.py), one
 * image after the other as long as `room` blocks hold it.
 *
 * images (num); transform (I, width, width): T.    plain (I): the second system's weight of each image's rows;
 * other_inverse (P, 3, 3), pull, other_pull (P, 3): see two_systems.
 * Out: counts (num): images of each, itself and those behind it that see its points; around (room): who they are; slabs,
 * other_slabs (room, width, width): block between each of them (rows) and the image (columns), its own one halved; grams (num,
 * 2, width, width), rights (num, 2, width). Returns how many images were done; fewer than there are where the next one finds no
 * room, -1 without memory or where there are too many columns. */
WIDE KERNEL int64_t joint_normals(
    const joint_model *m, int64_t num, const int64_t *images, const double *transform, const double *plain,
    const double *other_inverse, const double *pull, const double *other_pull, int64_t room, int64_t *counts, int64_t *around,
    double *slabs, double *other_slabs, double *grams, double *rights) {
    int64_t width = m->width, padded = (width + LANES - 1) / LANES * LANES, used = 0, done = 0, square = width * width;
    const two_systems of = {plain, {m->point_inverse, other_inverse}, {pull, other_pull}};
    normal_space space = {{0}, NULL, NULL, NULL, NULL, NULL, NULL};
    if (padded > MOST_COLUMNS || !has_room(m, num, images, padded, &space)) {
        leave(&space);
        return -1;
    }
    for (; done < num; done++) {
        int64_t image = images[done];
        double *slab = slabs + used * square, *other = other_slabs + used * square;
        double *gram = grams + 2 * done * square, *right = rights + 2 * done * width;
        collect(m, m->offsets[image], m->offsets[image + 1], image, space.place, &space.near);
        if (space.near.num_images > room - used) break;
        if (padded == 8) normal_of(m, &of, image, 8, &space, transform, slab, other, gram, right);
        else if (padded == 12) normal_of(m, &of, image, 12, &space, transform, slab, other, gram, right);
        else normal_of(m, &of, image, padded, &space, transform, slab, other, gram, right);
        memcpy(around + used, space.near.image, (size_t)space.near.num_images * sizeof *around);
        counts[done] = space.near.num_images, used += counts[done];
    }
    leave(&space);
    return done;
}

/* joint_meats of one image, its views collected. */
INLINE void meat_of(
    const joint_model *m, int64_t image, int64_t padded, const normal_space *space, const double *transform,
    const int32_t *track, double *slab) {
    int64_t first = m->offsets[image], n = m->offsets[image + 1] - first, width = m->width;
    const surroundings *near = &space->near;
    double turn[MOST_COLUMNS * MOST_COLUMNS];
    pad_square(transform + image * width * width, width, padded, turn);
    memset(space->scores, 0, (size_t)(n * padded) * sizeof *space->scores);
    for (int64_t i = 0; i < n; i++) {
        const double *dx = m->design + (first + i) * 2 * width, *dy = dx + width, *left = m->left + 2 * (first + i);
        double x = m->weight[first + i] * left[0], y = m->weight[first + i] * left[1];
        double *to = space->scores + padded * (track[i] < 0 ? -1 - track[i] : track[i]);
        wide sum[WIDES] = {{0}};
        for (int64_t c = 0; c < width; c++) {
            double value = dx[c] * x + dy[c] * y;
            for (int64_t d = 0; d < padded / LANES; d++) sum[d] += value * LOAD(turn + c * padded + LANES * d);
        }
        for (int64_t d = 0; d < padded / LANES; d++) STORE(to + LANES * d) += sum[d];
    }
    for (int64_t k = 0; k < near->num_images; k++) {
        double here[MOST_COLUMNS * MOST_COLUMNS];
        memset(here, 0, (size_t)(padded * padded) * sizeof *here);
        for (int64_t j = near->start[k]; j < near->start[k + 1]; j++) {
            soon(m, near->view, j, near->start[k + 1]);
            if (j + AHEAD < near->start[k + 1]) SOON(m->left + 2 * near->view[j + AHEAD]);
            if (track[near->own[j]] < 0) continue;
            int64_t row = near->view[j];
            const double *dx = m->design + row * 2 * width, *dy = dx + width;
            const double *s = space->scores + padded * track[near->own[j]];
            double w = m->weight[row], x = w * m->left[2 * row], y = w * m->left[2 * row + 1];
            for (int64_t c = 0; c < width; c++) {
                double value = dx[c] * x + dy[c] * y;
                for (int64_t d = 0; d < padded; d += LANES) STORE(here + c * padded + d) += value * LOAD(s + d);
            }
        }
        turn_back(here, padded, width, transform + near->image[k] * width * width, k ? 1.0 : 0.5, slab + k * width * width);
    }
}

/* Sums over tracks of s_k s^T, s the sum of w y~^T N over an image's views of a track (columns), s_k that of everybody behind it
 * (rows); its own one is halved (score_meat).    track (n): as in joint_first, image by image.
 * The rest as joint_normals has it. */
WIDE KERNEL int64_t joint_meats(
    const joint_model *m, int64_t num, const int64_t *images, const double *transform, const int32_t *track, int64_t room,
    int64_t *counts, int64_t *around, double *slabs) {
    int64_t width = m->width, padded = (width + LANES - 1) / LANES * LANES, used = 0, done = 0;
    normal_space space = {{0}, NULL, NULL, NULL, NULL, NULL, NULL};
    if (padded > MOST_COLUMNS || !has_room(m, num, images, padded, &space)) {
        leave(&space);
        return -1;
    }
    for (; done < num; done++) {
        int64_t image = images[done];
        const int32_t *own = track + m->offsets[image];
        double *slab = slabs + used * width * width;
        collect(m, m->offsets[image], m->offsets[image + 1], image, space.place, &space.near);
        if (space.near.num_images > room - used) break;
        if (padded == 8) meat_of(m, image, 8, &space, transform, own, slab);
        else if (padded == 12) meat_of(m, image, 12, &space, transform, own, slab);
        else meat_of(m, image, padded, &space, transform, own, slab);
        memcpy(around + used, space.near.image, (size_t)space.near.num_images * sizeof *around);
        counts[done] = space.near.num_images, used += counts[done];
    }
    leave(&space);
    return done;
}
