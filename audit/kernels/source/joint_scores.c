/* The scores of the candidate fields of images, one after the other, from the points to what the tests need (docs/method.md
 * section 11b; audit/joint/image_scores.py). */
#include "joint.h"

enum { TILE = 16, RUN = 8, VECTORS = FIELDS / LANES, TRACKS_AT_ONCE = 64, LINE = 8 };

/* S^+ (size, size) of the base: dense, or of a band by places, D^-1 (Y - A B^T - B A^T) D^-1 (audit/joint/banded.py). */
typedef struct {
    int64_t size, width;       /* width of an image's columns */
    const int64_t *columns;    /* (I, width); `size` where an image has none */
    const double *transform;   /* (I, width, width) */
    const double *dense;       /* NULL: banded */
    int64_t num_banded, num_blocks, num_outer; /* places from num_banded on are the border: Y is zero there */
    const int64_t *place;                      /* (size) of each column */
    const int64_t *block, *first;              /* (num_banded) of each place, (num_blocks + 1) place where each begins */
    const int64_t *starts, *block_columns;
    const double *near, *aside, *pull, *scale;
    /* what was included since: S^+ + U U^T, its border (size, num_extra) and corner (num_extra, num_extra) */
    int64_t num_update, num_extra;
    const double *update, *border, *corner;
    const int64_t *extra_column; /* (I) first of an image's included fields in the border */
} base_inverse;

typedef struct {
    int64_t key, row, column;
} keyed;

static int by_key(const void *left, const void *right) {
    const keyed *a = left, *b = right;
    return a->key != b->key ? (a->key > b->key) - (a->key < b->key) : (a->row > b->row) - (a->row < b->row);
}

/* out (FIELDS) += x times from. */
INLINE void add_row(double *out, double x, const double *from) {
    wide f = {x, x, x, x};
    for (int v = 0; v < VECTORS; v++) STORE(out + LANES * v) += f * LOAD(from + LANES * v);
}

/* Entries of Y at places key[first_row ..] and key[first_column ..], at or right of the diagonal; 0 where not at hand. Columns of an
 * image mostly follow each other. */
INLINE int entries_of(
    const base_inverse *s, const keyed *key, int64_t first_row, int64_t rows, int64_t first_column, int64_t columns, double *out) {
    int64_t at[TILE];
    for (int64_t j = 0; j < columns; j++) at[j] = key[first_column + j].key;
    for (int64_t i = 0; i < rows; i++) {
        int64_t place = key[first_row + i].key, origin = 0;
        const double *row;
        if (s->dense) {
            row = s->dense + place * s->size;
        } else {
            int64_t block = s->block[place];
            origin = s->first[block];
            if (at[columns - 1] - origin >= s->block_columns[block]) return 0;
            row = s->near + s->starts[block] + (place - origin) * s->block_columns[block];
        }
        for (int64_t j = 0; j < columns; j += RUN) {
            if (at[j] >= place && j + RUN <= columns && at[j + RUN - 1] - at[j] == RUN - 1) {
                for (int l = 0; l < RUN; l += LANES) STORE(out + TILE * i + j + l) = LOAD(row + at[j] - origin + l);
                continue;
            }
            for (int64_t l = j; l < columns && l < j + RUN; l++) out[TILE * i + l] = at[l] >= place ? row[at[l] - origin] : 0.0;
        }
    }
    return 1;
}

/* out (num, FIELDS) = S^+ at the keys times from (num, FIELDS); scaled (num, FIELDS): room. 0 where entries are not at hand. */
static inline __attribute__((always_inline)) int times_inverse(
    const base_inverse *s, const keyed *key, const int64_t *column, int64_t num, const double *from, double *scaled, double *out) {
    for (int64_t i = 0; i < num; i++) {
        double d = s->dense ? 1.0 : s->scale[column[i]];
        for (int c = 0; c < FIELDS; c++) scaled[FIELDS * i + c] = d * from[FIELDS * i + c];
    }
    int64_t inner = num;
    while (!s->dense && inner && key[inner - 1].key >= s->num_banded) inner--;
    memset(out, 0, (size_t)(num * FIELDS) * sizeof *out);
    for (int64_t i = 0; i < inner; i += TILE) {
        int64_t rows = inner - i < TILE ? inner - i : TILE;
        for (int64_t j = i; j < inner; j += TILE) {
            double tile[TILE * TILE] ALIGNED;
            int64_t columns = inner - j < TILE ? inner - j : TILE;
            if (!entries_of(s, key, i, rows, j, columns, tile)) return 0;
            if (i == j) {
                for (int64_t a = 0; a < rows; a++) {
                    for (int64_t b = 0; b < a; b++) tile[TILE * a + b] = tile[TILE * b + a];
                }
            } else {
                add_products(columns, VECTORS, rows, tile, TILE, 1, scaled + FIELDS * i, FIELDS, out + FIELDS * j, FIELDS);
            }
            add_products(rows, VECTORS, columns, tile, 1, TILE, scaled + FIELDS * j, FIELDS, out + FIELDS * i, FIELDS);
        }
    }
    for (int64_t k = 0; !s->dense && k < s->num_outer; k++) {
        double of_aside[FIELDS] = {0.0}, of_pull[FIELDS] = {0.0};
        for (int64_t i = 0; i < num; i++) {
            add_row(of_aside, s->aside[key[i].key * s->num_outer + k], scaled + FIELDS * i);
            add_row(of_pull, s->pull[key[i].key * s->num_outer + k], scaled + FIELDS * i);
        }
        for (int64_t i = 0; i < num; i++) {
            add_row(out + FIELDS * i, -s->aside[key[i].key * s->num_outer + k], of_pull);
            add_row(out + FIELDS * i, -s->pull[key[i].key * s->num_outer + k], of_aside);
        }
    }
    for (int64_t i = 0; !s->dense && i < num; i++) {
        for (int c = 0; c < FIELDS; c++) out[FIELDS * i + c] *= s->scale[column[i]];
    }
    return 1;
}

/* out (num, FIELDS) += U U^T from, TILE columns of U at a time; panel (num, TILE): room for them. */
INLINE void add_update(const base_inverse *s, const int64_t *column, int64_t num, const double *from, double *panel, double *out) {
    for (int64_t k = 0; k < s->num_update; k += TILE) {
        int64_t some = s->num_update - k < TILE ? s->num_update - k : TILE;
        double along[TILE * FIELDS] ALIGNED = {0.0};
        for (int64_t i = 0; i < num; i++) {
            memcpy(panel + TILE * i, s->update + column[i] * s->num_update + k, (size_t)some * sizeof *panel);
        }
        add_products(some, VECTORS, num, panel, TILE, 1, from, FIELDS, along, FIELDS);
        add_products(num, VECTORS, some, panel, 1, TILE, along, FIELDS, out, FIELDS);
    }
}

/* What included fields add to out (num + num_extra, FIELDS): U U^T, border and corner, at num columns of the base and those of
 * num_extra included fields behind them. */
static inline __attribute__((always_inline)) void add_included(
    const base_inverse *s, const int64_t *column, int64_t num, int64_t num_extra, const double *from, double *panel, double *out) {
    const int64_t *extra = column + num;
    memset(out + FIELDS * num, 0, (size_t)(num_extra * FIELDS) * sizeof *out);
    add_update(s, column, num, from, panel, out);
    for (int64_t e = 0; e < num_extra; e++) {
        for (int64_t i = 0; i < num; i++) {
            double x = s->border[column[i] * s->num_extra + extra[e]];
            add_row(out + FIELDS * i, x, from + FIELDS * (num + e));
            add_row(out + FIELDS * (num + e), x, from + FIELDS * i);
        }
        for (int64_t f = 0; f < num_extra; f++) {
            add_row(out + FIELDS * (num + e), s->corner[extra[e] * s->num_extra + extra[f]], from + FIELDS * (num + f));
        }
    }
}

/* out (FIELDS, FIELDS) += left^T right, both (num, FIELDS), at and right of the diagonal, four rows at a time: of scalars with scalars,
 * and of dense fields with dense fields. */
INLINE void add_symmetric(int64_t num, const double *left, const double *right, double *out) {
    for (int64_t first = 0; first < num; first += TRACKS_AT_ONCE) {
        int64_t count = num - first < TRACKS_AT_ONCE ? num - first : TRACKS_AT_ONCE;
        for (int64_t a = 0; a < FIELDS; a += LANES) {
            const double *l = left + FIELDS * first + a, *r = right + FIELDS * first + a;
            int64_t end = a < 2 * SCALAR ? 2 * SCALAR : FIELDS;
            add_products(LANES, (end - a) / LANES, count, l, FIELDS, 1, r, FIELDS, out + FIELDS * a + a, FIELDS);
        }
    }
}

/* Room for one image after the other: most rows, views, columns of images around. */
typedef struct {
    int64_t most_rows, most_views, most_columns;
    double *xyz, *predicted, *scalar, *dense, *absorbing, *track_score, *scores;
    double *right, *ordered, *scaled, *solution, *moved, *panel;
    int32_t *view, *own, *track;
    int64_t *place, *around, *start, *column, *position;
    keyed *keys;
    void *all[2]; /* what the first two rows above lie in */
} workspace;

/* Numbers that begin where a line of the cache does: vectors then never lie in two. */
static double *lined_up(int64_t num, void **all) {
    *all = malloc((size_t)(num + LINE) * sizeof(double));
    return *all ? (double *)(((uintptr_t)*all + LINE * sizeof(double) - 1) / (LINE * sizeof(double)) * (LINE * sizeof(double))) : NULL;
}

static int has_room(workspace *w, int64_t num_images, int64_t width) {
    int64_t n = w->most_rows, v = w->most_views, c = w->most_columns;
    w->scalar = lined_up(n * (SCALAR + 2 * DENSE + FIELDS + 3 + 2 + 6), w->all);
    w->right = lined_up(c * (5 * FIELDS + TILE), w->all + 1);
    w->scores = malloc((size_t)(v * width + 1) * sizeof(double));
    w->view = malloc((size_t)(2 * v + n + 1) * sizeof(int32_t));
    w->place = calloc((size_t)(num_images + 1), sizeof(int64_t));
    w->around = malloc((size_t)(v + v + 1 + 2 * c + 1) * sizeof(int64_t));
    w->keys = malloc((size_t)(c + 1) * sizeof(keyed));
    if (!w->scalar || !w->scores || !w->right || !w->view || !w->place || !w->around || !w->keys) return 0;
    w->dense = w->scalar + SCALAR * n, w->track_score = w->dense + 2 * DENSE * n;
    w->xyz = w->track_score + FIELDS * n, w->predicted = w->xyz + 3 * n, w->absorbing = w->predicted + 2 * n;
    w->ordered = w->right + c * FIELDS, w->scaled = w->ordered + c * FIELDS, w->solution = w->scaled + c * FIELDS;
    w->moved = w->solution + c * FIELDS, w->panel = w->moved + c * FIELDS;
    w->own = w->view + v, w->track = w->own + v;
    w->start = w->around + v, w->column = w->start + v + 1, w->position = w->column + c;
    return 1;
}

static void leave(workspace *w) {
    free(w->all[0]), free(w->all[1]), free(w->scores), free(w->view), free(w->place), free(w->around), free(w->keys);
}

/* Which distinct point each row shows, -1 - t where the row before it shows it too; returns how many there are. */
static int64_t number_tracks(const joint_model *m, int64_t first, int64_t n, int32_t *track) {
    int64_t count = 0;
    for (int64_t i = 0; i < n; i++) {
        int again = i && m->point_idx[first + i] == m->point_idx[first + i - 1];
        track[i] = (int32_t)(again ? -count : count);
        count += !again;
    }
    return count;
}

/* Order the columns around an image: keys ascending, column of each, those of included fields behind them; position of each row
 * of right, -1 without a column. num: how many distinct columns the base has here, and how many included fields. */
static void order_columns(const joint_model *m, const base_inverse *s, const workspace *w, int64_t num_around, int64_t *num) {
    int64_t rows = 0, count = 0, row = 0, extra = 0;
    for (int64_t k = 0; k < num_around; k++) {
        for (int64_t c = 0; c < s->width; c++, row++) {
            int64_t column = s->columns[w->around[k] * s->width + c];
            w->position[row] = -1;
            if (column < s->size) w->keys[rows++] = (keyed){s->dense ? column : s->place[column], row, column};
        }
        row += m->extra_width[w->around[k]];
    }
    qsort(w->keys, (size_t)rows, sizeof *w->keys, by_key);
    for (int64_t r = 0; r < rows; r++) {
        keyed here = w->keys[r];
        if (!count || w->keys[count - 1].key != here.key) w->column[count] = here.column, w->keys[count++] = here;
        w->position[here.row] = count - 1;
    }
    row = 0;
    for (int64_t k = 0; k < num_around; k++) {
        row += s->width;
        for (int64_t e = 0; e < m->extra_width[w->around[k]]; e++, row++, extra++) {
            w->column[count + extra] = s->extra_column[w->around[k]] + e;
            w->position[row] = count + extra;
        }
    }
    num[0] = count, num[1] = extra;
}

/* ordered (num, FIELDS): T^T right of each image around, summed by column; rows of included fields as they are. */
INLINE void collect_columns(const joint_model *m, const base_inverse *s, const workspace *w, int64_t num_around, int64_t num) {
    memset(w->ordered, 0, (size_t)(num * FIELDS) * sizeof(double));
    for (int64_t k = 0, row = 0; k < num_around; k++) {
        const double *t = s->transform + w->around[k] * s->width * s->width, *right = w->right + row * FIELDS;
        for (int64_t d = 0; d < s->width; d++) {
            int64_t to = w->position[row + d];
            for (int64_t c = 0; c < s->width && to >= 0; c++) {
                if (t[c * s->width + d] != 0.0) add_row(w->ordered + FIELDS * to, t[c * s->width + d], right + FIELDS * c);
            }
        }
        row += s->width;
        for (int64_t e = 0; e < m->extra_width[w->around[k]]; e++, row++) {
            add_row(w->ordered + FIELDS * w->position[row], 1.0, w->right + row * FIELDS);
        }
    }
}

/* moved (rows, FIELDS): T times the solution of each image around; rows of included fields as they are. */
INLINE void spread_columns(const joint_model *m, const base_inverse *s, const workspace *w, int64_t num_around, int64_t num_rows) {
    memset(w->moved, 0, (size_t)(num_rows * FIELDS) * sizeof(double));
    for (int64_t k = 0, row = 0; k < num_around; k++) {
        const double *t = s->transform + w->around[k] * s->width * s->width;
        double *moved = w->moved + row * FIELDS;
        for (int64_t c = 0; c < s->width; c++) {
            for (int64_t d = 0; d < s->width; d++) {
                int64_t from = w->position[row + d];
                if (from >= 0 && t[c * s->width + d] != 0.0) add_row(moved + FIELDS * c, t[c * s->width + d], w->solution + FIELDS * from);
            }
        }
        row += s->width;
        for (int64_t e = 0; e < m->extra_width[w->around[k]]; e++, row++) {
            add_row(w->moved + row * FIELDS, 1.0, w->solution + FIELDS * w->position[row]);
        }
    }
}

/* The rows of an image's points: xyz (n, 3), predicted (n, 2). */
void joint_look_up(const joint_model *m, const seen_points *p, int64_t first, int64_t n, double *xyz, double *predicted) {
    for (int64_t i = 0; i < n; i++) {
        int64_t source = p->source[first + i];
        if (i + 2 * AHEAD < n) SOON(p->points + m->point_idx[first + i + 2 * AHEAD]);
        if (i + AHEAD < n) {
            int64_t later = p->source[first + i + AHEAD];
            SOON(p->xyz + 3 * p->points[m->point_idx[first + i + AHEAD]]), SOON(p->observed + 2 * p->observation_row[later]);
            SOON(p->residuals + later), SOON(p->residuals + p->num_residuals + later);
        }
        const double *from = p->xyz + 3 * p->points[m->point_idx[first + i]], *xy = p->observed + 2 * p->observation_row[source];
        for (int axis = 0; axis < 3; axis++) xyz[3 * i + axis] = from[axis];
        for (int axis = 0; axis < 2; axis++) predicted[2 * i + axis] = xy[axis] - p->residuals[axis * p->num_residuals + source];
    }
}

/* What the tests of some images need of their 44 candidate functions.
 *
 * images (num); facts (num, 27), is_fisheye, power (num): as joint_fields has them.    most_rows, most_views, most_columns:
 * of these images, of the views of their points, and of design and included fields around.    widest: most columns of one image.
 * Out, by image: status; num_tracks; gram, meat (44, 44), zero between scalars and dense fields; plain (16, 16), dense_plain (12):
 * w E^T E, its diagonal; score (44); right, solution (width, 44): R and B at its own columns, zero where it has none. */
KERNEL int64_t joint_scores(
    const joint_model *m, const base_inverse *s, const seen_points *p, int64_t num, const int64_t *images, const double *facts,
    const int64_t *is_fisheye, const int64_t *power, int64_t most_rows, int64_t most_views, int64_t most_columns, int64_t widest, int64_t *status, int64_t *num_tracks,
    double *gram, double *meat, double *plain, double *dense_plain, double *score, double *right, double *solution) {
    int64_t width = m->width;
    workspace w = {0};
    w.most_rows = most_rows, w.most_views = most_views, w.most_columns = most_columns;
    if (!has_room(&w, m->num_images, widest)) {
        leave(&w);
        return NO_MEMORY;
    }
    memset(right, 0, (size_t)(num * width * FIELDS) * sizeof *right);
    memset(solution, 0, (size_t)(num * width * FIELDS) * sizeof *solution);
    for (int64_t k = 0; k < num; k++) {
        int64_t image = images[k], first = m->offsets[image], n = m->offsets[image + 1] - first, found[2];
        double *g = gram + k * FIELDS * FIELDS, *v = meat + k * FIELDS * FIELDS;
        joint_look_up(m, p, first, n, w.xyz, w.predicted);
        status[k] = joint_fields(m, image, facts + 27 * k, w.xyz, w.predicted, is_fisheye[k], power[k], w.scalar, w.dense);
        if (status[k] != DONE) continue;
        num_tracks[k] = number_tracks(m, first, n, w.track);
        status[k] = joint_first(
            m, w.place, image, w.scalar, w.dense, w.track, num_tracks[k], w.most_columns, w.view, w.own, w.around, w.start, found,
            w.absorbing, w.right, g, plain + k * SCALAR * SCALAR, dense_plain + k * DENSE, score + k * FIELDS,
            w.track_score, w.scores, most_views * widest);
        if (status[k] != DONE) continue;
        int64_t count[2];
        order_columns(m, s, &w, found[0], count);
        collect_columns(m, s, &w, found[0], count[0] + count[1]);
        if (!times_inverse(s, w.keys, w.column, count[0], w.ordered, w.scaled, w.solution)) {
            status[k] = NEEDS_NUMPY;
            continue;
        }
        add_included(s, w.column, count[0], count[1], w.ordered, w.panel, w.solution);
        spread_columns(m, s, &w, found[0], found[1]);
        joint_second(m, found[0], w.own, w.around, w.start, w.track, w.scores, w.moved, w.track_score);
        memset(v, 0, FIELDS * FIELDS * sizeof *v);
        add_symmetric(count[0] + count[1], w.ordered, w.solution, v);
        for (int64_t a = 0; a < FIELDS * FIELDS; a++) g[a] -= v[a], v[a] = 0.0;
        add_symmetric(num_tracks[k], w.track_score, w.track_score, v);
        for (int64_t a = 0; a < FIELDS; a++) {
            for (int64_t b = 0; b < a; b++) g[FIELDS * a + b] = g[FIELDS * b + a], v[FIELDS * a + b] = v[FIELDS * b + a];
        }
        for (int64_t j = 0, row = 0; j < found[0]; row += width + m->extra_width[w.around[j]], j++) {
            for (int64_t c = 0; w.around[j] == image && c < width; c++) {
                int64_t from = w.position[row + c], at = (k * width + c) * FIELDS;
                if (from < 0) continue;
                memcpy(right + at, w.ordered + FIELDS * from, FIELDS * sizeof *right);
                memcpy(solution + at, w.solution + FIELDS * from, FIELDS * sizeof *solution);
            }
        }
    }
    leave(&w);
    return DONE;
}
