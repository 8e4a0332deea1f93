/* What fields that become free do to all residuals of a joint system. Twin: system.py's with_step. */
#include "joint.h"

/* Subtract the change of a step from the residuals off the points: out_left (n, 2) = left - (q - J V^-1 J^T w q), q (n, 2) = design
 * moved + fields; out_steps (P, 3) = steps - V^-1 J^T w q.
 *
 * moved (I, width): T change of each image.    field_first (I): its first row of fields (.., 2), -1 without any.    room: (2 times the
 * most views of a point).    Point by point: what belongs to a view is met once, while it is at hand. */
KERNEL int64_t joint_take_change(
    const joint_model *m, int64_t num_points, const double *moved, const int64_t *field_first, const double *fields, const double *steps,
    double *room, double *out_left, double *out_steps) {
    const int64_t width = m->width, num = m->point_offsets[num_points];
    for (int64_t p = 0; p < num_points; p++) {
        const int64_t first = m->point_offsets[p], last = m->point_offsets[p + 1];
        double pull[3] = {0.0, 0.0, 0.0}, change[3];
        for (int64_t k = first; k < last; k++) {
            if (k + 2 * AHEAD < num) {
                const int64_t later = m->by_point[k + 2 * AHEAD];
                for (int64_t c = 0; c < 2 * width; c += 8) SOON(m->design + later * 2 * width + c);
                SOON(m->weight + later), SOON(m->left + 2 * later), SOON(out_left + 2 * later);
            }
            const int64_t row = m->by_point[k], image = m->image_of[k];
            const double *x = m->design + row * 2 * width, *y = x + width, *t = moved + width * image;
            double q[2] = {0.0, 0.0};
            for (int64_t c = 0; c < width; c++) q[0] += x[c] * t[c], q[1] += y[c] * t[c];
            if (field_first[image] >= 0) {
                const double *own = fields + 2 * (field_first[image] + row - m->offsets[image]);
                q[0] += own[0], q[1] += own[1];
            }
            for (int i = 0; i < 3; i++) pull[i] += (x[3 + i] * q[0] + y[3 + i] * q[1]) * m->weight[row];
            room[2 * (k - first)] = q[0], room[2 * (k - first) + 1] = q[1];
        }
        const double *v = m->point_inverse + 9 * p;
        for (int i = 0; i < 3; i++) {
            change[i] = v[3 * i] * pull[0] + v[3 * i + 1] * pull[1] + v[3 * i + 2] * pull[2];
            out_steps[3 * p + i] = steps[3 * p + i] - change[i];
        }
        for (int64_t k = first; k < last; k++) {
            const int64_t row = m->by_point[k];
            for (int axis = 0; axis < 2; axis++) {
                const double *j = m->design + (row * 2 + axis) * width + 3;
                const double by_point = j[0] * change[0] + j[1] * change[1] + j[2] * change[2];
                out_left[2 * row + axis] = m->left[2 * row + axis] - (room[2 * (k - first) + axis] - by_point);
            }
        }
    }
    return DONE;
}
