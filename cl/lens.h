// Camera models: image position of a point in the camera's frame, the Jacobian of the local affine approximation, and
// the vector-Jacobian product of both.
//
//   PINHOLE       u = fx x/z + cx; only in the Jacobian, x/z and y/z are clamped to the enlarged image
//   ORTHOGRAPHIC  u = fx x + cx, with fx in px per world unit
//   FISHEYE       u = fx s x + cx, s = theta_d/rho, rho^2 = x^2 + y^2, theta = atan2(rho, z),
//                 theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)   (Kannala and Brandt 2006,
//                 equation 6, with the odd powers that OpenCV and COLMAP keep)
// v accordingly. The depth is z, except for FISHEYE, which sees beyond 90 degrees: there it is the distance |p|.
// docs/stages/project.md derives the second derivatives of FISHEYE; clsplat/reference/lens.py is the twin.
//
// The file that includes this documents -DLENS=PINHOLE|ORTHOGRAPHIC|FISHEYE.
#ifndef CLSPLAT_LENS_H
#define CLSPLAT_LENS_H

#define PINHOLE      1
#define ORTHOGRAPHIC 2
#define FISHEYE      3
#if !defined(LENS) || LENS < PINHOLE || LENS > FISHEYE
#error "-DLENS must be PINHOLE, ORTHOGRAPHIC or FISHEYE"
#endif

static inline mat3 camera_rotation(const Camera *camera) {
    const real *r = camera->rotation;
    mat3 m = {(real3)(r[0], r[1], r[2]), (real3)(r[3], r[4], r[5]), (real3)(r[6], r[7], r[8])};
    return m;
}

typedef struct {
    real2 slopes; // PINHOLE: clamped x/z, y/z
    real3 j0, j1; // rows of the Jacobian, px per world unit
    real depth;   // world units
    real3 onward; // gradient of the depth
} Lens;

#if LENS == PINHOLE

// Slopes x/z and y/z at which the Jacobian is evaluated: clamped to the image enlarged by FRUSTUM_MARGIN.
static inline real2 clamped_slopes(const Camera *camera, real2 slopes) {
    const real2 focal = (real2)(camera->fx, camera->fy), centre = (real2)(camera->cx, camera->cy);
    const real2 size = (real2)(camera->width, camera->height);
    const real2 margin = (real)(0.5 * FRUSTUM_MARGIN) * size / focal;
    const real2 lo = -centre / focal - margin, hi = (size - centre) / focal + margin;
    return CLAMP(slopes, lo, hi);
}

static inline real2 lens_centre(const Camera *camera, real3 p) {
    return (real2)(camera->fx * p.x / p.z + camera->cx, camera->fy * p.y / p.z + camera->cy);
}

static inline bool lens_sees(const Camera *camera, real3 p) {
    return p.z > camera->near;
}

static inline Lens lens(const Camera *camera, real3 p) {
    Lens l;
    const real inv_z = 1 / p.z;
    l.slopes = clamped_slopes(camera, p.xy * inv_z);
    l.j0 = (real3)(camera->fx * inv_z, 0, -camera->fx * l.slopes.x * inv_z);
    l.j1 = (real3)(0, camera->fy * inv_z, -camera->fy * l.slopes.y * inv_z);
    l.depth = p.z;
    l.onward = (real3)(0, 0, 1);
    return l;
}

// Gradient with respect to p. v_intrinsics receives the gradients with respect to fx, fy, cx, cy. The derivative of a
// clamped slope is 0. fx times the limit is affine in cx and does not depend on fx.
static inline real3 lens_vjp(const Camera *camera, real3 p, const Lens *l, real2 v_centre, real3 v_j0, real3 v_j1,
                             real v_depth, real4 *v_intrinsics) {
    const real inv_z = 1 / p.z;
    const real2 focal = (real2)(camera->fx, camera->fy), slopes = p.xy * inv_z;
    const bool free_x = slopes.x == l->slopes.x, free_y = slopes.y == l->slopes.y;
    real2 v_slopes = v_centre * focal;
    if (free_x)
        v_slopes.x -= focal.x * inv_z * v_j0.z;
    if (free_y)
        v_slopes.y -= focal.y * inv_z * v_j1.z;
    real3 v_p;
    v_p.xy = v_slopes * inv_z;
    v_p.z = v_depth - (v_slopes.x * slopes.x + v_slopes.y * slopes.y) * inv_z -
            inv_z * inv_z * (focal.x * (v_j0.x - l->slopes.x * v_j0.z) + focal.y * (v_j1.y - l->slopes.y * v_j1.z));

    *v_intrinsics = (real4)(v_centre.x * slopes.x + (v_j0.x - (free_x ? slopes.x * v_j0.z : 0)) * inv_z,
                            v_centre.y * slopes.y + (v_j1.y - (free_y ? slopes.y * v_j1.z : 0)) * inv_z,
                            v_centre.x + (free_x ? 0 : v_j0.z * inv_z), v_centre.y + (free_y ? 0 : v_j1.z * inv_z));
    return v_p;
}

#elif LENS == ORTHOGRAPHIC

static inline real2 lens_centre(const Camera *camera, real3 p) {
    return (real2)(camera->fx * p.x + camera->cx, camera->fy * p.y + camera->cy);
}

static inline bool lens_sees(const Camera *camera, real3 p) {
    return p.z > camera->near;
}

static inline Lens lens(const Camera *camera, real3 p) {
    const Lens l = {(real2)0, (real3)(camera->fx, 0, 0), (real3)(0, camera->fy, 0), p.z, (real3)(0, 0, 1)};
    return l;
}

static inline real3 lens_vjp(const Camera *camera, real3 p, const Lens *l, real2 v_centre, real3 v_j0, real3 v_j1,
                             real v_depth, real4 *v_intrinsics) {
    *v_intrinsics = (real4)(v_centre.x * p.x + v_j0.x, v_centre.y * p.y + v_j1.y, v_centre);
    return (real3)(camera->fx * v_centre.x, camera->fy * v_centre.y, v_depth);
}

#else

// s and its derivatives, which are even in rho: ds = q (x dx + y dy) + h dz; likewise for q (by w and m) and h (by
// m, n).
typedef struct {
    real s, q, h, w, m, n;
} Radial;

static inline Radial radial(const Camera *camera, real3 p) {
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

static inline real2 lens_centre(const Camera *camera, real3 p) {
    const real s = radial(camera, p).s;
    return (real2)(camera->fx * p.x * s + camera->cx, camera->fy * p.y * s + camera->cy);
}

static inline bool lens_sees(const Camera *camera, real3 p) {
    const real r = sqrt(dot3(p, p));
    return r > camera->near && p.z > r * camera->cos_max;
}

static inline Lens lens(const Camera *camera, real3 p) {
    Lens l;
    const Radial f = radial(camera, p);
    const real xyq = p.x * p.y * f.q;
    l.slopes = 0;
    l.j0 = camera->fx * (real3)(f.s + p.x * p.x * f.q, xyq, p.x * f.h);
    l.j1 = camera->fy * (real3)(xyq, f.s + p.y * p.y * f.q, p.y * f.h);
    l.depth = sqrt(dot3(p, p));
    l.onward = p / l.depth;
    return l;
}

static inline real3 lens_vjp(const Camera *camera, real3 p, const Lens *l, real2 v_centre, real3 v_j0, real3 v_j1,
                             real v_depth, real4 *v_intrinsics) {
    const Radial f = radial(camera, p);
    const real2 v = (real2)(camera->fx, camera->fy) * v_centre;
    const real3 a = camera->fx * v_j0, b = camera->fy * v_j1;
    const real ab = a.y + b.x;
    const real v_s = v.x * p.x + v.y * p.y + a.x + b.y;
    const real v_q = a.x * p.x * p.x + ab * p.x * p.y + b.y * p.y * p.y, v_h = a.z * p.x + b.z * p.y;
    const real across = v_s * f.q + v_q * f.w + v_h * f.m;
    *v_intrinsics = (real4)(v_centre.x * p.x * f.s + dot3(v_j0, l->j0) / camera->fx,
                            v_centre.y * p.y * f.s + dot3(v_j1, l->j1) / camera->fy, v_centre);
    return (real3)(v.x * f.s + (2 * a.x * p.x + ab * p.y) * f.q + a.z * f.h + across * p.x,
                   v.y * f.s + (2 * b.y * p.y + ab * p.x) * f.q + b.z * f.h + across * p.y,
                   v_s * f.h + v_q * f.m + v_h * f.n) +
           v_depth * l->onward;
}

#endif

// Size at p, in world units, of one unit in an image with a focal length of one unit; for FISHEYE, on the axis.
static inline real lens_reach(const Camera *camera, real3 p) {
#if LENS == ORTHOGRAPHIC
    return 1;
#else
    return lens(camera, p).depth;
#endif
}

// Direction from which a Gaussian is seen, not normalised: from the camera's centre, or for ORTHOGRAPHIC along the
// axis.
static inline real3 lens_offset(const Camera *camera, real3 mean) {
#if LENS == ORTHOGRAPHIC
    return camera_rotation(camera).row2;
#else
    return mean - (real3)(camera->position[0], camera->position[1], camera->position[2]);
#endif
}

#endif
