/* Residuals of all observations of a model, with derivatives in the point and the pose; those in the distortion.
 *
 * Twins: sfm_audit.audit.inliers.residuals and sfm_audit.audit.cameras, whose formulas these are, in their order. A
 * block of points goes from step to step in arrays of its own (structure of arrays, in the first cache): points into
 * the camera frame, onto the plane that the lens distorts, through the lens, out as residuals and derivatives.
 * An image with a point in front of its camera that cannot be used, or an odd derivative, goes to numpy. */
#include "kernel.h"

enum { BLOCK = 128, MAX_EXTRA = 12, NUM_PARAMS = 4 + MAX_EXTRA, LANES = 4, NUM_POSE = 6, NUM_SUMS = 27 };
/* As in sfm_audit.audit.kernels.projection. */
enum { IDENTITY, RADIAL, OPENCV, FULL_OPENCV, BROWN, FOV, THIN_PRISM, RAD_TAN_THIN_PRISM, DIVISION, EUCM };
enum { LENS, IS_FISHEYE, NUM_EXTRA, NUM_LENS }; /* columns of `lenses` */
enum { INLIERS, DANGLING, BEHIND, NUM_COUNTS };

static const double EPSILON = DBL_EPSILON, MAX_MAGNITUDE = 1e12, MAX_RESIDUAL_PX = 1e9, MAX_DERIVATIVE = 1e30;
static const double FOV_SMALL = 1e-4, NEAR_AXIS = 1e-3;

typedef double Column[BLOCK];

/* x, y, z: camera frame. px, py: (X, Y) / Z. u, v: what the lens distorts. wx, wy: distorted; xu .. yv: derivatives.
 * jac: d px / d point in the camera frame. residual, pose: the same of the pose, by axis. */
typedef struct {
    int n;
    Column x, y, z, seen_x, seen_y, inverse, px, py, tan2, gain, u, v, wx, wy, xu, xv, yu, yv;
    Column jac[2][3], residual[2], pose[2][NUM_POSE], extra[MAX_EXTRA][2];
    int64_t row[BLOCK];
} Block;

#define EACH(k, b) for (int k = 0; k < (b)->n; k++)

/* Numbers without sign in the order of their bits: infinity and NaN are the largest. */
INLINE int64_t magnitude(double value) {
    int64_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits & INT64_MAX;
}
INLINE int64_t larger(int64_t a, int64_t b) { return a > b ? a : b; }
INLINE double number(int64_t bits) {
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

/* ---- onto the plane ---- */

INLINE void perspective(Block *b) {
    EACH(k, b) {
        b->inverse[k] = b->z[k] >= EPSILON ? 1.0 / b->z[k] : NAN;
        b->u[k] = b->x[k] * b->inverse[k];
        b->v[k] = b->y[k] * b->inverse[k];
    }
}

INLINE void equidistant(Block *b) {
    EACH(k, b) {
        b->inverse[k] = b->z[k] >= EPSILON ? 1.0 / b->z[k] : NAN;
        b->px[k] = b->x[k] * b->inverse[k];
        b->py[k] = b->y[k] * b->inverse[k];
        b->tan2[k] = b->px[k] * b->px[k] + b->py[k] * b->py[k];
        const double tangent = sqrt(b->tan2[k] > DBL_MIN ? b->tan2[k] : DBL_MIN);
        b->gain[k] = arctan(tangent) / tangent;
        b->u[k] = b->px[k] * b->gain[k];
        b->v[k] = b->py[k] * b->gain[k];
    }
}

/* ---- through the lens; the formulas are explained in audit/cameras/warps.py ---- */

typedef struct {
    double x, y, xu, xv, yu, yv;
} Warp;

INLINE void keep(Block *b, int k, Warp w) {
    b->wx[k] = w.x, b->wy[k] = w.y, b->xu[k] = w.xu, b->xv[k] = w.xv, b->yu[k] = w.yu, b->yv[k] = w.yv;
}
INLINE void keep_extra(Block *b, int k, int i, double d_x, double d_y) {
    b->extra[i][0][k] = d_x, b->extra[i][1][k] = d_y;
}

/* sum c_i r2^i, i = 1 .. count, and its derivative by r2 */
INLINE double polynomial(double r2, const double *c, int count, double *slope) {
    double value = c[count - 1], d = 0.0;
    for (int i = count - 2; i >= 0; i--) {
        d = d * r2 + value;
        value = value * r2 + c[i];
    }
    *slope = d * r2 + value;
    return value * r2;
}

INLINE Warp radially(double u, double v, double gain, double slope) {
    const double hu = 2.0 * slope * u, hv = 2.0 * slope * v, cross = hu * v;
    return (Warp){u * gain, v * gain, gain + hu * u, cross, cross, gain + hv * v};
}

INLINE Warp radial_tangential(double u, double v, double r2, double gain, double slope, double p1, double p2) {
    const double common = gain + 2.0 * (p1 * v + p2 * u), hu = 2.0 * slope * u, hv = 2.0 * slope * v;
    const double cross = hu * v + 2.0 * (p1 * u + p2 * v);
    return (Warp){u * common + p2 * r2, v * common + p1 * r2, common + u * (hu + 4.0 * p2), cross, cross,
                  common + v * (hv + 4.0 * p1)};
}

INLINE void tangential_extra(Block *b, int k, int p1, int p2, double u, double v, double r2) {
    const double cross = 2.0 * u * v;
    keep_extra(b, k, p1, cross, r2 + 2.0 * v * v);
    keep_extra(b, k, p2, r2 + 2.0 * u * u, cross);
}

INLINE void identity(Block *b) { EACH(k, b) keep(b, k, (Warp){b->u[k], b->v[k], 1.0, 0.0, 0.0, 1.0}); }

INLINE void radial_of(Block *b, const double *c, int count) {
    EACH(k, b) {
        const double u = b->u[k], v = b->v[k], r2 = u * u + v * v;
        double slope, d_x = u, d_y = v;
        const double gain = 1.0 + polynomial(r2, c, count, &slope);
        keep(b, k, radially(u, v, gain, slope));
        for (int i = 0; i < count; i++) {
            d_x *= r2, d_y *= r2;
            keep_extra(b, k, i, d_x, d_y);
        }
    }
}

INLINE void radial(Block *b, const double *c, int count) {
    switch (count) { /* known counts are unrolled, and then several points are computed at once */
    case 1: radial_of(b, c, 1); break;
    case 2: radial_of(b, c, 2); break;
    case 3: radial_of(b, c, 3); break;
    default: radial_of(b, c, 4); break;
    }
}

INLINE void opencv(Block *b, const double *c) { /* k1 k2 p1 p2 */
    const double k1 = c[0], k2 = c[1], p1 = c[2], p2 = c[3], radials[] = {k1, k2};
    EACH(k, b) {
        const double u = b->u[k], v = b->v[k], r2 = u * u + v * v;
        double slope;
        const double gain = 1.0 + polynomial(r2, radials, 2, &slope);
        keep(b, k, radial_tangential(u, v, r2, gain, slope, p1, p2));
        keep_extra(b, k, 0, u * r2, v * r2);
        keep_extra(b, k, 1, u * r2 * r2, v * r2 * r2);
        tangential_extra(b, k, 2, 3, u, v, r2);
    }
}

INLINE void brown(Block *b, const double *c) { /* k1 k2 p1 p2 k3 */
    const double p1 = c[2], p2 = c[3], radials[] = {c[0], c[1], c[4]};
    EACH(k, b) {
        const double u = b->u[k], v = b->v[k], r2 = u * u + v * v, r4 = r2 * r2;
        double slope;
        const double gain = 1.0 + polynomial(r2, radials, 3, &slope);
        keep(b, k, radial_tangential(u, v, r2, gain, slope, p1, p2));
        keep_extra(b, k, 0, u * r2, v * r2);
        keep_extra(b, k, 1, u * r4, v * r4);
        tangential_extra(b, k, 2, 3, u, v, r2);
        keep_extra(b, k, 4, u * (r4 * r2), v * (r4 * r2));
    }
}

INLINE void full_opencv(Block *b, const double *c) { /* k1 k2 p1 p2 k3 k4 k5 k6 */
    const double p1 = c[2], p2 = c[3], above[] = {c[0], c[1], c[4]}, below[] = {c[5], c[6], c[7]};
    EACH(k, b) {
        const double u = b->u[k], v = b->v[k], r2 = u * u + v * v;
        double d_upper, d_lower;
        const double upper = polynomial(r2, above, 3, &d_upper), lower = polynomial(r2, below, 3, &d_lower);
        const double inverse = 1.0 / (1.0 + lower), gain = (1.0 + upper) * inverse;
        keep(b, k, radial_tangential(u, v, r2, gain, (d_upper - gain * d_lower) * inverse, p1, p2));
        const double x1 = u * inverse * r2, y1 = v * inverse * r2, x2 = x1 * r2, y2 = y1 * r2, x3 = x2 * r2,
                     y3 = y2 * r2;
        keep_extra(b, k, 0, x1, y1);
        keep_extra(b, k, 1, x2, y2);
        tangential_extra(b, k, 2, 3, u, v, r2);
        keep_extra(b, k, 4, x3, y3);
        keep_extra(b, k, 5, -gain * x1, -gain * y1);
        keep_extra(b, k, 6, -gain * x2, -gain * y2);
        keep_extra(b, k, 7, -gain * x3, -gain * y3);
    }
}

INLINE void thin_prism(Block *b, const double *c) { /* k1 k2 p1 p2 k3 k4 sx1 sy1 */
    const double p1 = c[2], p2 = c[3], sx = c[6], sy = c[7], radials[] = {c[0], c[1], c[4], c[5]};
    EACH(k, b) {
        const double u = b->u[k], v = b->v[k], r2 = u * u + v * v;
        double slope;
        const double gain = 1.0 + polynomial(r2, radials, 4, &slope);
        const Warp w = radial_tangential(u, v, r2, gain, slope, p1, p2);
        keep(b, k, (Warp){w.x + sx * r2, w.y + sy * r2, w.xu + 2.0 * sx * u, w.xv + 2.0 * sx * v,
                          w.yu + 2.0 * sy * u, w.yv + 2.0 * sy * v});
        const double x1 = u * r2, y1 = v * r2, x2 = x1 * r2, y2 = y1 * r2, x3 = x2 * r2, y3 = y2 * r2;
        keep_extra(b, k, 0, x1, y1);
        keep_extra(b, k, 1, x2, y2);
        tangential_extra(b, k, 2, 3, u, v, r2);
        keep_extra(b, k, 4, x3, y3);
        keep_extra(b, k, 5, x3 * r2, y3 * r2);
        keep_extra(b, k, 6, r2, 0.0);
        keep_extra(b, k, 7, 0.0, r2);
    }
}

INLINE void rad_tan_thin_prism(Block *b, const double *c) { /* k0 .. k5 p0 p1 s0 .. s3: p0 is OPENCV's p2 */
    const double p0 = c[6], p1 = c[7], s0 = c[8], s1 = c[9], s2 = c[10], s3 = c[11];
    EACH(k, b) {
        const double u = b->u[k], v = b->v[k], q2 = u * u + v * v;
        double slope, d_a = u, d_b = v;
        const double gain = 1.0 + polynomial(q2, c, 6, &slope);
        const Warp first = radially(u, v, gain, slope);
        const double r2 = first.x * first.x + first.y * first.y, r4 = r2 * r2;
        const Warp second = radial_tangential(first.x, first.y, r2, 1.0, 0.0, p1, p0);
        const double prism_x = 2.0 * s0 + 4.0 * s1 * r2, prism_y = 2.0 * s2 + 4.0 * s3 * r2;
        const double xa = second.xu + prism_x * first.x, xb = second.xv + prism_x * first.y;
        const double ya = second.yu + prism_y * first.x, yb = second.yv + prism_y * first.y;
        keep(b, k, (Warp){second.x + r2 * (s0 + s1 * r2), second.y + r2 * (s2 + s3 * r2),
                          xa * first.xu + xb * first.yu, xa * first.xv + xb * first.yv,
                          ya * first.xu + yb * first.yu, ya * first.xv + yb * first.yv});
        for (int i = 0; i < 6; i++) {
            d_a *= q2, d_b *= q2;
            keep_extra(b, k, i, xa * d_a + xb * d_b, ya * d_a + yb * d_b);
        }
        tangential_extra(b, k, 7, 6, first.x, first.y, r2);
        keep_extra(b, k, 8, r2, 0.0);
        keep_extra(b, k, 9, r4, 0.0);
        keep_extra(b, k, 10, 0.0, r2);
        keep_extra(b, k, 11, 0.0, r4);
    }
}

INLINE void fov(Block *b, const double *c) { /* omega */
    const double omega = c[0];
    if (omega * omega < FOV_SMALL) {
        EACH(k, b) {
            const double u = b->u[k], v = b->v[k], shape = (u * u + v * v) / 3.0 - 1.0 / 12.0;
            keep(b, k, radially(u, v, 1.0 + omega * omega * shape, omega * omega / 3.0));
            keep_extra(b, k, 0, u * (2.0 * omega * shape), v * (2.0 * omega * shape));
        }
        return;
    }
    const double tangent = tan(omega / 2.0), d_tangent = (1.0 + tangent * tangent) / 2.0;
    const double bent = -8.0 * tangent * tangent * tangent / (3.0 * omega);
    const double d_bent = -8.0 * tangent * tangent * d_tangent / omega - bent / omega;
    EACH(k, b) {
        const double u = b->u[k], v = b->v[k], r2 = u * u + v * v, safe = r2 > FOV_SMALL ? r2 : FOV_SMALL;
        const int is_near = r2 < FOV_SMALL;
        const double radius = sqrt(safe), inverse = 1.0 / (omega * (1.0 + 4.0 * tangent * tangent * safe));
        const double far_gain = copysign(arctan(fabs(2.0 * tangent * radius)), tangent) / (radius * omega);
        const double gain = is_near ? 2.0 * tangent / omega + bent * r2 : far_gain;
        const double slope = is_near ? bent : (2.0 * tangent * inverse - far_gain) / (2.0 * safe);
        const double d_omega = is_near ? 2.0 * (d_tangent - tangent / omega) / omega + d_bent * r2
                                       : 2.0 * d_tangent * inverse - far_gain / omega;
        keep(b, k, radially(u, v, gain, slope));
        keep_extra(b, k, 0, u * d_omega, v * d_omega);
    }
}

INLINE void distort(Block *b, int lens, const double *c, int num_extra) {
    switch (lens) {
    case IDENTITY: identity(b); break;
    case RADIAL: radial(b, c, num_extra); break;
    case OPENCV: opencv(b, c); break;
    case FULL_OPENCV: full_opencv(b, c); break;
    case BROWN: brown(b, c); break;
    case FOV: fov(b, c); break;
    case THIN_PRISM: thin_prism(b, c); break;
    default: rad_tan_thin_prism(b, c); break;
    }
}

/* ---- derivatives in the point: audit/cameras/perspective.py, fisheye.py, rational.py ---- */

INLINE void bend_perspective(Block *b) {
    EACH(k, b) {
        const double inverse = b->inverse[k], u = b->u[k], v = b->v[k];
        b->jac[0][0][k] = b->xu[k] * inverse;
        b->jac[0][1][k] = b->xv[k] * inverse;
        b->jac[0][2][k] = (b->xu[k] * u + b->xv[k] * v) * -inverse;
        b->jac[1][0][k] = b->yu[k] * inverse;
        b->jac[1][1][k] = b->yv[k] * inverse;
        b->jac[1][2][k] = (b->yu[k] * u + b->yv[k] * v) * -inverse;
    }
}

INLINE void bend_equidistant(Block *b) {
    EACH(k, b) {
        const double t = b->tan2[k], px = b->px[k], py = b->py[k];
        const double series = -2.0 / 3.0 + t * (4.0 / 5.0 + t * (-6.0 / 7.0 + t * (8.0 / 9.0 - t * (10.0 / 11.0))));
        const double at = t > NEAR_AXIS ? t : NEAR_AXIS;
        const double curvature = t < NEAR_AXIS ? series : (1.0 / (1.0 + t) - b->gain[k]) / at;
        const double bend = curvature * b->inverse[k], gain = b->gain[k] * b->inverse[k];
        const double fall = -b->inverse[k] / (1.0 + t);
        const double wx = b->xu[k] * px + b->xv[k] * py, wy = b->yu[k] * px + b->yv[k] * py;
        b->jac[0][0][k] = b->xu[k] * gain + px * (bend * wx);
        b->jac[0][1][k] = b->xv[k] * gain + py * (bend * wx);
        b->jac[0][2][k] = wx * fall;
        b->jac[1][0][k] = b->yu[k] * gain + px * (bend * wy);
        b->jac[1][1][k] = b->yv[k] * gain + py * (bend * wy);
        b->jac[1][2][k] = wy * fall;
    }
}

/* (x, y) inverse, with the derivatives of m = 1 / inverse */
INLINE void over_depth(Block *b, int k, double inverse, double m_x, double m_y, double m_z) {
    const double px = b->x[k] * inverse, py = b->y[k] * inverse, gx = -px * inverse, gy = -py * inverse;
    b->wx[k] = px, b->wy[k] = py;
    b->u[k] = gx, b->v[k] = gy; /* for the derivatives in the parameters */
    b->jac[0][0][k] = inverse + gx * m_x, b->jac[0][1][k] = gx * m_y, b->jac[0][2][k] = gx * m_z;
    b->jac[1][0][k] = gy * m_x, b->jac[1][1][k] = inverse + gy * m_y, b->jac[1][2][k] = gy * m_z;
}

INLINE void division(Block *b, const double *c) { /* k */
    EACH(k, b) {
        const double x = b->x[k], y = b->y[k], z = b->z[k], rho2 = x * x + y * y;
        const double root = sqrt(z * z - 4.0 * c[0] * rho2), over_root = 1.0 / root, side = -2.0 * c[0] * over_root;
        over_depth(b, k, 2.0 / (z + root), side * x, side * y, 0.5 + 0.5 * z * over_root);
        keep_extra(b, k, 0, b->u[k] * (-rho2 * over_root), b->v[k] * (-rho2 * over_root));
    }
}

INLINE void eucm(Block *b, const double *c) { /* alpha beta */
    const double alpha = c[0], beta = c[1];
    EACH(k, b) {
        const double x = b->x[k], y = b->y[k], z = b->z[k] >= EPSILON ? b->z[k] : NAN, rho2 = x * x + y * y;
        const double root = sqrt(beta * rho2 + z * z), depth = alpha * root + (1.0 - alpha) * z;
        const double over_root = 1.0 / root, side = alpha * beta * over_root;
        const double inverse = depth >= EPSILON ? 1.0 / depth : NAN;
        over_depth(b, k, inverse, side * x, side * y, (1.0 - alpha) + alpha * z * over_root);
        const double d_beta = 0.5 * alpha * rho2 * over_root;
        keep_extra(b, k, 0, b->u[k] * (root - z), b->v[k] * (root - z));
        keep_extra(b, k, 1, b->u[k] * d_beta, b->v[k] * d_beta);
    }
}

/* ---- an image ---- */

typedef struct {
    const int64_t *offsets, *camera_idx, *lenses;
    const int32_t *point_idx;
    const double *xy_px, *xyz_world, *quaternions, *translations, *params;
} Scene;

typedef struct {
    int64_t capacity;
    double *residuals, *jacobian, *pose_sums;
    int32_t *rows;
    int64_t *counts;
} Found;

/* Sums over an image. lanes: of products of pose columns (upper triangle), then of columns and residuals. */
typedef struct {
    double lanes[NUM_SUMS][LANES];
    int64_t residual, derivative, distance; /* largest, as bits */
} Sums;

/* Points into the camera frame, in Eigen's order of operations (loaders.model.moved); rows from `first` on. */
INLINE void place(Block *b, const Scene *s, int64_t image, int64_t first, int n) {
    const double *q = s->quaternions + 4 * image, *t = s->translations + 3 * image;
    const double w = q[0], qx = q[1], qy = q[2], qz = q[3];
    const int64_t last = s->offsets[image + 1];
    Column x, y, z;
    b->n = n;
    for (int64_t k = first + BLOCK; k < first + 2 * BLOCK && k < last; k++)
        SOON(s->xyz_world + 3 * (int64_t)(s->point_idx[k] < 0 ? 0 : s->point_idx[k]));
    EACH(k, b) {
        const int64_t point = s->point_idx[first + k];
        const double *xyz = s->xyz_world + 3 * (point < 0 ? 0 : point);
        x[k] = point < 0 ? NAN : xyz[0];
        y[k] = point < 0 ? NAN : xyz[1];
        z[k] = point < 0 ? NAN : xyz[2];
        b->row[k] = first + k;
    }
    EACH(k, b) {
        double ux = qy * z[k] - qz * y[k], uy = qz * x[k] - qx * z[k], uz = qx * y[k] - qy * x[k];
        ux += ux, uy += uy, uz += uz;
        b->x[k] = x[k] + w * ux + (qy * uz - qz * uy) + t[0];
        b->y[k] = y[k] + w * uy + (qz * ux - qx * uz) + t[1];
        b->z[k] = z[k] + w * uz + (qx * uy - qy * ux) + t[2];
    }
}

INLINE void gather(Block *b, const Scene *s, int64_t image, int64_t first, int n) {
    place(b, s, image, first, n);
    EACH(k, b) {
        b->seen_x[k] = s->xy_px[2 * (first + k)];
        b->seen_y[k] = s->xy_px[2 * (first + k) + 1];
    }
}

/* Keep the points in front of the camera whose numbers can be calculated with (method.md section 1); count others. */
INLINE void keep_candidates(Block *b, const Scene *s, int64_t *counts) {
    int64_t most = 0, num_odd = 0;
    EACH(k, b) {
        most = larger(most, larger(larger(magnitude(b->x[k]), magnitude(b->y[k])), magnitude(b->z[k])));
        most = larger(most, larger(magnitude(b->seen_x[k]), magnitude(b->seen_y[k])));
        num_odd += !(b->z[k] > 0.0);
    }
    if (num_odd == 0 && number(most) <= MAX_MAGNITUDE)
        return;
    int kept = 0;
    EACH(k, b) {
        const int is_sane = fabs(b->x[k]) <= MAX_MAGNITUDE && fabs(b->y[k]) <= MAX_MAGNITUDE &&
                            fabs(b->z[k]) <= MAX_MAGNITUDE && fabs(b->seen_x[k]) <= MAX_MAGNITUDE &&
                            fabs(b->seen_y[k]) <= MAX_MAGNITUDE;
        const int is_dangling = s->point_idx[b->row[k]] < 0;
        counts[DANGLING] += is_dangling;
        counts[BEHIND] += !is_dangling && is_sane && !(b->z[k] > 0.0);
        if (is_dangling || !is_sane || !(b->z[k] > 0.0))
            continue;
        b->x[kept] = b->x[k], b->y[kept] = b->y[k], b->z[kept] = b->z[k];
        b->seen_x[kept] = b->seen_x[k], b->seen_y[kept] = b->seen_y[k], b->row[kept] = b->row[k];
        kept++;
    }
    b->n = kept;
}

/* Through the lens, with derivatives in its parameters and, where wanted, in the point. */
INLINE void bend(Block *b, const int64_t *lens, const double *extra, const int with_point) {
    if (lens[LENS] == DIVISION) {
        division(b, extra);
    } else if (lens[LENS] == EUCM) {
        eucm(b, extra);
    } else if (lens[IS_FISHEYE]) {
        equidistant(b);
        distort(b, (int)lens[LENS], extra, (int)lens[NUM_EXTRA]);
        if (with_point)
            bend_equidistant(b);
    } else {
        perspective(b);
        distort(b, (int)lens[LENS], extra, (int)lens[NUM_EXTRA]);
        if (with_point)
            bend_perspective(b);
    }
}

INLINE void project(Block *b, const int64_t *lens, const double *params) {
    const double fx = params[0], fy = params[1], cx = params[2], cy = params[3];
    bend(b, lens, params + 4, 1);
    EACH(k, b) {
        b->residual[0][k] = b->seen_x[k] - (b->wx[k] * fx + cx);
        b->residual[1][k] = b->seen_y[k] - (b->wy[k] * fy + cy);
    }
    for (int axis = 0; axis < 3; axis++)
        EACH(k, b) {
            b->jac[0][axis][k] *= fx;
            b->jac[1][axis][k] *= fy;
        }
}

/* Products of the six columns of the pose (audit/inliers/stationarity.py) and of the residuals. */
INLINE void add_pose(Block *b, Sums *sums) {
    const int padded = (b->n + LANES - 1) / LANES * LANES;
    for (int axis = 0; axis < 2; axis++) {
        Column *p = b->pose[axis], *j = b->jac[axis];
        EACH(k, b) {
            p[0][k] = j[2][k] * b->y[k] - j[1][k] * b->z[k];
            p[1][k] = j[0][k] * b->z[k] - j[2][k] * b->x[k];
            p[2][k] = j[1][k] * b->x[k] - j[0][k] * b->y[k];
            p[3][k] = j[0][k];
            p[4][k] = j[1][k];
            p[5][k] = j[2][k];
        }
        for (int k = b->n; k < padded; k++) {
            for (int i = 0; i < NUM_POSE; i++)
                p[i][k] = 0.0;
            b->residual[axis][k] = 0.0;
        }
        double(*out)[LANES] = sums->lanes;
        for (int i = 0; i < NUM_POSE; i++, out++) {
            double own[NUM_POSE + 1][LANES] = {{0.0}};
            for (int k = 0; k < padded; k += LANES)
                for (int l = 0; l < LANES; l++) {
                    for (int m = i; m < NUM_POSE; m++)
                        own[m][l] += p[i][k + l] * p[m][k + l];
                    own[NUM_POSE][l] += p[i][k + l] * b->residual[axis][k + l];
                }
            for (int m = i; m < NUM_POSE; m++, out++)
                for (int l = 0; l < LANES; l++)
                    (*out)[l] += own[m][l];
            for (int l = 0; l < LANES; l++)
                (*out)[l] += own[NUM_POSE][l];
        }
    }
}

INLINE void add_largest(const Block *b, Sums *sums) {
    int64_t residual = sums->residual, derivative = sums->derivative, distance = sums->distance;
    EACH(k, b) {
        residual = larger(residual, larger(magnitude(b->residual[0][k]), magnitude(b->residual[1][k])));
        distance = larger(distance, larger(larger(magnitude(b->x[k]), magnitude(b->y[k])), magnitude(b->z[k])));
        double size = 0.0;
        for (int axis = 0; axis < 3; axis++)
            size += fabs(b->jac[0][axis][k]) + fabs(b->jac[1][axis][k]);
        derivative = larger(derivative, magnitude(size));
    }
    sums->residual = residual, sums->derivative = derivative, sums->distance = distance;
}

/* Residuals and derivatives in the point in the world frame (J R), behind what is there. */
INLINE void store(const Block *b, const Found *f, const double *rotation, int64_t at) {
    EACH(k, b) f->rows[at + k] = (int32_t)b->row[k];
    for (int axis = 0; axis < 2; axis++) {
        memcpy(f->residuals + axis * f->capacity + at, b->residual[axis], sizeof(double) * (size_t)b->n);
        const Column *j = b->jac[axis];
        for (int world = 0; world < 3; world++) {
            const double r0 = rotation[world], r1 = rotation[3 + world], r2 = rotation[6 + world];
            double *out = f->jacobian + (3 * axis + world) * f->capacity + at;
            EACH(k, b) out[k] = r0 * j[0][k] + r1 * j[1][k] + r2 * j[2][k];
        }
    }
}

INLINE void store_extra(const Block *b, double *extra, int64_t stride, int64_t num_extra, const double *focal) {
    for (int64_t i = 0; i < num_extra; i++)
        for (int axis = 0; axis < 2; axis++) {
            double *out = extra + (2 * i + axis) * stride;
            EACH(k, b) out[k] = b->extra[i][axis][k] * focal[axis];
        }
}

static void rotation_of(const double *q, double *r) {
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    r[0] = 1 - 2 * (y * y + z * z), r[1] = 2 * (x * y - w * z), r[2] = 2 * (x * z + w * y);
    r[3] = 2 * (x * y + w * z), r[4] = 1 - 2 * (x * x + z * z), r[5] = 2 * (y * z - w * x);
    r[6] = 2 * (x * z - w * y), r[7] = 2 * (y * z + w * x), r[8] = 1 - 2 * (x * x + y * y);
}

static int project_image(const Scene *s, const Found *f, int64_t image, Block *b) {
    const int64_t first = s->offsets[image], last = s->offsets[image + 1], camera = s->camera_idx[image];
    int64_t *counts = f->counts + NUM_COUNTS * image;
    memset(counts, 0, sizeof(int64_t) * NUM_COUNTS);
    if (camera < 0 || s->lenses[NUM_LENS * camera] < 0)
        return NEEDS_NUMPY;
    const int64_t *lens = s->lenses + NUM_LENS * camera;
    const double *params = s->params + NUM_PARAMS * camera;
    double rotation[9];
    Sums sums = {{{0.0}}, 0, 0, 0};
    rotation_of(s->quaternions + 4 * image, rotation);
    int64_t num = 0;
    for (int64_t row = first; row < last; row += BLOCK) {
        gather(b, s, image, row, (int)(last - row < BLOCK ? last - row : BLOCK));
        keep_candidates(b, s, counts);
        project(b, lens, params);
        add_pose(b, &sums);
        add_largest(b, &sums);
        store(b, f, rotation, first + num);
        num += b->n;
    }
    if (!(number(sums.residual) <= MAX_RESIDUAL_PX) || !(number(sums.derivative) <= MAX_DERIVATIVE) ||
        !(number(sums.derivative) * number(sums.distance) <= MAX_MAGNITUDE))
        return NEEDS_NUMPY;
    for (int i = 0; i < NUM_SUMS; i++)
        f->pose_sums[NUM_SUMS * image + i] =
            (sums.lanes[i][0] + sums.lanes[i][1]) + (sums.lanes[i][2] + sums.lanes[i][3]);
    counts[INLIERS] = num;
    return DONE;
}

/* Project images first .. last - 1 of a model.
 *
 * offsets (I + 1), point_idx (M), xy_px (M, 2): the observations by image. xyz_world (P, 3). quaternions (I, 4),
 * translations (I, 3), camera_idx (I). lenses (C, 3): lens (-1: not here), is_fisheye, num_extra. params (C, 16): fx fy
 * cx cy, then the distortion. Out, the inliers of an image from its first observation on: rows (M), residuals (2, M),
 * jacobian (2, 3, M) in the world frame; counts (I, 3): inliers, dangling, behind; pose_sums (I, 27): for each of six
 * pose columns its products with it and those behind it, then with the residuals; status (I). Returns how many images are left to numpy. */
KERNEL int64_t sfm_project(int64_t first, int64_t last, const int64_t *offsets, const int32_t *point_idx,
                           const double *xy_px, const double *xyz_world, const double *quaternions,
                           const double *translations, const int64_t *camera_idx, const int64_t *lenses,
                           const double *params, int64_t capacity, int32_t *rows, double *residuals, double *jacobian,
                           int64_t *counts, double *pose_sums, int64_t *status) {
    const Scene scene = {offsets, camera_idx, lenses, point_idx, xy_px, xyz_world, quaternions, translations, params};
    const Found found = {capacity, residuals, jacobian, pose_sums, rows, counts};
    int64_t num_left = 0;
    Block *block = calloc(1, sizeof *block);
    for (int64_t image = first; image < last; image++) {
        status[image] = block == NULL ? NO_MEMORY : project_image(&scene, &found, image, block);
        num_left += status[image] != DONE;
    }
    free(block);
    return num_left;
}

static void distortion_of(const Scene *s, int64_t image, Block *b, double *extra) {
    const int64_t first = s->offsets[image], last = s->offsets[image + 1];
    const int64_t *lens = s->lenses + NUM_LENS * s->camera_idx[image];
    const double *params = s->params + NUM_PARAMS * s->camera_idx[image];
    for (int64_t row = first; row < last; row += BLOCK) {
        place(b, s, image, row, (int)(last - row < BLOCK ? last - row : BLOCK));
        bend(b, lens, params + 4, 0);
        store_extra(b, extra + (row - first), last - first, lens[NUM_EXTRA], params);
    }
}

/* Derivatives in the distortion of the inliers of some images (num,), all of which have a lens of this file: (e, 2, n)
 * of each from extra_offsets (num,) on. Inputs as of sfm_project, but offsets and point_idx are those of the inliers. */
KERNEL int64_t sfm_distortion(int64_t num, const int64_t *images, const int64_t *offsets, const int32_t *point_idx,
                              const double *xyz_world, const double *quaternions, const double *translations,
                              const int64_t *camera_idx, const int64_t *lenses, const double *params,
                              const int64_t *extra_offsets, double *extra) {
    const Scene scene = {offsets, camera_idx, lenses, point_idx, NULL, xyz_world, quaternions, translations, params};
    Block *block = calloc(1, sizeof *block);
    for (int64_t i = 0; block != NULL && i < num; i++)
        distortion_of(&scene, images[i], block, extra + extra_offsets[i]);
    free(block);
    return block == NULL ? NO_MEMORY : DONE;
}
