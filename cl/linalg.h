// Vectors, 3x3 matrices, rotations from quaternions and their vector-Jacobian products, for each lane (lanes.h).
// For y = f(x), f_vjp(x, v_y) returns v_x, the gradient with respect to x of a scalar whose gradient with
// respect to y is v_y.
#ifndef CLSPLAT_LINALG_H
#define CLSPLAT_LINALG_H

#include "lanes.h"

static inline reals3 vector3(reals x, reals y, reals z) {
    const reals3 v = {x, y, z};
    return v;
}

static inline reals4 vector4(reals x, reals y, reals z, reals w) {
    const reals4 v = {x, y, z, w};
    return v;
}

static inline reals dot3(reals3 a, reals3 b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

static inline reals dot4(reals4 a, reals4 b) {
    return a.x * b.x + a.y * b.y + a.z * b.z + a.w * b.w;
}

static inline reals3 cross3(reals3 a, reals3 b) {
    return vector3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

static inline reals3 plus3(reals3 a, reals3 b) {
    return vector3(a.x + b.x, a.y + b.y, a.z + b.z);
}

// Product of the components.
static inline reals3 times3(reals3 a, reals3 b) {
    return vector3(a.x * b.x, a.y * b.y, a.z * b.z);
}

static inline reals3 scaled3(reals s, reals3 a) {
    return vector3(s * a.x, s * a.y, s * a.z);
}

static inline reals4 scaled4(reals s, reals4 a) {
    return vector4(s * a.x, s * a.y, s * a.z, s * a.w);
}

// s a + t b
static inline reals3 combined3(reals s, reals3 a, reals t, reals3 b) {
    return vector3(s * a.x + t * b.x, s * a.y + t * b.y, s * a.z + t * b.z);
}

typedef struct {
    reals3 row0, row1, row2;
} mat3;

static inline reals3 mat3_mul(const mat3 *m, reals3 v) {
    return vector3(dot3(m->row0, v), dot3(m->row1, v), dot3(m->row2, v));
}

static inline reals3 mat3_tmul(const mat3 *m, reals3 v) {
    return vector3(m->row0.x * v.x + m->row1.x * v.y + m->row2.x * v.z,
                   m->row0.y * v.x + m->row1.y * v.y + m->row2.y * v.z,
                   m->row0.z * v.x + m->row1.z * v.y + m->row2.z * v.z);
}

// a b^T + c d^T
static inline mat3 mat3_outer2(reals3 a, reals3 b, reals3 c, reals3 d) {
    const mat3 m = {combined3(a.x, b, c.x, d), combined3(a.y, b, c.y, d), combined3(a.z, b, c.z, d)};
    return m;
}

// m + a b^T
static inline void add_outer(reals3 a, reals3 b, mat3 *m) {
    m->row0 = plus3(m->row0, scaled3(a.x, b));
    m->row1 = plus3(m->row1, scaled3(a.y, b));
    m->row2 = plus3(m->row2, scaled3(a.z, b));
}

static inline reals3 normalized3(reals3 v) {
    const reals norm = ROOTS(dot3(v, v));
    return vector3(v.x / norm, v.y / norm, v.z / norm);
}

static inline reals4 normalized4(reals4 v) {
    const reals norm = ROOTS(dot4(v, v));
    return vector4(v.x / norm, v.y / norm, v.z / norm, v.w / norm);
}

static inline reals3 normalize_vjp(reals3 v, reals3 v_unit) {
    const reals inv_norm = 1 / ROOTS(dot3(v, v));
    const reals3 unit = scaled3(inv_norm, v);
    return combined3(inv_norm, v_unit, -inv_norm * dot3(unit, v_unit), unit);
}

// Rotation matrix of the unit quaternion q = wxyz (kept in the vector's x, y, z, w in that order).
static inline mat3 rotation_from_quat(reals4 q) {
    const reals w = q.x, x = q.y, y = q.z, z = q.w;
    const mat3 r = {vector3(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
                    vector3(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
                    vector3(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))};
    return r;
}

static inline reals4 rotation_from_quat_vjp(reals4 q, const mat3 *v) {
    const reals w = q.x, x = q.y, y = q.z, z = q.w;
    const reals3 a = v->row0, b = v->row1, c = v->row2;
    return scaled4((reals)2, vector4(x * (c.y - b.z) + y * (a.z - c.x) + z * (b.x - a.y),
                                     -2 * x * (b.y + c.z) + y * (b.x + a.y) + z * (c.x + a.z) + w * (c.y - b.z),
                                     x * (b.x + a.y) - 2 * y * (a.x + c.z) + z * (c.y + b.z) + w * (a.z - c.x),
                                     x * (c.x + a.z) + y * (c.y + b.z) - 2 * z * (a.x + b.y) + w * (b.x - a.y)));
}

static inline reals4 normalize_quat_vjp(reals4 q, reals4 v_unit) {
    const reals inv_norm = 1 / ROOTS(dot4(q, q));
    const reals4 unit = scaled4(inv_norm, q);
    const reals along = dot4(unit, v_unit);
    return scaled4(inv_norm, vector4(v_unit.x - along * unit.x, v_unit.y - along * unit.y, v_unit.z - along * unit.z,
                                     v_unit.w - along * unit.w));
}

#endif
