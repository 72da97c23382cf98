// 3x3 matrices, rotations from quaternions and their vector-Jacobian products.
// For y = f(x), f_vjp(x, v_y) returns v_x, the gradient with respect to x of a scalar whose gradient with
// respect to y is v_y.
//
// dot3 and cross3 replace built-in functions, which not every driver inlines (common.h).
#ifndef CLSPLAT_LINALG_H
#define CLSPLAT_LINALG_H

static inline real dot3(real3 a, real3 b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline real3 cross3(real3 a, real3 b) {
    return a.yzx * b.zxy - a.zxy * b.yzx;
}

static inline real dot4(real4 a, real4 b) {
    return a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w;
}

typedef struct {
    real3 row0, row1, row2;
} mat3;

static inline real3 mat3_mul(mat3 m, real3 v) {
    return (real3)(dot3(m.row0, v), dot3(m.row1, v), dot3(m.row2, v));
}

static inline real3 mat3_tmul(mat3 m, real3 v) {
    return m.row0 * v.x + m.row1 * v.y + m.row2 * v.z;
}

// a b^T + c d^T
static inline mat3 mat3_outer2(real3 a, real3 b, real3 c, real3 d) {
    mat3 m = {a.x * b + c.x * d, a.y * b + c.y * d, a.z * b + c.z * d};
    return m;
}

static inline real3 normalize_vjp(real3 v, real3 v_unit) {
    const real inv_norm = 1 / sqrt(dot3(v, v));
    const real3 unit = v * inv_norm;
    return (v_unit - unit * dot3(unit, v_unit)) * inv_norm;
}

// Rotation matrix of the unit quaternion q = wxyz (kept in the vector's x, y, z, w in that order).
static inline mat3 rotation_from_quat(real4 q) {
    const real w = q.x, x = q.y, y = q.z, z = q.w;
    mat3 r = {(real3)(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
              (real3)(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
              (real3)(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))};
    return r;
}

static inline real4 rotation_from_quat_vjp(real4 q, mat3 v) {
    const real w = q.x, x = q.y, y = q.z, z = q.w;
    const real3 a = v.row0, b = v.row1, c = v.row2;
    return 2 * (real4)(x * (c.y - b.z) + y * (a.z - c.x) + z * (b.x - a.y),
                       -2 * x * (b.y + c.z) + y * (b.x + a.y) + z * (c.x + a.z) + w * (c.y - b.z),
                       x * (b.x + a.y) - 2 * y * (a.x + c.z) + z * (c.y + b.z) + w * (a.z - c.x),
                       x * (c.x + a.z) + y * (c.y + b.z) - 2 * z * (a.x + b.y) + w * (b.x - a.y));
}

static inline real4 normalize_quat_vjp(real4 q, real4 v_unit) {
    const real inv_norm = 1 / sqrt(dot4(q, q));
    const real4 unit = q * inv_norm;
    return (v_unit - unit * dot4(unit, v_unit)) * inv_norm;
}

#endif
