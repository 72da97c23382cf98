// Camera models: image position of a point in the camera's frame, the Jacobian of the local affine approximation, and
// the vector-Jacobian product of both.
//
//   PINHOLE       u = fx x/z + cx; only in the Jacobian, x/z and y/z are clamped to the enlarged image
//   ORTHOGRAPHIC  u = fx x + cx, with fx in px per world unit
//   FISHEYE       u = fx s x + cx, s = theta_d/rho, rho^2 = x^2 + y^2, theta = atan2(rho, z),
//                 theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)   (Kannala and Brandt 2006,
//                 equation 6, with the odd powers that OpenCV and COLMAP keep)
//   EQUIRECTANGULAR  u = fx atan2(x, z) + cx, v = fy atan2(y, |(x, z)|) + cy; only without the Jacobian, for gaussian_rays.h
// v accordingly. The depth is z, except for FISHEYE and EQUIRECTANGULAR, which see beyond 90 degrees: there it is the
// distance |p|. docs/stages/project.md derives the second derivatives of FISHEYE; clsplat/reference/lens.py is the
// twin.
//
// The file that includes this documents -DLENS=PINHOLE|ORTHOGRAPHIC|FISHEYE|EQUIRECTANGULAR. The last two take one lane
// (lanes.h).
#ifndef CLSPLAT_LENS_H
#define CLSPLAT_LENS_H

#include "linalg.h"
#include "structs.h"

#define PINHOLE         1
#define ORTHOGRAPHIC    2
#define FISHEYE         3
#define EQUIRECTANGULAR 4
#if !defined(LENS) || LENS < PINHOLE || LENS > EQUIRECTANGULAR
#error "-DLENS must be PINHOLE, ORTHOGRAPHIC, FISHEYE or EQUIRECTANGULAR"
#endif
#if LENS >= FISHEYE && LANES != 1
#error "-DLENS=FISHEYE and EQUIRECTANGULAR need -DLANES=1"
#endif

static inline reals3 camera_rotate(const Camera *camera, reals3 v) {
    const real *r = camera->rotation;
    return vector3(r[0] * v.x + r[1] * v.y + r[2] * v.z, r[3] * v.x + r[4] * v.y + r[5] * v.z,
                   r[6] * v.x + r[7] * v.y + r[8] * v.z);
}

// By the inverse of the rotation.
static inline reals3 camera_rotate_back(const Camera *camera, reals3 v) {
    const real *r = camera->rotation;
    return vector3(r[0] * v.x + r[3] * v.y + r[6] * v.z, r[1] * v.x + r[4] * v.y + r[7] * v.z,
                   r[2] * v.x + r[5] * v.y + r[8] * v.z);
}

// A point of the world in the camera's frame.
static inline reals3 camera_point(const Camera *camera, reals3 mean) {
    const reals3 p = camera_rotate(camera, mean);
    return vector3(p.x + camera->translation[0], p.y + camera->translation[1], p.z + camera->translation[2]);
}

typedef struct {
    reals2 slopes; // PINHOLE: clamped x/z, y/z
    reals3 j0, j1; // rows of the Jacobian, px per world unit
    reals depth;   // world units
    reals3 onward; // gradient of the depth
} Lens;

#if LENS == PINHOLE

// Slope x/z or y/z at which the Jacobian is evaluated: clamped to the image enlarged by FRUSTUM_MARGIN.
static inline reals clamped_slope(reals slope, real focal, real centre, real size) {
    const real margin = (real)(0.5 * FRUSTUM_MARGIN) * size / focal;
    const reals lo = -centre / focal - margin, hi = (size - centre) / focal + margin;
    return CLAMP(slope, lo, hi);
}

static inline reals2 lens_centre(const Camera *camera, reals3 p) {
    const reals2 centre = {camera->fx * p.x / p.z + camera->cx, camera->fy * p.y / p.z + camera->cy};
    return centre;
}

static inline masks lens_sees(const Camera *camera, reals3 p) {
    return p.z > camera->near;
}

static inline Lens lens(const Camera *camera, reals3 p) {
    Lens l;
    const reals inv_z = 1 / p.z;
    l.slopes.x = clamped_slope(p.x * inv_z, camera->fx, camera->cx, camera->width);
    l.slopes.y = clamped_slope(p.y * inv_z, camera->fy, camera->cy, camera->height);
    l.j0 = vector3(camera->fx * inv_z, 0, -camera->fx * l.slopes.x * inv_z);
    l.j1 = vector3(0, camera->fy * inv_z, -camera->fy * l.slopes.y * inv_z);
    l.depth = p.z;
    l.onward = vector3(0, 0, 1);
    return l;
}

// Gradient with respect to p. v_intrinsics receives the gradients with respect to fx, fy, cx, cy. The derivative of a
// clamped slope is 0. fx times the limit is affine in cx and does not depend on fx.
static inline reals3 lens_vjp(const Camera *camera, reals3 p, const Lens *l, reals2 v_centre, reals3 v_j0,
                              reals3 v_j1, reals v_depth, reals4 *v_intrinsics) {
    const reals inv_z = 1 / p.z, zero = 0;
    const real fx = camera->fx, fy = camera->fy;
    const reals slope_x = p.x * inv_z, slope_y = p.y * inv_z;
    // The gradients of the slopes in the Jacobian.
    const reals free_x = slope_x == l->slopes.x ? v_j0.z : zero, free_y = slope_y == l->slopes.y ? v_j1.z : zero;
    const reals v_x = v_centre.x * fx - fx * inv_z * free_x, v_y = v_centre.y * fy - fy * inv_z * free_y;
    *v_intrinsics = vector4(v_centre.x * slope_x + (v_j0.x - slope_x * free_x) * inv_z,
                            v_centre.y * slope_y + (v_j1.y - slope_y * free_y) * inv_z,
                            v_centre.x + (v_j0.z - free_x) * inv_z, v_centre.y + (v_j1.z - free_y) * inv_z);
    return vector3(v_x * inv_z, v_y * inv_z,
                   v_depth - (v_x * slope_x + v_y * slope_y) * inv_z -
                       inv_z * inv_z * (fx * (v_j0.x - l->slopes.x * v_j0.z) + fy * (v_j1.y - l->slopes.y * v_j1.z)));
}

#elif LENS == ORTHOGRAPHIC

static inline reals2 lens_centre(const Camera *camera, reals3 p) {
    const reals2 centre = {camera->fx * p.x + camera->cx, camera->fy * p.y + camera->cy};
    return centre;
}

static inline masks lens_sees(const Camera *camera, reals3 p) {
    return p.z > camera->near;
}

static inline Lens lens(const Camera *camera, reals3 p) {
    const Lens l = {{0, 0}, vector3(camera->fx, 0, 0), vector3(0, camera->fy, 0), p.z, vector3(0, 0, 1)};
    return l;
}

static inline reals3 lens_vjp(const Camera *camera, reals3 p, const Lens *l, reals2 v_centre, reals3 v_j0,
                              reals3 v_j1, reals v_depth, reals4 *v_intrinsics) {
    *v_intrinsics = vector4(v_centre.x * p.x + v_j0.x, v_centre.y * p.y + v_j1.y, v_centre.x, v_centre.y);
    return vector3(camera->fx * v_centre.x, camera->fy * v_centre.y, v_depth);
}

#elif LENS == EQUIRECTANGULAR

static inline reals2 lens_centre(const Camera *camera, reals3 p) {
    const reals2 centre = {camera->fx * atan2(p.x, p.z) + camera->cx,
                           camera->fy * atan2(p.y, sqrt(p.x * p.x + p.z * p.z)) + camera->cy};
    return centre;
}

static inline masks lens_sees(const Camera *camera, reals3 p) {
    return dot3(p, p) > camera->near * camera->near;
}

#else

// s and its derivatives, which are even in rho: ds = q (x dx + y dy) + h dz; likewise for q (by w and m) and h (by
// m, n).
typedef struct {
    real s, q, h, w, m, n;
} Radial;

static inline Radial radial(const Camera *camera, reals3 p) {
    Radial f;
    const real k1 = camera->k1, k2 = camera->k2, k3 = camera->k3, k4 = camera->k4;
    const real rho2 = p.x * p.x + p.y * p.y, z = p.z, inv_z = 1 / z, t = rho2 * inv_z * inv_z;
    // Near the axis the quotients below cancel, and 0/0 on it: four terms of s z as a power series in (rho/z)^2. At the
    // switch they are as accurate as the quotients in single precision, and far more accurate in double precision.
    if (z > 0 && t < (real)1e-4) {
        const real a1 = k1 - (real)(1.0 / 3), a2 = k2 - k1 + (real)0.2;
        const real a3 = k3 - (real)(5.0 / 3) * k2 + (real)(14.0 / 15) * k1 - (real)(1.0 / 7);
        const real s0 = 1 + t * (a1 + t * (a2 + t * a3)), s1 = a1 + t * (2 * a2 + 3 * t * a3),
                   s2 = 2 * a2 + 6 * t * a3;
        const real inv_z2 = inv_z * inv_z, inv_z3 = inv_z2 * inv_z;
        f.s = s0 * inv_z;
        f.q = 2 * s1 * inv_z3;
        f.h = -(s0 + 2 * t * s1) * inv_z2;
        f.w = 4 * s2 * inv_z3 * inv_z2;
        f.m = -(6 * s1 + 4 * t * s2) * inv_z2 * inv_z2;
        f.n = (2 * s0 + t * (10 * s1 + 4 * t * s2)) * inv_z3;
        return f;
    }
    const real rho = sqrt(rho2), theta = atan2(rho, z), u = theta * theta, inv_r2 = 1 / (rho2 + z * z);
    const real inv_rho2 = 1 / rho2;
    // theta_d and its derivatives by theta
    const real d0 = theta * (1 + u * (k1 + u * (k2 + u * (k3 + u * k4))));
    const real d1 = 1 + u * (3 * k1 + u * (5 * k2 + u * (7 * k3 + u * 9 * k4)));
    const real d2 = theta * (6 * k1 + u * (20 * k2 + u * (42 * k3 + u * 72 * k4)));
    f.s = d0 / rho;
    f.q = (d1 * z * inv_r2 - f.s) * inv_rho2;
    f.h = -d1 * inv_r2;
    f.m = (2 * d1 - d2 * z / rho) * inv_r2 * inv_r2;
    f.w = -(z * f.m + 3 * f.q) * inv_rho2;
    f.n = (d2 * rho + 2 * d1 * z) * inv_r2 * inv_r2;
    return f;
}

static inline reals2 lens_centre(const Camera *camera, reals3 p) {
    const real s = radial(camera, p).s;
    const reals2 centre = {camera->fx * p.x * s + camera->cx, camera->fy * p.y * s + camera->cy};
    return centre;
}

static inline masks lens_sees(const Camera *camera, reals3 p) {
    const real r = sqrt(dot3(p, p));
    return r > camera->near && p.z > r * camera->cos_max;
}

static inline Lens lens(const Camera *camera, reals3 p) {
    Lens l;
    const Radial f = radial(camera, p);
    const real xyq = p.x * p.y * f.q;
    l.slopes.x = l.slopes.y = 0;
    l.j0 = scaled3(camera->fx, vector3(f.s + p.x * p.x * f.q, xyq, p.x * f.h));
    l.j1 = scaled3(camera->fy, vector3(xyq, f.s + p.y * p.y * f.q, p.y * f.h));
    l.depth = sqrt(dot3(p, p));
    l.onward = vector3(p.x / l.depth, p.y / l.depth, p.z / l.depth);
    return l;
}

static inline reals3 lens_vjp(const Camera *camera, reals3 p, const Lens *l, reals2 v_centre, reals3 v_j0,
                              reals3 v_j1, reals v_depth, reals4 *v_intrinsics) {
    const Radial f = radial(camera, p);
    const real v_x = camera->fx * v_centre.x, v_y = camera->fy * v_centre.y;
    const reals3 a = scaled3(camera->fx, v_j0), b = scaled3(camera->fy, v_j1);
    const real ab = a.y + b.x;
    const real v_s = v_x * p.x + v_y * p.y + a.x + b.y;
    const real v_q = a.x * p.x * p.x + ab * p.x * p.y + b.y * p.y * p.y, v_h = a.z * p.x + b.z * p.y;
    const real across = v_s * f.q + v_q * f.w + v_h * f.m;
    *v_intrinsics = vector4(v_centre.x * p.x * f.s + dot3(v_j0, l->j0) / camera->fx,
                            v_centre.y * p.y * f.s + dot3(v_j1, l->j1) / camera->fy, v_centre.x, v_centre.y);
    return vector3(v_x * f.s + (2 * a.x * p.x + ab * p.y) * f.q + a.z * f.h + across * p.x + v_depth * l->onward.x,
                   v_y * f.s + (2 * b.y * p.y + ab * p.x) * f.q + b.z * f.h + across * p.y + v_depth * l->onward.y,
                   v_s * f.h + v_q * f.m + v_h * f.n + v_depth * l->onward.z);
}

#endif

// Size at p, in world units, of one unit in an image with a focal length of one unit; for FISHEYE, on the axis.
static inline reals lens_reach(const Camera *camera, reals3 p) {
#if LENS == ORTHOGRAPHIC
    return 1;
#elif LENS == EQUIRECTANGULAR
    return sqrt(dot3(p, p));
#else
    return lens(camera, p).depth;
#endif
}

// Direction from which a Gaussian is seen, not normalised: from the camera's centre, or for ORTHOGRAPHIC along the
// axis.
static inline reals3 lens_offset(const Camera *camera, reals3 mean) {
#if LENS == ORTHOGRAPHIC
    return vector3(camera->rotation[6], camera->rotation[7], camera->rotation[8]);
#else
    return vector3(mean.x - camera->position[0], mean.y - camera->position[1], mean.z - camera->position[2]);
#endif
}

#endif
